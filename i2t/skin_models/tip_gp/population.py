"""Gaussian process of one skin whose hyperparameters are marginalised over a population of skins.

The model is a mixture over the kernels of the population (`prior`, `kernel`), weighted by leave-one-out errors
(`leave_one_out`).

Marginal likelihood was misleading on real presses. The weight of a kernel is therefore its share of the population
times two leave-one-out scores: the log density (Student's t, so that one bad press does not decide; pseudo-Bayesian
model averaging, Gelfand and Dey, JRSS B 56, 1994; Yao et al., Bayesian Analysis 13, 2018) and the squared error. Both
are tempered, because presses and channels are not independent. Each channel may favour kernels of its own, since one
chip may be noisier than the others.

The kernel that is best among the presses may not be the best far from them. There are therefore two sets of weights:
near the presses, mainly from presses left out one by one; far from them, mainly from presses left out together with
their neighbours. A prediction uses a weighted mean of both, by its distance from the nearest press.

A few presses cannot distinguish hundreds of kernels, and the mixture may then be worse than a plain Gaussian process.
It is therefore stacked with that process, channel by channel, near the presses and far from them (Wolpert, Neural
Networks 5, 1992; Breiman, Machine Learning 24, 1996). The share of each is chosen by the squared error of parts left
out, each predicted with weights that were computed without it. The plain process keeps a share that falls with the
number of presses.

Kernels whose amplitude falls with the distance from a chip are members twice: with the chips of the skin's board and
without chips. Leave-one-out errors weigh the board as they weigh kernels. If several boards are possible, a short list
of kernels chooses one of them by leave-one-out errors, and only that board takes part.

Presses far outside their stated errors are given more noise (Student's t errors as a scale mixture; West, JRSS B 46,
1984). Local heights of the skin, common to all channels, are estimated from the errors along the slopes by the load.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp
from scipy.stats import t as student_t

from i2t.leave_one_out import STDS_WITHIN_90
from i2t.skin_models.tip_gp import kernel
from i2t.skin_models.tip_gp.heights import (
    ROUGHNESS,
    Heights,
    SlopedErrors,
    height_inverses,
    heights_at,
    hypothesis_shares,
    measured_heights,
)
from i2t.skin_models.tip_gp.kernel import PressGeometry, SkinKernels, squared_distance
from i2t.skin_models.tip_gp.leave_one_out import (
    Conditioned,
    LeaveOneOutPresses,
    Observed,
    condition_all,
    leave_one_out,
    leave_one_out_slopes,
    spatial_parts,
    ungrouped,
)
from i2t.skin_models.tip_gp.members import (
    NO_CHIP_POSITIONS,
    Components,
    add_previous_session,
    join_members,
    kernels_on_boards,
    take_members,
)
from i2t.skin_models.tip_gp.prior import KernelPrior, add_plain_members, load_prior
from i2t.types import in_one_line


@dataclass(frozen=True)
class Weighting:
    """Options for weighting a mixture's kernels by leave-one-out errors; exponents were chosen on simulated skins."""

    density_exponent: float = 0.3  # exponent of the leave-one-out density of all channels together
    error_exponent: float = 8.0  # exponent of the leave-one-out error, in presses of one channel
    channel_exponent: float = 0.1  # additional exponent of a channel's own density
    tempering_presses: float = 5.0  # number of presses beyond which further presses add less and less
    density_dof: float = 5.0  # degrees of freedom of the t distribution of leave-one-out errors
    # Presses that lie together are also left out together, as a test of positions far from all presses.
    parts: int = 5
    min_part_presses: int = 10
    near_part_share: float = 0.25  # share of the score from parts left out, for weights near the presses
    far_part_share: float = 0.75  # share of the score from parts left out, for weights far from the presses
    min_far_distance: float = 1e-4  # m, minimum distance between positions with near and with far weights


