"""Units: tests by size whether lengths are in metres, fields in microtesla and forces in newtons."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from i2t.recordings.columns import NEWTONS_PER_GRAM
from i2t.recordings.diagnose.findings import Finding, FindingName
from i2t.recordings.diagnose.smooth import smooth_r2, subsample


@dataclass(frozen=True)
class UnitRanges:
    """Plausible sizes of recorded lengths, fields and forces, by which their units are recognised.

    Attributes:
        max_extent_m: Range of positions above which they are in millimetres.
        min_extent_m: Range of positions below which millimetres were stated for metres, if readings depend on position.
        doubtful_extent_m: Range of positions of several presses below which their unit is doubtful; millimetres were
            stated for metres if this is so for travel as well.
        max_travel_m: Travel above which it is in millimetres.
        min_travel_m: Travel below which millimetres were stated for metres.
        min_norm_ut: Norm below which strong readings are not in microtesla: the noise of one reading of five chips
            alone is 12 uT.
        max_norm_ut: Norm above which strong readings are in nanotesla: chips saturate at 1.3e5 uT on each axis.
        max_norm_in_tesla: Norm, in the recorded unit, below which strong readings are in tesla; between this and
            `min_norm_ut` they are in millitesla.
        max_force_n: Force above which forces are in grams.
        min_position_r2: R2 of a smooth model above which readings depend on position.
        max_rows: Number of rows that this model is fitted to, at most.
        min_presses: Number of presses from which nearly equal positions are doubtful.
    """

    max_extent_m: float = 0.5
    min_extent_m: float = 5e-5
    doubtful_extent_m: float = 1e-4
    max_travel_m: float = 0.05
    min_travel_m: float = 1e-5
    min_norm_ut: float = 2.0
    max_norm_ut: float = 2e5
    max_norm_in_tesla: float = 2e-3
    max_force_n: float = 150.0
    min_position_r2: float = 0.3
    max_rows: int = 300
    min_presses: int = 5


def find_units(
    position: Float[np.ndarray, "n d"],
    readings: Float[np.ndarray, "n c"],
    *,
    travel: Float[np.ndarray, " n"] | None = None,
    force: Float[np.ndarray, " n"] | None = None,
    ranges: UnitRanges = UnitRanges(),
) -> Finding:
    """Test by size whether lengths are in metres, fields in microtesla and forces in newtons.

    Args:
        position: `(n, d)` positions of the presses, as recorded.
        readings: `(n, c)` readings, as recorded.
        travel: `(n,)` travels as recorded, or None if there are none.
        force: `(n,)` forces as recorded, or None if there are none.
        ranges: Plausible sizes.

    Returns:
        Finding whose correction holds the factors to metres, microtesla and newtons. It is not identifiable if nothing
        is corrected although all positions nearly coincide.
    """
    norm = np.linalg.norm(readings[np.isfinite(readings).all(1)], axis=1)
    strong = float(np.quantile(norm, 0.9)) if len(norm) else np.nan
    finite_positions = position[np.isfinite(position).all(1)]
    extent = float(np.ptp(finite_positions, axis=0).max()) if len(finite_positions) else np.nan
    farthest = float(np.abs(finite_positions).max()) if len(finite_positions) else np.nan
    largest_travel, largest_force = _largest(travel), _largest(force)
    travel_too_small = 0 < largest_travel < ranges.min_travel_m
    narrow = extent < ranges.doubtful_extent_m
    # Lengths of one table have one unit: positions are corrected with the travel, unless they would leave the bench.
    all_too_small = travel_too_small and narrow and 0 < 1e3 * farthest < ranges.max_extent_m
    too_narrow = not all_too_small and 1e-6 < extent < ranges.min_extent_m
    too_narrow = too_narrow and _depends_on_position(position, readings, ranges)
    positions = f"the positions range over {extent:.3g}"
    travels, forces = f"the travel reaches {largest_travel:.3g}", f"the forces reach {largest_force:.3g}"
    fields = f"strong readings have a norm of {strong:.2g}"
    unit, to_microtesla = ("tesla", 1e6) if strong < ranges.max_norm_in_tesla else ("millitesla", 1e3)
    # Quantity, whether its size is implausible, the factor that corrects it, and the reason.
    tests = (
        ("length", extent > ranges.max_extent_m, 1e-3, f"{positions}, too large for m: they are in millimetres"),
        (
            "length", all_too_small, 1e3,
            f"{positions} m and {travels} m, as if metres were named millimetres: all lengths are multiplied by 1000",
        ),
        (
            "length", too_narrow, 1e3,
            f"{positions} m, although readings depend on them: the positions alone are multiplied by 1000",
        ),
        ("travel", travel_too_small, 1e3, f"{travels} m: the travel alone is multiplied by 1000"),
        ("travel", largest_travel > ranges.max_travel_m, 1e-3, f"{travels}, too large for m: it is in millimetres"),
        ("field", 0 < strong < ranges.min_norm_ut, to_microtesla, f"{fields}, too small for uT: they are in {unit}"),
        ("field", strong > ranges.max_norm_ut, 1e-3, f"{fields}, too large for uT: they are in nanotesla"),
        (
            "force",
            largest_force > ranges.max_force_n,
            NEWTONS_PER_GRAM,
            f"{forces}, too large for N: they are in grams",
        ),
    )  # fmt: skip
    implausible = [(quantity, factor, reason) for quantity, failed, factor, reason in tests if failed]
    if all_too_small:
        implausible = [entry for entry in implausible if entry[0] != "travel"]
    factors = {f"{quantity}_factor": factor for quantity, factor, _ in implausible}
    if all_too_small:
        factors["travel_factor"] = 1e3
    corrects_length = all_too_small or too_narrow
    doubtful = narrow and not corrects_length and len(finite_positions) >= ranges.min_presses
    reasons = [reason for *_, reason in implausible]
    if doubtful:
        reasons.append(f"{positions} m only, so their unit is doubtful")
    if implausible:
        sentence = f"The units are not those stated: {'; '.join(reasons)}."
    elif doubtful:
        sentence = f"{reasons[0][:1].upper()}{reasons[0][1:]}."
    else:
        sentence = "The sizes of lengths, fields and forces fit metres, microtesla and newtons."
    return Finding(
        FindingName.UNITS, sentence, identifiable=bool(np.isfinite(strong)) and not doubtful, wrong=bool(implausible),
        evidence={
            "extent": extent, "strong_norm": strong, "largest_travel": largest_travel, "largest_force": largest_force,
        },
        correction=factors,
    )  # fmt: skip


def _depends_on_position(position: np.ndarray, readings: np.ndarray, ranges: UnitRanges) -> bool:
    """Test whether readings depend on the position of the press."""
    finite = np.flatnonzero(np.isfinite(position).all(1) & np.isfinite(readings).all(1))
    rows = finite[subsample(len(finite), ranges.max_rows)]
    return smooth_r2(position[rows], readings[rows]) > ranges.min_position_r2


def _largest(values: np.ndarray | None) -> float:
    """Compute the 90th percentile of the magnitudes, 0 if there are no values."""
    magnitudes = np.abs(values[np.isfinite(values)]) if values is not None else np.empty(0)
    return float(np.quantile(magnitudes, 0.9)) if len(magnitudes) else 0.0
