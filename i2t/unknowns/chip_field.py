"""Placement of the board under the skin, from what its chips read together: turned or mirrored, two chips swapped, an
axis flipped, shifted.

All chips feel one skin. Let the skin be magnetized any way, dipoles m_i on a grid at a height over the chips. A press
at x sinks them, moves them aside and tilts them by smooth functions of their distance from x, and the readings of all
channels are linear in the moments, y = f(load) F(x) m + noise. With m ~ N(0, s^2 I) the readings are jointly normal,

    y ~ N(0, s^2 K),  K = F F' + noise I,

whatever the magnetization is, and the evidence of y says how well a board explains them. A hypothesis is cheap: chips
that are swapped and axes that are flipped permute y and change its signs, so that one factor of K judges all of them;
a board that is turned or shifted changes the positions x. What is reported is the gain of log evidence for each value
(a reading of one channel), because a model this plain is too sure of itself: on the recording that thresholds were
chosen on (eFlesh `spatial`) the best single flip of a sound board gains 0.06 and the best swap 0.04.

What is linear cannot be told: all magnets flipped together are another skin, and so is a chip all of whose axes are
flipped where no other chip feels what it feels. Metres, microtesla, NumPy only.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from i2t.types import Board
from i2t.unknowns.findings import Finding, RecordedPresses
from i2t.unknowns.smooth import thinned

STAGE, SWAPPED, FLIPPED, PLACEMENT = (
    "board on the stage",
    "order of the chips",
    "axes of the chips",
    "board's placement",
)
FIELD_PRESSES = 70  # that are looked at: the cost grows with their cube
MIN_FIELD_PRESSES = 25
STAGE_GAIN = 0.09  # of log evidence for each value, for the board to be turned
SWAP_GAIN = 0.05
FLIP_GAIN = 0.2  # of a sound board the best flip gains up to 0.11 on simulated skins
IDENTIFICATION_GAIN = 0.02  # what the wrong hypotheses must lose for the right one to be known
GRID_CELLS = 15  # of dipoles along an edge
_AXES = 3
STAGES: dict[str, np.ndarray] = {
    "as recorded": np.array([[1, 0], [0, 1]]),
    "x mirrored": np.array([[-1, 0], [0, 1]]),
    "y mirrored": np.array([[1, 0], [0, -1]]),
    "turned by 180 degrees": np.array([[-1, 0], [0, -1]]),
    "x and y exchanged": np.array([[0, 1], [1, 0]]),
    "turned by +90 degrees": np.array([[0, -1], [1, 0]]),
    "turned by -90 degrees": np.array([[0, 1], [-1, 0]]),
    "x and y exchanged and both mirrored": np.array([[0, -1], [-1, 0]]),
}


class FieldShape(NamedTuple):
    """Motion of the dipoles in a press."""

    gap: float  # m, height of the dipoles over the chips
    reach: float  # m, over which a press is felt
    aside: float  # share of the sinking by which a dipole moves aside
    noise: float  # variance, of the readings' mean square


class _Sample(NamedTuple):
    """Presses to judge by."""

    position: np.ndarray  # (n, 2) m
    growth: np.ndarray  # (n,) of the load
    readings: np.ndarray  # (n, chips, 3), of mean square 1


class _Evidence(NamedTuple):
    log: float
    quadratic: np.ndarray  # (chips, 3, chips, 3, chips, chips): of each pair of channels, for each pair of chips there
    log_determinant: float


def find_board(
    presses: RecordedPresses, board: Board, *, growth: Float[np.ndarray, " n"] | None = None
) -> list[Finding]:
    """Ask how the board lies under the skin, and whether its chips are what they are said to be.

    Args:
        presses: Of one skin, at many places.
        board: As it is described.
        growth: How much each press moves the skin, relative to the others; by default the same.

    Returns:
        Findings about the stage, the order of the chips, their axes, and where the board lies.
    """
    n, chips = len(presses.readings), len(board.chips)
    names = (STAGE, SWAPPED, FLIPPED, PLACEMENT)
    spread = presses.position.std(0).min() if n else 0.0
    if n < MIN_FIELD_PRESSES or chips < 3 or spread < 1e-3:
        why = (
            f"{n} presses are too few" if n < MIN_FIELD_PRESSES
            else f"a board of {chips} chips has too few" if chips < 3
            else "all presses are at one place"
        )  # fmt: skip
        return [Finding(name, f"{name.capitalize()}: not identifiable, as {why}.", False) for name in names]
    sample = _sample(presses, growth, chips)
    shape = _fit_shape(sample, board)
    recorded = _evidence(sample, board, shape)
    values = sample.readings.size
    stages = {name: _log_evidence(sample, board, shape, matrix) for name, matrix in STAGES.items()}
    swaps, flips = _swaps(recorded, values), _flips(recorded, values)
    best_stage = max(stages, key=lambda name: stages[name])
    stage_gain = (stages[best_stage] - recorded.log) / values
    swap = max(swaps, key=lambda pair: swaps[pair])
    flip = max(flips, key=lambda one: flips[one])
    gains = {"stage": stage_gain, "swap": swaps[swap], "flip": flips[flip]}
    r2 = _explained(recorded, values)
    likeliest = max(gains, key=lambda kind: gains[kind])
    wrong = {
        "stage": bool(likeliest == "stage" and stage_gain > STAGE_GAIN),
        "swap": bool(likeliest == "swap" and gains["swap"] > SWAP_GAIN),
        "flip": bool(likeliest == "flip" and gains["flip"] > FLIP_GAIN),
    }
    matrix = STAGES[best_stage] if wrong["stage"] else STAGES["as recorded"]
    others = sorted(stages.values())
    return [
        _stage_finding(best_stage, stages, recorded.log, values, wrong=wrong["stage"], r2=r2, others=others),
        _swap_finding(swap, swaps, wrong=wrong["swap"]),
        _flip_finding(flip, flips, wrong=wrong["flip"]),
        _placement_finding(sample, board, shape, matrix),
    ]


def correct_board(presses: RecordedPresses, board: Board, findings: list[Finding]) -> tuple[RecordedPresses, Board]:
    """Presses and board as the findings say that they are.

    Args:
        presses: As recorded.
        board: As described.
        findings: Of `find_board`.

    Returns:
        Presses with their channels in order, and the board turned as it lies under the stage.
    """
    readings = presses.readings
    for finding in findings:
        order, signs = finding.correction.get("chip_order"), finding.correction.get("channel_signs")
        if order is not None:
            readings = readings.reshape(len(readings), -1, _AXES)[:, list(order)].reshape(len(readings), -1)
        if signs is not None:
            readings = readings * np.asarray(signs, np.float64)
        matrix = finding.correction.get("board_from_stage")
        if matrix is not None:
            board = turn_board(board, np.asarray(matrix, np.float64))
    return presses._replace(readings=readings), board


def turn_board(board: Board, matrix: Float[np.ndarray, "2 2"]) -> Board:
    """A board as it lies in the stage's axes.

    Args:
        board: In its own axes.
        matrix: That maps the stage's x and y to the board's: a turn, or a mirror where an axis of the stage is flipped.

    Returns:
        The board with its chips where the stage has them. A mirror turns a field as an axial vector.
    """
    whole = np.eye(3)
    whole[:2, :2] = matrix.T
    determinant = np.linalg.det(whole)
    turned = determinant * whole @ np.asarray(board.rotations, np.float64)
    chips = np.asarray(board.chips, np.float64) @ whole.T
    return Board(chips.astype(np.float32), turned.astype(np.float32))


def _sample(presses: RecordedPresses, growth: np.ndarray | None, chips: int) -> _Sample:
    grown = np.ones(len(presses.readings)) if growth is None else np.asarray(growth, np.float64)
    firm = np.flatnonzero(grown > 0.15 * np.quantile(grown, 0.95))
    rows = firm[thinned(len(firm), FIELD_PRESSES)]
    readings = presses.readings[rows].astype(np.float64)
    readings = readings / max(np.sqrt(np.mean(readings**2)), 1e-30)
    return _Sample(
        position=presses.position[rows].astype(np.float64), growth=grown[rows] / np.mean(grown[rows]),
        readings=readings.reshape(len(rows), chips, 3),
    )  # fmt: skip


def _fit_shape(sample: _Sample, board: Board) -> FieldShape:
    """The shape of most evidence, one number after the other; what is to be judged cannot fit itself by it alone."""
    shape = FieldShape(4e-3, 8e-3, 0.3, 0.03)
    for _ in range(2):
        for name, values in (
            ("reach", (2e-3, 4e-3, 8e-3, 14e-3, 22e-3)),
            ("gap", (2e-3, 3e-3, 4.5e-3, 7e-3)),
            ("noise", (3e-3, 0.01, 0.03, 0.1)),
            ("aside", (0.0, 0.4)),
        ):
            tried = [shape._replace(**{name: value}) for value in values]
            shape = max(tried, key=lambda one: _log_evidence(sample, board, one))
    return shape


def _features(position: np.ndarray, board: Board, shape: FieldShape) -> Float[np.ndarray, "n chips 3 k"]:
    """Readings at presses for dipoles of unit moment, in the chips' axes, of mean square 1 over dipoles."""
    chips = np.asarray(board.chips, np.float64)
    half = np.abs(np.concatenate([position, chips[:, :2]])).max() + 2e-3
    line = np.linspace(-half, half, GRID_CELLS)
    x, y = np.meshgrid(line, line)
    dipoles = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    below = np.column_stack([chips[:, :2], np.full(len(chips), -shape.gap)])
    tensor, gradient = _dipole_tensors((below[:, None] - dipoles[None]) * 1e3)
    offset = dipoles[None, :, :2] - position[:, None]
    near = np.exp(-(offset**2).sum(-1) / (2 * shape.reach**2))
    away = offset / shape.reach
    moved = np.concatenate([shape.aside * near[..., None] * away, -near[..., None]], -1)
    change = -np.einsum("nsk,cskab->ncasb", moved, gradient, optimize=True)
    # A dipole tilts with the slope of the sinking: the rotation by half of its curl, per millimetre of sinking.
    slope = near[..., None] * away / (1e3 * shape.reach)
    turn = np.zeros((*near.shape, 3, 3))
    turn[..., 0, 2], turn[..., 1, 2] = -slope[..., 0], -slope[..., 1]
    turn[..., 2, 0], turn[..., 2, 1] = slope[..., 0], slope[..., 1]
    change += np.einsum("csab,nsbd->ncasd", tensor, turn, optimize=True)
    change = np.einsum("cba,ncbsd->ncasd", np.asarray(board.rotations, np.float64), change, optimize=True)
    features = change.reshape(*change.shape[:3], -1)
    return features / np.sqrt((features**2).sum(-1).mean())


