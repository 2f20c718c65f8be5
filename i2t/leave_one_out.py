"""Exact leave-one-out of a normal distribution: part of y as predicted from all the rest, without fitting again.

Let y ~ N(0, P^-1). Given all other entries, entries b of y have the covariance inv(P_bb) and differ from their mean by

    y_b - E[y_b | rest] = inv(P_bb) (P y)_b,

so that one precision matrix P serves every b (Rasmussen and Williams, "Gaussian Processes for Machine Learning",
equations 5.10 to 5.12). A mean is subtracted from y before. The functions take P_bb and the weights (P y)_b, because a
linear regression has these without P itself. Where the covariance is s^2 inv(P), weights and errors stay as they are.

NumPy arrays in, NumPy arrays out, and likewise of JAX, also under `jax.jit` and `jax.grad`.
"""

import contextlib
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import lapack

Array: TypeAlias = Any  # of NumPy or JAX

STDS_WITHIN_90 = 1.645  # standard deviations of a normal error that hold nine in ten
SMALL_SYSTEM = 40  # edge of matrices that are inverted in one call
UNINFORMED_VARIANCE = 1e6  # of what is left out where a matrix is not positive definite, which rounding can bring about


class LeftOutRows(NamedTuple):
    """Rows, each predicted from all others."""

    error: Float[Array, "... n c"]  # value minus mean
    variance: Float[Array, "... n #c"]


class LeftOutBlocks(NamedTuple):
    """Blocks of m entries, each predicted from all others."""

    error: Float[Array, "... m c"]  # value minus mean
    log_density: Float[Array, "... c"]  # of the block's values


def leave_out_rows(
    precision: Float[Array, "... n"], weights: Float[Array, "... n c"], scale: Float[Array, "... 1 c"] | float = 1.0
) -> LeftOutRows:
    """Leave out single rows.

    Args:
        precision: Diagonal of the precision matrix P of n rows.
        weights: P y, for c independent columns of y.
        scale: s, by which the standard deviations of each column, or of all alike, are those of P.

    Returns:
        Errors (value minus mean) in the unit of y, and variances, one for all columns that have one scale.
    """
    own = precision[..., None]
    return LeftOutRows(weights / own, scale**2 / own)


def leave_out_blocks(precision: Float[Array, "... m m"], weights: Float[Array, "... m c"]) -> LeftOutBlocks:
    """Leave out blocks of m rows, each of them whole.

    Args:
        precision: Diagonal blocks P_bb of the precision matrix, positive definite.
        weights: Their rows (P y)_b, for c independent columns of y.

    Returns:
        Errors (value minus mean) in the unit of y, and the log density of each column of each block.

    Raises:
        LinAlgError: A block is a singular NumPy array.
    """
    if isinstance(precision, np.ndarray):
        error: Array = np.linalg.solve(precision, weights)
        log_determinant: Array = np.linalg.slogdet(precision)[1]
    else:
        import jax.numpy as jnp
        from jax.scipy.linalg import cho_solve

        factor = jnp.linalg.cholesky(precision)
        error = cho_solve((factor, True), weights)
        log_determinant = 2 * jnp.sum(jnp.log(jnp.diagonal(factor, axis1=-2, axis2=-1)), axis=-1)
    square = (weights * error).sum(-2)
    constant = 0.5 * weights.shape[-2] * np.log(2 * np.pi)
    return LeftOutBlocks(error, 0.5 * (log_determinant[..., None] - square) - constant)


def leave_out_parts(
    precision: Float[np.ndarray, "groups n n"],
    weights: Float[np.ndarray, "groups n c"],
    part: Int[np.ndarray, " n"],
    scale: Float[np.ndarray, "groups 1 c"] | float = 1.0,
) -> LeftOutRows:
    """Leave out the rows of each part together, for several precision matrices at once.

    Args:
        precision: Precision matrices P of n rows.
        weights: P y, for c independent columns of y.
        part: Number of the part of each row.
        scale: As for `leave_out_rows`.

    Returns:
        Errors (value minus mean) in the unit of y, and the variance of each row.
    """
    error, variance = np.empty_like(weights), np.empty((*weights.shape[:2], 1))
    for number in np.unique(part):
        rows = np.flatnonzero(part == number)
        covariance = inverses(precision[:, rows[:, None], rows], failed=UNINFORMED_VARIANCE)
        error[:, rows] = covariance @ weights[:, rows]
        variance[:, rows] = np.diagonal(covariance, axis1=1, axis2=2)[..., None]
    return LeftOutRows(error, np.maximum(variance, 0) * scale**2)


def inverses(matrices: Float[np.ndarray, "groups n n"], *, failed: float) -> Float[np.ndarray, "groups n n"]:
    """Invert symmetric positive definite matrices.

    Args:
        matrices: Several of one size.
        failed: Diagonal of the result for a matrix that is not positive definite.

    Returns:
        Their inverses.
    """
    if matrices.shape[1] <= SMALL_SYSTEM:
        with contextlib.suppress(np.linalg.LinAlgError):
            return np.linalg.inv(matrices)
    return np.stack([_inverse(matrix, failed) for matrix in matrices])


def _inverse(matrix: np.ndarray, failed: float) -> np.ndarray:
    factor, info = lapack.dpotrf(matrix, lower=1)
    if not info:
        inverse, info = lapack.dpotri(factor, lower=1)  # its lower half; the upper one of the factor is zero
    if info:
        return failed * np.eye(len(matrix))
    whole = inverse + inverse.T
    whole[np.diag_indices(len(matrix))] *= 0.5
    return whole
