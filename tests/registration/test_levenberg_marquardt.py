"""The optimiser on problems whose answers are known."""

import jax
import jax.numpy as jnp
import numpy as np

from i2t.registration.levenberg_marquardt import LeastSquares, levenberg_marquardt


def squares(residual, parameters: int, size: int) -> LeastSquares:
    """Plain least squares; the scale has no effect."""
    return LeastSquares(
        residual_and_jacobian=lambda x: (residual(x), jax.jacfwd(residual)(x)),
        cost=lambda x, linearised, scale: jnp.sum(linearised[0] ** 2),
        normal_equations=lambda x, linearised, scale: (
            linearised[1].T @ linearised[1],
            linearised[1].T @ linearised[0],
        ),
        placeholder=(jnp.full(size, 1e6), jnp.zeros((size, parameters))),
    )


def test_the_valley_of_rosenbrock_ends_at_its_minimum():
    """Rosenbrock, "An automatic method for finding the greatest or least value of a function", 1960: (1, 1)."""
    problem = squares(lambda x: jnp.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]]), 2, 2)
    x, _ = levenberg_marquardt(problem, jnp.array([-1.2, 1.0]), jnp.ones(60))
    np.testing.assert_allclose(x, [1, 1], atol=1e-5)


def test_marquardts_damping_is_independent_of_units():
    """In other units, the same steps are taken."""
    a, b = np.random.default_rng(0).normal(size=(8, 3)), np.random.default_rng(1).normal(size=8)
    units = np.array([1.0, 64.0, 1 / 1024])  # powers of two, which round nothing
    solution, scaled = (
        levenberg_marquardt(squares(lambda x, u=u: (a * u) @ x - b, 3, 8), jnp.zeros(3), jnp.ones(3))[0]
        for u in (np.ones(3), units)
    )
    np.testing.assert_allclose(scaled * units, solution, rtol=1e-5)
