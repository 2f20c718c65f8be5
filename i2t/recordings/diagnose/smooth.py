"""Fit of a smooth model to readings: errors of a Gaussian process, y ~ N(0, s^2 K), on rows left out in closed form
(`i2t.leave_one_out`).

The scale s of all channels together is its most likely value. NumPy only.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cho_solve, cholesky

from i2t.leave_one_out import leave_out_rows

SMOOTH_LENGTHS = (0.35, 0.7, 1.4, 2.8)  # of the labels' standard deviations
SMOOTH_NOISES = (3e-3, 3e-2, 0.3)  # of the signal's variance


class LeftOut(NamedTuple):
    """Each row as predicted from all others."""

    error: Float[np.ndarray, "n c"]
    log_density: float  # of all rows, each as predicted from all others, over the most likely scale


def left_out(covariance: Float[np.ndarray, "n n"], values: Float[np.ndarray, "n c"]) -> LeftOut:
    """Predict each row from all others.

    Args:
        covariance: Of the rows, noise included, up to a factor.
        values: Of the rows, of mean zero.

    Returns:
        Errors, and the log density of the rows; minus infinity where the covariance is none.
    """
    try:
        factor = cholesky(covariance, lower=True)
    except LinAlgError:
        return LeftOut(np.full_like(values, np.inf), -np.inf)
    inverse = cho_solve((factor, True), np.eye(len(values)))
    error, variance = leave_out_rows(np.diagonal(inverse), inverse @ values)
    square = max(float(np.mean(error**2 / variance)), 1e-300)  # the most likely s^2
    density = -0.5 * values.shape[1] * np.log(variance).sum() - 0.5 * values.size * np.log(square)
    return LeftOut(error, float(density))


def smooth_r2(labels: Float[np.ndarray, "n k"], values: Float[np.ndarray, "n c"]) -> float:
    """Share of the values' variance that a smooth function of the labels explains, each row predicted from the others.

    Args:
        labels: Of each row, in any units; columns that do not vary are left out.
        values: To explain.

    Returns:
        R2 of the best of a few lengths and noises, at most 1.
    """
    spread = labels.std(0)
    varying = spread > 1e-9 * np.maximum(np.abs(labels).max(0), 1e-30)
    centred = values - values.mean(0)
    total = (centred**2).sum()
    if not varying.any() or total == 0 or len(labels) < 3:
        return 0.0
    x = labels[:, varying] / spread[varying]
    square = ((x[:, None] - x[None]) ** 2).sum(-1)
    best = np.inf
    for length in SMOOTH_LENGTHS:
        eigenvalues, vectors = np.linalg.eigh(np.exp(-square / (2 * length**2)))
        along = vectors.T @ centred
        for noise in SMOOTH_NOISES:
            shrunk = 1 / (np.maximum(eigenvalues, 0) + noise)
            left_out = leave_out_rows((vectors**2) @ shrunk, vectors @ (shrunk[:, None] * along))
            best = min(best, float((left_out.error**2).sum()))
    return 1 - best / float(total)


def thinned(n: int, most: int) -> np.ndarray:
    """At most so many of n rows, at random and in order.

    Args:
        n: Rows.
        most: To keep.

    Returns:
        Their indices.
    """
    if n <= most:
        return np.arange(n)
    return np.sort(np.random.default_rng(0).choice(n, most, replace=False))
