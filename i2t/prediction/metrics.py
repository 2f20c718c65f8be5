"""Scores of predicted readings, their intervals, and nearest neighbours.

This module uses NumPy because nothing in it is differentiated.
R2 is pooled over channels against the mean of the scored touches: 1 - sum (y - f)^2 / sum (y - mean y)^2.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from i2t.dataset import source_phrase
from i2t.intervals import MIN_CLUSTERS, Estimate, bootstrap_clusters, rate_interval
from i2t.leave_one_out import STDS_WITHIN_90
from i2t.prediction.touch_model import Reading


class Score(NamedTuple):
    """Accuracy of predicted readings: explained variance R2 (1 is perfect), errors in uT, and cosine similarity."""

    r2: float  # R2 pooled over all channels
    r2_median: float  # median of the channels' R2
    rmse: float  # uT, root mean square error
    # root mean square error in standard deviations of the sensor's noise; NaN if the noise is unknown
    rmse_sigma: float
    cosine: float  # median over touches of the cosine between predicted and measured reading
    r2_axis: tuple[float, float, float]  # R2 of x, y and z, each pooled over the chips
    rmse_axis: tuple[float, float, float]  # uT, root mean square error of x, y and z


def score(truth: np.ndarray, predicted: np.ndarray, noise: np.ndarray | None = None) -> Score:
    """Compare readings with their predictions.

    Args:
        truth: (n, 3 chips) measured readings (uT).
        predicted: (n, 3 chips) predicted readings (uT).
        noise: (3 chips,) standard deviation (uT) of the sensor's own noise, if it is known.

    Returns:
        All scores; R2 is NaN if the truth does not vary.
    """
    truth, predicted = np.asarray(truth, np.float64), np.asarray(predicted, np.float64)
    error, spread = (predicted - truth) ** 2, (truth - truth.mean(0)) ** 2
    by_axis = [slice(axis, None, 3) for axis in range(3)]
    norms = np.linalg.norm(truth, axis=1) * np.linalg.norm(predicted, axis=1)
    cosines = np.sum(truth * predicted, axis=1) / np.where(norms > 0, norms, 1)
    return Score(
        r2=_explained(error, spread),
        r2_median=_median_explained(error.sum(0), spread.sum(0)),
        rmse=float(np.sqrt(error.mean())),
        rmse_sigma=float("nan") if noise is None else float(np.sqrt((error / np.asarray(noise) ** 2).mean())),
        cosine=float(np.median(cosines)),
        r2_axis=_three(_explained(error[:, axis], spread[:, axis]) for axis in by_axis),
        rmse_axis=_three(np.sqrt(error[:, axis].mean()) for axis in by_axis),
    )


@dataclass(frozen=True)
class PredictorScore:
    """Scores of a predictor on touches, with 95 % intervals over sessions, as `Predictor.score` returns them.

    Attributes:
        r2: Explained variance R2, pooled over channels.
        rmse: Root mean square error (uT).
        cosine: Median over touches of the cosine between predicted and measured reading.
        coverage: Share of measured values in their predicted 90 % intervals.
        touches: Number of touches.
        objects: Names of the touched objects.
        groups: Number of sessions, or of other groups of touches that are not independent.
        grouped_by: Word for the groups.
        used: Number of touches that were used in the fit; None if the predictor does not hold a record of its touches.
        source: Source of the touches: "simulated", "real", "mixed" or "not stated".
        measured: `(n, 3 chips)` measured readings (uT).
        predicted: Predicted readings and standard deviations, `(n, 3 chips)` uT.

    Example:
        score = predictor.score(dataset)
        print(score)
        r2, low, high = score.r2
    """

    r2: Estimate
    rmse: Estimate
    cosine: Estimate
    coverage: Estimate
    touches: int
    objects: tuple[str, ...]
    groups: int
    grouped_by: str
    used: int | None
    source: str
    measured: np.ndarray = field(repr=False, compare=False)
    predicted: Reading = field(repr=False, compare=False)

    def __str__(self) -> str:
        """Write a table of the scores."""
        of = self.objects[0] if len(self.objects) == 1 else f"{len(self.objects)} objects"
        sessions = f"{self.groups} {self.grouped_by if self.groups > 1 else self.grouped_by.removesuffix('s')}"
        use = {None: "their use in the fit is unknown", 0: "none of them used in the fit"}.get(
            self.used, f"{self.used} OF THEM USED IN THE FIT, so this is not a test"
        )
        interval = f"95 % interval over {sessions}" if self.groups >= MIN_CLUSTERS else f"no interval: {sessions}"
        rows = (
            ("R2", self.r2, ""),
            ("RMSE", self.rmse, " uT"),
            ("cosine", self.cosine, ""),
            ("in 90 % range", self.coverage, ""),
        )
        lines = [f"{name:<14}{_written(estimate)}{unit}" for name, estimate, unit in rows]
        about = f"{self.touches} touches of {of} in {sessions} ({source_phrase(self.source)}), {use}"
        return "\n".join([about, f"{'':<14}{interval}", *lines])

    def to_json(self) -> dict[str, Any]:
        """Convert the scores for a JSON file.

        Returns:
            All fields but the readings; an estimate is a list of its value and the limits of its interval.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.compare}
        return {name: list(value) if isinstance(value, Estimate) else value for name, value in values.items()}


