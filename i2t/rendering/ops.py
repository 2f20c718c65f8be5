"""Small operations on arrays in the form that XLA runs fastest."""

from collections.abc import Callable, Sequence
from typing import Any, SupportsIndex

import jax
import jax.numpy as jnp
from jaxtyping import Array


def fusion_barrier(work: Callable[[Array], Any], i: Array, holds: Array) -> Any:
    """Compute `work(i)` in a computation of its own.

    Without it, XLA's CPU backend fuses the work with the update that stores its result: values are computed again for
    each of their uses, and the fused loop runs on a single core. A branch whose condition the compiler cannot decide
    keeps the two apart. The condition is true in every call, so the result equals that of `work` to the last bit.

    Args:
        work: A function of a loop's counter.
        i: The counter.
        holds: A condition that is true, but only at run time, such as that of the loop, `i < count`.

    Returns:
        `work(i)`, an array or a tree of arrays.
    """
    return jax.lax.cond(holds, work, lambda i: jax.tree.map(jnp.zeros_like, jax.eval_shape(work, i)), i)


def dynamic_slice(array: Array, start: Sequence[Any], shape: Sequence[int]) -> Array:
    """Take a block of an array with indices of 32 bits.

    Args:
        array: The array.
        start: Index of the block's first element along each axis; may be traced.
        shape: Shape of the block.

    Returns:
        The block of the given shape.
    """
    return jax.lax.dynamic_slice(array, [jnp.asarray(i, jnp.int32) for i in start], shape)


def dynamic_update(array: Array, block: Array, start: Sequence[Any]) -> Array:
    """Replace a block of an array with indices of 32 bits.

    Args:
        array: The array.
        block: The new block, with as many axes as the array.
        start: Index of the block's first element along each axis; may be traced.

    Returns:
        The array with the new block.
    """
    return jax.lax.dynamic_update_slice(array, block, [jnp.asarray(i, jnp.int32) for i in start])


def element(tree: Any, i: SupportsIndex) -> Any:
    """Take an element of every array of a tree.

    Args:
        tree: A tree of arrays with a common first axis.
        i: Index on that axis.

    Returns:
        The tree of elements, without that axis.
    """
    return jax.tree.map(lambda leaf: leaf[i], tree)


def indices(n: int) -> Array:
    """Count from 0 to n - 1 with 32 bits.

    Args:
        n: Number of indices.

    Returns:
        `(n,)` indices, int32.
    """
    return jnp.arange(n, dtype=jnp.int32)


def minimum(a: Any, b: Any) -> Array:
    """Compute the minimum of numbers that are not NaN in a single instruction; `jnp.minimum` needs several to pass on
    NaN.

    Args:
        a: Numbers of any shape.
        b: Numbers that broadcast with `a`.

    Returns:
        The smaller of each pair.
    """
    return jnp.where(a < b, a, b)


def maximum(a: Any, b: Any) -> Array:
    """Compute the maximum of numbers that are not NaN, as `minimum` does.

    Args:
        a: Numbers of any shape.
        b: Numbers that broadcast with `a`.

    Returns:
        The larger of each pair.
    """
    return jnp.where(a > b, a, b)
