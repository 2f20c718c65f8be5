"""Height zero: where along its approach the tip first meets the skin, from readings alone.

A recording that follows the tip shows it row by row: within one approach each channel is
y(z) = b + c t + g ((z0 - z)+)^p + noise: a constant, a slow creep along the rows t, and a growth from first contact on.
For a given zero and power that is linear; zero and power are those of the least squared error near the contact.

Single presses tell it together. Above first contact nothing is read; below it a reading grows with the depth
d = z0 - z, at every place by its own map:

    reading(x, z) = (d / unit)^p g(x) + w(x, d) + noise.

The maps g and w are Gaussian processes over the skin; w grows with the depth as an integrated Wiener process, which
begins at first contact with value and slope zero and bends freely afterwards, as no skin grows by a power exactly
(kernel: Rasmussen and Williams, "Gaussian Processes for Machine Learning", equation 6.28). z0 is where each press is
best predicted from all others. Presses hardly tell the power p: 0.1 more of it is as good as a zero some 0.03 mm
higher. A ball sinks by a power of 1.5 into a thick layer (Hertz) and of 2 into a thin one on a hard board (Johnson,
"Contact Mechanics", section 5.8), so that p is taken as 1.75, and what it leaves open widens the interval. Where all
presses are below first contact, z0 is extrapolated, and the powers 1.5 to 2 say how far. Where all go to one height, no
number of them tells.

Heights z (m) are along the skin's outward normal, from anywhere. NumPy and SciPy only.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from i2t.recordings.diagnose.findings import Finding
from i2t.recordings.diagnose.smooth import left_out, thinned
from i2t.recordings.presses import Presses

HEIGHT_ZERO = "height zero"
MIN_HEIGHT_RANGE_M = 0.1e-3  # between the lowest and the highest tenth of the presses: less is one height
MIN_ZERO_PRESSES = 30
ONE_HEIGHT_M = 0.1e-3  # presses whose heights differ by less go to one height
HEIGHT_SUBSETS = 3  # of many presses, whose estimates are put together
HEIGHT_SUBSET_PRESSES = 160
FIRST_PRESSES = 80  # by which the zero is found coarsely
POWER = 1.75  # by which readings grow with the depth
USUAL_POWERS = (1.5, 2.0)  # of skins that were measured
POWER_STD = 0.08
USABLE_ZERO_M = 0.1e-3  # an interval of at most this half width is used
SHAPE_ERROR_M = 0.02e-3  # of the zero, as no skin grows by a power exactly
MIN_SHIFT_M = 0.05e-3  # between the zero found and the one stated
FREE_SHARE = 0.01  # of the presses that are above first contact, where it shows
# Of the presses that read although they stand above the stated height: beyond it, what is stated is no first contact.
READING_ABOVE_SHARE = 0.2
ZERO_R2 = 0.3  # of readings that depend on position and height
ZERO_STEP_M = 4e-6
APPROACH_ROWS = 12  # at least, on one way down
APPROACH_SHARE = 0.3  # of the recording's range of heights that an approach covers at least
CONTACT_SHARE = 0.1  # of an approach's largest change: what is beyond says little of the contact
CONTACT_NOISES = 8.0  # standard deviations of a reading's norm: an onset must rise above its noise
REST_ROWS = 15  # before the tip moves
JITTER_M = 2e-5
ONSET_POWERS = (1.0, 1.25, 1.5, 2.0)
ONSET_SHARE = 0.5  # of what a straight creep leaves unexplained, which an onset explains at least


class _Shape(NamedTuple):
    """Parameters that are not asked for but must be chosen."""

    length: float  # m, of the map
    free: float  # share of the variance that does not grow by the power
    noise: float  # variance, of that at the deepest presses
    relative_noise: float  # standard deviation, of the signal's at the same depth


class _Fit(NamedTuple):
    zero: float  # m
    r2: float
    statistical: float  # m, standard error
    of_power: float  # m, by which the zero moves with what is left open of the power
    usual: tuple[float, ...]  # m, the zero at the usual powers


NOISES = (1e-5, 1e-4, 1e-3, 1e-2)  # variance, of the readings' mean square
HEIGHT_SHAPES = tuple(_Shape(*values) for values in product((3e-3, 6e-3, 12e-3), (0.03, 0.3), NOISES, (0.01, 0.1)))


def find_height_zero(presses: Presses, stated: float | None = None) -> Finding:
    """Estimate the height of first contact.

    Args:
        presses: With heights, in the order of time.
        stated: What the recording says (m), where it does.

    Returns:
        The finding; its estimate, in m, is of the scale of the heights. Where it is not identifiable the interval says
        what is left open, or there is none.
    """
    if presses.height is None or not np.isfinite(presses.height).any():
        return Finding(HEIGHT_ZERO, "Height zero is not identifiable: no height of the tip was recorded.", False)
    if np.isfinite(presses.height).all():
        zeros = find_approaches(np.asarray(presses.height, np.float64), presses.readings)
        if len(zeros):
            return _of_approaches(zeros, stated, presses.height)
    presses = presses.rows(np.isfinite(presses.height))
    height = np.asarray(presses.height, np.float64)
    span = float(np.subtract(*np.quantile(height, [0.95, 0.05])))
    if len(height) < MIN_ZERO_PRESSES or span < MIN_HEIGHT_RANGE_M:
        why = (
            f"{len(height)} presses are too few ({MIN_ZERO_PRESSES} are enough)"
            if len(height) < MIN_ZERO_PRESSES
            else f"all presses go to one height ({1e3 * span:.2g} mm between them)"
        )
        said = f"Height zero is not identifiable from this recording: {why}; how deep it was pressed is unknown."
        return Finding(HEIGHT_ZERO, said, False, evidence={"presses": len(height), "height_range_mm": 1e3 * span})
    order = np.random.default_rng(0).permutation(len(height))
    parts = min(HEIGHT_SUBSETS, max(len(height) // HEIGHT_SUBSET_PRESSES, 1))
    subsets = [presses.rows(np.sort(order[i::parts][:HEIGHT_SUBSET_PRESSES])) for i in range(parts)]
    return _judge([_fit(subset) for subset in subsets], height, stated)


def first_contact(height: Float[np.ndarray, " n"], finding: Finding | None = None) -> float:
    """The height that depths count from.

    Args:
        height: Of presses along the skin's outward normal (m), corrected; NaN where it is not known.
        finding: About the height of first contact, if it was looked for.

    Returns:
        Where readings begin (m), if the presses tell; else that of the highest press, from which all depths may be too
        small by one number; NaN where all presses go to one height, so that nothing is known of a depth.
    """
    if finding is not None and finding.identifiable and finding.estimate is not None:
        return finding.estimate
    if not np.isfinite(height).any() or (finding is not None and np.ptp(height[np.isfinite(height)]) < ONE_HEIGHT_M):
        return float("nan")
    return float(np.nanmax(height))


def find_approaches(height: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"]) -> Float[np.ndarray, " k"]:
    """First contact in each approach of a recording that follows the tip.

    Args:
        height: Of the tip along the skin's outward normal (m), in the order of time.
        readings: At these rows (uT).

    Returns:
        Heights (m) of first contact, one for each approach that shows it; none where rows are single presses.
    """
    falling = np.diff(height) < JITTER_M
    edges = np.flatnonzero(np.diff(np.concatenate([[False], falling, [False]]).astype(int)))
    zeros = []
    for start, stop in zip(edges[::2].tolist(), (edges[1::2] + 1).tolist(), strict=True):
        moved = int(np.argmax(height[start:stop] < height[start] - 2 * JITTER_M))
        way = slice(start + max(moved - REST_ROWS, 0), stop)
        reach = height[way.start] - height[stop - 1]
        if stop - way.start >= APPROACH_ROWS and reach >= max(APPROACH_SHARE * np.ptp(height), 1e-4):
            zeros.append(_onset(height[way], readings[way]))
    return np.array([zero for zero in zeros if zero is not None])


def _onset(height: np.ndarray, readings: np.ndarray) -> float | None:
    """Height at which readings begin to change on one way down, or None where they do not begin within it."""
    change = np.linalg.norm(readings - readings[:3].mean(0), axis=1)
    noise = np.sqrt((np.median(np.diff(readings[: 2 * REST_ROWS], axis=0) ** 2, axis=0) / 0.91).sum())
    beyond = np.flatnonzero(change > max(CONTACT_SHARE * change.max(), CONTACT_NOISES * noise))
    end = max(int(beyond[0]) + 1 if len(beyond) else len(height), APPROACH_ROWS)
    z, y = height[:end], readings[:end]
    if len(z) < APPROACH_ROWS or z[0] - z[-1] < 5e-5:
        return None
    creep = np.column_stack([np.ones(len(z)), np.arange(len(z)) / len(z)])

    def error(zero: float, power: float) -> float:
        return _squared_error(np.column_stack([creep, np.maximum(zero - z, 0) ** power / 1e-3**power]), y)

    candidates = np.linspace(z[-1], z[0], 161)[1:-1]
    errors = np.array([min(error(zero, power) for power in ONSET_POWERS) for zero in candidates])
    zero = float(candidates[errors.argmin()])
    explained = 1 - float(errors.min()) / max(_squared_error(creep, y), 1e-30)
    # A zero at the end of the way has no row above it that would show readings at rest.
    return None if explained < ONSET_SHARE or np.sum(z > zero) < 3 else zero


def _squared_error(design: np.ndarray, values: np.ndarray) -> float:
    q = np.linalg.qr(design)[0]
    return float(((values - q @ (q.T @ values)) ** 2).sum())


def _of_approaches(zeros: np.ndarray, stated: float | None, height: np.ndarray) -> Finding:
    """Finding of the zeros of several approaches in a row."""
    zero, count = float(np.median(zeros)), len(zeros)
    spread = float(np.max(np.abs(zeros - zero)))
    half = max(0.05e-3, 1.2533 * 1.645 * float(np.std(zeros)) / np.sqrt(count))
    wrong = bool(stated is not None and abs(zero - stated) > max(half, 2 * MIN_SHIFT_M))
    first, last = 1e3 * zeros[0], 1e3 * zeros[-1]
    return Finding(
        HEIGHT_ZERO,
        f"First contact is at {1e3 * zero:.3f} mm, the median of {count} approaches, up to {1e3 * spread:.2f} mm off "
        f"it ({int((height > zero).sum())} rows are above it): {first:.2f} mm in the first and {last:.2f} mm in the "
        "last.",
        identifiable=True, wrong=wrong, estimate=zero, low=zero - half, high=zero + half, unit="m",
        evidence={"approaches": count, "largest_deviation_mm": 1e3 * spread, "first_mm": first, "last_mm": last},
        correction={"height_zero_m": zero} if wrong else {},
    )  # fmt: skip


def _judge(fits: list[_Fit], height: np.ndarray, stated: float | None) -> Finding:
    """Put the fits to parts of the presses together."""
    zeros, r2 = np.array([fit.zero for fit in fits]), float(np.median([fit.r2 for fit in fits]))
    zero = float(np.median(zeros))
    statistical = max(float(np.mean([fit.statistical for fit in fits])), float(np.std(zeros))) / np.sqrt(len(fits))
    of_power = float(np.mean([fit.of_power for fit in fits]))
    half = 1.645 * float(np.sqrt(statistical**2 + of_power**2 + SHAPE_ERROR_M**2))
    above = int((height > zero + half).sum())  # beyond doubt
    evidence = {
        "r2": r2, "presses": len(height), "presses_above": above, "spread_between_parts_mm": 1e3 * float(np.ptp(zeros)),
    }  # fmt: skip
    reaches = above >= max(3, FREE_SHARE * len(height))
    if reaches and half <= USABLE_ZERO_M and r2 > ZERO_R2:
        off = 0.0 if stated is None else zero - stated
        wrong = abs(off) > max(half, MIN_SHIFT_M)
        return Finding(
            HEIGHT_ZERO,
            f"First contact is at {1e3 * zero:.3f} mm (90 % interval {1e3 * (zero - half):.3f} to "
            f"{1e3 * (zero + half):.3f}), where readings begin ({above} presses are above it)"
            f"{f'; {1e3 * off:+.3f} mm from what was stated' if wrong else ''}.",
            identifiable=True, wrong=wrong, estimate=zero, low=zero - half, high=zero + half, unit="m",
            evidence=evidence, correction={"height_zero_m": zero} if wrong else {},
        )  # fmt: skip
    why = "no press is above first contact" if not reaches else "parts of the presses disagree"
    if r2 <= ZERO_R2:
        why = f"readings hardly depend on position and height (R2 {r2:.2f})"
    usual = [end for fit in fits for end in fit.usual]
    low, high = min(zero - half, *usual), max(zero + half, *usual)
    off_top = 1e3 * (np.array([low, high]) - float(np.quantile(height, 0.99)))
    if stated is not None and r2 > ZERO_R2:
        reading = float(np.mean((height > stated) & (height < low)))
        if reading > READING_ABOVE_SHARE:
            top = float(height.max())
            too_low = f"{1e3 * (top - stated):.2f} mm"
            return Finding(
                HEIGHT_ZERO,
                f"The height of first contact that depths count from is too low: {100 * reading:.0f} % of the presses "
                f"stand above it and read all the same. Depth counts from the highest press, {too_low} "
                "above it; give the height of first contact if it is known (--z0-mm of the converter).",
                identifiable=False, wrong=True, estimate=zero, low=low, high=high, unit="m",
                evidence=evidence | {"share_reading_above": reading}, correction={"height_zero_m": top},
            )  # fmt: skip
    return Finding(
        HEIGHT_ZERO,
        f"Height zero is not identifiable to {1e3 * USABLE_ZERO_M:g} mm: {why}; if readings grow with the depth to the "
        f"power {USUAL_POWERS[0]:g} to {USUAL_POWERS[1]:g}, first contact is {off_top[0]:+.2f} to {off_top[1]:+.2f} mm "
        "from the highest press.",
        identifiable=False, estimate=zero, low=low, high=high, unit="m", evidence=evidence,
    )  # fmt: skip


def _fit(presses: Presses) -> _Fit:
    """Zero of the growth, first coarsely and by few presses, then finely by all."""
    assert presses.height is not None
    low, high = np.quantile(np.asarray(presses.height, np.float64), [0.05, 1.0])
    reach = high - low
    grid = np.concatenate([np.linspace(low + 0.15 * reach, high, 14), high + reach * np.array([0.1, 0.25, 0.5, 1.0])])
    few, shapes = (
        presses.rows(thinned(len(presses.height), FIRST_PRESSES)),
        [_Shape(6e-3, 0.1, n, 0.05) for n in NOISES],
    )
    zero = max(product(grid, shapes), key=lambda one: _try(few, one[0], POWER, one[1])[0])[0]
    for step in (0.12 * reach, 0.03 * reach):
        shape = max(HEIGHT_SHAPES, key=lambda one: _try(presses, zero, POWER, one)[0])
        zero = _zero_of(presses, zero, POWER, shape, step)
    order = np.random.default_rng(1).permutation(len(presses.height))
    halves = [_zero_of(presses.rows(np.sort(order[i::2])), zero, POWER, shape, step) for i in (0, 1)]
    less, more = (_zero_of(presses, zero, POWER + sign * POWER_STD, shape, step) for sign in (-1, 1))
    usual = tuple(_zero_of(presses, zero, power, shape, 0.2 * reach) for power in USUAL_POWERS)
    r2 = _try(presses, zero, POWER, shape)[1]
    return _Fit(zero, r2, statistical=abs(halves[1] - halves[0]) / 2, of_power=abs(more - less) / 2, usual=usual)


def _zero_of(presses: Presses, zero: float, power: float, shape: _Shape, step: float) -> float:
    """The zero of most density within two steps of a given one."""
    found = minimize_scalar(
        lambda at: -_try(presses, at, power, shape)[0], bounds=(zero - 2 * step, zero + 2 * step), method="bounded",
        options={"xatol": ZERO_STEP_M},
    )  # fmt: skip
    return float(found.x)


def _try(presses: Presses, zero: float, power: float, shape: _Shape) -> tuple[float, float]:
    """Log density and R2 of presses that are predicted from each other with this zero and power."""
    assert presses.height is not None
    depth = np.maximum(zero - np.asarray(presses.height, np.float64), 0)
    depth = depth / max(float(np.quantile(depth, 0.9)), 1e-6)
    grown = depth**power
    square = ((presses.position[:, None] - presses.position[None]) ** 2).sum(-1)
    growth = (1 - shape.free) * grown[:, None] * grown[None] + shape.free * _integrated_wiener(depth)
    covariance = np.exp(-square / (2 * shape.length**2)) * growth
    covariance[np.diag_indices_from(covariance)] += shape.noise + (shape.relative_noise * grown) ** 2
    values = presses.readings / max(np.sqrt(np.mean(presses.readings**2)), 1e-30)
    found = left_out(covariance, values)
    return found.log_density, 1 - float((found.error**2).sum() / max((values**2).sum(), 1e-30))


def _integrated_wiener(depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Covariance of a process that begins at depth zero with value and slope zero, 1 at the depth 1."""
    least, most = np.minimum(depth[:, None], depth[None]), np.maximum(depth[:, None], depth[None])
    return 0.5 * least**2 * (3 * most - least)
