"""Many calls of one function: items in batches that fit the processor's caches, and calls laid over devices.

What is computed in bulk (simulated touches, predicted touches, beliefs along episodes, members of an ensemble) is many
calls of one compiled function with arguments of the same shapes. On a GPU `spread` makes them one after the other, as
a loop would. On a CPU it makes a few at a time, each in a thread, because one call keeps two cores busy for half of the
time only. Where there are n devices, it makes n at a time: their arguments lie side by side on a mesh of one axis, and
each device runs what a single one would have run, on arrays of the same shapes. So results do not depend on the number
of devices or threads, and devices exchange nothing.
"""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import chain, islice
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Int, PyTree

CLASSES = (64, 8, 1)  # touches that are predicted together, so that a new number of them compiles nothing
CALLS = "calls"  # the axis of the mesh
CALLS_AT_A_TIME = 4  # at most, of a CPU: each holds its own arrays
Call: TypeAlias = tuple[Any, ...]


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


def select_rows(tree: PyTree, rows: Any) -> PyTree:
    """Rows of every array of a tree, taken on the host, where that costs no compilation.

    Args:
        tree: Of arrays with a shared axis 0.
        rows: Numbers, a mask, or a slice.

    Returns:
        The tree with those rows; its arrays are NumPy's or JAX's, as they were.
    """

    def some(leaf: Any) -> Any:
        found = np.asarray(leaf)[rows]
        return jax.device_put(found) if isinstance(leaf, jax.Array) else found

    return jax.tree.map(some, tree)


def filled_batches(rows: Int[np.ndarray, " n"], size: int) -> list[Int[np.ndarray, " size"]]:
    """Rows in batches of one size, so that one compilation serves all.

    Args:
        rows: Numbers.
        size: Of a batch.

    Returns:
        The batches; the last one is filled up with its own rows.
    """
    return [np.resize(rows[start : start + size], size) for start in range(0, len(rows), size)]


def spread(
    function: Callable[..., PyTree], calls: Iterable[Call], *, shared: Call = (), **static: Any
) -> Iterator[PyTree]:
    """`function(*call, *shared, **static)` for each call: as many at a time as there are devices, or a few on a CPU.

    Args:
        function: Compiled (`jax.jit`), of module level or kept by whoever calls, because what is compiled for several
            devices is found again by it.
        calls: Positional arguments that are each call's own, all of the same shapes. They are asked for as they are
            needed.
        shared: Positional arguments that follow, the same for all calls: arrays, numbers, and configurations of numbers
            that are traced (`i2t.runtime.compiling.traced_floats`).
        static: Named arguments that are not arrays, the same for all calls.

    Yields:
        Results in the order of the calls, on the host.
    """
    remaining, devices = iter(calls), jax.device_count()
    group = list(islice(remaining, devices))
    if len(group) < 2:  # one device, or nothing to share between several
        shared = _here(shared)
        yield from a_few_at_a_time(lambda *call: function(*call, *shared, **static), chain(group, remaining))
        return
    program, shared = _program(function, tuple(static.items()), _mesh()), everywhere(shared)
    by_call = NamedSharding(_mesh(), P(CALLS))
    while group:
        filled = group + group[-1:] * (devices - len(group))  # the last devices repeat the last call
        side_by_side = jax.device_put(jax.tree.map(lambda *leaves: jnp.stack(leaves), *filled), by_call)
        made = jax.device_get(program(side_by_side, shared))
        for i in range(len(group)):
            yield jax.tree.map(lambda leaf, i=i: leaf[i], made)
        group = list(islice(remaining, devices))


