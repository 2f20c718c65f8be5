"""What i2t uses of JAX beyond its public interface works as it did, and is used in one place."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from i2t.runtime.compiling import jit_quickly
from i2t.runtime.jax_internals import single_operation

LIBRARY = Path(__file__).parents[2] / "i2t"
PRIVATE = re.compile(r"jax\.(?:_src|extend|interpreters|lib)\b")
CHANGED = "JAX changed what i2t/runtime/jax_internals.py uses: adapt it, and the bound in pyproject.toml"

traced = []  # shapes with which the function below was traced


def _scale(x, *, factor):
    traced.append(x.shape)
    return factor * x, x.sum(1)


def _shapes(x, *, factor):
    return jax.ShapeDtypeStruct(x.shape, x.dtype), jax.ShapeDtypeStruct(x.shape[:1], x.dtype)


def _batch(arrays, axes, **options):
    (x,), (axis,) = arrays, axes
    x = jnp.moveaxis(x, axis, 0)
    return [part.reshape(*x.shape[:2], *part.shape[1:]) for part in SCALE(x.reshape(-1, x.shape[2]), **options)], (0, 0)


SCALE = single_operation("test_scale", _scale, result_shapes=_shapes, batch=_batch, static_argnames=("factor",))


def test_a_function_is_one_operation_of_programs_and_batches():
    x = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    for call in (jax.vmap(lambda x: SCALE(x, factor=2)), jax.jit(jax.vmap(lambda x: SCALE(x, factor=2)))):
        scaled, total = call(x)
        np.testing.assert_array_equal(scaled, 2 * x, err_msg=CHANGED)
        np.testing.assert_array_equal(total, x.sum(2), err_msg=CHANGED)
    np.testing.assert_array_equal(SCALE(x[0], factor=3)[0], 3 * x[0], err_msg=CHANGED)
    assert (2, 3, 2) not in traced, CHANGED
    assert "test_scale" in str(jax.make_jaxpr(lambda x: SCALE(x, factor=2))(x[0])), CHANGED


def test_no_other_module_uses_what_is_not_public():
    users = {path.name for path in LIBRARY.rglob("*.py") if PRIVATE.search(path.read_text())}
    assert users == {"jax_internals.py"}


def test_a_quickly_compiled_function_works_within_programs_batches_and_derivatives():
    """There jax.jit refuses compiler options; the second function has no argument that could be a tracer."""
    double, three = jit_quickly(lambda x: 2.0 * x), jit_quickly(lambda: jnp.float32(3))
    assert double(1.0) + three() == 5
    assert jax.jit(lambda x: double(x) + double(1.0) + three())(1.0) == 7
    np.testing.assert_array_equal(jax.vmap(lambda x: double(x) + three())(jnp.ones(2)), [5, 5])
    assert jax.grad(lambda x: double(x) * three())(1.0) == 6
    assert jax.jit(lambda x: jax.lax.fori_loop(0, 2, lambda i, y: y + three(), x))(1.0) == 7
