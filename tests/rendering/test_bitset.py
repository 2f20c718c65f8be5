"""Bit lists against Python's own integers."""

import jax.numpy as jnp
import numpy as np
import pytest

from i2t.rendering import bitset

RNG = np.random.default_rng(0)
WORDS = RNG.integers(0, 2**32, (3, 5), dtype=np.uint32)
WORDS[0, 1] = 0
WORDS[2] = [0, 0, 2**31, 0, 1]


def set_bits(row: np.ndarray) -> list[tuple[int, int]]:
    return [(w, b) for w, word in enumerate(row) for b in range(bitset.WORD_BITS) if int(word) >> b & 1]


def test_counts_and_lowest_bits():
    assert np.asarray(bitset.popcount(jnp.asarray(WORDS[1]))).tolist() == [int(word).bit_count() for word in WORDS[1]]
    lowest = [-1 if not word else (int(word) & -int(word)).bit_length() - 1 for word in WORDS.ravel()]
    assert np.asarray(bitset.lowest_set_bit(jnp.asarray(WORDS.ravel()))).tolist() == lowest


def test_flags_become_bits():
    flags = RNG.integers(0, 2, (32, 7)).astype(bool)
    expected = [sum(int(flag) << i for i, flag in enumerate(column)) for column in flags.T]
    assert np.asarray(bitset.pack_bits(list(jnp.asarray(flags)))).tolist() == expected
    assert np.asarray(bitset.bitwise_or_reduce([jnp.uint32(9), jnp.uint32(3)])) == 11


@pytest.mark.full
@pytest.mark.parametrize("words", [1, 2, 3, 4, 5])
def test_every_set_bit_is_found_by_its_number(words):
    lists = jnp.asarray(WORDS[:, :words])
    sums = bitset.cumulative_popcounts(lists)
    assert np.asarray(sums).tolist() == [[len(set_bits(row[: w + 1])) for w in range(words)] for row in WORDS]
    for row in range(3):
        expected = set_bits(WORDS[row, :words])
        order = jnp.arange(len(expected), dtype=jnp.int32)
        place, bit = bitset.select_kth_set_bit(lists, sums, jnp.full_like(order, row), order)
        assert list(zip(np.asarray(place).tolist(), np.asarray(bit).tolist(), strict=True)) == expected
