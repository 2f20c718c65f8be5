"""Batches: what is compiled once gives what a loop gives, for every number of items."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.batching import map_batches


@pytest.mark.parametrize("n", [1, 11])
def test_any_number_of_items_gives_what_a_loop_gives(n):
    items = jax.random.split(jax.random.key(0), n), jnp.arange(2.0 * n).reshape(n, 2)

    def one(item):
        key, row = item
        return row.sum() + jax.random.normal(key)

    expected = [one(item) for item in zip(*items, strict=True)]
    np.testing.assert_allclose(map_batches(one, items, batch_size=4), expected, rtol=1e-6)


def test_a_rest_is_not_traced_again():
    traced = []
    map_batches(lambda x: traced.append(x.shape) or x, jnp.zeros(11), batch_size=4)
    assert traced == [()]