@dataclass(frozen=True)
class Selection:
    """Options for selecting the mixture's members, in stages of more presses and fewer kernels."""

    # (presses, members) of each stage
    stages: tuple[tuple[int, int], ...] = ((60, 10**9), (150, 64), (400, 24), (10**9, 8))
    kept_share: float = 0.995  # share of the members' weight that is kept at the end
    max_members: int = 48
    many_presses: int = 400  # number of presses above which fewer members are kept
    max_members_of_many: int = 6
    board_kernels: int = 32  # number of kernels that choose one of several boards


@dataclass(frozen=True)
class Stacking:
    """Options for stacking with the plain process, chosen on simulated skins and on presses of one real skin."""

    # number of prior presses, far from the others, for which the population adds nothing
    far_plain_presses: float = 2.0
    parts: tuple[int, ...] = (5, 3)  # numbers of parts; larger parts resemble the edges of a skin
    prior_channels: float = 4.0  # weight, in mean channels, of the part of the shares that all channels have in common


@dataclass(frozen=True)
class IntervalScaling:
    """Prior of the factor by which predicted standard deviations are scaled to have the right coverage."""

    factor: float = 1.1  # factor on the standard deviations that was found on simulated skins
    prior_presses: float = 10.0  # weight of `factor`, in presses
    shared_presses: float = 30.0  # weight, in presses, of a factor common to all channels


@dataclass(frozen=True)
class MixtureConfig:
    """All options of the mixture of Gaussian processes that models one skin."""

    weighting: Weighting = Weighting()
    selection: Selection = Selection()
    stacking: Stacking = Stacking()
    scaling: IntervalScaling = IntervalScaling()
    tail_dof: float = 4.0  # degrees of freedom of the errors' t distribution
    tail_limit: float = 9.0  # mean squared error of a chip, in variances, above which it is given more noise
    min_robust_presses: int = 8
    min_height_presses: int = 10
    height_passes: int = 2
    given_height_passes: int = 3  # number of passes if the roughness of the skin is given


_MIXTURE = MixtureConfig()  # default choices of the mixture of Gaussian processes


@in_one_line
class PressTable(NamedTuple):
    """Positions (m) and loads (m or N) of n presses, and an earlier session's predictions (uT) of their readings."""

    position: Float[np.ndarray, "n 2"]  # m, tool frame; zeros if no position is known
    loads: Float[np.ndarray, "n kinds"]  # m of travel, N of force; one column for each known kind of load
    previous_mean: Float[np.ndarray, "n c"] | None = None  # uT, prediction of a previous session


@in_one_line
class PopulationGP(NamedTuple):
    """Mixture of Gaussian processes that predicts readings of a tip on one skin, conditioned on n presses."""

    presses: PressTable
    readings: Float[np.ndarray, "n c"]  # uT
    chip_positions: Float[np.ndarray, "boards chips 2"] | None  # m
    typical_loads: Float[np.ndarray, " kinds"]  # m or N
    extra_noise: Float[np.ndarray, "n groups"]  # additional relative variance of outlying presses
    heights: Heights
    components: Components
    weights: Float[np.ndarray, "k c"]  # weights of the members near the presses
    # weights of the members far from the presses; None if the presses are too few
    far_weights: Float[np.ndarray, "k c"] | None = None


