"""Many calls of a function: items in batches that fit the processor's caches, and calls distributed over devices.

Bulk work (simulated touches, predicted touches, beliefs along episodes, members of an ensemble) consists of many calls
of a compiled function with arguments of the same shapes. On a GPU `map_on_devices` makes them in turn, as a loop would.
On a CPU it makes a few at a time in threads, because a call keeps two cores busy for only half of the time. On n
devices it makes n at a time: their arguments are stacked on a mesh with a single axis, and each device runs the program
of a single device on arrays of the same shapes. Results therefore do not depend on the number of devices or threads,
and devices exchange nothing.
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

CALL_AXIS = "calls"  # name of the axis of the device mesh, along which the calls of a function are distributed
Call: TypeAlias = tuple[Any, ...]


def map_batches(function: Callable[[Any], Any], items: Any, batch_size: int) -> Any:
    """Map a function over items in batches of one size, so that it is compiled once.

    `jax.lax.map(..., batch_size=...)` compiles the function again for a smaller last batch. Here the last item is
    repeated until that batch is full.

    Args:
        function: Function of a single item.
        items: Arrays whose axis 0 has n items.
        batch_size: Largest number of items in a batch.

    Returns:
        Results of the function, with n on axis 0.
    """
    n = jax.tree.leaves(items)[0].shape[0]
    if n <= batch_size:
        return jax.vmap(function)(items)
    rows = np.minimum(np.arange(n + -n % batch_size), n - 1).reshape(-1, batch_size)
    results = jax.lax.map(jax.vmap(function), jax.tree.map(lambda x: x[rows], items))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n], results)


def select_rows(tree: PyTree, rows: Any) -> PyTree:
    """Select rows of every array of a tree on the host, which needs no compilation.

    Args:
        tree: A tree of arrays with a common axis 0.
        rows: Indices, a mask, or a slice.

    Returns:
        The tree with these rows. NumPy arrays stay NumPy's, and JAX arrays JAX's.
    """

    def select(leaf: Any) -> Any:
        selected = np.asarray(leaf)[rows]
        return jax.device_put(selected) if isinstance(leaf, jax.Array) else selected

    return jax.tree.map(select, tree)


def filled_batches(rows: Int[np.ndarray, " n"], size: int) -> list[Int[np.ndarray, " size"]]:
    """Divide rows into batches of one size, so that one compilation serves all.

    Args:
        rows: Indices of the rows.
        size: Number of rows in a batch.

    Returns:
        The batches. The last one is filled up by repeating its own rows.
    """
    return [np.resize(rows[start : start + size], size) for start in range(0, len(rows), size)]


def map_on_devices(
    function: Callable[..., PyTree], calls: Iterable[Call], *, shared: Call = (), **static: Any
) -> Iterator[PyTree]:
    """Call `function(*call, *shared, **static)` for each call, as many at a time as there are devices, or a few on a
    CPU.

    Args:
        function: A compiled function (`jax.jit`). It must exist as long as the calls do, such as a function of a
            module, because the program for several devices is cached by it.
        calls: Positional arguments of each call, all of the same shapes. They are requested when they are needed.
        shared: Positional arguments that follow and are the same for all calls: arrays, numbers, and configurations
            with traced numbers (`i2t.runtime.compiling.traced_floats`).
        static: Keyword arguments that are not arrays, the same for all calls.

    Yields:
        Results in the order of the calls, on the host.
    """
    remaining, devices = iter(calls), jax.device_count()
    group = list(islice(remaining, devices))
    if len(group) < 2:  # one device, or too few calls to distribute
        shared = _here(shared)
        yield from map_in_threads(lambda *call: function(*call, *shared, **static), chain(group, remaining))
        return
    program, shared = _program(function, tuple(static.items()), _mesh()), put_on_all_devices(shared)
    by_call = NamedSharding(_mesh(), P(CALL_AXIS))
    while group:
        filled = group + group[-1:] * (devices - len(group))  # the remaining devices repeat the last call
        stacked = jax.device_put(jax.tree.map(lambda *leaves: jnp.stack(leaves), *filled), by_call)
        results = jax.device_get(program(stacked, shared))
        for i in range(len(group)):
            yield jax.tree.map(lambda leaf, i=i: leaf[i], results)
        group = list(islice(remaining, devices))


def map_in_threads(work: Callable[..., PyTree], calls: Iterable[Call], *, max_threads: int = 4) -> Iterator[PyTree]:
    """Call `work(*call)` for each call on a single device. On a CPU with several cores, calls run in threads, unless
    this thread has its own settings of JAX.

    Args:
        work: A function that calls compiled functions and may run in several threads.
        calls: Positional arguments, of any shapes. They are requested when they are needed.
        max_threads: Largest number of threads on a CPU, each of which holds its own arrays.

    Yields:
        Results in the order of the calls, on the host.
    """

    def make(call: Call) -> PyTree:
        return jax.device_get(work(*call))

    remaining = iter(calls)
    yield from map(make, islice(remaining, 1))  # compiles the program once for all threads
    workers = min(usable_cores(), max_threads) if jax.default_backend() == "cpu" else 1
    with ThreadPoolExecutor(workers) as pool:
        if workers == 1 or pool.submit(lambda: dict(jax.config.values)).result() != dict(jax.config.values):
            yield from map(make, remaining)
        futures = deque(pool.submit(make, call) for call in islice(remaining, workers))
        while futures:
            yield futures.popleft().result()
            futures.extend(pool.submit(make, call) for call in islice(remaining, 1))


def usable_cores() -> int:
    """Count the cores that this process may use.

    Returns:
        The number of cores.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_rows_on_devices(
    function: Callable[..., PyTree], rows: Call, *, shared: Call = (), multiple: int = 1, **static: Any
) -> PyTree:
    """Call `function(*rows, *shared, **static)` with the rows divided into equal parts, one for each device.

    Args:
        function: A compiled function, as for `map_on_devices`. Every array of its result has the rows as axis 0, and
            rows do not depend on each other.
        rows: Positional arguments whose arrays all have the rows as axis 0.
        shared: Positional arguments that follow.
        multiple: Number of rows of which the size of each part is a multiple. A function that processes this number of
            rows at a time then always processes the same rows together.
        static: Keyword arguments that are not arrays.

    Returns:
        The result for all rows.
    """
    length = len(jax.tree.leaves(rows)[0])
    groups = -(-length // multiple)
    parts = min(jax.device_count(), groups)
    if parts < 2:
        return function(*rows, *_here(shared), **static)
    size = multiple * -(-groups // parts)
    index = np.resize(np.arange(length), (parts, size))  # filled up with the first rows
    calls = [jax.tree.map(lambda leaf, part=part: leaf[part], rows) for part in index]
    results = list(map_on_devices(function, calls, shared=shared, **static))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:length], *results)


