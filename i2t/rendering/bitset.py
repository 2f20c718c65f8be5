"""Sets as machine words of 32 bits: lists of a renderer without sorting or growing."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, UInt

WORD_BITS = 32
HALF_BITS = 16


def as_uint32(value: int) -> np.uint32:
    """A constant of the type of words.

    Args:
        value: From 0 to 2^32 - 1.

    Returns:
        The constant.
    """
    return np.uint32(value)


def popcount(words: UInt[Array, "*n"]) -> Int[Array, "*n"]:
    """Number of set bits.

    Args:
        words: Of bits.

    Returns:
        The number for each word.
    """
    return jax.lax.population_count(words).astype(jnp.int32)


def lowest_set_bit(words: UInt[Array, "*n"]) -> Int[Array, "*n"]:
    """Index of the lowest set bit.

    Args:
        words: Of bits.

    Returns:
        The index for each word; -1 if there is none.
    """
    return 31 - jax.lax.clz(words & (~words + as_uint32(1))).astype(jnp.int32)


def bitwise_or_reduce(words: list[Array]) -> Array:
    """All set bits of several words.

    Args:
        words: Arrays of words.

    Returns:
        Their union, word by word.
    """
    total = words[0]
    for other in words[1:]:
        total = total | other
    return total


def pack_bits(flags: Array, axis: int = -1) -> Array:
    """Pack flags into words.

    Args:
        flags: Booleans, a word's bits along one axis.
        axis: Which.

    Returns:
        Words, without that axis, whose bit i is flag i.
    """
    # A product with powers of two takes XLA a tenth of the instructions of shifts; float32 holds half a word exactly.
    bit = np.arange(WORD_BITS)
    weights = np.zeros((2, WORD_BITS), np.float32)
    weights[bit // HALF_BITS, bit] = 2.0 ** (bit % HALF_BITS)
    halves = jnp.tensordot(flags.astype(jnp.float32), weights, (axis, 1), precision="highest").astype(jnp.uint32)
    return halves[..., 0] | halves[..., 1] << as_uint32(HALF_BITS)


def cumulative_popcounts(words: UInt[Array, "p n"]) -> Int[Array, "p n"]:
    """Number of set bits up to and including each word of a row.

    Args:
        words: Of bits, in rows.

    Returns:
        The running sums.
    """
    counts = popcount(words).astype(jnp.float32)  # a product with a triangle of ones is quickest; exact below 2^24
    return (counts @ jnp.triu(jnp.ones((words.shape[1],) * 2, jnp.float32))).astype(jnp.int32)


def select_kth_set_bit(
    words: UInt[Array, "p n"], sums: Int[Array, "p n"], row: Int[Array, "*#m"], order: Int[Array, "*#m"]
) -> tuple[Int[Array, "*m"], Int[Array, "*m"]]:
    """The k-th set bit of a row of words.

    Args:
        words: Of bits, in rows.
        sums: Running sums of the set bits, of `cumulative_popcounts`.
        row: In which to look.
        order: k, from 0; beyond the last it gives the last word.

    Returns:
        Indices of the word in its row and of the bit in its word.
    """
    last = words.shape[1] - 1
    row, order = jnp.broadcast_arrays(row, order)
    place = jnp.zeros_like(order)
    step = 1 << last.bit_length() >> 1
    while step:
        probe = place + step
        past = (probe <= last) & (order >= sums.at[row, jnp.minimum(probe, last) - 1].get(mode="promise_in_bounds"))
        place = jnp.where(past, probe, place)
        step >>= 1
    before = jnp.where(place > 0, sums.at[row, jnp.maximum(place - 1, 0)].get(mode="promise_in_bounds"), 0)
    left, bits, bit = order - before, words.at[row, place].get(mode="promise_in_bounds"), jnp.zeros_like(order)
    for width in (16, 8, 4, 2, 1):
        below = popcount(bits & as_uint32((1 << width) - 1))
        upper = left >= below
        bit = jnp.where(upper, bit + width, bit)
        left, bits = jnp.where(upper, left - below, left), jnp.where(upper, bits >> as_uint32(width), bits)
    return place, bit
