"""Lag: whether each reading belongs to the labels of an earlier or later row."""

import numpy as np
from jaxtyping import Float

from i2t.recordings.diagnose.findings import Finding
from i2t.recordings.diagnose.smooth import smooth_r2, thinned
from i2t.recordings.presses import Presses

LAG = "lag of the labels"
LAG_ROWS = 300  # that are looked at
MAX_LAG = 4  # rows by which labels may be shifted
MIN_LAG_ROWS = 20
LAG_UNEXPLAINED = 1.5  # times: what a smooth model leaves unexplained as recorded, over what it leaves with the lag
LAG_GAIN = 0.03  # of R2, at least
LAG_SHARE = 0.5  # of the R2 that is explained with the lag, which is lost without: where noise hides the rest


def find_lag(presses: Presses) -> Finding:
    """Ask whether each reading belongs to the labels of an earlier or later row.

    Args:
        presses: In the order of time.

    Returns:
        The finding; the estimate is the lag (rows). With lag k the reading of row i belongs to the labels of row i + k.
    """
    load = presses.height if presses.height is not None and np.isfinite(presses.height).all() else presses.force
    loads = [] if load is None or not np.isfinite(load).all() else [load]
    return lag_between(np.column_stack([presses.position, *loads]), presses.readings)


def lag_between(labels: Float[np.ndarray, "n k"], readings: Float[np.ndarray, "n c"]) -> Finding:
    """Ask whether readings belong to the labels of an earlier or later row, whatever the labels are.

    Args:
        labels: Of each row, in any units.
        readings: Of the same rows (uT).

    Returns:
        The finding, as of `find_lag`.
    """
    n = len(labels)
    rows = thinned(n - 2 * MAX_LAG, LAG_ROWS) + MAX_LAG
    if len(rows) < MIN_LAG_ROWS:
        enough = MIN_LAG_ROWS + 2 * MAX_LAG
        sentence = f"A lag of the labels is not identifiable: {n} presses are too few ({enough} are enough)."
        return Finding(LAG, sentence, False)
    r2 = {lag: smooth_r2(labels[rows + lag], readings[rows]) for lag in range(-MAX_LAG, MAX_LAG + 1)}
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
