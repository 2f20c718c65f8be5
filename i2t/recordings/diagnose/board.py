"""Rotation of the board under the skin, inferred from all chips together: as described, rotated or mirrored.

All chips measure one skin. Let the skin be magnetized in any way, as dipoles m_i on a grid at a height over the chips.
A press at x pushes them down and sideways and tilts them by smooth functions of their distance from x, and the readings
of all channels are linear in the moments, y = f(load) F(x) m + noise. With m ~ N(0, s^2 I) the readings are jointly
normal,

    y ~ N(0, s^2 K),  K = F F' + noise I,

for any magnetization, and the evidence of y measures how well a board explains them: a rotated board changes the
positions x. The finding reports the gain of log evidence per value (one channel of one reading), because a model this
simple is overconfident. Swapped chips and flipped axes are not tested: they gain hardly more than the best wrong
hypothesis on a correct board. Lengths are in metres and readings in microtesla.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from i2t.recordings.diagnose.findings import Finding, FindingName, not_identifiable
from i2t.recordings.diagnose.smooth import subsample
from i2t.recordings.presses import Presses
from i2t.types import Board

AS_RECORDED = "as recorded"  # name of the stage axes that agree with the board's, so need no correction
# Maps from the x and y of the stage that moves the tip to the board's, by the relation between the axes.
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


@dataclass(frozen=True)
class StageConfig:
    """Thresholds and model size of the test of the board's rotation; thresholds were chosen on eFlesh `spatial`.

    Attributes:
        min_gain: Gain of log evidence per value above which the board is rotated.
        min_lead: Lead in log evidence per value over the next best hypothesis, from which the described rotation is
            identified.
        min_presses: Number of presses below which nothing is identifiable.
        min_chips: Number of chips below which nothing is identifiable.
        max_presses: Number of presses that the model uses, at most: its cost grows with their cube.
        grid_cells: Number of dipoles along an edge of the grid.
    """

    min_gain: float = 0.09
    min_lead: float = 0.02
    min_presses: int = 25
    min_chips: int = 3
    max_presses: int = 70
    grid_cells: int = 15


class _SkinModel(NamedTuple):
    """Motion of the dipoles in a press, and noise."""

    gap: float  # m, height of the dipoles above the chips
    reach: float  # m, length scale of the motion around a press
    sideways: float  # lateral motion relative to the downward motion
    noise: float  # variance of the noise, relative to the readings' mean square


class _Sample(NamedTuple):
    """Presses that the evidence is computed on."""

    position: np.ndarray  # (n, 2) m, positions of the presses
    growth: np.ndarray  # (n,) motion of the skin at each press, with mean 1
    readings: np.ndarray  # (n, chips, 3) readings with mean square 1


def find_board(
    presses: Presses,
    board: Board,
    *,
    growth: Float[np.ndarray, " n"] | None = None,
    config: StageConfig = StageConfig(),
) -> Finding:
    """Test how the board is turned or mirrored relative to the axes of the stage that positions the tip.

    Args:
        presses: n presses of one skin at many places.
        board: Board as it is described.
        growth: `(n,)` motion of the skin in each press, in any unit; None if it is the same in all.
        config: Thresholds and size of the model.

    Returns:
        Finding on the board's rotation. Its correction holds the matrix that `rotate_board` takes.
    """
    n, chips = len(presses.readings), len(board.chips)
    if n < config.min_presses or chips < config.min_chips or presses.position.std(0).min() < 1e-3:
        reason = (
            f"{n} presses are too few ({config.min_presses} are enough)" if n < config.min_presses
            else f"a board of {chips} chips has too few ({config.min_chips} are enough)" if chips < config.min_chips
            else "all presses are at one place"
        )  # fmt: skip
        return not_identifiable(FindingName.STAGE, reason, untested=True)
    sample = _sample(presses, growth, chips, config.max_presses)
    model, values = _fit_model(sample, board, config.grid_cells), sample.readings.size
    evidence = {
        name: _log_evidence(sample, board, model, config.grid_cells, matrix) / values for name, matrix in STAGES.items()
    }
    recorded = evidence[AS_RECORDED]
    return _stage_finding({name: value - recorded for name, value in evidence.items()}, recorded, config)


def rotate_board(board: Board, matrix: Float[np.ndarray, "2 2"]) -> Board:
    """Express a board in the axes of the stage.

    Args:
        board: Board in its own axes.
        matrix: Map from the stage's x and y to the board's: a rotation, or a mirror if an axis of the stage is flipped.

    Returns:
        The board with chips and rotations in the stage's axes. A mirror maps a field as an axial vector.
    """
    stage_from_board = np.eye(3)
    stage_from_board[:2, :2] = matrix.T
    rotations = np.linalg.det(stage_from_board) * stage_from_board @ np.asarray(board.rotations, np.float64)
    chips = np.asarray(board.chips, np.float64) @ stage_from_board.T
    return Board(chips.astype(np.float32), rotations.astype(np.float32))


def _sample(presses: Presses, growth: np.ndarray | None, chips: int, max_presses: int) -> _Sample:
    motion = np.ones(len(presses.readings)) if growth is None else np.asarray(growth, np.float64)
    firm = np.flatnonzero(motion > 0.15 * np.quantile(motion, 0.95))
    rows = firm[subsample(len(firm), max_presses)]
    readings = presses.readings[rows].astype(np.float64)
    readings = readings / max(np.sqrt(np.mean(readings**2)), 1e-30)
    return _Sample(
        position=presses.position[rows].astype(np.float64), growth=motion[rows] / np.mean(motion[rows]),
        readings=readings.reshape(len(rows), chips, 3),
    )  # fmt: skip


def _fit_model(sample: _Sample, board: Board, grid_cells: int) -> _SkinModel:
    """Maximise the evidence over one parameter after the other, with the board as described."""
    model = _SkinModel(4e-3, 8e-3, 0.3, 0.03)
    for _ in range(2):
        for name, values in (
            ("reach", (2e-3, 4e-3, 8e-3, 14e-3, 22e-3)),
            ("gap", (2e-3, 3e-3, 4.5e-3, 7e-3)),
            ("noise", (3e-3, 0.01, 0.03, 0.1)),
            ("sideways", (0.0, 0.4)),
        ):
            candidates = [model._replace(**{name: value}) for value in values]
            model = max(candidates, key=lambda candidate: _log_evidence(sample, board, candidate, grid_cells))
    return model


def _log_evidence(
    sample: _Sample, board: Board, model: _SkinModel, grid_cells: int, matrix: np.ndarray = STAGES[AS_RECORDED]
) -> float:
    """Compute the log evidence of the readings at the most likely scale; -inf if K is not positive definite."""
    features = _features(sample.position @ matrix.T, board, model, grid_cells) * sample.growth[:, None, None, None]
    flat = features.transpose(1, 2, 0, 3).reshape(-1, features.shape[-1])  # rows by chip, axis and press
    covariance = flat @ flat.T
    covariance[np.diag_indices_from(covariance)] += model.noise
    try:
        factor = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
    except LinAlgError:
        return -np.inf
    white = solve_triangular(factor, sample.readings.transpose(1, 2, 0).ravel(), lower=True, check_finite=False)
    scale = max(float(white @ white), 1e-30) / len(white)
    return float(-0.5 * len(white) * np.log(scale) - np.log(np.diagonal(factor)).sum())


def _features(
    position: np.ndarray, board: Board, model: _SkinModel, grid_cells: int
) -> Float[np.ndarray, "n chips 3 k"]:
    """Compute the readings of presses for k dipole components of unit moment, in the chips' axes.

    They are scaled to a sum over components of mean square 1.
    """
    chips = np.asarray(board.chips, np.float64)
    half = np.abs(np.concatenate([position, chips[:, :2]])).max() + 2e-3
    line = np.linspace(-half, half, grid_cells)
    x, y = np.meshgrid(line, line)
    dipoles = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    below = np.column_stack([chips[:, :2], np.full(len(chips), -model.gap)])
    tensor, gradient = _dipole_tensors((below[:, None] - dipoles[None]) * 1e3)
    offset = dipoles[None, :, :2] - position[:, None]
    sinking = np.exp(-(offset**2).sum(-1) / (2 * model.reach**2))
    outward = offset / model.reach
    motion = np.concatenate([model.sideways * sinking[..., None] * outward, -sinking[..., None]], -1)
    change = -np.einsum("nsk,cskab->ncasb", motion, gradient, optimize=True)
    # A dipole tilts with the slope of the sinking: the rotation by half of its curl, per millimetre of sinking.
    slope = sinking[..., None] * outward / (1e3 * model.reach)
    tilt = np.zeros((*sinking.shape, 3, 3))
    tilt[..., :2, 2], tilt[..., 2, :2] = -slope, slope
    change += np.einsum("csab,nsbd->ncasd", tensor, tilt, optimize=True)
    change = np.einsum("cba,ncbsd->ncasd", np.asarray(board.rotations, np.float64), change, optimize=True)
    features = change.reshape(*change.shape[:3], -1)
    return features / np.sqrt((features**2).sum(-1).mean())


def _dipole_tensors(offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the field of a dipole as a matrix on its moment, and its derivatives along the offset, up to a factor.

    Offsets are in millimetres.
    """
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


def _stage_finding(gains: dict[str, float], evidence_per_value: float, config: StageConfig) -> Finding:
    best, second = sorted(gains, key=lambda name: -gains[name])[:2]
    lead = gains[best] - gains[second]
    evidence = {"evidence_per_value": evidence_per_value, "lead": lead}
    evidence |= {f"gain_{name}": gain for name, gain in gains.items() if name != AS_RECORDED}
    if gains[best] > config.min_gain:
        sentence = (
            f"The readings of the chips fit together better with the stage {best} ({gains[best]:+.2f} of log evidence "
            "per value): the board is corrected accordingly."
        )
        correction = {"board_from_stage": STAGES[best].tolist()}
        return Finding(FindingName.STAGE, sentence, True, wrong=True, evidence=evidence, correction=correction)
    if best == AS_RECORDED and lead >= config.min_lead:
        sentence = f"The board is as described: any rotation or mirror loses {lead:.2f} of log evidence per value."
        return Finding(FindingName.STAGE, sentence, identifiable=True, evidence=evidence)
    reason = f"{best} and {second} explain the readings about equally well ({lead:+.3f} of log evidence per value)"
    return not_identifiable(FindingName.STAGE, reason, evidence=evidence)
