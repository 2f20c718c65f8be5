"""Exact leave-one-out predictions of a normal distribution, without fitting it again.

Let y ~ N(0, P^-1). Given all other entries, the entries b of y have covariance inv(P_bb) and differ from their mean by

    y_b - E[y_b | rest] = inv(P_bb) (P y)_b,

so that one precision matrix P serves every b (Rasmussen and Williams, "Gaussian Processes for Machine Learning",
equations 5.10 to 5.12). Subtract a mean from y first. The functions take P_bb and the weights (P y)_b, because a linear
regression yields both without forming P. If the covariance is s^2 inv(P), weights and errors do not change.

The functions take NumPy or JAX arrays and return the same kind, also under `jax.jit` and `jax.grad`.
"""

import contextlib
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import lapack

Array: TypeAlias = Any  # a NumPy or JAX array

STDS_WITHIN_90 = 1.645  # half width, in standard deviations, of the interval that holds 90 % of a normal distribution
UNINFORMED_VARIANCE = 1e6  # variance predicted where rounding left a matrix that is not positive definite


class LeftOutRows(NamedTuple):
    """Leave-one-out errors (value minus predicted mean) and variances of n rows, each given the others."""

    error: Float[Array, "... n c"]  # value of each row minus its predicted mean
    variance: Float[Array, "... n #c"]


class LeftOutBlocks(NamedTuple):
    """Leave-block-out errors (value minus predicted mean) of each row, and log density of each block of m rows, given
    all rows outside the block.
    """

    error: Float[Array, "... m c"]  # value of each row minus its predicted mean
    log_density: Float[Array, "... c"]  # predicted log density of the block's values


def leave_out_rows(
    precision: Float[Array, "... n"], weights: Float[Array, "... n c"], scale: Float[Array, "... 1 c"] | float = 1.0
) -> LeftOutRows:
    """Compute the leave-one-out error and variance of each row of a Gaussian model from its precision matrix.

    Args:
        precision: Diagonal of the precision matrix P (inverse covariance) of n rows.
        weights: The product P y for c independent columns of targets y.
        scale: Factor s of the standard deviations of each column, or of all columns.

    Returns:
        Errors (value minus mean) in the unit of y, and variances; with one scale for all columns, one variance serves
        all of them.
    """
    own = precision[..., None]
    return LeftOutRows(weights / own, scale**2 / own)


def leave_out_blocks(precision: Float[Array, "... m m"], weights: Float[Array, "... m c"]) -> LeftOutBlocks:
    """Compute the leave-block-out error and log density of blocks of m rows of a Gaussian model.

    Args:
        precision: Diagonal blocks P_bb of the precision matrix, positive definite.
        weights: Rows (P y)_b of each block for c independent columns of targets y.

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
    """Compute errors and variances of rows predicted from the rows of all other parts, for several Gaussian models.

    Args:
        precision: Precision matrices P (inverse covariances) of n rows, one for each group.
        weights: The products P y for c independent columns of targets y.
        part: Number of the part to which each row belongs.
        scale: Factor of the standard deviations, as for `leave_out_rows`.

    Returns:
        Errors (value minus mean) in the unit of y, and the variance of each row, which is very large where rounding
        left a matrix that is not positive definite.
    """
    error, variance = np.empty_like(weights), np.empty((*weights.shape[:2], 1))
    for number in np.unique(part):
        rows = np.flatnonzero(part == number)
        covariance = inverses(precision[:, rows[:, None], rows], failed=UNINFORMED_VARIANCE)
        error[:, rows] = covariance @ weights[:, rows]
        variance[:, rows] = np.diagonal(covariance, axis1=1, axis2=2)[..., None]
    return LeftOutRows(error, np.maximum(variance, 0) * scale**2)


def inverses(matrices: Float[np.ndarray, "groups n n"], *, failed: float) -> Float[np.ndarray, "groups n n"]:
    """Invert symmetric matrices that are positive definite, except for rounding.

    Args:
        matrices: Matrices of one size.
        failed: Diagonal of the result for a matrix that is not positive definite.

    Returns:
        `(groups, n, n)` inverses.
    """
    if matrices.shape[1] <= 40:  # NumPy inverts a stack of small matrices faster than LAPACK one by one
        with contextlib.suppress(np.linalg.LinAlgError):
            return np.linalg.inv(matrices)
    return np.stack([_inverse(matrix, failed) for matrix in matrices])


def _inverse(matrix: np.ndarray, failed: float) -> np.ndarray:
    factor, info = lapack.dpotrf(matrix, lower=1)
    if not info:
        inverse, info = lapack.dpotri(factor, lower=1)  # fills the lower half; the upper half stays zero
    if info:
        return failed * np.eye(len(matrix))
    whole = inverse + inverse.T
    whole[np.diag_indices(len(matrix))] *= 0.5
    return whole
