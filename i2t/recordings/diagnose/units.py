"""Units: whether lengths are metres, fields microtesla and forces newtons, by their sizes."""

import numpy as np
from jaxtyping import Float

from i2t.recordings.columns import NEWTONS_PER_GRAM
from i2t.recordings.diagnose.findings import Finding
from i2t.recordings.diagnose.smooth import smooth_r2, thinned

UNITS = "units"
PLACED_ROWS = 300  # that are looked at
MAX_EXTENT_M = 0.5  # of where a skin was pressed: beyond it are millimetres
MAX_DEPTH_M = 0.05
MIN_EXTENT_M = 5e-5  # of places that readings depend on: within it are metres that were taken for millimetres
MIN_DEPTH_M = 1e-5
PLACED_R2 = 0.3  # of readings that depend on where was pressed
MIN_NORM_UT = 2.0  # of the strongest readings: the noise alone of one reading of five chips is 12 uT
TESLA_BELOW = 2e-3  # in the unit recorded: readings between the two are millitesla
MAX_NORM_UT = 2e5  # chips end at 1.3e5 uT on each axis
MAX_FORCE_N = 150.0  # beyond are grams


def find_units(
    position: Float[np.ndarray, "n d"],
    readings: Float[np.ndarray, "n c"],
    *,
    depth: Float[np.ndarray, " n"] | None = None,
    force: Float[np.ndarray, " n"] | None = None,
) -> Finding:
    """Ask whether lengths are metres, fields microtesla and forces newtons, by their sizes.

    Args:
        position: Of the presses, as recorded.
        readings: As recorded.
        depth: As recorded, where it was.
        force: As recorded, where it was.

    Returns:
        The finding; its correction has the factors to metres, microtesla and newtons.
    """
    norm = np.linalg.norm(readings[np.isfinite(readings).all(1)], axis=1)
    strong = float(np.quantile(norm, 0.9)) if len(norm) else np.nan
    there = position[np.isfinite(position).all(1)]
    extent = float(np.ptp(there, axis=0).max()) if len(there) else np.nan
    deep, hard = _largest(depth), _largest(force)
    narrow = 1e-6 < extent < MIN_EXTENT_M and _depends(position, readings)
    wide = f"positions range over {extent:.3g}"
    many, few = f"depths reach {deep:.3g}", f"strong readings have the norm {strong:.2g}"
    unit, to_microtesla = ("tesla", 1e6) if strong < TESLA_BELOW else ("millitesla", 1e3)
    # What is out of range, what it is in units of, and what is said of it.
    suspects = (
        ("length", extent > MAX_EXTENT_M, 1e-3, f"{wide}, which can be no metres: they are read as millimetres"),
        ("length", narrow, 1e3, f"{wide} m only, and readings depend on them: they are read as a thousand times that"),
        ("depth", 0 < deep < MIN_DEPTH_M, 1e3, f"{many} m, which is no press: they are read as a thousand times that"),
        ("depth", deep > MAX_DEPTH_M, 1e-3, f"{many}, which can be no metres: they are read as millimetres"),
        (
            "field", 0 < strong < MIN_NORM_UT, to_microtesla,
            f"{few}, less than the noise of a chip in uT: they are read as {unit}",
        ),
        ("field", strong > MAX_NORM_UT, 1e-3, f"{few}, beyond any chip in uT: they are read as nanotesla"),
        (
            "force", hard > MAX_FORCE_N, NEWTONS_PER_GRAM,
            f"forces reach {hard:.3g}, which no skin bears in newtons: they are read as grams",
        ),
    )  # fmt: skip
    wrong = [(name, factor, said) for name, is_so, factor, said in suspects if is_so]
    sentence = (
        f"Units are not what was stated: {'; '.join(said for *_, said in wrong)}."
        if wrong
        else "Lengths, fields and forces have sizes that fit metres, microtesla and newtons."
    )
    return Finding(
        UNITS, sentence, identifiable=bool(np.isfinite(strong)), wrong=bool(wrong),
        evidence={"extent": extent, "strong_norm": strong, "largest_depth": deep, "largest_force": hard},
        correction={f"{name}_factor": factor for name, factor, _ in wrong},
    )  # fmt: skip


def _depends(position: np.ndarray, readings: np.ndarray) -> bool:
    """Test whether readings depend on the place of the press."""
    finite = np.flatnonzero(np.isfinite(position).all(1) & np.isfinite(readings).all(1))
    rows = finite[thinned(len(finite), PLACED_ROWS)]
    return smooth_r2(position[rows], readings[rows]) > PLACED_R2


def _largest(values: np.ndarray | None) -> float:
    """The 90th percentile of the sizes, 0 where nothing was recorded."""
    known = np.abs(values[np.isfinite(values)]) if values is not None else np.empty(0)
    return float(np.quantile(known, 0.9)) if len(known) else 0.0