def size_classes(n: int, sizes: tuple[int, ...] = (64, 8, 1)) -> Iterator[np.ndarray]:
    """Divide n touches into batches of few sizes, so that a new number of touches needs no compilation.

    Args:
        n: Number of touches, at least 1.
        sizes: Sizes of the batches, in descending order to 1.

    Yields:
        Indices of the touches in a batch. The last batch may repeat the last touch.
    """
    start = 0
    while start < n:
        remaining = n - start
        size = next(size for size in sizes if size <= remaining)
        if size == 1 and remaining > 1:
            size = sizes[-2]
        yield np.minimum(np.arange(start, start + size), n - 1)
        start += size


def put_on_all_devices(values: PyTree) -> PyTree:
    """Copy arrays to all devices, for arguments that several calls of `map_on_devices` share.

    Args:
        values: Arrays on the host or on any device; those on all devices stay.

    Returns:
        The same arrays on all devices.
    """
    return jax.device_put(values, NamedSharding(_mesh(), P()) if jax.device_count() > 1 else None)


def _here(values: PyTree) -> PyTree:
    """Put arrays and numbers on a single device once for all calls, so that computations do not run on all devices."""
    return jax.device_put(values, jax.devices()[0] if jax.device_count() > 1 else None)


def _mesh() -> Mesh:
    return jax.make_mesh((jax.device_count(),), (CALL_AXIS,), axis_types=(AxisType.Auto,), devices=jax.devices())


@lru_cache(maxsize=32)
def _program(function: Callable[..., PyTree], static: tuple[tuple[str, Any], ...], mesh: Mesh) -> Callable[..., PyTree]:
    """Make the program of each device, a call on its own row of the stacked arguments."""

    def local(own: PyTree, shared: PyTree) -> PyTree:
        call = jax.tree.map(lambda leaf: leaf[0], own)
        return jax.tree.map(lambda leaf: leaf[None], function(*call, *shared, **dict(static)))

    # Loops may end sooner on some devices, which do not wait for each other, so types are not checked.
    over = jax.shard_map(local, mesh=mesh, in_specs=(P(CALL_AXIS), P()), out_specs=P(CALL_AXIS), check_vma=False)
    options = getattr(function, "compiler_options", lambda: None)  # set by `i2t.runtime.compiling`
    return jax.jit(over, compiler_options=options())
