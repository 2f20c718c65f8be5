"""Relations of labels and readings: a lag between them, the direction of the height, the sign of the force, the units.

NumPy only. Each function judges recorded presses by one property that any sound skin has; none needs a model of one.
"""

import numpy as np
from jaxtyping import Float
from scipy.stats import rankdata

from i2t.recordings.diagnose.findings import Finding, RecordedPresses
from i2t.recordings.diagnose.smooth import smooth_r2, thinned

LAG, HEIGHT_AXIS, FORCE_SIGN, UNITS = "lag of the labels", "height axis", "sign of the force", "units"
LAG_ROWS = 300  # that are looked at
MIN_LAG_ROWS = 20
LAG_UNEXPLAINED = 1.5  # times: what a smooth model leaves unexplained as recorded, over what it leaves with the lag
LAG_GAIN = 0.03  # of R2, at least
LAG_SHARE = 0.5  # of the R2 that is explained with the lag, which is lost without: where noise hides the rest
SURE_ERRORS = 4.0  # standard errors of a rank correlation
MIN_RANKS = 0.15  # rank correlation, at least
PUSH_SHARE = 0.9  # of the presses that must pull for the force to be turned
MIN_PUSH_N = 0.05  # less is no press
MAX_EXTENT_M = 0.5  # of where a skin was pressed: beyond it are millimetres
MAX_DEPTH_M = 0.05
MIN_EXTENT_M = 5e-5  # of places that readings depend on: within it are metres that were taken for millimetres
MIN_DEPTH_M = 1e-5
PLACED_R2 = 0.3  # of readings that depend on where was pressed
MIN_NORM_UT = 2.0  # of the strongest readings: the noise alone of one reading of five chips is 12 uT
TESLA_BELOW = 2e-3  # in the unit recorded: readings between the two are millitesla
MAX_NORM_UT = 2e5  # chips end at 1.3e5 uT on each axis
MAX_FORCE_N = 150.0  # beyond are grams
NEWTONS_PER_GRAM = 9.80665e-3


def find_lag(presses: RecordedPresses, max_lag: int = 4) -> Finding:
    """Ask whether each reading belongs to the labels of an earlier or later row.

    Args:
        presses: In the order of time.
        max_lag: Rows by which labels may be shifted. With lag k the reading of row i belongs to the labels of row
            i + k.

    Returns:
        The finding; the estimate is the lag (rows).
    """
    load = presses.height if presses.height is not None and np.isfinite(presses.height).all() else presses.force
    loads = [] if load is None or not np.isfinite(load).all() else [load]
    return lag_between(np.column_stack([presses.position, *loads]), presses.readings, max_lag)


def lag_between(labels: Float[np.ndarray, "n k"], readings: Float[np.ndarray, "n c"], max_lag: int = 4) -> Finding:
    """Ask whether readings belong to the labels of an earlier or later row, whatever the labels are.

    Args:
        labels: Of each row, in any units.
        readings: Of the same rows (uT).
        max_lag: As for `find_lag`.

    Returns:
        The finding, as of `find_lag`.
    """
    n = len(labels)
    rows = thinned(n - 2 * max_lag, LAG_ROWS) + max_lag
    if len(rows) < MIN_LAG_ROWS:
        enough = MIN_LAG_ROWS + 2 * max_lag
        sentence = f"A lag of the labels is not identifiable: {n} presses are too few ({enough} are enough)."
        return Finding(LAG, sentence, False)
    r2 = {lag: smooth_r2(labels[rows + lag], readings[rows]) for lag in range(-max_lag, max_lag + 1)}
    best = max(r2, key=lambda lag: r2[lag])
    near = [lag for lag in r2 if 0 < abs(lag - best) <= 3]
    contrast = r2[best] - min(r2[lag] for lag in near)
    evidence = {"r2_as_recorded": r2[0], "r2_best": r2[best], "best_lag": float(best), "r2_contrast": contrast}
    if contrast < LAG_GAIN or r2[best] < 0.1:
        why = "readings hardly depend on the labels" if r2[best] < 0.1 else "neighbouring rows are nearly alike"
        said = f"{why} (R2 {r2[0]:.3f} as recorded, {r2[best]:.3f} at {best:+d} rows)"
        return Finding(LAG, f"A lag of the labels is not identifiable: {said}.", False, evidence=evidence)
    unexplained = (1 - r2[0]) / max(1 - r2[best], 1e-6)
    evidence["unexplained_ratio"] = unexplained
    gain = r2[best] - r2[0]
    late = bool(best != 0 and gain > LAG_GAIN and (unexplained > LAG_UNEXPLAINED or gain > LAG_SHARE * r2[best]))
    lag = best if late else 0
    said = (
        f"Labels are shifted by {lag:+d} rows: a smooth model explains {r2[best]:.2f} of the readings with them and "
        f"{r2[0]:.2f} as recorded."
        if late
        else f"Labels and readings belong together row by row (R2 of a smooth model {r2[0]:.3f})."
    )
    return Finding(
        LAG, said, identifiable=True, wrong=late, estimate=float(lag), low=float(lag), high=float(lag), unit="rows",
        evidence=evidence, correction={"label_lag_rows": lag} if late else {},
    )  # fmt: skip


