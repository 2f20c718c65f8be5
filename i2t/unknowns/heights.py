"""Height zero: where along its approach the tip first meets the skin, from readings alone.

Above first contact nothing is read; below it a reading grows with the depth d = z0 - z, at every place by its own map:

    reading(x, z) = (d / unit)^p g(x) + w(x, d) + noise.

The maps g and w are Gaussian processes over the skin; w grows with the depth as an integrated Wiener process, which
begins at first contact with value and slope zero and bends freely afterwards, as no skin grows by a power exactly
(kernel: Rasmussen and Williams, "Gaussian Processes for Machine Learning", equation 6.28). z0 and p are those under
which each press is best predicted from all others. A skin hardly tells its power: 0.1 more of it is as good as a zero
some 0.03 mm higher. A ball sinks by a power of 1.5 into a thick layer (Hertz) and of 2 into a thin one on a hard board
(Johnson, "Contact Mechanics", section 5.8), so that p is believed to be near 1.75 unless the presses contradict it.
Where presses were recorded on both sides of first contact, z0 is where the readings begin. Where all are below it, z0
is extrapolated, and the power decides: what 1.5 to 2 leave open is the interval. Where all presses go to one height, no
number of them tells.

Heights z (m) are along the skin's outward normal, from anywhere. NumPy only.
"""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.unknowns.findings import Finding, RecordedPresses
from i2t.unknowns.smooth import left_out, thinned

HEIGHT_ZERO = "height zero"
HEIGHT_DRIFT = "drift of the height zero"
MIN_HEIGHT_RANGE_M = 0.1e-3  # between the lowest and the highest tenth of the presses: less is one height
MIN_ZERO_PRESSES = 30
HEIGHT_SUBSETS = 3  # of many presses, whose estimates are put together
HEIGHT_SUBSET_PRESSES = 160
FIRST_PRESSES = 80  # by which the zero is found coarsely
USUAL_POWERS = (1.5, 2.0)  # of skins that were measured
POWER_STEP = 0.1
POWER_MEAN, POWER_STD = 1.75, 0.1  # of what is believed of the power before any press
POWER_WEIGHT = 60.0  # on this belief, as the log density of readings is of many that are not independent
POWER_LEFT_OPEN = 0.08  # standard deviation of the power, after all presses
USABLE_ZERO_M = 0.1e-3  # an interval of at most this half width is used
SHAPE_ERROR_M = 0.02e-3  # of the zero, as no skin grows by a power exactly
DRIFT_ERRORS = 4.0  # standard errors beyond which a drift is one
MIN_DRIFT_M = 0.05e-3  # over a recording


class _Fit(NamedTuple):
    zero: float  # m
    power: float
    log_density: float
    r2: float
    around: np.ndarray  # (n,) m, how far each press is off the common zero
    statistical: float = 0.0  # m, standard error
    of_power: float = 0.0  # m, by which the zero moves with what is left open of the power
    usual: tuple[float, float] = (0.0, 0.0)  # m, the zero at the usual powers


class _Shape(NamedTuple):
    """Parameters that are not asked for but must be chosen."""

    length: float  # m, of the map
    free: float  # share of the variance that does not grow by the power
    noise: float  # variance, of that at the deepest presses
    relative_noise: float  # standard deviation, of the signal's at the same depth


NOISES = (1e-5, 1e-4, 1e-3, 1e-2)  # variance, of the readings' mean square
HEIGHT_SHAPES = tuple(_Shape(*values) for values in product((3e-3, 6e-3, 12e-3), (0.03, 0.3), NOISES, (0.01, 0.1)))


