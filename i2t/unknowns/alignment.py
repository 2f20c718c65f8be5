"""An earlier session of the same skin, laid over a later one: height, shift along the skin, gain of each chip.

Between two sessions the skin was taken off, or the robot homed: the same press is elsewhere by a few tenths of a
millimetre, deeper or less deep, and read larger or smaller. The earlier session is a map, reading = F(x, d); the later
one is y = g_chip F(x + s, d + h) + noise. s, h and g are found from the presses of the later session by least squares
with priors, so that a few presses move them little and none not at all. The same least squares asks whether chips were
swapped or an axis flipped in between, and whether a part of the skin was magnetized anew. NumPy only.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import least_squares, linear_sum_assignment

from i2t.unknowns.findings import AXES, Finding, corrected_readings
from i2t.unknowns.smooth import left_out, thinned

ALIGNMENT = "earlier session"
ALIGNED_CHIPS = "chips since the earlier session"
MAP_PRESSES = 350  # of the earlier session that its map is made of
ALIGNED_PRESSES = 120  # of the later one: more tell no more
SHIFT_STD_M = 1e-3
LOAD_STD = 0.3  # of the loads' range, where both sessions count them alike
SESSION_GAIN_STD = 0.15  # of the logarithm
CHIP_GAIN_STD = 0.1  # of the logarithm of one chip's gain over all chips'
PRIOR_PRESSES = 3.0  # presses' worth of error that the priors stand for, at least
SWAP_ERROR_RATIO = 0.8  # of the squared error: what chips in another order must leave at most
CHANGED_SKIN_R2 = 0.3  # below it the sessions are not of one skin
MIN_CHIPS_SINCE = 8  # presses
MAP_OFFSETS = (0.1, 0.7, 1.4)
MAP_POWERS = (1.0, 1.5, 2.0)
MAP_LENGTHS = (3e-3, 6e-3, 12e-3)
MAP_NOISES = (1e-3, 1e-2, 0.1)


class SessionMap(NamedTuple):
    """Map of an earlier session, which predicts every press."""

    position: Float[np.ndarray, "m 2"]  # m
    load: Float[np.ndarray, " m"]  # m of depth, or N
    weights: Float[np.ndarray, "m c"]
    unit: float  # of the loads
    shape: tuple[float, ...]  # load below zero at which nothing is read (in units), power, and length (m)
    r2: float  # of its own presses, each predicted from the others


class Alignment(NamedTuple):
    """Alignment of a later session on an earlier one: its press (x, d) is the earlier's (x + shift, d + load)."""

    shift: Float[np.ndarray, " 2"]  # m
    load: float  # m or N
    gain: Float[np.ndarray, " chips"]
    shift_std: Float[np.ndarray, " 2"]
    load_std: float
    r2: float  # of the later presses, aligned
    r2_unaligned: float


def fit_session_map(
    position: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"]
) -> SessionMap:
    """The map of an earlier session: a Gaussian process that grows by a power of the load.

    Args:
        position: Of its presses (m).
        load: Depths (m) or forces (N).
        readings: Of the presses (uT).

    Returns:
        The map.
    """
    rows = thinned(len(load), MAP_PRESSES)
    at, load, values = position[rows].astype(float), load[rows].astype(float), readings[rows].astype(float)
    unit = max(float(np.quantile(np.abs(load), 0.9)), 1e-9)
    square = ((at[:, None] - at[None]) ** 2).sum(-1)
    scale = max(float(np.mean(values**2)), 1e-30)
    some = slice(200)

    def density(shape: tuple[float, float, float, float]) -> float:
        *form, noise = shape
        covariance = _map_covariance(square[some, some], load[some], load[some], unit, form)
        return left_out(covariance + noise * np.eye(len(covariance)), values[some] / np.sqrt(scale)).log_density

    *form, noise = max(product(MAP_OFFSETS, MAP_POWERS, MAP_LENGTHS, MAP_NOISES), key=density)
    covariance = _map_covariance(square, load, load, unit, form) + noise * np.eye(len(load))
    error = left_out(covariance, values).error
    r2 = 1 - float((error**2).sum() / max(((values - values.mean(0)) ** 2).sum(), 1e-30))
    weights = cho_solve((cholesky(covariance, lower=True), True), values)
    return SessionMap(at, load, weights, unit=unit, shape=tuple(form), r2=r2)


