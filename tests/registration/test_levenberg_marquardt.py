"""The optimiser on problems whose answers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.registration.levenberg_marquardt import LeastSquares, init, levenberg_marquardt, step


def squares(residual, parameters: int, size: int) -> LeastSquares:
    """Plain least squares; the scale has no effect."""
    return LeastSquares(
        residual_and_jacobian=lambda x: (residual(x), jax.jacfwd(residual)(x)),
        cost=lambda x, linearised, scale: jnp.sum(linearised[0] ** 2),
        normal_equations=lambda x, linearised, scale: (
            linearised[1].T @ linearised[1],
            linearised[1].T @ linearised[0],
        ),
        retract=lambda x, change: x + change,
        unseen=(jnp.full(size, 1e6), jnp.zeros((size, parameters))),
    )


@pytest.mark.parametrize("scale_free", [False, True])
def test_the_valley_of_rosenbrock_ends_at_its_minimum(scale_free):
    """Rosenbrock, "An automatic method for finding the greatest or least value of a function", 1960: (1, 1)."""
    problem = squares(lambda x: jnp.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]]), 2, 2)
    end = levenberg_marquardt(problem, jnp.array([-1.2, 1.0]), jnp.ones(60), scale_free=scale_free)
    np.testing.assert_allclose(end.x, [1, 1], atol=1e-5)


def test_marquardts_damping_knows_no_units():
    """In other units the same steps are taken."""
    a, b = np.random.default_rng(0).normal(size=(8, 3)), np.random.default_rng(1).normal(size=8)
    units = np.array([1.0, 64.0, 1 / 1024])  # powers of two, which round nothing
    one, other = (
        levenberg_marquardt(squares(lambda x, u=u: (a * u) @ x - b, 3, 8), jnp.zeros(3), jnp.ones(3), scale_free=True)
        for u in (np.ones(3), units)
    )
    np.testing.assert_allclose(other.x * units, one.x, rtol=1e-5)


def test_steps_that_do_not_help_are_not_kept_and_raise_the_damping():
    problem = squares(lambda x: jnp.stack([jnp.where(x[0] > 0.5, 100.0, 1 - x[0])]), 1, 1)
    scale = jnp.ones(())
    first, looked = step(problem, init(problem, jnp.zeros(1)), scale, scale)
    second, info = step(problem, first, scale, scale)
    assert looked.accepted
    assert not info.accepted
    np.testing.assert_array_equal(second.x, first.x)
    assert second.damping > first.damping
    assert second.trial < first.trial


def test_a_tolerance_ends_the_search_at_the_last_scale():
    problem = squares(lambda x: x - 3.0, 2, 2)
    scales = jnp.array([4.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    assert levenberg_marquardt(problem, jnp.zeros(2), scales).steps == len(scales)
    end = levenberg_marquardt(problem, jnp.zeros(2), scales, tolerance=0.01)
    assert 3 <= end.steps < len(scales)
    np.testing.assert_allclose(end.x, 3, atol=0.01)