def find_height_zero(presses: RecordedPresses, stated: float | None = None) -> Finding:
    """Estimate the height of first contact.

    Args:
        presses: With heights.
        stated: What the recording says (m), where it does.

    Returns:
        The finding; its estimate, in m, is of the scale of the heights. Where it is not identifiable the interval says
        what is left open, or there is none.
    """
    if presses.height is None or not np.isfinite(presses.height).any():
        return Finding(HEIGHT_ZERO, "Height zero is not identifiable: no height of the tip was recorded.", False)
    presses = presses.rows(np.isfinite(presses.height))
    height = np.asarray(presses.height, np.float64)
    low, high = np.quantile(height, [0.05, 0.95])
    if len(height) < MIN_ZERO_PRESSES or high - low < MIN_HEIGHT_RANGE_M:
        why = (
            f"{len(height)} presses are too few"
            if len(height) < MIN_ZERO_PRESSES
            else f"all presses go to one height ({1e3 * (high - low):.2g} mm between them)"
        )
        return Finding(
            HEIGHT_ZERO,
            f"Height zero is not identifiable from this recording: {why}; how deep it was pressed is unknown.",
            False,
            evidence={"presses": len(height), "height_range_mm": 1e3 * float(high - low)},
        )
    return _judge([_fit(part) for part in _subsets(presses)], height, stated)


def find_height_drift(presses: RecordedPresses, zero: float) -> Finding:
    """Ask whether the height of first contact changes in the course of a recording.

    Each press is predicted from all others, and what is left of it along its growth with the depth says how far its own
    zero is off; a straight line through these over time is the drift.

    Args:
        presses: With heights, in the order of time.
        zero: Height of first contact (m), or any height above all presses.

    Returns:
        The finding; the estimate is the change from the first press to the last (mm).
    """
    if presses.height is None or len(presses.height) < 2 * MIN_ZERO_PRESSES:
        return Finding(HEIGHT_DRIFT, "A drift of the height zero is not identifiable: too few heights.", False)
    rows = thinned(len(presses.height), 2 * HEIGHT_SUBSET_PRESSES)
    time = np.arange(len(presses.height), dtype=float)
    if presses.seconds is not None and float(np.ptp(presses.seconds)) > 0:  # else a clock that stands still
        time = np.asarray(presses.seconds, np.float64)
    span = max(float(time[-1] - time[0]), 1e-9)
    chosen = presses.rows(rows)
    depth = zero - np.asarray(chosen.height, np.float64)
    below = depth > 0.1 * max(np.quantile(depth, 0.95), 0)
    if below.sum() < 2 * MIN_ZERO_PRESSES or np.ptp(depth[below]) < MIN_HEIGHT_RANGE_M:
        return Finding(
            HEIGHT_DRIFT, "A drift of the height zero is not identifiable: all presses go to one height.", False
        )
    chosen, at = chosen.rows(below), (time[rows][below] - time[0]) / span - 0.5
    around = _best_shape(chosen, zero, 1.75).around
    middle = np.median(around)
    spread = 1.4826 * np.median(np.abs(around - middle)) + 1e-12
    firm = np.abs(around - middle) < 4 * spread
    x, y = at[firm] - at[firm].mean(), around[firm]
    slope = float(x @ y / (x @ x))
    residual = y - y.mean() - slope * x
    error = float(np.sqrt(residual @ residual / max(len(y) - 2, 1) / (x @ x)))
    drifts = abs(slope) > DRIFT_ERRORS * error and abs(slope) > MIN_DRIFT_M
    found = f"{1e3 * slope:+.3f} mm from the first press to the last (standard error {1e3 * error:.3f} mm)"
    return Finding(
        HEIGHT_DRIFT,
        f"Height zero {'drifts by ' + found if drifts else 'does not drift beyond chance: ' + found}.",
        identifiable=True,
        estimate=1e3 * slope,
        low=1e3 * (slope - 1.645 * error),
        high=1e3 * (slope + 1.645 * error),
        unit="mm",
        evidence={"standard_error_mm": 1e3 * error, "presses": int(firm.sum()), "drifts": float(drifts)},
    )


