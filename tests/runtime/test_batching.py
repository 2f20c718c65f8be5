"""Batches equal a loop; calls distributed over devices equal those on a single device, to the last bit."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.runtime.batching import map_batches, map_on_devices, map_rows_on_devices, put_on_all_devices

ROOT = Path(__file__).parents[2]


def started(words, devices=1):
    """A separate process, which compiles more than it computes."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    environment["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    environment["XLA_FLAGS"] = flags.strip()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.Popen([sys.executable, *words], env=environment, text=True, **pipes)


def output_of(process):
    output = process.communicate(timeout=540)[0]
    assert process.returncode == 0, output
    return output


def test_a_single_device_makes_calls_in_turn_when_they_are_requested():
    requested = []
    calls = (requested.append(i) or (jnp.float32(i),) for i in range(3))
    results = map_on_devices(jax.jit(jnp.multiply), calls, shared=(2.0,))
    assert float(next(results)) == 0.0
    assert requested == [0]
    assert [float(result) for result in results] == [2.0, 4.0]
    assert list(map_on_devices(jnp.multiply, [])) == []
    x = jnp.arange(3.0)
    assert map_rows_on_devices(lambda x: x, (x,)) is x
    np.testing.assert_array_equal(put_on_all_devices(x), x)


FOUR = """
import jax
import jax.numpy as jnp
import numpy as np
from functools import partial
from i2t.runtime.batching import put_on_all_devices, map_on_devices, map_rows_on_devices

@partial(jax.jit, static_argnames="power")
def draw(key, x, shared, power):
    return jax.random.fold_in(key, 1), x**power + shared["bias"] + jax.random.normal(key), jax.lax.axis_index("calls")

keys, x = jax.random.split(jax.random.key(0), 6), np.arange(12.0, dtype=np.float32).reshape(6, 2)
shared = {"bias": jnp.ones(2), "nothing": None}
made = list(map_on_devices(draw, zip(keys, x), shared=(put_on_all_devices(shared),), power=2))
assert [int(device) for *_, device in made] == [0, 1, 2, 3, 0, 1], "a call on each device"
for key, row, (after, value, _) in zip(keys, x, made, strict=True):
    assert (after == jax.random.fold_in(key, 1)).all()
    np.testing.assert_array_equal(value, row**2 + 1 + jax.random.normal(key))

@jax.jit
def by_row(keys, x, bias):
    value = jax.vmap(jax.random.normal)(keys) + x.sum(1) + bias
    return {"value": value, "keys": keys, "many": jnp.full(len(x), len(x))}

for multiple, rows in ((1, 2), (3, 3)):  # six rows cut into parts of these
    found = map_rows_on_devices(by_row, (keys, x), shared=(jnp.float32(1),), multiple=multiple)
    assert found["many"].tolist() == [rows] * 6, found["many"]
    np.testing.assert_allclose(found["value"], by_row(keys, x, 1.0)["value"], rtol=1e-6)
    assert (found["keys"] == keys).all()
bias = put_on_all_devices((jnp.ones(2),))
(alone,) = map_on_devices(lambda x, bias: (x + bias).sharding.device_set, [(jnp.zeros(2),)], shared=bias)
assert len(alone) == 1, "one call alone is made on one device"
print(jax.device_count(), "devices")
"""


def test_over_four_devices_every_call_finds_its_own_arguments():
    assert output_of(started(["-c", FOUR], devices=4)) == "4 devices\n"


@pytest.mark.full
def test_touches_beliefs_and_networks_are_the_same_on_four_devices(tmp_path):
    work = str(ROOT / "tests" / "helpers" / "bulk_work.py")
    assert output_of(started([work, str(tmp_path / "one.npz")])) == "1 devices\n"
    assert output_of(started([work, str(tmp_path / "four.npz")], devices=4)) == "4 devices\n"
    single, four = (dict(np.load(tmp_path / f"{name}.npz")) for name in ("one", "four"))
    assert len(single) > 60
    assert set(four) == set(single)
    for field, value in single.items():
        np.testing.assert_array_equal(four[field], value, err_msg=field)


def test_calls_in_threads_keep_their_order_precision_and_exceptions():
    requested = []

    def calls():
        for i in range(9):
            requested.append(i)
            yield (np.float32(i),)

    def work(i, shared):
        if i == 7:
            raise ValueError("the seventh")
        precision = jax.config.values["jax_default_matmul_precision"]
        return i + shared, precision == "highest"

    with jax.default_matmul_precision("highest"):
        results = map_on_devices(work, calls(), shared=(10.0,))
        assert next(results) == (10.0, True)
        assert requested == [0]  # requested when they are needed
        assert [next(results) for _ in range(6)] == [(10.0 + i, True) for i in range(1, 7)]
        with pytest.raises(ValueError, match="the seventh"):
            next(results)


@pytest.mark.parametrize("n", [1, 11])
def test_any_number_of_items_gives_what_a_loop_gives(n):
    items = jax.random.split(jax.random.key(0), n), jnp.arange(2.0 * n).reshape(n, 2)

    def one(item):
        key, row = item
        return row.sum() + jax.random.normal(key)

    expected = [one(item) for item in zip(*items, strict=True)]
    np.testing.assert_allclose(map_batches(one, items, batch_size=4), expected, rtol=1e-6)


def test_a_smaller_last_batch_is_not_traced_again():
    traced = []
    map_batches(lambda x: traced.append(x.shape) or x, jnp.zeros(11), batch_size=4)
    assert traced == [()]
