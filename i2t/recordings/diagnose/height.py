"""Height zero: the height at which the tip first meets the skin, inferred from readings alone.

A recording that follows the tip shows first contact in its rows: within one approach each channel is
y(z) = b + c t + g ((z0 - z)+)^p + noise: a constant, a slow creep along the rows t, and a growth from first contact on.
For a given zero and power this model is linear; zero and power minimise the squared error near the contact.

Single presses show first contact together. Above it nothing is read; below it a reading grows with the travel
d = z0 - z, at each place by its own map:

    reading(x, z) = (d / unit)^p g(x) + w(x, d) + noise.

The maps g and w are Gaussian processes over the skin. w grows with travel as an integrated Wiener process, which starts
at first contact with value and slope zero and bends freely below it, as no skin grows exactly by a power (kernel:
Rasmussen and Williams, "Gaussian Processes for Machine Learning", equation 6.28). z0 maximises the leave-one-out
density of the presses. They hardly determine the power p: raising it by 0.1 fits as well as a zero some 0.03 mm higher.
A ball sinks by a power of 1.5 into a thick layer (Hertz) and of 2 into a thin one on a hard board (Johnson, "Contact
Mechanics", section 5.8), so p is fixed at 1.75, and its uncertainty widens the interval. If all presses are below first
contact, z0 is extrapolated, and the powers 1.5 to 2 bound it. If all presses go to one height, it is not identifiable.

Heights z are in metres along the skin's outward normal, from any origin.
"""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from i2t.recordings.diagnose.findings import Finding, FindingName, not_identifiable
from i2t.recordings.diagnose.smooth import leave_one_out, subsample
from i2t.recordings.presses import Presses


@dataclass(frozen=True)
class ApproachConfig:
    """Thresholds for finding first contact within an approach of the tip to the skin.

    Attributes:
        min_rows: Number of rows of an approach, at least.
        min_range_share: Share of the recording's range of heights that an approach covers, at least.
        max_rest_rows: Number of rows before the motion that belong to an approach, at most.
        jitter_m: Change of height that counts as rest.
        max_change_share: Share of an approach's largest change up to which rows show the onset.
        min_change_stds: Standard deviations of a reading's norm by which the onset must rise above the noise.
        powers: Powers of growth to try.
        min_explained_share: Share of the squared error of a straight creep that the growth must explain.
    """

    min_rows: int = 12
    min_range_share: float = 0.3
    max_rest_rows: int = 15
    jitter_m: float = 2e-5
    max_change_share: float = 0.1
    min_change_stds: float = 8.0
    powers: tuple[float, ...] = (1.0, 1.25, 1.5, 2.0)
    min_explained_share: float = 0.5


@dataclass(frozen=True)
class HeightZeroConfig:
    """Model of single presses, and thresholds for estimating the height at which the tip first meets the skin.

    Attributes:
        min_presses: Number of presses below which height zero is not identifiable.
        min_range_m: Range of heights (5 % to 95 %) below which all presses go to one height.
        max_subsets: Number of subsets of many presses whose estimates are combined.
        subset_presses: Number of presses in a subset, at most.
        coarse_presses: Number of presses in the coarse search, at most.
        power: Power by which readings grow with travel.
        power_std: Standard deviation of the power.
        power_range: Powers of skins that were measured.
        lengths_m: Length scales of the maps over the skin to try.
        free_shares: Shares of the variance that do not grow by the power, to try.
        noises: Noise variances to try, relative to the readings' mean square.
        relative_noises: Noise standard deviations to try, relative to the signal at the same travel.
        zero_tolerance_m: Tolerance of the search for the zero.
        shape_std_m: Standard deviation of the zero because no skin grows exactly by a power.
        max_half_width_m: Half width of the interval up to which a zero is used.
        min_shift_m: Difference from the stated height above which that is wrong.
        min_r2: R2 above which readings depend on position and height.
        min_free_share: Share of the presses that must lie above first contact for it to be identifiable.
        max_reading_above_share: Share of the presses that may read although they lie above the stated height of first
            contact; beyond it the stated height is wrong.
        approach: Thresholds for recordings that follow the tip.
    """

    min_presses: int = 30
    min_range_m: float = 0.1e-3
    max_subsets: int = 3
    subset_presses: int = 160
    coarse_presses: int = 80
    power: float = 1.75
    power_std: float = 0.08
    power_range: tuple[float, float] = (1.5, 2.0)
    lengths_m: tuple[float, ...] = (3e-3, 6e-3, 12e-3)
    free_shares: tuple[float, ...] = (0.03, 0.3)
    noises: tuple[float, ...] = (1e-5, 1e-4, 1e-3, 1e-2)
    relative_noises: tuple[float, ...] = (0.01, 0.1)
    zero_tolerance_m: float = 4e-6
    shape_std_m: float = 0.02e-3
    max_half_width_m: float = 0.1e-3
    min_shift_m: float = 0.05e-3
    min_r2: float = 0.3
    min_free_share: float = 0.01
    max_reading_above_share: float = 0.2
    approach: ApproachConfig = ApproachConfig()


