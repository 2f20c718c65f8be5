"""Leaving out in closed form against conditioning on the rest, in both array libraries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from i2t.leave_one_out import inverses, leave_out_blocks, leave_out_parts, leave_out_rows

ROWS, COLUMNS = 9, 3
PARTS = np.array([0, 1, 2, 0, 1, 2, 0, 0, 1])


def drawn(seed: int, rows: int = ROWS) -> tuple[np.ndarray, np.ndarray]:
    """A covariance and values."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(rows, rows))
    return root @ root.T + 0.5 * np.eye(rows), rng.normal(size=(rows, COLUMNS))


def conditioned(covariance: np.ndarray, y: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors and covariance of a block given the rest."""
    rest = np.setdiff1d(np.arange(len(y)), block)
    gain = np.linalg.solve(covariance[np.ix_(rest, rest)], covariance[np.ix_(rest, block)]).T
    return y[block] - gain @ y[rest], covariance[np.ix_(block, block)] - gain @ covariance[np.ix_(rest, block)]


def test_rows_left_out_are_those_conditioned_on_the_rest():
    covariance, y = drawn(0)
    precision = np.linalg.inv(covariance)
    left_out = leave_out_rows(np.diagonal(precision), precision @ y)
    for i in range(ROWS):
        error, variance = conditioned(covariance, y, np.array([i]))
        np.testing.assert_allclose(left_out.error[i], error[0], rtol=1e-10)
        np.testing.assert_allclose(left_out.variance[i], variance[0], rtol=1e-10)


def test_blocks_left_out_are_those_conditioned_on_the_rest():
    covariance, y = drawn(1)
    precision = np.linalg.inv(covariance)
    for block in (np.array([2, 5, 6]), np.arange(4)):
        left_out = leave_out_blocks(precision[np.ix_(block, block)], (precision @ y)[block])
        error, own = conditioned(covariance, y, block)
        np.testing.assert_allclose(left_out.error, error, rtol=1e-10)
        density = multivariate_normal(cov=own).logpdf(error.T)
        np.testing.assert_allclose(left_out.log_density, density, rtol=1e-10)


def test_parts_are_left_out_in_every_group():
    (one, y), (other, z) = drawn(2), drawn(3)
    precision, weights = np.linalg.inv([one, other]), np.stack([np.linalg.solve(one, y), np.linalg.solve(other, z)])
    left_out = leave_out_parts(precision, weights, PARTS)
    for i, (covariance, values) in enumerate(((one, y), (other, z))):
        for part in range(3):
            rows = np.flatnonzero(part == PARTS)
            error, own = conditioned(covariance, values, rows)
            np.testing.assert_allclose(left_out.error[i, rows], error, rtol=1e-10)
            np.testing.assert_allclose(left_out.variance[i, rows, 0], np.diagonal(own), rtol=1e-10)


def test_compiled_blocks_are_those_of_numpy_and_have_their_derivative():
    blocks, weights = np.stack([drawn(seed, 4)[0] for seed in (4, 5)]), np.stack([drawn(6, 4)[1], drawn(7, 4)[1]])
    expected = leave_out_blocks(blocks, weights)
    compiled = jax.jit(leave_out_blocks)(jnp.asarray(blocks), jnp.asarray(weights))
    for one, other in zip(compiled, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-4)

    def density(scale: jax.Array) -> jax.Array:
        return jnp.sum(leave_out_blocks(scale * jnp.asarray(blocks), jnp.asarray(weights)).log_density)

    step = 1e-4
    up, down = (leave_out_blocks((1 + sign * step) * blocks, weights).log_density.sum() for sign in (1, -1))
    np.testing.assert_allclose(jax.jit(jax.grad(density))(jnp.float32(1)), (up - down) / (2 * step), rtol=1e-3)


@pytest.mark.parametrize("rows", [5, 60])
def test_inverses_of_small_and_large_matrices(rows):
    matrices = np.stack([drawn(8, rows)[0], drawn(9, rows)[0]])
    np.testing.assert_allclose(inverses(matrices, failed=1.0) @ matrices, np.stack([np.eye(rows)] * 2), atol=1e-8)


def test_a_matrix_that_is_not_positive_definite_predicts_with_a_huge_variance():
    matrices = np.stack([-np.eye(60), drawn(8, 60)[0]])
    inverse = inverses(matrices, failed=7.0)
    np.testing.assert_array_equal(inverse[0], 7 * np.eye(60))
    np.testing.assert_allclose(inverse[1] @ matrices[1], np.eye(60), atol=1e-8)