def fit_population(
    presses: PressTable,
    readings: Float[np.ndarray, "n c"],
    *,
    load_kinds: tuple[str, ...],
    chip_positions: Float[np.ndarray, "boards chips 2"] | None = None,
    prior: KernelPrior | None = None,
) -> PopulationGP:
    """Weigh the kernels of a population by the presses of one skin, and condition the mixture on them.

    Args:
        presses: n presses in any order.
        readings: `(n, c)` readings of the presses (uT).
        load_kinds: "travel" or "force" for each column of the loads.
        chip_positions: `(boards, chips, 2)` chip positions (m) of each board that the skin may have. Each chip has
            three successive channels.
        prior: Kernels of a population; by default those of the package.

    Returns:
        The conditioned mixture. If several boards were given, its `chip_positions` are those of the chosen one.
    """
    gp = _on_likeliest_board(_unweighted_members(presses, readings, load_kinds, chip_positions, prior or load_prior()))
    plain = _plain_processes(gp.components)
    gp = _weigh_in_stages(gp)
    if len(readings) >= _MIXTURE.min_robust_presses:
        gp = _with_heavy_tails(gp)
    if load_kinds and len(readings) >= _MIXTURE.min_height_presses:
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
    """Condition one kernel with given hyperparameters on the presses of one skin.

    Args:
        kernels: A stack of one kernel.
        presses: n presses with one load each.
        readings: `(n, c)` readings of the presses (uT).
        typical_load: Unit of the kernel's loads (m or N).
        chip_positions: `(chips, 2)` chip positions (m), if the kernel uses them.
        height_std: Standard deviation of the skin's local heights (typical loads); 0 for a flat skin.
        height_length: Correlation length of the heights (m).

    Returns:
        A mixture of this kernel alone.
    """
    board, chips = (NO_CHIP_POSITIONS, None) if chip_positions is None else (0, chip_positions[None])
    alone = Components(kernels, np.array([0]), np.array([False]), np.zeros(1), np.array([board]))
    gp = _unweighted(presses, readings, alone, np.array([typical_load]), chips)
    for _ in range(_MIXTURE.given_height_passes if height_std else 0):
        gp = gp._replace(
            heights=measured_heights(np.array([height_std]), np.array([height_length]), _sloped_errors(gp))
        )
    return gp


def condition(gp: PopulationGP) -> list[Conditioned]:
    """Condition each member of a mixture on its presses; the resulting linear systems are not saved with it.

    Args:
        gp: The mixture.

    Returns:
        One system for each component.
    """
    systems: dict[int, Conditioned] = {}
    for rows, at, observed in _groups_by_input(gp):
        group = condition_all(kernel.take(gp.components.kernels, rows), at, observed)
        systems |= dict(zip(rows.tolist(), group, strict=True))
    return [systems[i] for i in range(len(systems))]


def predict_population(
    gp: PopulationGP, presses: PressTable, conditioned: list[Conditioned] | None = None, *, batch_size: int = 500
) -> tuple[Float[np.ndarray, "m c"], Float[np.ndarray, "m c"]]:
    """Predict the readings of presses by the mixture of one skin.

    Args:
        gp: The mixture of one skin.
        presses: m presses, without readings.
        conditioned: The result of `condition`, if it is available.
        batch_size: Number of presses that are predicted at once.

    Returns:
        `(m, c)` means and standard deviations of the readings (uT), noise included.
    """
    conditioned = conditioned or condition(gp)
    inverses = height_inverses(gp.heights, gp.presses.position)
    parts = [
        _predict_rows(gp, _rows_of(presses, slice(start, start + batch_size)), conditioned, inverses)
        for start in range(0, len(presses.position), batch_size)
    ]
    mean, variance = (np.concatenate(part) for part in zip(*parts, strict=True))
    return mean, np.sqrt(variance)


def board_shares(gp: PopulationGP) -> Float[np.ndarray, " boards"]:
    """Compute the weight of the members that use each board's chip positions in a mixture.

    Args:
        gp: The mixture.

    Returns:
        `(boards + 1,)` weights that sum to 1; the first is that of members without chips.
    """
    boards = 0 if gp.chip_positions is None else len(gp.chip_positions)
    return np.bincount(gp.components.board + 1, _shares(gp), boards + 1)