def predict_session(
    session: SessionMap, position: Float[np.ndarray, "n 2"], load: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n c"]:
    """Predict the readings of the earlier session.

    Args:
        session: Its map.
        position: Of presses (m).
        load: Their loads.

    Returns:
        Readings (uT).
    """
    square = ((position[:, None] - session.position[None]) ** 2).sum(-1)
    return _map_covariance(square, load, session.load, session.unit, session.shape) @ session.weights


def align_session(
    session: SessionMap,
    position: Float[np.ndarray, "n 2"],
    load: Float[np.ndarray, " n"],
    readings: Float[np.ndarray, "n c"],
    *,
    load_known: bool = True,
) -> Alignment:
    """Lay a later session on an earlier one.

    Args:
        session: The earlier one.
        position: Of the later presses (m).
        load: Their loads, counted as the earlier session's are as well as is known.
        readings: Theirs (uT).
        load_known: Whether the loads of both sessions count from about the same zero. Otherwise any load of the earlier
            session may be meant.

    Returns:
        The alignment; without presses it is none, with the spread of the priors.
    """
    chips = max(readings.shape[1] // AXES, 1)
    load_std = session.unit * (LOAD_STD if load_known else 1.0)
    if not len(load):
        shift_std = np.full(2, SHIFT_STD_M)
        return Alignment(np.zeros(2), 0.0, np.ones(chips), shift_std, load_std, r2=np.nan, r2_unaligned=np.nan)
    rows = thinned(len(load), ALIGNED_PRESSES)
    at, load, values = position[rows].astype(float), load[rows].astype(float), readings[rows].astype(float)
    total = max(float(((values - values.mean(0)) ** 2).sum()), 1e-30)
    before = predict_session(session, at, load)
    # What an aligned map leaves is about what the map leaves of its own presses, and the priors count in these.
    error = np.sqrt(max(1 - session.r2, 0.02) * np.mean(values**2))
    tempered = error * np.sqrt(max(len(load) / PRIOR_PRESSES, 1.0) ** 0.5)

    def moved(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        expected = predict_session(session, at + SHIFT_STD_M * theta[:2], load + load_std * theta[2])
        return expected, np.repeat(_gains(expected, values, chips, error), AXES)

    def residual(theta: np.ndarray) -> np.ndarray:
        expected, gain = moved(theta)
        log_gain = np.log(np.clip(gain[::AXES], 1e-2, 1e2)).mean() / SESSION_GAIN_STD
        return np.concatenate([((values - gain * expected) / tempered).ravel(), theta, [log_gain]])

    starts = [0.0] if load_known else [-1.0, -0.5, 0.0, 0.5, 1.0]
    found = min(
        (least_squares(residual, [0.0, 0.0, start], method="lm", diff_step=1e-3) for start in starts),
        key=lambda one: one.cost,
    )
    theta = found.x
    spread = np.sqrt(np.diagonal(np.linalg.pinv(found.jac.T @ found.jac)))
    expected, gain = moved(theta)
    return Alignment(
        shift=SHIFT_STD_M * theta[:2], load=float(load_std * theta[2]), gain=gain[::AXES],
        shift_std=SHIFT_STD_M * spread[:2], load_std=float(load_std * spread[2]),
        r2=1 - float(((values - gain * expected) ** 2).sum()) / total,
        r2_unaligned=1 - float(((values - before) ** 2).sum()) / total,
    )  # fmt: skip


def lay_over(
    session: SessionMap,
    position: Float[np.ndarray, "n 2"],
    load: Float[np.ndarray, " n"],
    readings: Float[np.ndarray, "n c"],
    *,
    load_known: bool = True,
    unit: str = "m",
) -> tuple[Alignment, Float[np.ndarray, "n c"], list[Finding]]:
    """Align a later session, and again with its chips put back where they were, if that explains it better.

    Args:
        session: The earlier one.
        position: Of the later presses (m).
        load: Their loads.
        readings: Theirs (uT).
        load_known: As for `align_session`.
        unit: Of the loads: m or N.

    Returns:
        The alignment, the readings that it is of, and the findings.
    """
    alignment = align_session(session, position, load, readings, load_known=load_known)
    if not len(load):
        said = "The earlier session is taken as it is: there is no press to align it by."
        return alignment, readings, [Finding(ALIGNMENT, said, False)]
    since = _chips_since(predict_session(session, position + alignment.shift, load + alignment.load), readings)
    findings = [_alignment_finding(alignment, len(load), unit), since]
    if not since.correction:
        return alignment, readings, findings
    put_back = corrected_readings(readings, since.correction)
    again = align_session(session, position, load, put_back, load_known=load_known)
    if not again.r2 > alignment.r2:
        return alignment, readings, findings[:1]
    return again, put_back, [_alignment_finding(again, len(load), unit), since]


def _alignment_finding(alignment: Alignment, presses: int, unit: str) -> Finding:
    """Say how a later session lies on an earlier one."""
    factor, name, unit = (1e3, "height", "mm") if unit == "m" else (1.0, "force", "N")
    shift, spread = 1e3 * alignment.shift, 1.645e3 * alignment.shift_std
    load, load_spread = factor * alignment.load, 1.645 * factor * alignment.load_std
    same = alignment.r2 > CHANGED_SKIN_R2
    sentence = (
        f"The earlier session lies shifted by {shift[0]:+.2f} +- {spread[0]:.2f} mm and {shift[1]:+.2f} +- "
        f"{spread[1]:.2f} mm, in {name} by {load:+.2f} +- {load_spread:.2f} {unit}, with gains "
        f"{np.round(alignment.gain, 2).tolist()}: it explains {alignment.r2:.2f} of the readings so, and "
        f"{alignment.r2_unaligned:.2f} as recorded"
        f"{'.' if same else '; that is no earlier session of this skin, or the skin has changed.'}"
    )
    return Finding(
        ALIGNMENT, sentence, identifiable=same, wrong=not same,
        evidence={
            "r2_as_recorded": alignment.r2_unaligned, "r2_aligned": alignment.r2, "shift_x_mm": shift[0],
            "shift_y_mm": shift[1], f"{name}_{unit}": load, "gain": float(np.mean(alignment.gain)), "presses": presses,
        },
        correction={
            "shift_m": alignment.shift.tolist(), "load": alignment.load, "gain": alignment.gain.tolist()
        } if same else {},
    )  # fmt: skip


def _chips_since(expected: np.ndarray, readings: np.ndarray) -> Finding:
    """Test whether chips were swapped or axes flipped since the earlier session."""
    n, channels = readings.shape
    chips = channels // AXES
    if n < MIN_CHIPS_SINCE or chips < 2:
        return Finding(ALIGNED_CHIPS, "Whether chips changed places is not identifiable: too few presses.", False)
    y, e = readings.reshape(n, chips, AXES), expected.reshape(n, chips, AXES)
    # What is left of recorded chip p where chip c is expected, each axis with its better sign, the chip with its gain.
    along = np.einsum("ica,ipa->cpa", e, y)
    left = (y**2).sum((0, 2))[None] - np.abs(along).sum(2) ** 2 / np.maximum((e**2).sum((0, 2)), 1e-30)[:, None]
    best = linear_sum_assignment(left)[1]
    as_recorded, least = float(np.trace(left)), float(left[np.arange(chips), best].sum())
    swapped = least < SWAP_ERROR_RATIO * as_recorded
    order = best if swapped else np.arange(chips)
    signs = np.ones((chips, AXES))
    size = np.sqrt((y[:, order] ** 2).sum(0) * (e**2).sum(0))
    signs[along[np.arange(chips), order] < -0.5 * np.maximum(size, 1e-30)] = -1
    said = []
    if swapped:
        said.append(f"chips {' and '.join(str(i) for i in np.flatnonzero(order != np.arange(chips)))} changed places")
    if (signs < 0).any():
        turned = ", ".join(f"{'xyz'[axis]} of chip {chip}" for chip, axis in np.argwhere(signs < 0))
        over = ", a chip or a magnet was turned over" if (signs < 0).all(1).any() else ""
        said.append(f"these now read the other way: {turned}{over}")
    return Finding(
        ALIGNED_CHIPS,
        f"Since the earlier session {' and '.join(said)}." if said else "Chips and axes are as they were.",
        identifiable=True, wrong=bool(said), evidence={"error_as_recorded": as_recorded, "error_best": least},
        correction={"chip_order": order.tolist(), "channel_signs": signs.ravel().tolist()} if said else {},
    )  # fmt: skip


def _gains(expected: np.ndarray, values: np.ndarray, chips: int, error: float) -> np.ndarray:
    """Gain of each chip: drawn to that of all chips, and that one to 1."""
    e, y = (part.reshape(len(part), chips, -1) for part in (expected, values))
    both, own = (e * y).sum((0, 2)), (e * e).sum((0, 2))
    prior = error**2 / SESSION_GAIN_STD**2 * len(values) ** 0.5
    together = (both.sum() + prior) / (own.sum() + prior)
    chip_prior = error**2 / CHIP_GAIN_STD**2 * len(values) ** 0.5
    return (both + chip_prior * together) / (own + chip_prior)


def _map_covariance(
    square: np.ndarray, a: np.ndarray, b: np.ndarray, unit: float, shape: Sequence[float]
) -> np.ndarray:
    offset, power, length = shape
    growth = np.outer(*(np.maximum((load / unit + offset) / (1 + offset), 0.0) ** power for load in (a, b)))
    bent = np.exp(-square / (2 * (0.4 * length) ** 2) - (a[:, None] - b[None]) ** 2 / (2 * unit**2))
    return growth * (np.exp(-square / (2 * length**2)) + 0.02 * bent)