class _GrowthModel(NamedTuple):
    """Parameters of the model of single presses, other than zero and power."""

    length: float  # m, length scale of the maps
    free_share: float  # share of the variance that does not grow with travel by the power law
    noise: float  # variance of the noise, relative to the readings' mean square
    relative_noise: float  # standard deviation of the noise, relative to the signal at the same travel


class _Fit(NamedTuple):
    """Zero of one subset of presses."""

    zero: float  # m, estimated height of first contact
    r2: float
    statistical_std: float  # m, statistical standard deviation of the zero
    power_std: float  # m, standard deviation of the zero because the power is uncertain
    range_zeros: tuple[float, ...]  # m, estimated zeros at both ends of the range of powers


def find_height_zero(
    presses: Presses, stated: float | None = None, *, config: HeightZeroConfig = HeightZeroConfig()
) -> Finding:
    """Estimate from readings the height at which the tip first meets the skin (height zero).

    Args:
        presses: Presses with heights, in the order of time.
        stated: Height of first contact that the recording states, in m; None if it states none.
        config: Model and thresholds.

    Returns:
        Finding whose estimate (m) is on the scale of the heights. If it is not identifiable, it has an interval where
        the presses bound the height, and otherwise none.
    """
    if presses.height is None or not np.isfinite(presses.height).any():
        return not_identifiable(FindingName.HEIGHT_ZERO, "no height of the tip was recorded", untested=True)
    if np.isfinite(presses.height).all():
        zeros = find_approaches(np.asarray(presses.height, np.float64), presses.readings, config=config.approach)
        if len(zeros):
            return _combine_approaches(zeros, stated, presses.height, config)
    presses = presses.rows(np.isfinite(presses.height))
    height = np.asarray(presses.height, np.float64)
    span = float(np.subtract(*np.quantile(height, [0.95, 0.05])))
    if len(height) < config.min_presses or span < config.min_range_m:
        reason, few = f"all presses go to one height (within {1e3 * span:.2g} mm)", len(height) < config.min_presses
        if few:
            reason = f"{len(height)} presses are too few ({config.min_presses} are enough)"
        evidence = {"presses": len(height), "height_range_mm": 1e3 * span}
        return not_identifiable(FindingName.HEIGHT_ZERO, reason, untested=few, evidence=evidence)
    order = np.random.default_rng(0).permutation(len(height))
    count = min(config.max_subsets, max(len(height) // config.subset_presses, 1))
    subsets = [presses.rows(np.sort(order[i::count][: config.subset_presses])) for i in range(count)]
    return _combine_fits([_fit(subset, config) for subset in subsets], height, stated, config)


def first_contact(height: Float[np.ndarray, " n"], finding: Finding | None = None) -> float:
    """Choose the height of first contact, from which travel into the skin is measured.

    Args:
        height: `(n,)` heights of presses along the skin's outward normal in m, corrected; NaN where unknown.
        finding: Finding about the height of first contact, or None if it was not tested.

    Returns:
        The height of first contact in m if the presses identify it. Otherwise the height of the highest press, from
        which all travels may be too small by the same amount. NaN if all presses go to one height, so that no travel is
        known.
    """
    if finding is not None and finding.identifiable and finding.estimate is not None:
        return finding.estimate
    if not np.isfinite(height).any() or (finding is not None and np.ptp(height[np.isfinite(height)]) < 0.1e-3):
        return float("nan")
    return float(np.nanmax(height))


def find_approaches(
    height: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"], *, config: ApproachConfig = ApproachConfig()
) -> Float[np.ndarray, " k"]:
    """Find the height of first contact in each approach of a recording that samples the tip's motion.

    Args:
        height: `(n,)` heights of the tip along the skin's outward normal in m, in the order of time.
        readings: `(n, c)` readings of these rows, in uT.
        config: Thresholds.

    Returns:
        `(k,)` heights of first contact in m, one for each approach that shows it; empty if the rows are single presses.
    """
    falling = np.diff(height) < config.jitter_m
    edges = np.flatnonzero(np.diff(np.concatenate([[False], falling, [False]]).astype(int)))
    zeros = []
    for start, stop in zip(edges[::2].tolist(), (edges[1::2] + 1).tolist(), strict=True):
        rest_rows = int(np.argmax(height[start:stop] < height[start] - 2 * config.jitter_m))
        rows = slice(start + max(rest_rows - config.max_rest_rows, 0), stop)
        descent = height[rows.start] - height[stop - 1]
        min_descent = max(config.min_range_share * np.ptp(height), 1e-4)
        if stop - rows.start >= config.min_rows and descent >= min_descent:
            zeros.append(_onset(height[rows], readings[rows], config))
    return np.array([zero for zero in zeros if zero is not None])


def _onset(height: np.ndarray, readings: np.ndarray, config: ApproachConfig) -> float | None:
    """Find the height at which readings begin to change in one approach; None if they do not begin within it."""
    change = np.linalg.norm(readings - readings[:3].mean(0), axis=1)
    # 0.91 is the median square of the difference of two standard normal variables.
    differences = np.diff(readings[: 2 * config.max_rest_rows], axis=0)
    noise = np.sqrt((np.median(differences**2, axis=0) / 0.91).sum())
    beyond = np.flatnonzero(change > max(config.max_change_share * change.max(), config.min_change_stds * noise))
    end = max(int(beyond[0]) + 1 if len(beyond) else len(height), config.min_rows)
    z, y = height[:end], readings[:end]
    if len(z) < config.min_rows or z[0] - z[-1] < 5e-5:
        return None
    creep = np.column_stack([np.ones(len(z)), np.arange(len(z)) / len(z)])

    def error(zero: float, power: float) -> float:
        return _squared_error(np.column_stack([creep, np.maximum(zero - z, 0) ** power / 1e-3**power]), y)

    candidates = np.linspace(z[-1], z[0], 161)[1:-1]
    errors = np.array([min(error(zero, power) for power in config.powers) for zero in candidates])
    zero = float(candidates[errors.argmin()])
    explained = 1 - float(errors.min()) / max(_squared_error(creep, y), 1e-30)
    # Rows above the zero must show the readings at rest.
    return None if explained < config.min_explained_share or np.sum(z > zero) < 3 else zero


def _squared_error(design: np.ndarray, values: np.ndarray) -> float:
    q = np.linalg.qr(design)[0]
    return float(((values - q @ (q.T @ values)) ** 2).sum())


def _combine_approaches(
    zeros: np.ndarray, stated: float | None, height: np.ndarray, config: HeightZeroConfig
) -> Finding:
    """Combine the zeros of several approaches."""
    zero, count = float(np.median(zeros)), len(zeros)
    deviation = float(np.max(np.abs(zeros - zero)))
    # 1.2533 is the ratio of the standard errors of median and mean; 1.645 is the 95 % quantile.
    half = max(0.05e-3, 1.2533 * 1.645 * float(np.std(zeros)) / np.sqrt(count))
    wrong = bool(stated is not None and abs(zero - stated) > max(half, 2 * config.min_shift_m))
    first, last = 1e3 * zeros[0], 1e3 * zeros[-1]
    return Finding(
        FindingName.HEIGHT_ZERO,
        f"First contact is at {1e3 * zero:.3f} mm, the median of {count} approaches, which deviate by up to "
        f"{1e3 * deviation:.2f} mm: {first:.2f} mm in the first and {last:.2f} mm in the last "
        f"({int((height > zero).sum())} rows are above it).",
        identifiable=True, wrong=wrong, estimate=zero, low=zero - half, high=zero + half, unit="m",
        evidence={"approaches": count, "largest_deviation_mm": 1e3 * deviation, "first_mm": first, "last_mm": last},
        correction={"height_zero_m": zero} if wrong else {},
    )  # fmt: skip


def _combine_fits(fits: list[_Fit], height: np.ndarray, stated: float | None, config: HeightZeroConfig) -> Finding:
    """Combine the fits to several subsets of presses."""
    zeros, r2 = np.array([fit.zero for fit in fits]), float(np.median([fit.r2 for fit in fits]))
    zero = float(np.median(zeros))
    statistical_std, power_std = np.mean([(fit.statistical_std, fit.power_std) for fit in fits], axis=0)
    statistical_std = max(statistical_std, np.std(zeros)) / np.sqrt(len(fits))
    half = 1.645 * float(np.sqrt(statistical_std**2 + power_std**2 + config.shape_std_m**2))
    above = int((height > zero + half).sum())
    evidence = {
        "r2": r2, "presses": len(height), "presses_above": above, "spread_between_parts_mm": 1e3 * float(np.ptp(zeros)),
    }  # fmt: skip
    enough_above = above >= max(3, config.min_free_share * len(height))
    if enough_above and half <= config.max_half_width_m and r2 > config.min_r2:
        shift = 0.0 if stated is None else zero - stated
        wrong = abs(shift) > max(half, config.min_shift_m)
        return Finding(
            FindingName.HEIGHT_ZERO,
            f"First contact is at {1e3 * zero:.3f} mm (90 % interval {1e3 * (zero - half):.3f} to "
            f"{1e3 * (zero + half):.3f} mm), where readings begin ({above} presses are above it)"
            f"{f'; {1e3 * shift:+.3f} mm from the stated height' if wrong else ''}.",
            identifiable=True, wrong=wrong, estimate=zero, low=zero - half, high=zero + half, unit="m",
            evidence=evidence, correction={"height_zero_m": zero} if wrong else {},
        )  # fmt: skip
    ends = [end for fit in fits for end in fit.range_zeros]
    low, high = min(zero - half, *ends), max(zero + half, *ends)
    if stated is not None and r2 > config.min_r2:
        reading_share = float(np.mean((height > stated) & (height < low)))
        if reading_share > config.max_reading_above_share:
            top = float(height.max())
            return Finding(
                FindingName.HEIGHT_ZERO,
                f"The stated height of first contact is too low: {100 * reading_share:.0f} % of the presses lie above "
                f"it but still read. Travel counts from the highest press, {1e3 * (top - stated):.2f} mm above it; "
                "give the height of first contact if it is known (--z0-mm of the converter).",
                identifiable=False, wrong=True, estimate=zero, low=low, high=high, unit="m",
                evidence=evidence | {"share_reading_above": reading_share}, correction={"height_zero_m": top},
            )  # fmt: skip
    reason = "subsets of the presses disagree" if enough_above else "no press is above first contact"
    if r2 <= config.min_r2:
        reason = f"readings hardly depend on position and height (R2 {r2:.2f})"
    powers, from_top = config.power_range, 1e3 * (np.array([low, high]) - float(np.quantile(height, 0.99)))
    return Finding(
        FindingName.HEIGHT_ZERO,
        f"Height zero is not identifiable to {1e3 * config.max_half_width_m:g} mm ({reason}): powers of {powers[0]:g} "
        f"to {powers[1]:g} put first contact {from_top[0]:+.2f} to {from_top[1]:+.2f} mm from the highest press.",
        identifiable=False, estimate=zero, low=low, high=high, unit="m", evidence=evidence,
    )  # fmt: skip


def _fit(presses: Presses, config: HeightZeroConfig) -> _Fit:
    """Find the zero of the growth, first coarsely with few presses, then finely with all."""
    assert presses.height is not None
    low, high = np.quantile(np.asarray(presses.height, np.float64), [0.05, 1.0])
    span, power = high - low, config.power
    grid = np.concatenate([np.linspace(low + 0.15 * span, high, 14), high + span * np.array([0.1, 0.25, 0.5, 1.0])])
    few = presses.rows(subsample(len(presses.height), config.coarse_presses))
    coarse = product(grid, (_GrowthModel(6e-3, 0.1, noise, 0.05) for noise in config.noises))
    zero = max(coarse, key=lambda candidate: _score(few, candidate[0], power, candidate[1])[0])[0]
    axes = (config.lengths_m, config.free_shares, config.noises, config.relative_noises)
    models = [_GrowthModel(*values) for values in product(*axes)]
    for step in (0.12 * span, 0.03 * span):
        model = max(models, key=lambda candidate: _score(presses, zero, power, candidate)[0])
        zero = _best_zero(presses, zero, power, model, step, config)
    order = np.random.default_rng(1).permutation(len(presses.height))
    halves = [_best_zero(presses.rows(np.sort(order[i::2])), zero, power, model, step, config) for i in (0, 1)]
    lower, higher = (
        _best_zero(presses, zero, power + sign * config.power_std, model, step, config) for sign in (-1, 1)
    )
    return _Fit(
        zero,
        _score(presses, zero, power, model)[1],
        statistical_std=abs(halves[1] - halves[0]) / 2,
        power_std=abs(higher - lower) / 2,
        range_zeros=tuple(_best_zero(presses, zero, end, model, 0.2 * span, config) for end in config.power_range),
    )


def _best_zero(
    presses: Presses, zero: float, power: float, model: _GrowthModel, step: float, config: HeightZeroConfig
) -> float:
    """Find the zero of highest density within two steps of a given one."""
    result = minimize_scalar(
        lambda candidate: -_score(presses, candidate, power, model)[0], bounds=(zero - 2 * step, zero + 2 * step),
        method="bounded", options={"xatol": config.zero_tolerance_m},
    )  # fmt: skip
    return float(result.x)


def _score(presses: Presses, zero: float, power: float, model: _GrowthModel) -> tuple[float, float]:
    """Compute log density and R2 of presses that are predicted from each other, given zero and power."""
    assert presses.height is not None
    travel = np.maximum(zero - np.asarray(presses.height, np.float64), 0)
    travel = travel / max(float(np.quantile(travel, 0.9)), 1e-6)
    power_law = travel**power
    square = ((presses.position[:, None] - presses.position[None]) ** 2).sum(-1)
    free = model.free_share
    growth = (1 - free) * power_law[:, None] * power_law[None] + free * _integrated_wiener(travel)
    covariance = np.exp(-square / (2 * model.length**2)) * growth
    covariance[np.diag_indices_from(covariance)] += model.noise + (model.relative_noise * power_law) ** 2
    values = presses.readings / max(np.sqrt(np.mean(presses.readings**2)), 1e-30)
    prediction = leave_one_out(covariance, values)
    return prediction.log_density, 1 - float((prediction.error**2).sum() / max((values**2).sum(), 1e-30))


def _integrated_wiener(travel: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Compute the covariance of a process that starts at 0 with value and slope zero, and is 1 at travel 1."""
    smaller, larger = np.minimum(travel[:, None], travel[None]), np.maximum(travel[:, None], travel[None])
    return 0.5 * smaller**2 * (3 * larger - smaller)
