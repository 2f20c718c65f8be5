"""The ambient field of a skin on an arm: fitted from free poses, predicted at any pose, and watched for changes.

A skin that touches nothing reads the Earth's field, which turns in it as the arm turns it, and a constant of each chip:
its offset, and the field of the skin itself. The arm knows how it stands, so both can be told apart. At a pose with
rotation R (tool axes in the base), chip i at p_i in the base reads, in tool axes,

    b_i = (I + S_i) R^T (e + G (p_i - c)) + o_i + noise

- e, 3 numbers: the field in the base frame at c, the middle of the chips over the fitted poses.
- o_i, 3 for each chip: its constant offset.
- G, 5 numbers: a gradient that iron in the room makes, symmetric and without trace, as a static field without currents
  nearby has it (curl and divergence are zero). Its prior has a standard deviation of 20 uT/m.
- S_i, 9 for each chip: the response of the chip and of iron that turns with the tool. Iron that the Earth magnetises
  (an induced dipole of a mount or a screw) adds a field that is linear in the Earth's, and so does an error of a chip's
  gain; in the calibration of magnetometers this is the soft-iron matrix (Vasconcelos et al., "Geometric approach to
  strapdown magnetometer calibration in sensor frame", 2011). Its prior has a standard deviation of 5 % in each number.

What does not turn with the room or the tool is in no term: a skin that sags under its weight, an arm's
motors, a second robot.

Noise has two parts: one of each chip, and one that all chips share, as a slow field of the room has it (a fifth to a
third of the variance of real boards). Both sizes are estimated from the residuals, so that the covariance of a fit and
the test for a change need no number from elsewhere. The test compares new free readings with their prediction in both
parts by an F statistic, each at half the false-alarm rate that is asked for.

Readings are microtesla in the board's order and axes; a missing chip is NaN and is left out. NumPy only, so that
drivers can use it; nothing is random.
"""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

from i2t import serialization
from i2t.types import Array, Board

FIELD_KIND = "i2t ambient field"
BURST = 10  # samples that a touch takes before contact
MIN_POSES = 4
MIN_TURN = 0.1  # by how much, root mean square, poses must turn the field's weakest direction: about 6 degrees
GRADIENT_STD_UT_M = 20.0
RESPONSE_STD = 0.05
MAX_FIT_STEPS, CONVERGED = 20, 1e-8
WEIGHT_ROUNDS = 3  # of estimating the noise and fitting with it
LEAST_NOISE_UT = 1e-3  # below which a noise is rounding


class FreePoses(NamedTuple):
    """Readings of a skin that touches nothing, at some poses of the arm."""

    T_b_t: Float[Array, "p 4 4"]  # tool in base, m
    samples: Float[Array, "p s c"]  # uT, s samples at each pose; NaN for a chip that is missing

    @property
    def reading(self) -> Float[np.ndarray, "p c"]:
        """Mean (p, c) uT at each pose of the samples that a channel has."""
        return mean_known(np.asarray(self.samples, float), axis=1)


class AmbientNoise(NamedTuple):
    """Standard deviations in tool axes, uT, of the mean of some samples about its prediction."""

    chip: Float[Array, "3"]  # of each chip by itself
    common: Float[Array, "3"]  # of the root of the number of chips times what they share
    dof_chip: Float[Array, ""]
    dof_common: Float[Array, ""]
    samples: Float[Array, ""]  # of the mean


class AmbientField(NamedTuple):
    """A fitted ambient field."""

    earth: Float[Array, "3"]  # uT, base axes
    offset: Float[Array, "chips 3"]  # uT, tool axes; NaN for a chip that never answered
    gradient: Float[Array, "5"]  # uT/m, base axes: xx, yy, xy, xz, yz
    centre: Float[Array, "3"]  # m, in the base, where the field is `earth`
    response: Float[Array, "chips 3 3"]  # S of each chip, tool axes
    covariance: Float[Array, "m m"]  # of all parameters, in this order but for the centre
    noise: AmbientNoise  # of the mean of a pose's samples
    burst: AmbientNoise  # of the mean of a burst of samples

    @property
    def earth_std(self) -> Float[np.ndarray, "3"]:
        """Standard errors (3,) uT of `earth`."""
        return np.sqrt(np.diag(self.covariance)[:3])