def a_few_at_a_time(work: Callable[..., PyTree], calls: Iterable[Call]) -> Iterator[PyTree]:
    """`work(*call)` for each call, on one device: on a CPU with several cores several are made at a time, where this
    thread has no settings of JAX for itself.

    Args:
        work: Of compiled functions, which may be called from several threads.
        calls: Positional arguments, of any shapes. They are asked for as they are needed.

    Yields:
        Results in the order of the calls, on the host.
    """

    def one(call: Call) -> PyTree:
        return jax.device_get(work(*call))

    remaining = iter(calls)
    yield from map(one, islice(remaining, 1))  # which compiles, once for all
    workers = min(usable_cores(), CALLS_AT_A_TIME) if jax.default_backend() == "cpu" else 1
    with ThreadPoolExecutor(workers) as pool:
        if workers == 1 or pool.submit(lambda: dict(jax.config.values)).result() != dict(jax.config.values):
            yield from map(one, remaining)
        made = deque(pool.submit(one, call) for call in islice(remaining, workers))
        while made:
            yield made.popleft().result()
            made.extend(pool.submit(one, call) for call in islice(remaining, 1))


def usable_cores() -> int:
    """Cores that this process may use.

    Returns:
        Their number.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def spread_rows(
    function: Callable[..., PyTree], rows: Call, *, shared: Call = (), multiple: int = 1, **static: Any
) -> PyTree:
    """`function(*rows, *shared, **static)` with the rows cut into equal parts, one for each device.

    Args:
        function: As of `spread`; every array of its result has the rows as axis 0, and no row depends on another.
        rows: Positional arguments whose arrays all have the rows as axis 0.
        shared: Positional arguments that follow.
        multiple: Of which the number of rows in a part is one: a function that takes so many rows at a time then takes
            the same ones together wherever they are.
        static: Named arguments that are not arrays.

    Returns:
        The result for all rows.
    """
    length = len(jax.tree.leaves(rows)[0])
    groups = -(-length // multiple)
    parts = min(jax.device_count(), groups)
    if parts < 2:
        return function(*rows, *_here(shared), **static)
    each = multiple * -(-groups // parts)
    index = np.resize(np.arange(length), (parts, each))  # filled up with the first rows
    calls = [jax.tree.map(lambda leaf, part=part: leaf[part], rows) for part in index]
    made = list(spread(function, calls, shared=shared, **static))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:length], *made)


def size_classes(n: int) -> Iterator[np.ndarray]:
    """Share n touches out to batches of few sizes.

    Args:
        n: Number of touches, at least 1.

    Yields:
        Numbers of touches, as many as a class has: 0 to n - 1, of which the last batch repeats the last.
    """
    start = 0
    while start < n:
        left = n - start
        size = next(size for size in CLASSES if size <= left)
        if size == 1 and left > 1:
            size = CLASSES[-2]
        yield np.minimum(np.arange(start, start + size), n - 1)
        start += size


def everywhere(values: PyTree) -> PyTree:
    """Arrays on all devices, for arguments that several calls of `spread` share.

    Args:
        values: Arrays on the host or on any device; those that are everywhere already stay.

    Returns:
        The same arrays on all devices.
    """
    return jax.device_put(values, NamedSharding(_mesh(), P()) if jax.device_count() > 1 else None)


def _here(values: PyTree) -> PyTree:
    """Arrays and numbers on one device only, so that single computations do not run on all, and once for all calls."""
    return jax.device_put(values, jax.devices()[0] if jax.device_count() > 1 else None)


def _mesh() -> Mesh:
    return jax.make_mesh((jax.device_count(),), (CALLS,), axis_types=(AxisType.Auto,), devices=jax.devices())


@lru_cache(maxsize=32)
def _program(function: Callable[..., PyTree], static: tuple[tuple[str, Any], ...], mesh: Mesh) -> Callable[..., PyTree]:
    """Program of each device: a call on its own arguments, which are one row of those side by side."""

    def local(own: PyTree, shared: PyTree) -> PyTree:
        call = jax.tree.map(lambda leaf: leaf[0], own)
        return jax.tree.map(lambda leaf: leaf[None], function(*call, *shared, **dict(static)))

    # Loops that end sooner on one device than on another are no error: devices do not wait for each other.
    over = jax.shard_map(local, mesh=mesh, in_specs=(P(CALLS), P()), out_specs=P(CALLS), check_vma=False)
    options = getattr(function, "compiler_options", lambda: None)  # of `i2t.runtime.compiling`
    return jax.jit(over, compiler_options=options())
