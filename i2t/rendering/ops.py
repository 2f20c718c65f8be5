"""Small operations on arrays in the form that XLA runs quickest."""

from collections.abc import Callable, Sequence
from typing import Any, SupportsIndex

import jax
import jax.numpy as jnp
from jaxtyping import Array


def fusion_barrier(work: Callable[[Array], Any], i: Array, holds: Array) -> Any:
    """Compute `work(i)` in a computation of its own.

    XLA's CPU backend otherwise fuses it with the update that stores it: values are computed again for each of their
    uses, and the fused loop runs on a single core. A branch that the compiler cannot decide keeps the two apart. The
    condition is true at every call, so the other branch is never taken and the result is that of `work` to the last
    bit.

    Args:
        work: A function of a loop's counter.
        i: The counter.
        holds: True, but only at run time: the condition of the loop, `i < count`.

    Returns:
        work(i), an array or a tree of arrays.
    """
    return jax.lax.cond(holds, work, lambda i: jax.tree.map(jnp.zeros_like, jax.eval_shape(work, i)), i)


def dynamic_slice(array: Array, start: Sequence[Any], shape: Sequence[int]) -> Array:
    """A block of an array; its indices stay 32 bits wide.

    Args:
        array: Any.
        start: Index of the block's first element along each axis; may be traced.
        shape: Of the block.

    Returns:
        The block.
    """
    return jax.lax.dynamic_slice(array, [jnp.asarray(i, jnp.int32) for i in start], shape)


def dynamic_update(array: Array, block: Array, start: Sequence[Any]) -> Array:
    """An array with one block replaced; its indices stay 32 bits wide.

    Args:
        array: Any.
        block: With as many axes.
        start: Index of the block's first element along each axis; may be traced.

    Returns:
        The new array.
    """
    return jax.lax.dynamic_update_slice(array, block, [jnp.asarray(i, jnp.int32) for i in start])


def element(tree: Any, i: SupportsIndex) -> Any:
    """An element of every array of a tree.

    Args:
        tree: Of arrays with a shared first axis.
        i: Index on it.

    Returns:
        The tree without that axis.
    """
    return jax.tree.map(lambda leaf: leaf[i], tree)


def indices(n: int) -> Array:
    """0, 1, ... n - 1 as 32 bits.

    Args:
        n: How many.

    Returns:
        (n,) int32.
    """
    return jnp.arange(n, dtype=jnp.int32)


def minimum(a: Any, b: Any) -> Array:
    """Minimum of numbers that are not NaN: one instruction, where `jnp.minimum` takes several to pass NaN on.

    Args:
        a: Numbers of any shape.
        b: Numbers that broadcast with them.

    Returns:
        The smaller of each two.
    """
    return jnp.where(a < b, a, b)


def maximum(a: Any, b: Any) -> Array:
    """Maximum of numbers that are not NaN.

    Args:
        a: Numbers of any shape.
        b: Numbers that broadcast with them.

    Returns:
        The larger of each two.
    """
    return jnp.where(a > b, a, b)