class AmbientChange(NamedTuple):
    """Test of new free readings against a fitted field."""

    changed: bool
    field_p: float  # how often chance alone makes what all chips share as large
    chips_p: float  # and what differs between chips
    field: Float[np.ndarray, "3"]  # uT, base axes: mean of what all chips share beyond the prediction
    chip: int  # with the largest residual
    residual: float  # uT, root mean square over channels

    @property
    def sentence(self) -> str:
        """Change in words."""
        if not self.changed:
            return f"the ambient field is the fitted one ({self.residual:.1f} uT off)"
        if self.field_p <= self.chips_p:
            size = np.linalg.norm(self.field)
            return f"the ambient field has changed by {size:.1f} uT in all chips (p = {self.field_p:.1g})"
        return f"the chips' offsets have changed, most of all chip {self.chip}'s (p = {self.chips_p:.1g})"


def fit_ambient(poses: FreePoses, board: Board, *, burst: int = BURST) -> AmbientField:
    """Fit the ambient field.

    Args:
        poses: Free poses that turn the skin about two axes at least; a dozen is enough.
        board: Of the skin, whose rotations are used.
        burst: Samples whose mean will later be compared with the field.

    Returns:
        The field with its covariance.

    Raises:
        ValueError: There are too few poses, they hardly turn, or shapes do not fit.
    """
    _check(poses, board)
    problem = _problem(poses, board)
    weights = _Weights(1.0, 1.0, 1.0, 1.0)
    for _ in range(WEIGHT_ROUNDS):
        theta, inverse = _solve(problem, weights)
        weights = _weights(problem, theta, weights, inverse)
    theta, inverse = _solve(problem, weights)
    earth, offset, gradient, response = _parts(theta, len(problem.chips))
    offset[~np.isfinite(problem.reading).any((0, 2))] = np.nan
    count = problem.samples.shape[1]
    return AmbientField(
        earth=earth,
        offset=offset,
        gradient=gradient,
        centre=problem.centre,
        response=response,
        covariance=inverse,
        noise=_noise(problem, weights, 0.0, 0.0, count),
        burst=_noise(problem, weights, *_within(problem, min(burst, count)), min(burst, count)),
    )


def predict_ambient(
    field: AmbientField, board: Board, T_b_t: Float[Array, "4 4"]
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, "c c"]]:
    """Reading of a skin that touches nothing.

    Args:
        field: Fitted.
        board: Of the skin.
        T_b_t: Tool in base, m.

    Returns:
        The reading (uT), NaN for a chip of unknown offset, and its covariance (uT^2), without the noise of samples.
    """
    predicted, jacobian = _prediction(field, board, np.asarray(T_b_t, float)[None])
    chips = board.num_chips
    turns = np.zeros((3 * chips, 3 * chips))
    for chip, rotation in enumerate(np.asarray(board.rotations, float)):
        turns[3 * chip : 3 * chip + 3, 3 * chip : 3 * chip + 3] = rotation.T
    spread = turns @ jacobian[0].reshape(3 * chips, -1)
    return np.asarray(board.to_board(predicted[0])), spread @ field.covariance @ spread.T


def subtract_ambient(
    field: AmbientField, board: Board, T_b_t: Float[Array, "*n 4 4"], reading: Float[Array, "*n c"]
) -> Float[np.ndarray, "*n c"]:
    """Readings without the ambient field.

    Args:
        field: Fitted.
        board: Of the skin.
        T_b_t: Tool in base at each reading, m.
        reading: uT.

    Returns:
        uT; NaN for chips that are missing, in the reading or in the fit.
    """
    poses = np.asarray(T_b_t, float).reshape(-1, 4, 4)
    predicted, _ = _prediction(field, board, poses)
    return np.asarray(reading, float) - np.asarray(board.to_board(predicted)).reshape(np.shape(reading))


