"""Lag: tests whether each reading belongs to the labels of an earlier or later row."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from i2t.recordings.diagnose.findings import Finding, FindingName, not_identifiable
from i2t.recordings.diagnose.smooth import smooth_r2, subsample
from i2t.recordings.presses import Presses


@dataclass(frozen=True)
class LagConfig:
    """Thresholds of the test for a lag between a recording's labels and readings.

    Attributes:
        max_lag: Largest lag that is tried, in rows.
        max_rows: Number of rows that the models are fitted to, at most.
        min_rows: Number of rows below which no lag is identifiable.
        min_r2: R2 with the best lag, below which the readings hardly depend on the labels.
        min_gain: Gain of R2 that a lag must exceed.
        min_unexplained_ratio: Ratio of the unexplained variance as recorded to that with the lag, above which the
            labels are shifted.
        min_lost_share: Share of the R2 with the lag that is lost without it, above which the labels are shifted too:
            noise keeps the ratio of unexplained variances small.
    """

    max_lag: int = 4
    max_rows: int = 300
    min_rows: int = 20
    min_r2: float = 0.1
    min_gain: float = 0.03
    min_unexplained_ratio: float = 1.5
    min_lost_share: float = 0.5


def find_lag(presses: Presses, *, config: LagConfig = LagConfig()) -> Finding:
    """Test whether each reading belongs to the labels of an earlier or later row.

    Args:
        presses: Presses in the order of time.
        config: Thresholds of the test.

    Returns:
        Finding whose estimate is the lag in rows: with lag k the reading of row i belongs to the labels of row i + k.
    """
    load = presses.height if presses.height is not None and np.isfinite(presses.height).all() else presses.force
    loads = [] if load is None or not np.isfinite(load).all() else [load]
    return lag_between(np.column_stack([presses.position, *loads]), presses.readings, config=config)


def lag_between(
    labels: Float[np.ndarray, "n k"], readings: Float[np.ndarray, "n c"], *, config: LagConfig = LagConfig()
) -> Finding:
    """Test whether readings belong to any kind of labels of an earlier or later row.

    Args:
        labels: `(n, k)` values of k labels, such as position and force, in each row, in any units.
        readings: `(n, c)` readings of the same rows, in uT.
        config: Thresholds of the test.

    Returns:
        Finding on the lag, as from `find_lag`.
    """
    n, max_lag = len(labels), config.max_lag
    rows = subsample(n - 2 * max_lag, config.max_rows) + max_lag
    if len(rows) < config.min_rows:
        reason = f"{n} presses are too few ({config.min_rows + 2 * max_lag} are enough)"
        return not_identifiable(FindingName.LAG, reason, untested=True)
    r2 = {lag: smooth_r2(labels[rows + lag], readings[rows]) for lag in range(-max_lag, max_lag + 1)}
    best = max(r2, key=lambda lag: r2[lag])
    neighbours = [lag for lag in r2 if 0 < abs(lag - best) <= 3]
    contrast = r2[best] - min(r2[lag] for lag in neighbours)
    evidence = {"r2_as_recorded": r2[0], "r2_best": r2[best], "best_lag": float(best), "r2_contrast": contrast}
    if contrast < config.min_gain or r2[best] < config.min_r2:
        is_weak = r2[best] < config.min_r2
        reason = "the readings hardly depend on the labels" if is_weak else "neighbouring rows are nearly alike"
        numbers = f"R2 is {r2[0]:.3f} as recorded and {r2[best]:.3f} at {best:+d} rows"
        return not_identifiable(FindingName.LAG, f"{reason} ({numbers})", evidence=evidence)
    unexplained_ratio = (1 - r2[0]) / max(1 - r2[best], 1e-6)
    evidence["unexplained_ratio"] = unexplained_ratio
    gain = r2[best] - r2[0]
    is_clear = unexplained_ratio > config.min_unexplained_ratio or gain > config.min_lost_share * r2[best]
    shifted = bool(best != 0 and gain > config.min_gain and is_clear)
    lag = best if shifted else 0
    sentence = (
        f"The labels are shifted by {lag:+d} rows: with that lag a smooth model explains {r2[best]:.2f} of the "
        f"readings' variance, and {r2[0]:.2f} as recorded."
        if shifted
        else f"Labels and readings match row by row (R2 of a smooth model {r2[0]:.3f})."
    )
    return Finding(
        FindingName.LAG, sentence, identifiable=True, wrong=shifted, estimate=float(lag), low=float(lag),
        high=float(lag), unit="rows", evidence=evidence, correction={"label_lag_rows": lag} if shifted else {},
    )  # fmt: skip