def _subsets(presses: RecordedPresses) -> list[RecordedPresses]:
    """Random parts of the presses, apart from each other; one of all where there are few."""
    n = len(presses.readings)
    order = np.random.default_rng(0).permutation(n)
    parts = min(HEIGHT_SUBSETS, max(n // HEIGHT_SUBSET_PRESSES, 1))
    return [presses.rows(np.sort(order[i::parts][:HEIGHT_SUBSET_PRESSES])) for i in range(parts)]


def _judge(fits: list[_Fit], height: np.ndarray, stated: float | None) -> Finding:
    """Put the fits to parts of the presses together."""
    zeros = np.array([fit.zero for fit in fits])
    zero, power = float(np.median(zeros)), float(np.median([fit.power for fit in fits]))
    statistical = max(float(np.mean([fit.statistical for fit in fits])), float(np.std(zeros))) / np.sqrt(len(fits))
    of_power = float(np.mean([fit.of_power for fit in fits]))
    half = 1.645 * float(np.sqrt(statistical**2 + of_power**2 + SHAPE_ERROR_M**2))
    above = int((height > zero + half).sum())  # beyond doubt
    spread = float(np.ptp(zeros))
    evidence = {
        "r2": float(np.median([fit.r2 for fit in fits])),
        "power": power,
        "presses": len(height),
        "presses_above": above,
        "spread_between_parts_mm": 1e3 * spread,
    }
    r2 = evidence["r2"]
    reaches = above >= max(3, 0.01 * len(height))
    known = bool(reaches and half <= USABLE_ZERO_M and r2 > 0.3)
    at = f"{1e3 * zero:.3f} mm (90 % interval {1e3 * (zero - half):.3f} to {1e3 * (zero + half):.3f})"
    if known:
        off = 0.0 if stated is None else zero - stated
        wrong = bool(stated is not None and abs(off) > max(half, 0.05e-3))
        said = f"; {1e3 * off:+.3f} mm from what was stated" if wrong else ""
        sentence = f"First contact is at {at}, where readings begin ({above} presses are above it){said}."
        return Finding(
            HEIGHT_ZERO, sentence, identifiable=True, wrong=wrong, estimate=zero, low=zero - half, high=zero + half,
            unit="m", evidence=evidence, correction={"height_zero_m": zero} if wrong else {},
        )  # fmt: skip
    top = float(np.quantile(height, 0.99))
    usual = [end for fit in fits for end in fit.usual]
    low, high = min(zero - half, *usual), max(zero + half, *usual)
    why = "no press is above first contact" if not reaches else "parts of the presses disagree"
    if r2 <= 0.3:
        why = f"readings hardly depend on position and height (R2 {r2:.2f})"
    return Finding(
        HEIGHT_ZERO,
        f"Height zero is not identifiable to {1e3 * USABLE_ZERO_M:g} mm: {why}; if readings grow with the depth to the "
        f"power {USUAL_POWERS[0]:g} to {USUAL_POWERS[1]:g}, first contact is {1e3 * (low - top):+.2f} to "
        f"{1e3 * (high - top):+.2f} mm from the highest press.",
        identifiable=False, estimate=zero, low=low, high=high, unit="m", evidence=evidence,
    )  # fmt: skip


def _fit(presses: RecordedPresses) -> _Fit:
    """Zero and power of the growth, first coarsely and by few presses, then finely by all."""
    assert presses.height is not None
    height = np.asarray(presses.height, np.float64)
    low, high = np.quantile(height, [0.05, 1.0])
    reach = high - low
    grid = np.concatenate([np.linspace(low + 0.15 * reach, high, 14), high + reach * np.array([0.1, 0.25, 0.5, 1.0])])
    few = presses.rows(thinned(len(height), FIRST_PRESSES))
    shapes = [_Shape(6e-3, 0.1, noise, 0.05) for noise in NOISES]
    powers = (*USUAL_POWERS, POWER_MEAN)
    best = max((_try(few, zero, power, one) for zero in grid for power in powers for one in shapes), key=_belief)
    shape = shapes[0]
    for first_step in (0.12 * reach, 0.03 * reach):
        shape = max(HEIGHT_SHAPES, key=lambda one: _try(presses, best.zero, best.power, one).log_density)
        best, step = _try(presses, best.zero, best.power, shape), first_step
        while step > 4e-6:
            near = best.power + POWER_STEP * np.array([-1.0, 0.0, 1.0])
            tried = (_try(presses, best.zero + move, power, shape) for move in step * _MOVES for power in near)
            best, step = max((best, *tried), key=_belief), 0.5 * step
    return best._replace(**_left_open(presses, best, shape, 0.03 * reach))


_MOVES = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])