def interval_scaling(gp: PopulationGP) -> Float[np.ndarray, " c"]:
    """Compute factors on predicted standard deviations, so that nine in ten readings lie within 1.645 of them.

    The factors come from leave-one-out errors, each predicted with weights that its own press took part in
    (cross-conformal prediction; Vovk, Annals of Mathematics and Artificial Intelligence 74, 2015). Because a few
    presses are uncertain evidence, each channel's factor is shrunk towards that of all channels, which is shrunk
    towards the one found on simulated skins.

    Args:
        gp: The mixture.

    Returns:
        `(c,)` factors, one for each channel.
    """
    prior = _MIXTURE.scaling
    n, (mean, variance) = len(gp.readings), _leave_one_out_mixture(gp)
    ratios = np.abs(gp.readings - mean) / np.sqrt(variance) / STDS_WITHIN_90
    level = min(0.9 * (n + 1) / n, 1.0)
    together = (n * np.quantile(ratios, level) + prior.prior_presses * prior.factor) / (n + prior.prior_presses)
    by_channel = n * np.quantile(ratios, level, axis=0) + prior.shared_presses * together
    return by_channel / (n + prior.shared_presses)


def leave_one_out_errors(gp: PopulationGP) -> Float[np.ndarray, "n c"]:
    """Compute a mixture's leave-one-out errors on its presses, with the members' weights from all presses.

    Args:
        gp: The mixture.

    Returns:
        `(n, c)` measured minus predicted readings (uT).
    """
    return gp.readings - _leave_one_out_mixture(gp)[0]


# --- members of the mixture and their weights ---


def _unweighted_members(
    presses: PressTable,
    readings: np.ndarray,
    load_kinds: tuple[str, ...],
    chip_positions: np.ndarray | None,
    prior: KernelPrior,
) -> PopulationGP:
    """Build the mixture of all members with equal weights."""
    n = len(readings)
    loads = presses.loads if load_kinds else np.ones((n, 1))
    typical = np.maximum(np.sqrt(np.mean(loads**2, axis=0)), 1e-9)
    presses = presses._replace(loads=loads)
    parts = []
    for column, kind in enumerate(load_kinds or ("force",)):
        kernels, log_share = add_plain_members(
            prior, kind, presses.position, loads[:, column] / typical[column], readings
        )
        parts.append(
            kernels_on_boards(kernels, log_share, column, 0 if chip_positions is None else len(chip_positions))
        )
    components = join_members(*parts)
    if presses.previous_mean is not None:
        components = add_previous_session(components)
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
    """Keep the members of one board and those without chips. A short list of kernels chooses the board."""
    boards, components = 0 if gp.chip_positions is None else len(gp.chip_positions), gp.components
    if boards < 2 or not (components.board != NO_CHIP_POSITIONS).any():
        return gp
    # Members of all boards are in the same order, so the same kernels compete.
    of_board = np.stack([np.flatnonzero(components.board == board) for board in range(boards)])
    common = np.argsort(-components.log_share[of_board[0]], kind="stable")[: _MIXTURE.selection.board_kernels]
    short_list = _select_members(gp, of_board[:, common].ravel())
    short = _subsample(short_list, min(_MIXTURE.selection.stages[0][0], len(gp.readings)))
    near, far = _weights(short, _leave_one_out_all(short))
    board = int(np.argmax(board_shares(short._replace(weights=near, far_weights=far))[1:]))
    gp = _select_members(gp, np.flatnonzero((components.board == NO_CHIP_POSITIONS) | (components.board == board)))
    own = gp.components.board != NO_CHIP_POSITIONS
    log_share = gp.components.log_share + np.where(own, np.log(boards), 0)
    kept = gp.components._replace(board=np.where(own, 0, NO_CHIP_POSITIONS), log_share=log_share)
    assert gp.chip_positions is not None
    return gp._replace(components=kept, chip_positions=gp.chip_positions[[board]])


