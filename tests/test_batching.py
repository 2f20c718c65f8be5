"""Batches: what is compiled once gives what a loop gives, for every number of items."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.batching import map_batches


@pytest.mark.parametrize("n", [1, 4, 11])
def test_any_number_of_items_gives_what_a_loop_gives(n):
    x = jnp.arange(2.0 * n).reshape(n, 2)
    keys = jax.random.split(jax.random.key(0), n)

    def one(item):
        key, row = item
        return {"sum": row.sum() + jax.random.normal(key), "row": row}

    found = map_batches(one, (keys, x), batch_size=4)
    np.testing.assert_allclose(found["sum"], [one(item)["sum"] for item in zip(keys, x, strict=True)], rtol=1e-6)
    np.testing.assert_array_equal(found["row"], x)


def test_a_rest_is_not_traced_again():
    traced = []
    map_batches(lambda x: traced.append(x.shape) or x, jnp.zeros(11), batch_size=4)
    assert traced == [()]
