"""Functions of one item, over many items in batches that fit the processor's caches."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def map_batches(function: Callable[[Any], Any], items: Any, batch_size: int) -> Any:
    """`jax.lax.map` in batches of one size, so that the function is compiled once.

    `jax.lax.map(..., batch_size=...)` compiles it a second time for a smaller batch that is left over. Here the last
    item is repeated until that batch is full.

    Args:
        function: Of one item.
        items: Arrays whose axis 0 counts n items.
        batch_size: Items at a time, at most.

    Returns:
        Its results, n on axis 0.
    """
    n = jax.tree.leaves(items)[0].shape[0]
    if n <= batch_size:
        return jax.vmap(function)(items)
    rows = np.minimum(np.arange(n + -n % batch_size), n - 1).reshape(-1, batch_size)
    found = jax.lax.map(jax.vmap(function), jax.tree.map(lambda x: x[rows], items))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n], found)
