"""A Gaussian process of one skin whose hyperparameters are marginalised over a population of skins.

It is a mixture over the population of kernels (`prior`, `kernel`), weighted by presses left out (`left_out`).

Marginal likelihood misled on real presses, so a kernel's weight is its share of the population times what it is worth
in predicting presses left out: its log density (Student's t, so that one bad press does not decide; pseudo-Bayesian
model averaging, Gelfand and Dey, JRSS B 56, 1994; Yao et al., Bayesian Analysis 13, 2018) and its squared error. Both
are tempered because presses and channels are not independent; the exponents were chosen on simulated skins. Channels
may lean to kernels of their own (one chip may be noisier than the others).

What is best among the presses need not be best where nothing was pressed. So there are two sets of weights: near the
presses by presses left out one by one, and far from them by presses left out with all that lie together. A prediction
takes a weighted mean of both, by its distance from the nearest press.

A few presses cannot tell hundreds of kernels apart, so that the mixture may be worse than a plain Gaussian process of
the same presses. At last it is stacked with that process, channel by channel, near the presses and far from them
(Wolpert, Neural Networks 5, 1992; Breiman, Machine Learning 24, 1996): the squared error of the parts that are left
out, each predicted by weights that it had no part in, decides, with a share of the plain process that falls with the
number of presses.

Kernels whose amplitude falls with the distance from a chip are members once with the chips of the skin's board, and all
kernels once without chips; what is left out weighs the board as it weighs kernels. Of several boards that may be the
skin's, a short list of kernels chooses one by presses left out, and only that one takes part.

Presses that lie far outside their stated errors are given more noise (Student's t errors as a scale mixture; West,
JRSS B 46, 1984), and local heights of the skin, common to all channels, are found from what is left along the slopes
by the load.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp
from scipy.stats import t as student_t

from i2t.leave_one_out import STDS_WITHIN_90
from i2t.skin_models.tip_gp import kernel
from i2t.skin_models.tip_gp.heights import (
    HEIGHT_LENGTHS_M,
    HEIGHT_STDS,
    MIN_HEIGHT_SHARE,
    Heights,
    SlopedErrors,
    height_inverses,
    heights_at,
    hypothesis_shares,
    measured_heights,
)
from i2t.skin_models.tip_gp.kernel import PressGeometry, SkinKernels, squared_distance
from i2t.skin_models.tip_gp.left_out import (
    Conditioned,
    LeftOutPresses,
    Observed,
    condition_all,
    left_out,
    left_out_slopes,
    parts_that_lie_together,
    ungrouped,
)
from i2t.skin_models.tip_gp.members import NO_BOARD, Components, join_members, on_boards, take_members, with_previous
from i2t.skin_models.tip_gp.prior import KernelPrior, load_prior, with_plain
from i2t.types import in_one_line

DENSITY_EXPONENT = 0.3  # of the leave-one-out density, all channels together
ERROR_EXPONENT = 8.0  # of the leave-one-out error, in presses' worth of one channel
CHANNEL_EXPONENT = 0.1  # of a channel's own density, on top
TEMPERING_PRESSES = 5.0  # beyond so many, presses add ever less to what is known of the kernel
# A skin is also asked for where it was not pressed: presses that lie together are left out together, too.
PARTS, MIN_PART_PRESSES = 5, 10
NEAR_PART_SHARE, FAR_PART_SHARE = 0.25, 0.75  # of the worth, by what is left out part by part
BOARD_KERNELS = 32  # by which one of several boards is chosen
# Stacking with the plain process, chosen on simulated skins and on presses of one real skin.
FAR_PLAIN_PRESSES = 2.0  # presses' worth of belief that the population adds nothing far from the presses
STACKING_PARTS = (PARTS, 3)  # ways to cut the presses: large parts are as far from the others as edges of a skin
STACKED_CHANNELS = 4.0  # mean channels' worth of belief that all channels are stacked alike
DENSITY_DOF = 5.0  # of the t that leave-one-out errors are judged by
# Presses that kernels are weighted by, and how many kernels are weighted by them.
STAGES = ((60, 10**9), (150, 64), (400, 24), (10**9, 8))
KEPT_SHARE, MAX_KEPT, MAX_KEPT_OF_MANY, KEEP_FEW_BEYOND = 0.995, 48, 6, 400
TAIL_DOF = 4.0  # of the errors' t
TAIL_LIMIT = 9.0  # mean square of a chip's errors in standard deviations beyond which it is given more noise
MIN_ROBUST_PRESSES = 8
FIRST_HEIGHT_PRESSES = 10
HEIGHT_PASSES, GIVEN_HEIGHT_PASSES = 2, 3  # the second where it is known how rough a skin is
MIN_TYPICAL_LOAD = 1e-9
DEFAULT_SCALING = 1.1  # of the standard deviations, on simulated skins
SCALING_PRESSES = 10.0  # presses' worth of belief in it
SHARED_PRESSES = 30.0  # presses' worth of belief that all channels have one
ALL_ROWS = slice(None)
MIN_FAR_M = 1e-4  # from where weights are those near the presses to where they are those far from them, at least
PREDICT_ROWS = 500  # presses that are predicted at once


@in_one_line
class PressTable(NamedTuple):
    """Presses with all that is known before their readings."""

    position: Float[np.ndarray, "n 2"]  # m, tool frame; zeros where no position is known
    loads: Float[np.ndarray, "n kinds"]  # m of depth, N of force: a column for each kind of load that is known
    previous_mean: Float[np.ndarray, "n c"] | None = None  # uT, as a previous session predicts


@in_one_line
class PopulationGP(NamedTuple):
    """The mixture conditioned on n presses of one skin."""

    presses: PressTable
    readings: Float[np.ndarray, "n c"]  # uT
    chip_positions: Float[np.ndarray, "boards chips 2"] | None  # m
    typical_loads: Float[np.ndarray, " kinds"]  # m or N
    extra_noise: Float[np.ndarray, "n groups"]  # relative variance of presses that are no good
    heights: Heights
    components: Components
    weights: Float[np.ndarray, "k c"]  # near the presses
    far_weights: Float[np.ndarray, "k c"] | None = None  # far from them; None where nothing can be said


def fit_population(
    presses: PressTable,
    readings: Float[np.ndarray, "n c"],
    *,
    load_kinds: tuple[str, ...],
    chip_positions: Float[np.ndarray, "boards chips 2"] | None = None,
    prior: KernelPrior | None = None,
) -> PopulationGP:
    """Weigh the population by the presses of one skin, and condition it on them.

    Args:
        presses: In any order.
        readings: Their readings (uT).
        load_kinds: "depth" or "force", of each column of the loads.
        chip_positions: Positions of the chips (m) of each board that may be the skin's; channels come three for each.
        prior: Kernels of a population; by default those of the package.

    Returns:
        The conditioned mixture. Of several boards, its `chip_positions` are of the one that a short list of kernels
        chose.
    """
    gp = _on_likeliest_board(_start(presses, readings, load_kinds, chip_positions, prior or load_prior()))
    plain = _plain_processes(gp.components)
    gp = _weigh_in_stages(gp)
    if len(readings) >= MIN_ROBUST_PRESSES:
        gp = _with_heavy_tails(gp)
    if load_kinds and len(readings) >= FIRST_HEIGHT_PRESSES:
        gp = _with_heights(gp)
    return _stacked_on_plain(gp, plain)


def fit_one(
    kernels: SkinKernels,
    presses: PressTable,
    readings: Float[np.ndarray, "n c"],
    *,
    typical_load: float,
    chip_positions: Float[np.ndarray, "chips 2"] | None = None,
    height_std: float = 0.0,
    height_length: float = 1.0,
) -> PopulationGP:
    """Condition one kernel, whose hyperparameters are known, on the presses of one skin.

    Args:
        kernels: A stack of one.
        presses: With one load.
        readings: Their readings (uT).
        typical_load: Unit of the kernel's loads (m or N).
        chip_positions: Positions of the chips (m), where the kernel shall know them.
        height_std: Of the skin's local heights (typical loads); 0 where it has none.
        height_length: Over which these change (m).

    Returns:
        A mixture of this kernel alone.
    """
    board, chips = (NO_BOARD, None) if chip_positions is None else (0, chip_positions[None])
    alone = Components(kernels, np.array([0]), np.array([False]), np.zeros(1), np.array([board]))
    gp = _unweighted(presses, readings, alone, np.array([typical_load]), chips)
    for _ in range(GIVEN_HEIGHT_PASSES if height_std else 0):
        gp = gp._replace(
            heights=measured_heights(np.array([height_std]), np.array([height_length]), _sloped_errors(gp))
        )
    return gp


def condition(gp: PopulationGP) -> list[Conditioned]:
    """The systems of a mixture's members, computed from saved values.

    Args:
        gp: The mixture.

    Returns:
        One for each component.
    """
    found: dict[int, Conditioned] = {}
    for rows, at, observed in _alike(gp):
        given = condition_all(kernel.take(gp.components.kernels, rows), at, observed)
        found |= dict(zip(rows.tolist(), given, strict=True))
    return [found[i] for i in range(len(found))]


def predict_population(
    gp: PopulationGP, presses: PressTable, conditioned: list[Conditioned] | None = None
) -> tuple[Float[np.ndarray, "m c"], Float[np.ndarray, "m c"]]:
    """Predict the readings of presses.

    Args:
        gp: The mixture of one skin.
        presses: What is known of the presses.
        conditioned: Its systems, where they are at hand.

    Returns:
        Mean and standard deviation (uT), noise included.
    """
    conditioned = conditioned or condition(gp)
    inverses = height_inverses(gp.heights, gp.presses.position)
    parts = [
        _predict_rows(gp, _rows_of(presses, slice(start, start + PREDICT_ROWS)), conditioned, inverses)
        for start in range(0, len(presses.position), PREDICT_ROWS)
    ]
    mean, variance = (np.concatenate(each) for each in zip(*parts, strict=True))
    return mean, np.sqrt(variance)


def board_shares(gp: PopulationGP) -> Float[np.ndarray, " boards"]:
    """Weight of each board in a mixture.

    Args:
        gp: The mixture.

    Returns:
        Weights, the first that of members that know no chips; they sum to 1.
    """
    boards = 0 if gp.chip_positions is None else len(gp.chip_positions)
    return np.bincount(gp.components.board + 1, _shares(gp), boards + 1)


def interval_scaling(gp: PopulationGP) -> Float[np.ndarray, " c"]:
    """Factors on the standard deviations of a mixture, so that nine in ten readings lie within 1.645 of them.

    From presses left out, each of which is predicted by weights that it took part in (cross-conformal prediction; Vovk,
    Annals of Mathematics and Artificial Intelligence 74, 2015). Because a few presses say little, each channel's factor
    is drawn to that of all channels, and that one to what was found on simulated skins.

    Args:
        gp: The mixture.

    Returns:
        A factor for each channel.
    """
    n, (mean, variance) = len(gp.readings), _left_out_mixture(gp)
    ratios = np.abs(gp.readings - mean) / np.sqrt(variance) / STDS_WITHIN_90
    level = min(0.9 * (n + 1) / n, 1.0)
    together = (n * np.quantile(ratios, level) + SCALING_PRESSES * DEFAULT_SCALING) / (n + SCALING_PRESSES)
    each = n * np.quantile(ratios, level, axis=0) + SHARED_PRESSES * together
    return each / (n + SHARED_PRESSES)


def left_out_errors(gp: PopulationGP) -> Float[np.ndarray, "n c"]:
    """Errors of a mixture on its presses, each predicted from all others with the weights that all gave.

    Args:
        gp: The mixture.

    Returns:
        Measured minus predicted (uT).
    """
    return gp.readings - _left_out_mixture(gp)[0]


# --- the mixture's members and their weights ---


def _start(
    presses: PressTable,
    readings: np.ndarray,
    load_kinds: tuple[str, ...],
    chip_positions: np.ndarray | None,
    prior: KernelPrior,
) -> PopulationGP:
    """All members, not weighted yet."""
    n = len(readings)
    loads = presses.loads if load_kinds else np.ones((n, 1))
    typical = np.maximum(np.sqrt(np.mean(loads**2, axis=0)), MIN_TYPICAL_LOAD)
    presses = presses._replace(loads=loads)
    parts = []
    for column, kind in enumerate(load_kinds or ("force",)):
        found = with_plain(prior, kind, presses.position, loads[:, column] / typical[column], readings)
        parts.append(on_boards(*found, column, 0 if chip_positions is None else len(chip_positions)))
    components = join_members(*parts)
    if presses.previous_mean is not None:
        components = with_previous(components)
    return _unweighted(presses, readings, components, typical, chip_positions)


def _unweighted(
    presses: PressTable,
    readings: np.ndarray,
    components: Components,
    typical_loads: np.ndarray,
    chip_positions: np.ndarray | None,
) -> PopulationGP:
    n, c = readings.shape
    return PopulationGP(
        presses=presses,
        readings=readings,
        chip_positions=chip_positions,
        typical_loads=typical_loads,
        extra_noise=np.zeros((n, c // 3 if c % 3 == 0 else 1)),
        heights=Heights(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(n), np.ones(n)),
        components=components,
        weights=np.ones((len(components.log_share), c)) / len(components.log_share),
    )


def _on_likeliest_board(gp: PopulationGP) -> PopulationGP:
    """Members of one board and those without chips: of several boards the one that a short list of kernels favours."""
    boards, components = 0 if gp.chip_positions is None else len(gp.chip_positions), gp.components
    if boards < 2 or not (components.board != NO_BOARD).any():
        return gp
    # Members of all boards stand in one order, so that the same kernels compete.
    of_board = np.stack([np.flatnonzero(components.board == board) for board in range(boards)])
    common = np.argsort(-components.log_share[of_board[0]], kind="stable")[:BOARD_KERNELS]
    short = _some_presses(_keep(gp, of_board[:, common].ravel()), min(STAGES[0][0], len(gp.readings)))
    near, far = _weights(short, _left_out_all(short))
    board = int(np.argmax(board_shares(short._replace(weights=near, far_weights=far))[1:]))
    gp = _keep(gp, np.flatnonzero((components.board == NO_BOARD) | (components.board == board)))
    own = gp.components.board != NO_BOARD
    log_share = gp.components.log_share + np.where(own, np.log(boards), 0)
    kept = gp.components._replace(board=np.where(own, 0, NO_BOARD), log_share=log_share)
    assert gp.chip_positions is not None
    return gp._replace(components=kept, chip_positions=gp.chip_positions[[board]])


def _weigh_in_stages(gp: PopulationGP) -> PopulationGP:
    """Weigh ever fewer members by ever more presses; those of little weight in the end are dropped."""
    n = len(gp.readings)
    for presses, members in STAGES:
        if len(gp.weights) > members:
            gp = _keep(gp, np.argsort(-_shares(gp), kind="stable")[:members])
        some = _some_presses(gp, min(presses, n))
        near, far = _weights(some, _left_out_all(some))
        gp = gp._replace(weights=near, far_weights=far)
        if presses >= n:
            break
    order = np.argsort(-_shares(gp), kind="stable")
    enough = 1 + int(np.searchsorted(np.cumsum(_shares(gp)[order]), KEPT_SHARE))
    most = MAX_KEPT if n <= KEEP_FEW_BEYOND else MAX_KEPT_OF_MANY
    return _keep(gp, order[: min(enough, most)])


def _shares(gp: PopulationGP) -> np.ndarray:
    """Mean weight (k,) of each member, over channels, near the presses and far from them."""
    far = gp.weights if gp.far_weights is None else gp.far_weights
    return (gp.weights + far).mean(1) / 2


def _keep(gp: PopulationGP, which: np.ndarray) -> PopulationGP:
    def some(weights: np.ndarray) -> np.ndarray:
        return weights[which] / weights[which].sum(0, keepdims=True)

    far = None if gp.far_weights is None else some(gp.far_weights)
    return gp._replace(components=take_members(gp.components, which), weights=some(gp.weights), far_weights=far)


def _some_presses(gp: PopulationGP, count: int) -> PopulationGP:
    """Some presses at random, whatever their order, always the same."""
    some = np.random.default_rng(0).permutation(len(gp.readings))[:count]
    return gp._replace(
        presses=_rows_of(gp.presses, some),
        readings=gp.readings[some],
        extra_noise=gp.extra_noise[some],
        heights=gp.heights._replace(measured=gp.heights.measured[some], variance=gp.heights.variance[some]),
    )


def _rows_of(presses: PressTable, rows: slice | np.ndarray) -> PressTable:
    mean = presses.previous_mean
    return PressTable(presses.position[rows], presses.loads[rows], None if mean is None else mean[rows])


def _weighed(gp: PopulationGP) -> PopulationGP:
    """The mixture with weights by all its presses."""
    near, far = _weights(gp, _left_out_all(gp))
    return gp._replace(weights=near, far_weights=far)


def _trust(gp: PopulationGP) -> np.ndarray:
    """Weight (n, c) of the squared error of each reading: less where it has been given more noise."""
    return np.repeat(1 / (1 + gp.extra_noise), gp.readings.shape[1] // gp.extra_noise.shape[1], axis=1)


def _weights(
    gp: PopulationGP, found: LeftOutPresses, rows: slice | np.ndarray = ALL_ROWS
) -> tuple[np.ndarray, np.ndarray | None]:
    """Weights (k, c) of the members near the presses and far from them by some presses, each channel's summing to 1."""
    trust = _trust(gp)[rows]
    n = len(trust)

    def worth_of(error: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        error, variance = error[:, rows], variance[:, rows]
        std = np.sqrt(np.maximum(variance, 1e-12))
        density = (student_t.logpdf(error / std, DENSITY_DOF) - np.log(std)).sum(1)
        missed = (trust[None] * error**2).sum((1, 2))
        return DENSITY_EXPONENT * density.sum(1) - ERROR_EXPONENT * n / 2 * np.log(np.maximum(missed, 1e-30)), density

    def weights_of(worth: np.ndarray, density: np.ndarray) -> np.ndarray:
        tempered = 1 / (1 + n / TEMPERING_PRESSES)
        each = (gp.components.log_share + tempered * worth)[:, None] + CHANNEL_EXPONENT * density
        return np.exp(each - logsumexp(each, axis=0, keepdims=True))

    alone = worth_of(found.error, found.variance)
    if found.part_error is found.error:
        return weights_of(*alone), None
    together = worth_of(found.part_error, found.part_variance)
    near, far = (
        weights_of(*((1 - share) * one + share * other for one, other in zip(alone, together, strict=True)))
        for share in (NEAR_PART_SHARE, FAR_PART_SHARE)
    )
    return near, far


def _left_out_all(gp: PopulationGP, part: np.ndarray | None = None) -> LeftOutPresses:
    """Errors of all members, by default with the parts of `_parts`."""
    (n, c), components = gp.readings.shape, gp.components
    k = len(components.log_share)
    part = _parts(gp) if part is None else part
    each = [np.empty((k, n, c)), np.empty((k, n, c)), np.empty((k, c))]
    each += each[:2] if part is None else [np.empty((k, n, c)), np.empty((k, n, c))]
    found = LeftOutPresses(*each)
    for rows, at, observed in _alike(gp):
        given = left_out(kernel.take(components.kernels, rows), at, observed, part)
        for into, values in zip(found, given, strict=True):
            into[rows] = values
    return found


def _parts(gp: PopulationGP, parts: int = PARTS) -> np.ndarray | None:
    """Presses that are left out together, because they lie together; None where they are few or all at one place."""
    position = gp.presses.position
    if len(position) < MIN_PART_PRESSES or not np.ptp(position, axis=0).any():
        return None
    return parts_that_lie_together(position, parts)


def _alike(gp: PopulationGP) -> Iterator[tuple[np.ndarray, PressGeometry, Observed]]:
    """Numbers of members that see the same inputs, and these inputs."""
    components = gp.components
    which = np.column_stack([components.load_column, components.uses_previous, components.board])
    presses = _raised(gp, gp.presses, _own_heights(gp))
    for combination in np.unique(which, axis=0):
        rows = np.flatnonzero((which == combination).all(1))
        column, previous, board = combination
        yield rows, _geometry(gp, presses, int(column), int(board)), _observed(gp, bool(previous))


def _raised(gp: PopulationGP, presses: PressTable, height: np.ndarray) -> PressTable:
    """Presses with local heights (typical loads) added to their loads of the first kind."""
    first = presses.loads[:, 0] + height * gp.typical_loads[0]
    return presses._replace(loads=np.column_stack([first, presses.loads[:, 1:]]))


def _geometry(gp: PopulationGP, presses: PressTable, column: int, board: int) -> PressGeometry:
    load = presses.loads[:, column] / gp.typical_loads[column]
    if board == NO_BOARD:
        return kernel.geometry(presses.position, load, None)
    assert gp.chip_positions is not None
    return kernel.geometry(presses.position, load, gp.chip_positions[board])


def _observed(gp: PopulationGP, previous: bool) -> Observed:
    target = gp.readings
    if previous:
        assert gp.presses.previous_mean is not None
        target = target - gp.presses.previous_mean
    return Observed(target, gp.extra_noise if gp.extra_noise.any() else gp.extra_noise[:, :1])


def _mixed(gp: PopulationGP, found: LeftOutPresses) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance (n, c) of presses left out."""
    error = np.einsum("kc,knc->nc", gp.weights, found.error)
    spread = found.variance + (found.error - error[None]) ** 2
    return gp.readings - error, np.einsum("kc,knc->nc", gp.weights, spread)


def _left_out_mixture(gp: PopulationGP) -> tuple[np.ndarray, np.ndarray]:
    """Each press as predicted from all others, with the weights that all presses gave."""
    return _mixed(gp, _left_out_all(gp))


# --- heavy tails ---


def _with_heavy_tails(gp: PopulationGP) -> PopulationGP:
    """Mixture with more noise for chips of presses far outside their stated errors, and new weights."""
    n, c = gp.readings.shape
    groups = gp.extra_noise.shape[1]
    each = c // groups
    found = _left_out_all(gp)
    mean, variance = _mixed(gp, found)
    square = ((gp.readings - mean) ** 2 / variance).reshape(n, groups, each).mean(2)
    ratio = (TAIL_DOF + each * square) / (TAIL_DOF + each)
    far = square > TAIL_LIMIT
    if not far.any():
        return gp
    scale = np.einsum("kc,kc->c", gp.weights, found.scale)
    relative = (variance / scale[None] ** 2).reshape(n, groups, each).mean(2)
    gp = gp._replace(extra_noise=np.where(far, (ratio - 1) * relative, 0.0))
    return _weighed(gp)


# --- local heights of the skin ---


def _with_heights(gp: PopulationGP) -> PopulationGP:
    """Loads corrected by local heights, as far as they explain errors of presses left out."""
    std, length = (
        np.array(part) for part in zip(*((s, x) for x in HEIGHT_LENGTHS_M for s in HEIGHT_STDS), strict=True)
    )
    for _ in range(HEIGHT_PASSES):
        left_out = _sloped_errors(gp)
        tried = measured_heights(std, length, left_out)
        share = hypothesis_shares(tried, gp.presses.position, left_out)
        kept = share > MIN_HEIGHT_SHARE
        if not kept.any():
            return gp
        gp = gp._replace(heights=tried._replace(std=std[kept], length=length[kept], share=share[kept]))
        gp = _weighed(gp)
    return gp


def _sloped_errors(gp: PopulationGP) -> SlopedErrors:
    """The mixture's presses left out, with slopes by the first load."""
    mean, variance = _left_out_mixture(gp)
    slopes = np.zeros((len(gp.weights), *gp.readings.shape))
    for rows, at, observed in _alike(gp):
        if gp.components.load_column[rows[0]] == 0:
            slopes[rows] = left_out_slopes(kernel.take(gp.components.kernels, rows), at, observed)
    slope = np.einsum("kc,knc->nc", gp.weights, slopes)
    return SlopedErrors(gp.readings - mean, variance, slope, _own_heights(gp))


def _own_heights(gp: PopulationGP) -> np.ndarray:
    """Heights at the mixture's presses (typical loads)."""
    position = gp.presses.position
    if not len(gp.heights.std):
        return np.zeros(len(position))
    return heights_at(gp.heights, squared_distance(position, position), height_inverses(gp.heights, position))[0]


# --- stacking with the plain process ---


def _plain_processes(components: Components) -> Components:
    """The plain process that is fitted to the presses, by each kind of load: the last without chips (`with_plain`)."""
    alone = (components.board == NO_BOARD) & ~components.uses_previous
    columns = np.unique(components.load_column)
    return take_members(
        components, np.array([np.flatnonzero(alone & (components.load_column == i))[-1] for i in columns])
    )


def _stacked_on_plain(gp: PopulationGP, plain: Components) -> PopulationGP:
    """The mixture with the best plain process as a last member, whose weight is by what the others add to it on parts
    that are left out; the mixture itself where the presses are too few for parts.
    """
    cuts = [part for part in (_parts(gp, parts) for parts in STACKING_PARTS) if part is not None]
    if not cuts:
        return gp
    near, far = zip(*(_errors_by_other_parts(gp, part) for part in cuts), strict=True)
    alone = [_left_out_all(gp._replace(components=plain), part) for part in cuts]
    best = int(np.argmin(sum((_trust(gp) * left_out.part_error**2).sum((1, 2)) for left_out in alone)))
    near_share = _stacking_share(gp, np.stack(near), np.stack([left_out.error[best] for left_out in alone]), 0.0)
    plain_far = np.stack([left_out.part_error[best] for left_out in alone])
    far_share = _stacking_share(gp, np.stack(far), plain_far, FAR_PLAIN_PRESSES)
    far_weights = gp.weights if gp.far_weights is None else gp.far_weights
    return gp._replace(
        components=join_members(gp.components, take_members(plain, np.array([best]))),
        weights=np.vstack([near_share * gp.weights, 1 - near_share]),
        far_weights=np.vstack([far_share * far_weights, 1 - far_share]),
    )


def _errors_by_other_parts(gp: PopulationGP, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, c) of the mixture on presses left out alone, and with their part, by the weights of other parts."""
    left_out = _left_out_all(gp, part)
    alone, together = np.empty_like(gp.readings), np.empty_like(gp.readings)
    for i in range(part.max() + 1):
        rows = part == i
        near, far = _weights(gp, left_out, ~rows)
        alone[rows] = np.einsum("kc,knc->nc", near, left_out.error[:, rows])
        together[rows] = np.einsum("kc,knc->nc", near if far is None else far, left_out.part_error[:, rows])
    return alone, together


def _stacking_share(gp: PopulationGP, error: np.ndarray, plain_error: np.ndarray, plain_presses: float) -> np.ndarray:
    """Share (c,) of the mixture in the sum of it and the plain process whose squared error is the least.

    Args:
        gp: The mixture.
        error: Its errors (cuts, n, c) (uT), for each way to cut the presses into parts.
        plain_error: Those of the plain process, likewise.
        plain_presses: Presses' worth of belief that the mixture adds nothing: the share is at most n / (n + this).

    Returns:
        A share between 0 and 1 for each channel, drawn to that of all channels.
    """
    apart, trust = plain_error - error, _trust(gp)
    gained, spread = (trust * plain_error * apart).sum((0, 1)), (trust * apart**2).sum((0, 1))
    most = len(gp.readings) / (len(gp.readings) + plain_presses)
    spread = np.maximum(spread / most, 1e-12)
    shared = np.clip(gained.sum() / spread.sum(), 0, most)
    belief = STACKED_CHANNELS * spread.mean()
    return np.clip((gained + belief * shared) / (spread + belief), 0, most)


# --- prediction ---


def _predict_rows(
    gp: PopulationGP, presses: PressTable, conditioned: list[Conditioned], inverses: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance (m, c) of a few presses."""
    m, c = len(presses.position), gp.readings.shape[1]
    away = squared_distance(presses.position, gp.presses.position)
    height, height_variance = heights_at(gp.heights, away, inverses)
    loads = presses.loads if gp.presses.loads.shape[1] == presses.loads.shape[1] else np.ones((m, 1))
    presses = _raised(gp, presses._replace(loads=loads), height)
    between = squared_distance(gp.presses.position, gp.presses.position)
    fitted = _raised(gp, gp.presses, heights_at(gp.heights, between, inverses)[0])
    mean, square = np.zeros((m, c)), np.zeros((m, c))
    slope, far = np.zeros((m, c)), _farness(gp, presses.position)[:, None]
    far_weights = gp.weights if gp.far_weights is None else gp.far_weights
    for i, given in enumerate(conditioned):
        weight = (1 - far) * gp.weights[i] + far * far_weights[i]
        own_mean, own_variance, own_slope = _predict_one(gp, i, given, presses, fitted)
        mean += weight * own_mean
        square += weight * (own_variance + own_mean**2)
        slope += weight * own_slope
    variance = np.maximum(square - mean**2, 0) + slope**2 * height_variance[:, None]
    return mean, np.maximum(variance, 1e-12)


def _farness(gp: PopulationGP, position: np.ndarray) -> np.ndarray:
    """Farness (m,): 0 for positions as near to a press as presses are to each other, to 1 for those as far as presses
    are from all that are not of their part.
    """
    known, part = gp.presses.position, _parts(gp)
    if part is None:
        return np.zeros(len(position))
    between = squared_distance(known, known)
    alone = np.where(np.eye(len(known), dtype=bool), np.inf, between)
    apart = np.where(part[:, None] == part, np.inf, between)
    near, far = (float(np.median(np.sqrt(square.min(1)))) for square in (alone, apart))
    distance = np.sqrt(squared_distance(position, known).min(1))
    return np.clip((distance - near) / max(far - near, MIN_FAR_M), 0, 1)


def _predict_one(
    gp: PopulationGP, i: int, given: Conditioned, presses: PressTable, raised: PressTable
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, variance and slope by the first load (m, c) of one member, from its own presses with their heights."""
    member = take_members(gp.components, np.array([i]))
    column, board = int(member.load_column[0]), int(member.board[0])
    at, fitted_at = _geometry(gp, presses, column, board), _geometry(gp, raised, column, board)
    groups = len(given.inverse)
    cross = np.broadcast_to(
        kernel.signal_covariances(member.kernels, at, fitted_at)[0], (groups, len(at.load), len(fitted_at.load))
    )
    weights = given.weights.reshape(len(fitted_at.load), groups, -1).swapaxes(0, 1)
    mean = ungrouped(cross @ weights)
    explained = np.einsum("gmn,gmn->gm", cross @ given.inverse, cross)
    own = kernel.signal_variances(member.kernels, at)[0] + kernel.noise_variances(member.kernels, at)[0]
    variance = np.maximum(own - explained, kernel.noise_variances(member.kernels, at)[0])
    variance = np.repeat(variance, mean.shape[1] // len(variance), axis=0).T
    slope = np.zeros_like(mean)
    if len(gp.heights.std) and column == 0:
        change = np.broadcast_to(kernel.load_slopes(member.kernels, at, fitted_at)[0], cross.shape)
        slope = ungrouped(change @ weights)
    if member.uses_previous[0]:
        assert presses.previous_mean is not None
        mean = mean + presses.previous_mean
    return mean, variance * given.scale[None] ** 2, slope
