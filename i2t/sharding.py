"""Calls laid over devices: every device of every process makes one of them, in one compiled program.

What is computed in bulk (simulated touches, predicted touches, beliefs along episodes, members of an ensemble) is many
calls of one compiled function with arguments of the same shapes. Where there is one device, `spread` makes them one
after the other, as a loop would. Where there are n, it makes n at a time: their arguments lie side by side on a mesh of
one axis, and each device runs what a single one would have run, on arrays of the same shapes. So results do not depend
on the number of devices, and devices exchange nothing but results.

Several processes, on one machine or on many, are one set of devices after `jax.distributed.initialize`: each runs the
same program with the same arguments and gets all results. What it writes to disk it has to write to a place of its own,
or in one process alone. docs/scaling.md says how to start them.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import chain, count, islice
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, PyTree, UInt

CALLS = "calls"  # the axis of the mesh
MAX_WAIT_S = 3600  # for processes that are slower than others
_BARRIERS = count()  # the same in all processes, as they make the same calls
Call: TypeAlias = tuple[Any, ...]


def spread(
    function: Callable[..., PyTree], calls: Iterable[Call], *, shared: Call = (), **static: Any
) -> Iterator[PyTree]:
    """`function(*call, *shared, **static)` for each call, as many at a time as there are devices.

    Args:
        function: Compiled (`jax.jit`), of module level or kept by whoever calls, because what is compiled for several
            devices is found again by it.
        calls: Positional arguments that are each call's own, all of the same shapes. They are asked for as they are
            needed.
        shared: Positional arguments that follow, the same for all calls.
        static: Named arguments that are not arrays, the same for all calls.

    Yields:
        Results in the order of the calls, on the host.
    """
    remaining, devices = iter(calls), jax.device_count()
    group = list(islice(remaining, devices))
    if len(group) < 2:  # one device, or nothing to share between several
        for call in chain(group, remaining):
            yield jax.device_get(function(*call, *_here(shared), **static))
        return
    program, shared = _program(function, tuple(static.items()), _mesh()), everywhere(shared)
    while group:
        filled = group + group[-1:] * (devices - len(group))  # the last devices repeat the last call
        made = _to_host(program(_side_by_side(filled), shared))
        for i in range(len(group)):
            yield jax.tree.map(lambda leaf, i=i: leaf[i], made)
        group = list(islice(remaining, devices))


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
    return jax.tree.map(lambda *leaves: _joined(leaves)[:length], *made)


def everywhere(values: PyTree) -> PyTree:
    """Arrays on all devices, for arguments that several calls of `spread` share.

    Args:
        values: Arrays on the host or on any device; those that are everywhere already stay.

    Returns:
        The same arrays on all devices.
    """
    if jax.device_count() == 1:
        return jax.device_put(values)
    sharding = NamedSharding(_mesh(), P())

    def put(leaf: Any) -> Array:
        if isinstance(leaf, Array) and leaf.sharding == sharding:
            return leaf
        host = np.asarray(leaf)
        copies = [jax.device_put(host, device) for device in sharding.addressable_devices]
        return jax.make_array_from_single_device_arrays(host.shape, sharding, copies)

    return jax.tree.map(put, _to_bits(values))


def _here(values: PyTree) -> PyTree:
    """Arrays of all devices on one device only, so that single computations do not run on all."""

    def one(leaf: Any) -> Any:
        several = isinstance(leaf, Array) and len(leaf.sharding.device_set) > 1
        return leaf.addressable_data(0) if several else leaf

    return _from_bits(jax.tree.map(one, values))


class _KeyBits(NamedTuple):
    """Random keys as numbers, because arrays that lie on several devices are made of numbers."""

    threefry: UInt[Array | np.ndarray, "..."]


def _to_bits(values: PyTree) -> PyTree:
    def bits(leaf: Any) -> Any:
        return _KeyBits(jax.random.key_data(leaf)) if _is_key(leaf) else leaf

    return jax.tree.map(bits, values)


def _from_bits(values: PyTree) -> PyTree:
    def key(leaf: Any) -> Any:
        return jax.random.wrap_key_data(jnp.asarray(leaf.threefry)) if isinstance(leaf, _KeyBits) else leaf

    return jax.tree.map(key, values, is_leaf=lambda leaf: isinstance(leaf, _KeyBits))


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _mesh() -> Mesh:
    """All devices of all processes."""
    return jax.make_mesh((jax.device_count(),), (CALLS,), axis_types=(AxisType.Auto,), devices=jax.devices())


@lru_cache(maxsize=32)
def _program(function: Callable[..., PyTree], static: tuple[tuple[str, Any], ...], mesh: Mesh) -> Callable[..., PyTree]:
    """Program of each device: a call on its own arguments, which are one row of those side by side."""

    def local(own: PyTree, shared: PyTree) -> PyTree:
        call = _from_bits(jax.tree.map(lambda leaf: leaf[0], own))
        made = function(*call, *_from_bits(shared), **dict(static))
        return jax.tree.map(lambda leaf: leaf[None], _to_bits(made))

    # Loops that end sooner on one device than on another are no error: devices do not wait for each other.
    over = jax.shard_map(local, mesh=mesh, in_specs=(P(CALLS), P()), out_specs=P(CALLS), check_vma=False)
    return jax.jit(over)


def _side_by_side(calls: Sequence[Call]) -> PyTree:
    """Arguments of as many calls as there are devices, each on its device."""
    sharding = NamedSharding(_mesh(), P(CALLS))
    own = {device: i for i, device in enumerate(sharding.mesh.devices.flat) if device in sharding.addressable_devices}

    def lay(*leaves: Any) -> Array:
        rows = [jax.device_put(np.asarray(leaves[i])[None], device) for device, i in own.items()]
        return jax.make_array_from_single_device_arrays((len(calls), *rows[0].shape[1:]), sharding, rows)

    return jax.tree.map(lay, *[_to_bits(call) for call in calls])


def _to_host(made: PyTree) -> PyTree:
    """Results of all devices, also of those of other processes."""
    if jax.process_count() == 1:
        return _from_bits(jax.device_get(made))
    jax.block_until_ready(made)
    _wait_for_processes()
    return _from_bits(multihost_utils.process_allgather(made, tiled=True))


def _wait_for_processes() -> None:
    """Wait until all processes are here. JAX's collectives on CPUs give up after half a minute, which is less than one
    process may take longer than another to compile.
    """
    from orbax.checkpoint import multihost  # here, as one process needs none

    barrier = multihost.get_barrier_sync_fn()
    barrier(key=f"i2t.sharding {next(_BARRIERS)}", timeout_ms=1000 * MAX_WAIT_S)


def _joined(leaves: Sequence[Any]) -> Any:
    return jnp.concatenate(leaves) if _is_key(leaves[0]) else np.concatenate(leaves)
