"""Scores of predicted readings, their intervals, and nearest neighbours.

NumPy, because nothing here is differentiated.
R2 is pooled over channels against the mean of the touches it is computed on: 1 - sum (y - f)^2 / sum (y - mean y)^2.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

EQUALLY_NEAR = 1e-12  # of the squared lengths of features: what rounding makes of one distance


class Score(NamedTuple):
    """Accuracy of predicted readings."""

    r2: float  # pooled over all channels
    r2_median: float  # median over channels
    rmse: float  # uT
    rmse_sigma: float  # in standard deviations of the sensor's noise; NaN where that is unknown
    cosine: float  # median over touches
    r2_axis: tuple[float, float, float]  # x, y and z, each pooled over the chips
    rmse_axis: tuple[float, float, float]  # uT


def score(truth: np.ndarray, predicted: np.ndarray, noise: np.ndarray | None = None) -> Score:
    """Compare readings with their predictions.

    Args:
        truth: (n, 3 chips) uT.
        predicted: (n, 3 chips) uT.
        noise: (3 chips,) uT, standard deviation of the sensor's own noise where it is known.

    Returns:
        All scores; R2 is NaN where the truth does not vary.
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


def _explained(error: np.ndarray, spread: np.ndarray) -> float:
    """R2; NaN where nothing varies."""
    return float(1 - error.sum() / spread.sum()) if spread.sum() > 0 else float("nan")


def _median_explained(error: np.ndarray, spread: np.ndarray) -> float:
    """Median R2 of the channels that vary."""
    varies = spread > 0
    return float(np.median(1 - error[varies] / spread[varies])) if varies.any() else float("nan")


def _three(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def nearest_neighbours(x: np.ndarray, y: np.ndarray, at: np.ndarray, k: int | float) -> np.ndarray:
    """Mean reading of the k nearest training touches, and of those as near as the k-th.

    Args:
        x: (n, d) features of the training touches.
        y: (n, 3 chips) their readings.
        at: (m, d) features of the touches to predict.
        k: Neighbours, a whole number; all where there are fewer.

    Returns:
        (m, 3 chips), in the unit of `y`.
    """
    near, _ = near_rows(x, at, k)
    return near @ y / near.sum(1, keepdims=True)


def near_rows(x: np.ndarray, at: np.ndarray, k: int | float) -> tuple[np.ndarray, np.ndarray]:
    """Find the k nearest training touches, and all equally near ones, so that rounding chooses none of them.

    Args:
        x: (n, d) features of the training touches.
        at: (m, d) features of the touches to predict.
        k: Neighbours, a whole number; all where there are fewer.

    Returns:
        (m, n) bool, and the squared distances (m, n).
    """
    square = (at**2).sum(1)[:, None] + (x**2).sum(1) - 2 * at @ x.T
    last = min(int(k), len(x)) - 1
    farthest = np.partition(square, last, axis=1)[:, [last]]
    rounding = EQUALLY_NEAR * ((at**2).sum(1)[:, None] + (x**2).sum(1).max())
    return square <= farthest + rounding, np.maximum(square, 0)
