"""A program that compiles quickly gives what any does, wherever it is called."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t import compiling
from i2t.compiling import jit_quickly


def curve(x: jax.Array, power: int) -> jax.Array:
    return jnp.cumsum(jnp.sin(x)) ** power


QUICK = jit_quickly(curve, static_argnames="power")
X = jnp.linspace(0.0, 1.0, 50)


def test_alone_inside_of_another_program_and_in_a_batch_it_is_the_function() -> None:
    np.testing.assert_allclose(QUICK(X, power=2), curve(X, 2), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda x: 2 * QUICK(x, power=2))(X), 2 * curve(X, 2), rtol=1e-6)
    known = jax.jit(lambda x: x + QUICK(np.asarray(X), power=2))  # of arguments that are numbers
    np.testing.assert_allclose(known(X), X + curve(X, 2), rtol=1e-6)
    np.testing.assert_allclose(jax.vmap(lambda x: QUICK(x, power=2))(X[None]), curve(X, 2)[None], rtol=1e-6)
    slope = jax.grad(lambda x: QUICK(x, power=2)[-1])(X)
    np.testing.assert_allclose(slope, 2 * curve(X, 1)[-1] * jnp.cos(X), rtol=1e-5)


def test_a_compiler_without_the_options_compiles_as_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(compiling.QUICKLY, "xla_of_another_version", True)
    compiling._options.cache_clear()
    assert compiling._options() is None
    np.testing.assert_allclose(jit_quickly(curve, static_argnames="power")(X, power=3), curve(X, 3), rtol=1e-6)
    compiling._options.cache_clear()