def _dipole_tensors(offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Field of a dipole, as a matrix on its moment, and its derivatives along the offset (up to a factor); mm."""
    r2 = (offset**2).sum(-1)
    r = np.sqrt(r2)
    eye = np.eye(3)
    outer = offset[..., :, None] * offset[..., None, :]
    tensor = 3 * outer / r[..., None, None] ** 5 - eye / r[..., None, None] ** 3
    mixed = (
        eye[:, :, None] * offset[..., None, None, :]
        + eye[:, None, :] * offset[..., None, :, None]
        + eye[None, :, :] * offset[..., :, None, None]
    )
    gradient = (
        3 * mixed / r[..., None, None, None] ** 5
        - 15 * offset[..., :, None, None] * outer[..., None, :, :] / r[..., None, None, None] ** 7
    )
    return tensor, gradient


def _factor(
    sample: _Sample, board: Board, shape: FieldShape, matrix: np.ndarray | None, shift: np.ndarray | None
) -> np.ndarray | None:
    """Lower factor of K, rows by chip, axis and press; None where K is no covariance."""
    position = sample.position if matrix is None else sample.position @ np.asarray(matrix, np.float64).T
    position = position if shift is None else position + shift
    features = _features(position, board, shape) * sample.growth[:, None, None, None]
    flat = features.transpose(1, 2, 0, 3).reshape(-1, features.shape[-1])
    covariance = flat @ flat.T
    covariance[np.diag_indices_from(covariance)] += shape.noise
    try:
        return cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
    except LinAlgError:
        return None


def _log_evidence(
    sample: _Sample, board: Board, shape: FieldShape, matrix: np.ndarray | None = None, shift: np.ndarray | None = None
) -> float:
    """Log evidence at the most likely scale."""
    factor = _factor(sample, board, shape, matrix, shift)
    if factor is None:
        return -np.inf
    values = sample.readings.transpose(1, 2, 0).ravel()
    white = solve_triangular(factor, values, lower=True, check_finite=False)
    return _log_of(white @ white, len(values), 2 * np.log(np.diagonal(factor)).sum())


def _log_of(quadratic: float | np.ndarray, values: int, log_determinant: float) -> float:
    return float(-0.5 * values * np.log(np.maximum(quadratic, 1e-30) / values) - 0.5 * log_determinant)


def _evidence(sample: _Sample, board: Board, shape: FieldShape) -> _Evidence:
    """The evidence as recorded, and all that swaps and flips need."""
    factor = _factor(sample, board, shape, None, None)
    n, chips, axes = sample.readings.shape
    if factor is None:
        raise ValueError("the presses have no covariance; check their positions")
    inverse = solve_triangular(factor, np.eye(len(factor)), lower=True, check_finite=False)
    precision = (inverse.T @ inverse).reshape(chips, axes, n, chips, axes, n)
    y = sample.readings
    quadratic = np.einsum("npa,candbm,mqb->cadbpq", y, precision, y, optimize=True)
    determinant = 2 * float(np.log(np.diagonal(factor)).sum())
    own = np.einsum("cadbcd->", quadratic)
    return _Evidence(_log_of(own, y.size, determinant), quadratic, determinant)


def _as_placed(evidence: _Evidence, order: np.ndarray) -> np.ndarray:
    """(channels, channels) quadratic form with the recorded chip order[i] at the place i."""
    chips = len(order)
    i, j = np.meshgrid(np.arange(chips), np.arange(chips), indexing="ij")
    form = evidence.quadratic[i, :, j, :, order[i], order[j]]  # (chips, chips, 3, 3)
    return form.transpose(0, 2, 1, 3).reshape(_AXES * chips, _AXES * chips)


def _swaps(evidence: _Evidence, values: int) -> dict[tuple[int, int], float]:
    """Gain of log evidence for each value by swapping each two chips."""
    chips = evidence.quadratic.shape[0]
    gains = {}
    for pair in combinations(range(chips), 2):
        order = np.arange(chips)
        order[list(pair)] = order[list(pair[::-1])]
        log = _log_of(_as_placed(evidence, order).sum(), values, evidence.log_determinant)
        gains[pair] = (log - evidence.log) / values
    return gains


def _flips(evidence: _Evidence, values: int) -> dict[tuple[int, str], float]:
    """Gain by flipping axes of one chip: each axis, each two, all."""
    chips = evidence.quadratic.shape[0]
    form = _as_placed(evidence, np.arange(chips))
    gains = {}
    for chip in range(chips):
        for axes in ("x", "y", "z", "xy", "xz", "yz", "xyz"):
            signs = _signs(chips, chip, axes)
            log = _log_of(signs @ form @ signs, values, evidence.log_determinant)
            gains[chip, axes] = (log - evidence.log) / values
    return gains


def _signs(chips: int, chip: int, axes: str) -> np.ndarray:
    signs = np.ones((chips, _AXES))
    signs[chip, ["xyz".index(axis) for axis in axes]] = -1
    return signs.ravel()


def _explained(evidence: _Evidence, values: int) -> float:
    """Scale of the signal over the noise, as a share: only to be shown."""
    return float(1 - np.exp(-2 * max(evidence.log, 0.0) / values))


def _stage_finding(
    best: str, stages: dict[str, float], recorded: float, values: int, *, wrong: bool, r2: float, others: list[float]
) -> Finding:
    lead = (others[-1] - others[-2]) / values
    gains = {f"gain_{name}": (log - recorded) / values for name, log in stages.items() if name != "as recorded"}
    evidence = {"evidence_per_value": recorded / values, "explained": r2, "lead": lead, **gains}
    if wrong:
        sentence = (
            f"The readings of the chips go together better with the stage {best}: log evidence of each value "
            f"{(stages[best] - recorded) / values:+.2f}; the board is turned so."
        )
    elif best != "as recorded" or lead < IDENTIFICATION_GAIN:
        sentence = (
            f"How the board is turned under the stage is not identifiable: {best} and the next best explain the "
            f"readings about as well ({lead:+.3f} of log evidence for each value)."
        )
    else:
        sentence = (
            f"The board lies as it is described: any turn or mirror loses {lead:.2f} of log evidence for each value."
        )
    known = bool(wrong or (best == "as recorded" and lead >= IDENTIFICATION_GAIN))
    correction = {"board_from_stage": STAGES[best].tolist()} if wrong else {}
    return Finding(STAGE, sentence, identifiable=known, wrong=wrong, evidence=evidence, correction=correction)


def _swap_finding(swap: tuple[int, int], swaps: dict[tuple[int, int], float], *, wrong: bool) -> Finding:
    gain = swaps[swap]
    evidence = {"best_gain": gain, "best_pair": float(10 * swap[0] + swap[1])}
    if wrong:
        chips = 1 + max(max(pair) for pair in swaps)
        order = np.arange(chips)
        order[list(swap)] = order[list(swap[::-1])]
        return Finding(
            SWAPPED, f"Chips {swap[0]} and {swap[1]} are swapped: with them exchanged, log evidence of each value "
            f"grows by {gain:.2f}.", identifiable=True, wrong=True, evidence=evidence,
            correction={"chip_order": order.tolist()},
        )  # fmt: skip
    if gain > -IDENTIFICATION_GAIN:
        sentence = (
            f"Whether chips {swap[0]} and {swap[1]} are swapped is not identifiable ({gain:+.3f} of log evidence for "
            "each value)."
        )
    else:
        sentence = f"The chips are in order: any swap loses {-gain:.2f} of log evidence for each value."
    return Finding(SWAPPED, sentence, identifiable=bool(gain <= -IDENTIFICATION_GAIN), evidence=evidence)


def _flip_finding(flip: tuple[int, str], flips: dict[tuple[int, str], float], *, wrong: bool) -> Finding:
    chip, axes = flip
    gain = flips[flip]
    chips = 1 + max(one for one, _ in flips)
    hidden = sorted({one for (one, _), value in flips.items() if value > -IDENTIFICATION_GAIN})
    evidence = {"best_gain": gain, "best_chip": float(chip)}
    if wrong:
        return Finding(
            FLIPPED, f"Axis {' and '.join(axes)} of chip {chip} points the other way: with it turned, log evidence of "
            f"each value grows by {gain:.2f}.", identifiable=True, wrong=True, evidence=evidence,
            correction={"channel_signs": _signs(chips, chip, axes).tolist()},
        )  # fmt: skip
    if hidden:
        sentence = (
            f"No axis of a chip is flipped that shows; of chip {', '.join(map(str, hidden))} one might be, unseen."
        )
    else:
        sentence = f"The chips' axes are as described: any flip loses {-gain:.2f} of log evidence for each value."
    return Finding(FLIPPED, sentence, identifiable=not hidden, evidence=evidence)


def _placement_finding(sample: _Sample, board: Board, shape: FieldShape, matrix: np.ndarray) -> Finding:
    """Offset and turn of the board against the stage, by a search downhill from the best quarter turn."""
    at = np.zeros(3)  # mm, mm, degrees

    def log(value: np.ndarray) -> float:
        angle = np.deg2rad(value[2])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return _log_evidence(sample, board, shape, turn @ matrix, 1e-3 * value[:2])

    best, steps = log(at), np.array([1.0, 1.0, 6.0])
    curvature = np.zeros(3)
    for _ in range(2):
        for k in range(3):
            step = np.eye(3)[k] * steps[k]
            down, up = log(at - step), log(at + step)
            bend = down + up - 2 * best
            curvature[k] = -bend / steps[k] ** 2
            move = 0.5 * (down - up) / bend if bend < 0 else float(np.sign(up - down))
            new = at + step * np.clip(move, -2, 2)
            value = log(new)
            if value > best:
                at, best = new, value
        steps *= 0.5
    # Evidence of a plain model is too sure of itself: a value counts as a twentieth of an independent one.
    half = 1.645 / np.sqrt(np.maximum(curvature, 1e-12) / 20)
    known = bool((half[:2] < 2.0).all())
    if not known:
        return Finding(
            PLACEMENT, "Where the board lies under the stage is not identifiable to 2 mm.", False,
            evidence={"x_mm": at[0], "y_mm": at[1], "turn_degrees": at[2]},
        )  # fmt: skip
    return Finding(
        PLACEMENT,
        f"The board's centre is seen at x = {-at[0]:+.1f} +- {half[0]:.1f} mm, y = {-at[1]:+.1f} +- {half[1]:.1f} mm "
        f"of the stage, turned by {-at[2]:+.0f} +- {half[2]:.0f} degrees.",
        identifiable=True, estimate=float(np.hypot(*at[:2])), low=None, high=None, unit="mm",
        evidence={
            "x_mm": at[0], "y_mm": at[1], "turn_degrees": at[2],
            "x_half_mm": half[0], "y_half_mm": half[1], "turn_half_degrees": half[2],
        },
    )  # fmt: skip
