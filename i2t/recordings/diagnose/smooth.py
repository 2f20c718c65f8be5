"""Smooth models of readings, scored by exact leave-one-out prediction (`i2t.leave_one_out`).

A model is a Gaussian process y ~ N(0, s^2 K). One scale s serves all channels; it takes its most likely value.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cho_solve, cholesky

from i2t.leave_one_out import leave_out_rows


class LeaveOneOutRows(NamedTuple):
    """Errors of n rows, each predicted by a Gaussian process from all others, and the sum of their log densities."""

    error: Float[np.ndarray, "n c"]  # error of each row as predicted from all others
    log_density: float  # log density of all rows, each predicted from all others, at the most likely scale


def leave_one_out(covariance: Float[np.ndarray, "n n"], values: Float[np.ndarray, "n c"]) -> LeaveOneOutRows:
    """Predict each row from all others by a Gaussian process with a given covariance.

    Args:
        covariance: `(n, n)` covariance of the rows up to a factor, noise included.
        values: `(n, c)` values of the rows, with mean zero.

    Returns:
        The errors, and the log density of the rows at the most likely factor, up to a constant. If the matrix is not
        positive definite, they are infinite and minus infinite.
    """
    try:
        factor = cholesky(covariance, lower=True)
    except LinAlgError:
        return LeaveOneOutRows(np.full_like(values, np.inf), -np.inf)
    inverse = cho_solve((factor, True), np.eye(len(values)))
    error, variance = leave_out_rows(np.diagonal(inverse), inverse @ values)
    squared_scale = max(float(np.mean(error**2 / variance)), 1e-300)  # the most likely s^2
    density = -0.5 * values.shape[1] * np.log(variance).sum() - 0.5 * values.size * np.log(squared_scale)
    return LeaveOneOutRows(error, float(density))


def smooth_r2(
    labels: Float[np.ndarray, "n k"],
    values: Float[np.ndarray, "n c"],
    *,
    lengths: tuple[float, ...] = (0.35, 0.7, 1.4, 2.8),
    noises: tuple[float, ...] = (3e-3, 3e-2, 0.3),
) -> float:
    """Compute the share of variance that a smooth function of the labels explains in leave-one-out prediction.

    Args:
        labels: `(n, k)` values of k labels in each row, in any units. Constant columns are ignored.
        values: `(n, c)` values to explain.
        lengths: Length scales to try, in standard deviations of the labels.
        noises: Noise variances to try, relative to the signal's.

    Returns:
        R2 with the best length and noise: 1 if the labels explain everything, 0 or less if nothing.
    """
    spread = labels.std(0)
    varying = spread > 1e-9 * np.maximum(np.abs(labels).max(0), 1e-30)
    centred = values - values.mean(0)
    total = (centred**2).sum()
    if not varying.any() or total == 0 or len(labels) < 3:
        return 0.0
    x = labels[:, varying] / spread[varying]
    square = ((x[:, None] - x[None]) ** 2).sum(-1)
    least_error = np.inf
    for length in lengths:
        eigenvalues, vectors = np.linalg.eigh(np.exp(-square / (2 * length**2)))
        projected = vectors.T @ centred
        for noise in noises:
            shrunk = 1 / (np.maximum(eigenvalues, 0) + noise)
            rows = leave_out_rows((vectors**2) @ shrunk, vectors @ (shrunk[:, None] * projected))
            least_error = min(least_error, float((rows.error**2).sum()))
    return 1 - least_error / float(total)


def subsample(n: int, max_rows: int) -> np.ndarray:
    """Choose rows at random, always the same ones for the same numbers.

    Args:
        n: Number of rows.
        max_rows: Number of rows to keep, at most.

    Returns:
        `(min(n, max_rows),)` row numbers in ascending order.
    """
    if n <= max_rows:
        return np.arange(n)
    return np.sort(np.random.default_rng(0).choice(n, max_rows, replace=False))
