"""Placement of the board under the skin, from what its chips read together: as described, turned or mirrored.

All chips feel one skin. Let the skin be magnetized any way, dipoles m_i on a grid at a height over the chips. A press
at x sinks them, moves them aside and tilts them by smooth functions of their distance from x, and the readings of all
channels are linear in the moments, y = f(load) F(x) m + noise. With m ~ N(0, s^2 I) the readings are jointly normal,

    y ~ N(0, s^2 K),  K = F F' + noise I,

whatever the magnetization is, and the evidence of y says how well a board explains them: one that is turned changes the
positions x. What is reported is the gain of log evidence for each value (a reading of one channel), because a model
this plain is too sure of itself; thresholds were chosen on eFlesh `spatial`. Chips that are swapped and axes that are
flipped gain hardly more than the best wrong ones of a sound board, and are not looked for. Metres, microtesla, NumPy
and SciPy only.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from i2t.recordings.diagnose.findings import Finding
from i2t.recordings.diagnose.smooth import thinned
from i2t.recordings.presses import Presses
from i2t.types import Board

STAGE = "board on the stage"
FIELD_PRESSES = 70  # that are looked at: the cost grows with their cube
MIN_FIELD_PRESSES = 25
MIN_FIELD_CHIPS = 3
STAGE_GAIN = 0.09  # of log evidence for each value, for the board to be turned
IDENTIFICATION_GAIN = 0.02  # what the wrong hypotheses must lose for the right one to be known
GRID_CELLS = 15  # of dipoles along an edge
AS_RECORDED = "as recorded"
STAGES: dict[str, np.ndarray] = {
    AS_RECORDED: np.array([[1, 0], [0, 1]]),
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


def find_board(presses: Presses, board: Board, *, growth: Float[np.ndarray, " n"] | None = None) -> Finding:
    """Ask how the board lies under the skin.

    Args:
        presses: Of one skin, at many places.
        board: As it is described.
        growth: How much each press moves the skin, relative to the others; by default the same.

    Returns:
        The finding about the stage.
    """
    n, chips = len(presses.readings), len(board.chips)
    if n < MIN_FIELD_PRESSES or chips < MIN_FIELD_CHIPS or presses.position.std(0).min() < 1e-3:
        why = (
            f"{n} presses are too few ({MIN_FIELD_PRESSES} are enough)" if n < MIN_FIELD_PRESSES
            else f"a board of {chips} chips has too few ({MIN_FIELD_CHIPS} are enough)" if chips < MIN_FIELD_CHIPS
            else "all presses are at one place"
        )  # fmt: skip
        return Finding(STAGE, f"{STAGE.capitalize()}: not identifiable, as {why}.", False)
    sample = _sample(presses, growth, chips)
    shape, values = _fit_shape(sample, board), sample.readings.size
    evidence = {
        name: _log_evidence(_factor(sample, board, shape, matrix), sample.readings) / values
        for name, matrix in STAGES.items()
    }
    recorded = evidence[AS_RECORDED]
    return _stage_finding({name: found - recorded for name, found in evidence.items()}, recorded)


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
    turned = np.linalg.det(whole) * whole @ np.asarray(board.rotations, np.float64)
    chips = np.asarray(board.chips, np.float64) @ whole.T
    return Board(chips.astype(np.float32), turned.astype(np.float32))


def _sample(presses: Presses, growth: np.ndarray | None, chips: int) -> _Sample:
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
            shape = max(tried, key=lambda one: _log_evidence(_factor(sample, board, one), sample.readings))
    return shape


def _factor(
    sample: _Sample, board: Board, shape: FieldShape, matrix: np.ndarray = STAGES[AS_RECORDED]
) -> np.ndarray | None:
    """Lower factor of K, rows by chip, axis and press; None where K is no covariance."""
    features = _features(sample.position @ matrix.T, board, shape) * sample.growth[:, None, None, None]
    flat = features.transpose(1, 2, 0, 3).reshape(-1, features.shape[-1])
    covariance = flat @ flat.T
    covariance[np.diag_indices_from(covariance)] += shape.noise
    try:
        return cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
    except LinAlgError:
        return None


def _log_evidence(factor: np.ndarray | None, readings: np.ndarray) -> float:
    """Log evidence of readings (n, chips, 3) at the most likely scale."""
    if factor is None:
        return -np.inf
    white = solve_triangular(factor, readings.transpose(1, 2, 0).ravel(), lower=True, check_finite=False)
    scale = max(float(white @ white), 1e-30) / len(white)
    return float(-0.5 * len(white) * np.log(scale) - np.log(np.diagonal(factor)).sum())


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
    turn[..., :2, 2], turn[..., 2, :2] = -slope, slope
    change += np.einsum("csab,nsbd->ncasd", tensor, turn, optimize=True)
    change = np.einsum("cba,ncbsd->ncasd", np.asarray(board.rotations, np.float64), change, optimize=True)
    features = change.reshape(*change.shape[:3], -1)
    return features / np.sqrt((features**2).sum(-1).mean())


def _dipole_tensors(offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Field of a dipole, as a matrix on its moment, and its derivatives along the offset (up to a factor); mm."""
    r = np.sqrt((offset**2).sum(-1))[..., None, None]
    eye = np.eye(3)
    outer = offset[..., :, None] * offset[..., None, :]
    mixed = (
        eye[:, :, None] * offset[..., None, None, :]
        + eye[:, None, :] * offset[..., None, :, None]
        + eye[None, :, :] * offset[..., :, None, None]
    )
    r4 = r[..., None]
    gradient = 3 * mixed / r4**5 - 15 * offset[..., :, None, None] * outer[..., None, :, :] / r4**7
    return 3 * outer / r**5 - eye / r**3, gradient


def _stage_finding(gains: dict[str, float], evidence_per_value: float) -> Finding:
    best, second = sorted(gains, key=lambda name: -gains[name])[:2]
    lead = gains[best] - gains[second]
    evidence = {"evidence_per_value": evidence_per_value, "lead": lead}
    evidence |= {f"gain_{name}": gain for name, gain in gains.items() if name != AS_RECORDED}
    if gains[best] > STAGE_GAIN:
        said = (
            f"The readings of the chips go together better with the stage {best}: log evidence of each value "
            f"{gains[best]:+.2f}; the board is turned so."
        )
        correction = {"board_from_stage": STAGES[best].tolist()}
        return Finding(STAGE, said, identifiable=True, wrong=True, evidence=evidence, correction=correction)
    if best == AS_RECORDED and lead >= IDENTIFICATION_GAIN:
        said = f"The board lies as it is described: any turn or mirror loses {lead:.2f} of log evidence for each value."
        return Finding(STAGE, said, identifiable=True, evidence=evidence)
    said = (
        f"How the board is turned under the stage is not identifiable: {best} and the next best explain the readings "
        f"about as well ({lead:+.3f} of log evidence for each value)."
    )
    return Finding(STAGE, said, identifiable=False, evidence=evidence)
