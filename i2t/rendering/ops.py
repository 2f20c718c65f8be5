"""Small operations on arrays in the form that XLA runs quickest."""

from collections.abc import Callable, Sequence
from typing import Any, SupportsIndex

import jax
import jax.numpy as jnp
from jaxtyping import Array


def fusion_barrier(work: Callable[[Array], Any], i: Array, holds: Array) -> Any:
    """work(i), kept apart from its storing by a condition that always holds: XLA would merge the two, and a merged one
    runs on a single core.
    """
    return jax.lax.cond(holds, work, lambda i: jax.tree.map(jnp.zeros_like, jax.eval_shape(work, i)), i)


def dynamic_slice(array: Array, start: Sequence[Any], shape: Sequence[int]) -> Array:
    """A block of `shape` that begins at `start`."""
    return jax.lax.dynamic_slice(array, [jnp.asarray(i, jnp.int32) for i in start], shape)


def dynamic_update(array: Array, block: Array, start: Sequence[Any]) -> Array:
    """The array with a block in place of what begins at `start`."""
    return jax.lax.dynamic_update_slice(array, block, [jnp.asarray(i, jnp.int32) for i in start])


def element(tree: Any, i: SupportsIndex) -> Any:
    """Element i of every array of a tree."""
    return jax.tree.map(lambda leaf: leaf[i], tree)


def indices(n: int) -> Array:
    """0, 1, ... n - 1."""
    return jnp.arange(n, dtype=jnp.int32)


def minimum(a: Any, b: Any) -> Array:
    """Minimum of numbers that are not NaN: one instruction, where `jnp.minimum` takes several to pass NaN on."""
    return jnp.where(a < b, a, b)


def maximum(a: Any, b: Any) -> Array:
    """Maximum of numbers that are not NaN."""
    return jnp.where(a > b, a, b)