def ambient_changed(field: AmbientField, board: Board, poses: FreePoses, *, false_alarm: float = 0.01) -> AmbientChange:
    """Test new free readings against a fitted field.

    Args:
        field: Fitted.
        board: Of the skin.
        poses: New free poses, one at least. Their samples are averaged; means of fewer samples than the fit had at
            a pose are judged by the noise of its bursts.
        false_alarm: How often a field that has not changed may be called changed.

    Returns:
        The answer, with what changed.

    Raises:
        ValueError: No chip is known in both.
    """
    T_b_t = np.asarray(poses.T_b_t, float)
    noise = field.noise if poses.samples.shape[1] >= field.noise.samples else field.burst
    predicted, jacobian = _prediction(field, board, T_b_t)
    residual = np.asarray(board.to_tool(poses.reading)) - predicted
    known = np.isfinite(residual).all((0, 2))
    if not known.any():
        raise ValueError("no chip answers in all of these poses and in the fitted field; look at the skin")
    common, own = _split(int(known.sum()))
    p_values = []
    for basis, size, dof in ((common, noise.common, noise.dof_common), (own, noise.chip, noise.dof_chip)):
        parts = np.einsum("bi,pix->pbx", basis, residual[:, known]).ravel()
        if not parts.size:
            p_values.append(1.0)
            continue
        jacobians = np.einsum("bi,pixk->pbxk", basis, jacobian[:, known]).reshape(len(parts), -1)
        spread = jacobians @ field.covariance @ jacobians.T
        spread[np.diag_indices(len(parts))] += np.tile(np.maximum(size, LEAST_NOISE_UT), len(parts) // 3) ** 2
        statistic = parts @ np.linalg.solve(spread, parts) / len(parts)
        p_values.append(float(special.fdtrc(len(parts), max(1.0, float(dof)), statistic)))
    shared = np.einsum("pij,pj->pi", T_b_t[:, :3, :3], residual[:, known].mean(1)).mean(0)
    sizes = np.where(known, np.sqrt(np.mean(np.nan_to_num(residual) ** 2, axis=(0, 2))), 0.0)
    return AmbientChange(
        changed=min(p_values) < false_alarm / 2,
        field_p=p_values[0],
        chips_p=p_values[1],
        field=shared,
        chip=int(np.argmax(sizes)),
        residual=float(np.sqrt(np.mean(residual[:, known] ** 2))),
    )


def save_ambient(path: Path | str, field: AmbientField, about: Mapping[str, str] | None = None) -> None:
    """Write a field to a file.

    Args:
        path: Of the file, .npz; one that is there is replaced.
        field: Fitted.
        about: Whose it is, in words.

    Raises:
        SerializationError: The file cannot be written.
    """
    serialization.save(path, FIELD_KIND, field, dict(about or {}))


def load_ambient(path: Path | str, board: Board | None = None) -> tuple[AmbientField, dict[str, str]]:
    """Read a field.

    Args:
        path: Of a file that `save_ambient` wrote.
        board: Of the skin it is for.

    Returns:
        The field, and whose it is.

    Raises:
        SerializationError: There is no such file, or it is damaged.
        ValueError: The field is of a board with another number of chips.
    """
    field, about = serialization.load(path, FIELD_KIND, AmbientField)
    with serialization.fitting(path):
        chips = len(field.offset)
        shapes = {"earth": (3,), "offset": (chips, 3), "gradient": (5,), "centre": (3,), "response": (chips, 3, 3)}
        shapes["covariance"] = (8 + 12 * chips, 8 + 12 * chips)
        for name, shape in shapes.items():
            values = np.asarray(getattr(field, name), float)
            if values.shape != shape or (name != "offset" and not np.isfinite(values).all()):
                raise ValueError(f"{name} is not {shape} finite numbers")
    if board is not None and chips != board.num_chips:
        raise ValueError(
            f"{path}: is the ambient field of {chips} chips, and the board has {board.num_chips}; "
            "name the field of this skin"
        )
    return field, about


def mean_known(values: Float[np.ndarray, "*n"], axis: int) -> Float[np.ndarray, "*m"]:
    """Mean of the values that are not NaN.

    Args:
        values: Any numbers, some of them missing.
        axis: Along which the mean is taken.

    Returns:
        The mean; NaN where nothing is known.
    """
    known = np.isfinite(values)
    count = known.sum(axis)
    total = np.where(known, values, 0.0).sum(axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


# The least squares. Parameters are, in this order: earth 3, offsets 3n, gradient 5, responses 9n; all in tool or base
# axes as in `AmbientField`.


class _Problem(NamedTuple):
    """Free poses as the fit sees them."""

    T_b_t: np.ndarray  # (p, 4, 4)
    chips: np.ndarray  # (n, 3) m, in the tool
    samples: np.ndarray  # (p, s, n, 3) uT, tool axes
    reading: np.ndarray  # (p, n, 3) uT, their means
    scale: np.ndarray  # (3,) scatter of x, y and z, about 1
    centre: np.ndarray  # (3,) m


class _Weights(NamedTuple):
    """Variances of a pose's mean, relative to the square of the scale."""

    chip: float
    common: float  # of the root of the number of chips times what they share
    dof_chip: float
    dof_common: float


def _check(poses: FreePoses, board: Board) -> None:
    T_b_t, samples = np.asarray(poses.T_b_t), np.asarray(poses.samples)
    n = len(T_b_t)
    if T_b_t.shape != (n, 4, 4) or samples.ndim != 3 or samples.shape[::2] != (n, board.num_readings):
        raise ValueError(
            f"free poses have shapes {T_b_t.shape} and {samples.shape}; give (p, 4, 4), and (p, s, "
            f"{board.num_readings}) for this board"
        )
    if n < MIN_POSES:
        raise ValueError(f"{n} free poses tell no ambient field; take at least {MIN_POSES}, better a dozen")
    if not np.isfinite(T_b_t).all() or not np.isfinite(samples).any():
        raise ValueError("free poses hold no readings, or poses that are not finite; take them again")
    moved = T_b_t[:, :3, :3] - T_b_t[:, :3, :3].mean(0)
    weakest = np.linalg.eigvalsh(np.einsum("pij,pkj->ik", moved, moved) / n)[0]
    if not weakest >= MIN_TURN**2:
        raise ValueError(
            "the free poses hardly turn the skin, so the Earth's field and the chips' offsets cannot be told apart; "
            "tilt it by 30 degrees or more about two axes"
        )


def _problem(poses: FreePoses, board: Board) -> _Problem:
    samples = np.asarray(board.to_tool(np.asarray(poses.samples, float)))
    within = samples - mean_known(samples, axis=1)[:, None]
    scatter = np.sqrt(mean_known(within.reshape(-1, 3) ** 2, axis=0))
    usable = samples.shape[1] > 1 and bool((scatter > LEAST_NOISE_UT).all())
    T_b_t, chips = np.asarray(poses.T_b_t, float), np.asarray(board.chips, float)
    return _Problem(
        T_b_t=T_b_t,
        chips=chips,
        samples=samples,
        reading=mean_known(samples, axis=1),
        scale=scatter / scatter.mean() if usable else np.ones(3),
        centre=_places(T_b_t, chips).mean((0, 1)),
    )


def _places(T_b_t: np.ndarray, chips: np.ndarray) -> np.ndarray:
    """Chip positions (p, n, 3) m in the base."""
    return np.einsum("pij,nj->pni", T_b_t[:, :3, :3], chips) + T_b_t[:, None, :3, 3]


def _solve(problem: _Problem, weights: _Weights) -> tuple[np.ndarray, np.ndarray]:
    """All parameters by Gauss-Newton, and their covariance."""
    chips = len(problem.chips)
    silent = ~np.isfinite(problem.reading).any((0, 2))
    prior = np.concatenate(
        [
            np.zeros(3),
            np.repeat(np.where(silent, 1.0, 0.0), 3),  # keeps a chip that never answered solvable
            np.full(5, GRADIENT_STD_UT_M**-2.0),
            np.full(9 * chips, RESPONSE_STD**-2.0),
        ]
    )
    theta = np.zeros(len(prior))
    for _ in range(MAX_FIT_STEPS):
        residual, jacobian = _whitened(problem, theta, weights)
        normal = jacobian.T @ jacobian + np.diag(prior)
        step = np.linalg.solve(normal, jacobian.T @ residual - prior * theta)
        theta += step
        if np.abs(step).max() < CONVERGED * max(1.0, np.abs(theta).max()):
            break
    return theta, np.linalg.inv(normal)


def _whitened(problem: _Problem, theta: np.ndarray, weights: _Weights) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (m,) of unit variance without correlation, and their Jacobian (m, k) in the parameters."""
    predicted, jacobian = _model(theta, problem.T_b_t, problem.chips, problem.centre)
    residual = (problem.reading - predicted) / problem.scale
    jacobian = jacobian / problem.scale[:, None]
    bases = np.zeros((len(residual), len(problem.chips), len(problem.chips)))
    known = np.isfinite(residual).all(-1)
    for pose, here in enumerate(known):
        common, own = _split(int(here.sum()))
        whitening = np.concatenate([common / np.sqrt(weights.common), own / np.sqrt(weights.chip)])
        bases[pose][np.ix_(np.arange(len(whitening)), here)] = whitening
    there = np.arange(known.shape[1]) < known.sum(1)[:, None]
    rows = bases @ np.where(known[..., None], residual, 0.0)
    columns = bases @ jacobian.reshape(len(residual), len(problem.chips), -1)
    return rows[there].ravel(), columns.reshape(*known.shape, 3, -1)[there].reshape(rows[there].size, -1)


def _weights(problem: _Problem, theta: np.ndarray, before: _Weights, inverse: np.ndarray) -> _Weights:
    """Variances of both parts of the noise, each from its own residuals and degrees of freedom."""
    residual, jacobian = _whitened(problem, theta, before)
    counts = np.isfinite(problem.reading).all(-1).sum(1)
    shared = np.concatenate([np.arange(3 * known) < 3 for known in counts])  # the rows that all chips share
    found = []
    for part, variance in ((~shared, before.chip), (shared, before.common)):
        rows = int(part.sum())
        used = float(np.sum((jacobian[part] @ inverse) * jacobian[part]))
        dof = max(1.0, rows - used)
        least = (LEAST_NOISE_UT / problem.scale.min()) ** 2
        found.append((max(least, variance * float(residual[part] @ residual[part]) / dof) if rows else variance, dof))
    (chip, dof_chip), (common, dof_common) = found
    return _Weights(chip, max(chip, common), dof_chip, dof_common)


def _within(problem: _Problem, burst: int) -> tuple[float, float]:
    """Variances, relative to the scale, by which means of bursts scatter about the mean of their pose: of chips by
    themselves, and of their shared part.
    """
    poses, samples = problem.samples.shape[:2]
    count = samples // burst
    if count < 2:
        return 0.0, 0.0
    bursts = mean_known(problem.samples[:, : count * burst].reshape(poses, count, burst, -1, 3), axis=2)
    parts: list[list[np.ndarray]] = [[], []]
    for means in (bursts - mean_known(bursts, axis=1)[:, None]).reshape(poses * count, -1, 3) / problem.scale:
        known = np.isfinite(means).all(-1)
        for place, basis in enumerate(_split(int(known.sum()))):
            parts[place].append((basis @ means[known]).ravel())
    common, own = (np.concatenate(part) for part in parts)
    return float(np.mean(own**2)) if own.size else 0.0, float(np.mean(common**2))


def _noise(problem: _Problem, weights: _Weights, chip: float, common: float, samples: int) -> AmbientNoise:
    return AmbientNoise(
        chip=problem.scale * np.sqrt(weights.chip + chip),
        common=problem.scale * np.sqrt(weights.common + common),
        dof_chip=np.array(weights.dof_chip),
        dof_common=np.array(weights.dof_common),
        samples=np.array(float(samples)),
    )


@lru_cache
def _split(chips: int) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal bases over chips (Helmert): of their shared part (1, n), and of their differences (n - 1, n)."""
    if chips == 0:
        return np.zeros((0, 0)), np.zeros((0, 0))
    own = np.zeros((chips - 1, chips))
    for row in range(1, chips):
        own[row - 1, :row], own[row - 1, row] = 1.0, -row
        own[row - 1] /= np.sqrt(row * (row + 1.0))
    return np.full((1, chips), chips**-0.5), own


def _parts(theta: np.ndarray, chips: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Earth (3,), offsets (n, 3), gradient (5,) and responses (n, 3, 3), as copies."""
    earth, offset, gradient, response = np.split(theta.copy(), [3, 3 + 3 * chips, 8 + 3 * chips])
    return earth, offset.reshape(chips, 3), gradient, response.reshape(chips, 3, 3)


def _model(
    theta: np.ndarray, T_b_t: np.ndarray, chips: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fields (p, n, 3) uT in tool axes, and their Jacobian (p, n, 3, k) in all parameters."""
    poses, n = len(T_b_t), len(chips)
    earth, offset, gradient, response = _parts(theta, n)
    back = T_b_t[:, :3, :3].swapaxes(-1, -2)
    lever = _lever(_places(T_b_t, chips) - centre)  # (p, n, 3, 5)
    turned = np.einsum("pij,pnj->pni", back, earth + lever @ gradient)
    seen = np.eye(3) + response
    jacobian = np.zeros((poses, n, 3, len(theta)))
    jacobian[..., :3] = np.einsum("nij,pjk->pnik", seen, back)
    each = np.arange(n)
    for axis in range(3):
        jacobian[:, each, axis, 3 + 3 * each + axis] = 1.0
        for other in range(3):
            jacobian[:, each, axis, 8 + 3 * n + 9 * each + 3 * axis + other] = turned[..., other]
    jacobian[..., 3 + 3 * n : 8 + 3 * n] = np.einsum("nij,pjk,pnkg->pnig", seen, back, lever)
    return np.einsum("nij,pnj->pni", seen, turned) + offset, jacobian


def _lever(away: np.ndarray) -> np.ndarray:
    """Field (uT), (..., 3, 5), at a distance (..., 3) m from the centre, by the gradient's five numbers."""
    x, y, z = away[..., 0], away[..., 1], away[..., 2]
    none = np.zeros_like(x)
    rows = [[x, none, y, z, none], [none, y, x, none, z], [-z, -z, none, x, y]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _prediction(field: AmbientField, board: Board, T_b_t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fields (p, n, 3) uT in tool axes, and their Jacobian (p, n, 3, k) in the parameters."""
    theta = np.concatenate([field.earth, field.offset.ravel(), field.gradient, field.response.ravel()])
    return _model(theta, T_b_t, np.asarray(board.chips, float), field.centre)