def _weigh_in_stages(gp: PopulationGP) -> PopulationGP:
    """Weigh fewer and fewer members by more and more presses, and drop those of little weight at the end."""
    n, selection = len(gp.readings), _MIXTURE.selection
    for presses, members in selection.stages:
        if len(gp.weights) > members:
            gp = _select_members(gp, np.argsort(-_shares(gp), kind="stable")[:members])
        some = _subsample(gp, min(presses, n))
        near, far = _weights(some, _leave_one_out_all(some))
        gp = gp._replace(weights=near, far_weights=far)
        if presses >= n:
            break
    order = np.argsort(-_shares(gp), kind="stable")
    enough = 1 + int(np.searchsorted(np.cumsum(_shares(gp)[order]), selection.kept_share))
    limit = selection.max_members if n <= selection.many_presses else selection.max_members_of_many
    return _select_members(gp, order[: min(enough, limit)])


def _shares(gp: PopulationGP) -> np.ndarray:
    """Compute the mean weight (k,) of each member over channels, near the presses and far from them."""
    far = gp.weights if gp.far_weights is None else gp.far_weights
    return (gp.weights + far).mean(1) / 2


def _select_members(gp: PopulationGP, which: np.ndarray) -> PopulationGP:
    def some(weights: np.ndarray) -> np.ndarray:
        return weights[which] / weights[which].sum(0, keepdims=True)

    far = None if gp.far_weights is None else some(gp.far_weights)
    return gp._replace(components=take_members(gp.components, which), weights=some(gp.weights), far_weights=far)


def _subsample(gp: PopulationGP, count: int) -> PopulationGP:
    """Take a random subset of the presses, the same in each call."""
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


def _reweighted(gp: PopulationGP) -> PopulationGP:
    """Weigh the members by all presses of the mixture."""
    near, far = _weights(gp, _leave_one_out_all(gp))
    return gp._replace(weights=near, far_weights=far)