def find_height_axis(presses: RecordedPresses) -> Finding:
    """Ask whether the height grows out of the skin or into it: readings grow with the depth.

    Args:
        presses: With heights along what is taken for the outward normal.

    Returns:
        The finding; the estimate is 1 where heights point out of the skin and -1 where they point into it.
    """
    if presses.height is None or not np.isfinite(presses.height).any():
        return Finding(HEIGHT_AXIS, "The direction of the height is not identifiable: none was recorded.", False)
    firm = np.isfinite(presses.height)
    depth, norm = -presses.height[firm], np.linalg.norm(presses.readings[firm], axis=1)
    if len(norm) < MIN_LAG_ROWS or np.ptp(depth) == 0 or np.ptp(norm) == 0:
        few = f"{len(norm)} presses are too few ({MIN_LAG_ROWS} are enough)"
        why = few if len(norm) < MIN_LAG_ROWS else "all heights, or all readings, are alike"
        return Finding(HEIGHT_AXIS, f"The direction of the height is not identifiable: {why}.", False)
    ranks = float(np.corrcoef(rankdata(depth), rankdata(norm))[0, 1])
    evidence = {"rank_correlation": ranks, "presses": len(norm)}
    found = f"(rank correlation with the depth {ranks:+.2f})"
    if abs(ranks) < max(SURE_ERRORS / np.sqrt(len(norm) - 1), MIN_RANKS):
        said = f"The direction of the height is not identifiable: readings hardly change with it {found}."
        return Finding(HEIGHT_AXIS, said, False, evidence=evidence)
    if ranks < 0:
        said = f"Readings grow where the height grows: the height points into the skin and is turned {found}."
        return Finding(
            HEIGHT_AXIS, said, identifiable=True, wrong=True, estimate=-1.0, evidence=evidence,
            correction={"height_sign": -1.0},
        )  # fmt: skip
    said = f"Readings grow as the height falls: the height points out of the skin {found}."
    return Finding(HEIGHT_AXIS, said, identifiable=True, estimate=1.0, evidence=evidence)


def find_force_sign(force: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"] | None = None) -> Finding:
    """Ask whether a press pushes: the force along tool z is positive when pressing.

    Args:
        force: Of presses (N); NaN where it was not read.
        readings: Of the same presses (uT); those that read nothing are no presses.

    Returns:
        The finding; the estimate is -1 where the forces must be turned.
    """
    known = np.isfinite(force) & (np.abs(force) > MIN_PUSH_N)
    if readings is not None and known.any():
        norm = np.linalg.norm(np.nan_to_num(readings), axis=1)
        known &= norm >= 0.2 * np.median(norm[known])
    if known.sum() < 3:
        return Finding(FORCE_SIGN, "The sign of the force is not identifiable: hardly any force was recorded.", False)
    pulls = float(np.mean(force[known] < 0))
    median = float(np.median(force[known]))
    evidence = {"share_negative": pulls, "median_force_N": median, "presses": int(known.sum())}
    negative = f"Forces along tool z are negative in {100 * pulls:.0f} % of the presses (median {median:.2f} N)"
    if pulls > PUSH_SHARE:
        return Finding(
            FORCE_SIGN, f"{negative}, as if they pulled: they are turned.", identifiable=True, wrong=True,
            estimate=-1.0, evidence=evidence, correction={"force_sign": -1.0},
        )  # fmt: skip
    if pulls > 1 - PUSH_SHARE:
        said = f"{negative}: they are hardly along tool z; check the axes that they were recorded in."
        return Finding(FORCE_SIGN, said, identifiable=False, evidence=evidence)
    said = f"Presses push: the median force along tool z is {median:.2f} N."
    return Finding(FORCE_SIGN, said, identifiable=True, estimate=1.0, evidence=evidence)


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
    rows = finite[thinned(len(finite), LAG_ROWS)]
    return smooth_r2(position[rows], readings[rows]) > PLACED_R2


def _largest(values: np.ndarray | None) -> float:
    """The 90th percentile of the sizes, 0 where nothing was recorded."""
    known = np.abs(values[np.isfinite(values)]) if values is not None else np.empty(0)
    return float(np.quantile(known, 0.9)) if len(known) else 0.0