def _left_open(presses: RecordedPresses, best: _Fit, shape: _Shape, step: float) -> dict[str, Any]:
    """Zeros by each half of the presses alone, by another power and by the usual powers."""
    order = np.random.default_rng(1).permutation(len(presses.readings))
    halves = [_zero_of(presses.rows(np.sort(order[i::2])), best.zero, best.power, shape, step) for i in (0, 1)]
    less, more = (_zero_of(presses, best.zero, best.power + sign * POWER_LEFT_OPEN, shape, step) for sign in (-1, 1))
    ends = tuple(_zero_of(presses, best.zero, power, shape, 4 * step) for power in USUAL_POWERS)
    return {"statistical": abs(halves[1] - halves[0]) / 2, "of_power": abs(more - less) / 2, "usual": ends}


def _zero_of(presses: RecordedPresses, zero: float, power: float, shape: _Shape, step: float) -> float:
    """The zero of most density at a given power, by steps downhill from a given one."""
    while step > 4e-6:
        tried = [_try(presses, zero + move, power, shape) for move in step * _MOVES]
        best = max(tried, key=_density)
        if abs(best.zero - zero) < 0.9 * step:
            step *= 0.5
        zero = best.zero
    return zero


def _belief(fit: _Fit) -> float:
    return fit.log_density - 0.5 * POWER_WEIGHT * ((fit.power - POWER_MEAN) / POWER_STD) ** 2


def _density(fit: _Fit) -> float:
    return fit.log_density


def _best_shape(presses: RecordedPresses, zero: float, power: float) -> _Fit:
    return max((_try(presses, zero, power, shape) for shape in HEIGHT_SHAPES), key=_density)


def _try(presses: RecordedPresses, zero: float, power: float, shape: _Shape) -> _Fit:
    """Fit of presses that are predicted from each other with this zero and power."""
    assert presses.height is not None
    depth = np.maximum(zero - np.asarray(presses.height, np.float64), 0)
    unit = max(float(np.quantile(depth, 0.9)), 1e-6)
    grown = (depth / unit) ** power
    square = ((presses.position[:, None] - presses.position[None]) ** 2).sum(-1)
    growth = (1 - shape.free) * grown[:, None] * grown[None] + shape.free * _integrated_wiener(depth / unit)
    covariance = np.exp(-square / (2 * shape.length**2)) * growth
    covariance[np.diag_indices_from(covariance)] += shape.noise + (shape.relative_noise * grown) ** 2
    values = presses.readings / max(np.sqrt(np.mean(presses.readings**2)), 1e-30)
    found = left_out(covariance, values)
    r2 = 1 - float((found.error**2).sum() / max((values**2).sum(), 1e-30))
    # The slope of a reading along the depth is p / d of what it should be; its error over that is the height's.
    expected = values - found.error
    slope = power / np.maximum(depth, 0.05 * unit)[:, None] * expected
    around = (found.error * slope).sum(1) / np.maximum((slope**2).sum(1), 1e-12)
    return _Fit(zero, power, found.log_density, r2, around)


def _integrated_wiener(depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Covariance of a process that begins at depth zero with value and slope zero, 1 at the depth 1."""
    least, most = np.minimum(depth[:, None], depth[None]), np.maximum(depth[:, None], depth[None])
    return 0.5 * least**2 * (3 * most - least)
