"""The parts of JAX that are not its public interface. No other module of i2t uses any.

JAX may change them in any release, so pyproject.toml bounds its version, and `tests/runtime/test_jax_internals.py`
fails where they changed. The public `jax.custom_batching.custom_vmap` would trace a function again for every
transformation of it.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array


def single_operation(
    name: str,
    function: Callable[..., Sequence[Array]],
    *,
    result_shapes: Callable[..., Sequence[jax.ShapeDtypeStruct]],
    batch: Callable[..., tuple[Sequence[Array], Sequence[int]]],
    static_argnames: tuple[str, ...],
) -> Callable[..., list[Array]]:
    """Make a function that JAX sees as a single operation, so that programs with it are traced once and not again for
    each transformation. It has no derivative.

    Args:
        name: Name of the operation.
        function: Pure function of arrays and of static options, which returns several arrays.
        result_shapes: Function that returns shapes and types of the results; it takes the arguments' shapes and types
            and the options.
        batch: Rule of `jax.vmap`: `batch(arrays, axes, **options)` returns the results and their batch axes.
        static_argnames: Names of the options.

    Returns:
        The operation, called as the function is.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True

    @primitive.def_abstract_eval
    def _(*arrays: ShapedArray, **options: Any) -> list[ShapedArray]:
        shapes = (jax.ShapeDtypeStruct(array.shape, array.dtype) for array in arrays)
        return [ShapedArray(result.shape, result.dtype) for result in result_shapes(*shapes, **options)]

    primitive.def_impl(jax.jit(function, static_argnames=static_argnames))  # for calls outside compiled functions
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=True))
    return primitive.bind