def _reading_weights(gp: PopulationGP) -> np.ndarray:
    """Compute the weight (n, c) of each reading's squared error, which falls with the reading's additional noise."""
    return np.repeat(1 / (1 + gp.extra_noise), gp.readings.shape[1] // gp.extra_noise.shape[1], axis=1)


def _weights(
    gp: PopulationGP, held_out: LeaveOneOutPresses, rows: slice | np.ndarray = slice(None)
) -> tuple[np.ndarray, np.ndarray | None]:
    """Weigh the members by some presses: weights (k, c) near the presses and far from them, 1 in sum per channel."""
    weighting = _MIXTURE.weighting
    trust = _reading_weights(gp)[rows]
    n = len(trust)

    def score(error: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        error, variance = error[:, rows], variance[:, rows]
        std = np.sqrt(np.maximum(variance, 1e-12))
        density = (student_t.logpdf(error / std, weighting.density_dof) - np.log(std)).sum(1)
        missed = (trust[None] * error**2).sum((1, 2))
        by_error = weighting.error_exponent * n / 2 * np.log(np.maximum(missed, 1e-30))
        return weighting.density_exponent * density.sum(1) - by_error, density

    def weights_of(total: np.ndarray, density: np.ndarray) -> np.ndarray:
        tempered = 1 / (1 + n / weighting.tempering_presses)
        by_channel = (gp.components.log_share + tempered * total)[:, None] + weighting.channel_exponent * density
        return np.exp(by_channel - logsumexp(by_channel, axis=0, keepdims=True))

    alone = score(held_out.error, held_out.variance)
    if held_out.part_error is held_out.error:
        return weights_of(*alone), None
    together = score(held_out.part_error, held_out.part_variance)
    near, far = (
        weights_of(*((1 - share) * single + share * part for single, part in zip(alone, together, strict=True)))
        for share in (weighting.near_part_share, weighting.far_part_share)
    )
    return near, far


def _leave_one_out_all(gp: PopulationGP, part: np.ndarray | None = None) -> LeaveOneOutPresses:
    """Compute the leave-one-out errors of all members, by default with the parts of `_parts`."""
    (n, c), components = gp.readings.shape, gp.components
    k = len(components.log_share)
    part = _parts(gp) if part is None else part
    arrays = [np.empty((k, n, c)), np.empty((k, n, c)), np.empty((k, c))]
    arrays += arrays[:2] if part is None else [np.empty((k, n, c)), np.empty((k, n, c))]
    result = LeaveOneOutPresses(*arrays)
    for rows, at, observed in _groups_by_input(gp):
        group = leave_one_out(kernel.take(components.kernels, rows), at, observed, part)
        for into, values in zip(result, group, strict=True):
            into[rows] = values
    return result


def _parts(gp: PopulationGP, parts: int = _MIXTURE.weighting.parts) -> np.ndarray | None:
    """Group presses that lie together and are left out together. Return None if they are few or all at one place."""
    position = gp.presses.position
    if len(position) < _MIXTURE.weighting.min_part_presses or not np.ptp(position, axis=0).any():
        return None
    return spatial_parts(position, parts)


def _groups_by_input(gp: PopulationGP) -> Iterator[tuple[np.ndarray, PressGeometry, Observed]]:
    """Group the members by their inputs, and yield the numbers of each group with its inputs."""
    components = gp.components
    which = np.column_stack([components.load_column, components.uses_previous, components.board])
    presses = _add_heights(gp, gp.presses, _heights_at_presses(gp))
    for combination in np.unique(which, axis=0):
        rows = np.flatnonzero((which == combination).all(1))
        column, previous, board = combination
        yield rows, _geometry(gp, presses, int(column), int(board)), _observed(gp, bool(previous))


def _add_heights(gp: PopulationGP, presses: PressTable, height: np.ndarray) -> PressTable:
    """Add local heights (typical loads) to the first load of presses."""
    first = presses.loads[:, 0] + height * gp.typical_loads[0]
    return presses._replace(loads=np.column_stack([first, presses.loads[:, 1:]]))


def _geometry(gp: PopulationGP, presses: PressTable, column: int, board: int) -> PressGeometry:
    load = presses.loads[:, column] / gp.typical_loads[column]
    if board == NO_CHIP_POSITIONS:
        return kernel.geometry(presses.position, load, None)
    assert gp.chip_positions is not None
    return kernel.geometry(presses.position, load, gp.chip_positions[board])


def _observed(gp: PopulationGP, previous: bool) -> Observed:
    target = gp.readings
    if previous:
        assert gp.presses.previous_mean is not None
        target = target - gp.presses.previous_mean
    return Observed(target, gp.extra_noise if gp.extra_noise.any() else gp.extra_noise[:, :1])


def _mixed(gp: PopulationGP, held_out: LeaveOneOutPresses) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mixture's means and variances (n, c) of presses left out."""
    error = np.einsum("kc,knc->nc", gp.weights, held_out.error)
    spread = held_out.variance + (held_out.error - error[None]) ** 2
    return gp.readings - error, np.einsum("kc,knc->nc", gp.weights, spread)


def _leave_one_out_mixture(gp: PopulationGP) -> tuple[np.ndarray, np.ndarray]:
    """Predict each press from all others, with the weights that all presses gave."""
    return _mixed(gp, _leave_one_out_all(gp))


# --- heavy tails ---


def _with_heavy_tails(gp: PopulationGP) -> PopulationGP:
    """Give more noise to chips of presses far outside their stated errors, and weigh the members again."""
    n, c = gp.readings.shape
    groups = gp.extra_noise.shape[1]
    channels = c // groups
    held_out = _leave_one_out_all(gp)
    mean, variance = _mixed(gp, held_out)
    square = ((gp.readings - mean) ** 2 / variance).reshape(n, groups, channels).mean(2)
    ratio = (_MIXTURE.tail_dof + channels * square) / (_MIXTURE.tail_dof + channels)
    outlying = square > _MIXTURE.tail_limit
    if not outlying.any():
        return gp
    scale = np.einsum("kc,kc->c", gp.weights, held_out.scale)
    relative = (variance / scale[None] ** 2).reshape(n, groups, channels).mean(2)
    gp = gp._replace(extra_noise=np.where(outlying, (ratio - 1) * relative, 0.0))
    return _reweighted(gp)


# --- local heights of the skin ---


def _with_heights(gp: PopulationGP) -> PopulationGP:
    """Correct the loads by local heights, as far as these explain leave-one-out errors."""
    std, length = (
        np.array(part) for part in zip(*((s, x) for x in ROUGHNESS.lengths for s in ROUGHNESS.stds), strict=True)
    )
    for _ in range(_MIXTURE.height_passes):
        held_out = _sloped_errors(gp)
        tried = measured_heights(std, length, held_out)
        share = hypothesis_shares(tried, gp.presses.position, held_out)
        kept = share > ROUGHNESS.min_share
        if not kept.any():
            return gp
        gp = gp._replace(heights=tried._replace(std=std[kept], length=length[kept], share=share[kept]))
        gp = _reweighted(gp)
    return gp


def _sloped_errors(gp: PopulationGP) -> SlopedErrors:
    """Compute the mixture's leave-one-out errors and their slopes by the first load."""
    mean, variance = _leave_one_out_mixture(gp)
    slopes = np.zeros((len(gp.weights), *gp.readings.shape))
    for rows, at, observed in _groups_by_input(gp):
        if gp.components.load_column[rows[0]] == 0:
            slopes[rows] = leave_one_out_slopes(kernel.take(gp.components.kernels, rows), at, observed)
    slope = np.einsum("kc,knc->nc", gp.weights, slopes)
    return SlopedErrors(gp.readings - mean, variance, slope, _heights_at_presses(gp))


def _heights_at_presses(gp: PopulationGP) -> np.ndarray:
    """Compute the local heights at the mixture's own presses (typical loads)."""
    position = gp.presses.position
    if not len(gp.heights.std):
        return np.zeros(len(position))
    return heights_at(gp.heights, squared_distance(position, position), height_inverses(gp.heights, position))[0]


# --- stacking with the plain process ---


def _plain_processes(components: Components) -> Components:
    """Take, for each kind of load, the plain process fitted to the presses; it is the last one without chips."""
    alone = (components.board == NO_CHIP_POSITIONS) & ~components.uses_previous
    columns = np.unique(components.load_column)
    return take_members(
        components, np.array([np.flatnonzero(alone & (components.load_column == i))[-1] for i in columns])
    )


def _stacked_on_plain(gp: PopulationGP, plain: Components) -> PopulationGP:
    """Add the best plain process as a last member, with a share chosen on parts that are left out. Return the mixture
    itself if the presses are too few for parts.
    """
    cuts = [part for part in (_parts(gp, parts) for parts in _MIXTURE.stacking.parts) if part is not None]
    if not cuts:
        return gp
    near, far = zip(*(_errors_by_other_parts(gp, part) for part in cuts), strict=True)
    alone = [_leave_one_out_all(gp._replace(components=plain), part) for part in cuts]
    best = int(np.argmin(sum((_reading_weights(gp) * held_out.part_error**2).sum((1, 2)) for held_out in alone)))
    near_share = _stacking_share(gp, np.stack(near), np.stack([held_out.error[best] for held_out in alone]), 0.0)
    plain_far = np.stack([held_out.part_error[best] for held_out in alone])
    far_share = _stacking_share(gp, np.stack(far), plain_far, _MIXTURE.stacking.far_plain_presses)
    far_weights = gp.weights if gp.far_weights is None else gp.far_weights
    return gp._replace(
        components=join_members(gp.components, take_members(plain, np.array([best]))),
        weights=np.vstack([near_share * gp.weights, 1 - near_share]),
        far_weights=np.vstack([far_share * far_weights, 1 - far_share]),
    )


def _errors_by_other_parts(gp: PopulationGP, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mixture's errors (n, c) on presses left out alone and by parts, with weights from the other parts."""
    held_out = _leave_one_out_all(gp, part)
    alone, together = np.empty_like(gp.readings), np.empty_like(gp.readings)
    for i in range(part.max() + 1):
        rows = part == i
        near, far = _weights(gp, held_out, ~rows)
        alone[rows] = np.einsum("kc,knc->nc", near, held_out.error[:, rows])
        together[rows] = np.einsum("kc,knc->nc", near if far is None else far, held_out.part_error[:, rows])
    return alone, together


def _stacking_share(gp: PopulationGP, error: np.ndarray, plain_error: np.ndarray, plain_presses: float) -> np.ndarray:
    """Find the share (c,) of the mixture for which its weighted sum with the plain process has the least squared error.

    Args:
        gp: The mixture.
        error: `(cuts, n, c)` errors of the mixture (uT), for each way to cut the presses into parts.
        plain_error: `(cuts, n, c)` errors of the plain process (uT).
        plain_presses: Prior presses for which the mixture adds nothing: the share is at most n / (n + plain_presses).

    Returns:
        A share between 0 and 1 for each channel, shrunk towards the one of all channels.
    """
    apart, trust = plain_error - error, _reading_weights(gp)
    gained, spread = (trust * plain_error * apart).sum((0, 1)), (trust * apart**2).sum((0, 1))
    limit = len(gp.readings) / (len(gp.readings) + plain_presses)
    spread = np.maximum(spread / limit, 1e-12)
    shared = np.clip(gained.sum() / spread.sum(), 0, limit)
    belief = _MIXTURE.stacking.prior_channels * spread.mean()
    return np.clip((gained + belief * shared) / (spread + belief), 0, limit)


# --- prediction ---


def _predict_rows(
    gp: PopulationGP, presses: PressTable, conditioned: list[Conditioned], inverses: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Predict the means and variances (m, c) of a batch of presses."""
    m, c = len(presses.position), gp.readings.shape[1]
    away = squared_distance(presses.position, gp.presses.position)
    height, height_variance = heights_at(gp.heights, away, inverses)
    loads = presses.loads if gp.presses.loads.shape[1] == presses.loads.shape[1] else np.ones((m, 1))
    presses = _add_heights(gp, presses._replace(loads=loads), height)
    between = squared_distance(gp.presses.position, gp.presses.position)
    fitted = _add_heights(gp, gp.presses, heights_at(gp.heights, between, inverses)[0])
    mean, square = np.zeros((m, c)), np.zeros((m, c))
    slope, far = np.zeros((m, c)), _far_weight(gp, presses.position)[:, None]
    far_weights = gp.weights if gp.far_weights is None else gp.far_weights
    for i, given in enumerate(conditioned):
        weight = (1 - far) * gp.weights[i] + far * far_weights[i]
        own_mean, own_variance, own_slope = _predict_one(gp, i, given, presses, fitted)
        mean += weight * own_mean
        square += weight * (own_variance + own_mean**2)
        slope += weight * own_slope
    variance = np.maximum(square - mean**2, 0) + slope**2 * height_variance[:, None]
    return mean, np.maximum(variance, 1e-12)


def _far_weight(gp: PopulationGP, position: np.ndarray) -> np.ndarray:
    """Compute the weight (m,) of the far weights: 0 at the median distance between neighbouring presses or nearer, 1 at
    the median distance of presses from other parts or farther.
    """
    pressed, part = gp.presses.position, _parts(gp)
    if part is None:
        return np.zeros(len(position))
    between = squared_distance(pressed, pressed)
    alone = np.where(np.eye(len(pressed), dtype=bool), np.inf, between)
    apart = np.where(part[:, None] == part, np.inf, between)
    near, far = (float(np.median(np.sqrt(square.min(1)))) for square in (alone, apart))
    distance = np.sqrt(squared_distance(position, pressed).min(1))
    return np.clip((distance - near) / max(far - near, _MIXTURE.weighting.min_far_distance), 0, 1)


def _predict_one(
    gp: PopulationGP, i: int, given: Conditioned, presses: PressTable, raised: PressTable
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predict mean, variance and slope by the first load (m, c) with one member, whose presses have their heights."""
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