def score_readings(
    truth: np.ndarray, predicted: Reading, groups: np.ndarray
) -> tuple[Estimate, Estimate, Estimate, Estimate]:
    """Compare readings with their predictions, with 95 % intervals over groups.

    Args:
        truth: (n, 3 chips) measured readings (uT).
        predicted: (n, 3 chips) predicted readings and standard deviations (uT).
        groups: (n,) labels of groups; touches of one group, such as a session, are not independent.

    Returns:
        R2, root mean square error (uT), median cosine, and share of values in the 90 % interval. The limits are NaN if
        there are fewer than three groups.
    """
    rows = np.arange(len(truth))

    def scores(weights: np.ndarray) -> np.ndarray:
        drawn = np.repeat(rows, weights.astype(int))
        values = score(truth[drawn], predicted.mean[drawn])
        return np.array([values.r2, values.rmse, values.cosine])

    estimates = bootstrap_clusters(scores, [groups], len(rows))
    bounds = ((-np.inf, 1.0), (0.0, np.inf), (-1.0, 1.0))
    r2, rmse, cosine = (
        Estimate(float(value), max(float(low), least), min(float(high), most))
        for value, low, high, (least, most) in zip(*estimates, bounds, strict=True)
    )
    inside = np.mean(np.abs(truth - predicted.mean) < STDS_WITHIN_90 * predicted.std, axis=1)
    return r2, rmse, cosine, Estimate(*(float(part) for part in rate_interval(inside, [groups])))


def _written(estimate: Estimate) -> str:
    """Write a value with its interval, if it has one."""
    interval = f" [{estimate.low:.2f}, {estimate.high:.2f}]" if np.isfinite(estimate.low) else ""
    return f"{estimate.mean:.2f}{interval}"


def _explained(error: np.ndarray, spread: np.ndarray) -> float:
    """Compute R2; NaN if the readings do not vary."""
    return float(1 - error.sum() / spread.sum()) if spread.sum() > 0 else float("nan")


def _median_explained(error: np.ndarray, spread: np.ndarray) -> float:
    """Compute the median R2 of the channels that vary."""
    varies = spread > 0
    return float(np.median(1 - error[varies] / spread[varies])) if varies.any() else float("nan")


def _three(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def nearest_neighbours(x: np.ndarray, y: np.ndarray, at: np.ndarray, k: int | float) -> np.ndarray:
    """Predict readings as the mean over the k nearest training touches, and all that are as near as the k-th.

    Args:
        x: (n, d) features of the training touches.
        y: (n, 3 chips) readings of the training touches.
        at: (m, d) features of the touches to predict.
        k: Number of neighbours, an integer; all touches if there are fewer.

    Returns:
        `(m, 3 chips)` predicted readings of the m touches, in the unit of `y`.
    """
    near, _ = near_rows(x, at, k)
    return near @ y / near.sum(1, keepdims=True)


def near_rows(x: np.ndarray, at: np.ndarray, k: int | float) -> tuple[np.ndarray, np.ndarray]:
    """Find the k nearest training touches and all equally near ones, so that rounding does not choose between them.

    Args:
        x: (n, d) features of the training touches.
        at: (m, d) features of the touches to predict.
        k: Number of neighbours, an integer; all touches if there are fewer.

    Returns:
        `(m, n)` mask of the near training touches, and `(m, n)` squared distances.
    """
    square = (at**2).sum(1)[:, None] + (x**2).sum(1) - 2 * at @ x.T
    last = min(int(k), len(x)) - 1
    farthest = np.partition(square, last, axis=1)[:, [last]]
    rounding = 1e-12 * ((at**2).sum(1)[:, None] + (x**2).sum(1).max())
    return square <= farthest + rounding, np.maximum(square, 0)
