"""Sets as machine words of 32 bits, which serve a renderer as lists that need neither sorting nor growing."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, UInt

WORD_BITS = 32  # number of bits in a word of a bit set


def as_uint32(value: int) -> np.uint32:
    """Convert a number to a 32-bit word.

    Args:
        value: Number from 0 to 2^32 - 1.

    Returns:
        The number as an unsigned integer of 32 bits.
    """
    return np.uint32(value)


def popcount(words: UInt[Array, "*n"]) -> Int[Array, "*n"]:
    """Count the set bits of 32-bit words.

    Args:
        words: Words of any shape.

    Returns:
        The number of set bits of each word.
    """
    return jax.lax.population_count(words).astype(jnp.int32)


def lowest_set_bit(words: UInt[Array, "*n"]) -> Int[Array, "*n"]:
    """Find the lowest set bit of each 32-bit word.

    Args:
        words: Words of any shape.

    Returns:
        The index of the lowest set bit of each word; -1 if no bit is set.
    """
    return 31 - jax.lax.clz(words & (~words + as_uint32(1))).astype(jnp.int32)


def bitwise_or_reduce(words: list[Array]) -> Array:
    """Compute the union of bit sets.

    Args:
        words: Arrays of words, all of one shape.

    Returns:
        The union of the arrays, word by word.
    """
    total = words[0]
    for other in words[1:]:
        total = total | other
    return total


def pack_bits(flags: Array, axis: int = -1) -> Array:
    """Pack flags into 32-bit words.

    Args:
        flags: Booleans with the 32 bits of a word along one axis.
        axis: The axis of the bits.

    Returns:
        Words, without that axis, whose bit i is flag i.
    """
    # XLA computes a product with powers of two in a tenth of the instructions of shifts. float32 holds half a word
    # exactly.
    half = WORD_BITS // 2
    bit = np.arange(WORD_BITS)
    weights = np.zeros((2, WORD_BITS), np.float32)
    weights[bit // half, bit] = 2.0 ** (bit % half)
    halves = jnp.tensordot(flags.astype(jnp.float32), weights, (axis, 1), precision="highest").astype(jnp.uint32)
    return halves[..., 0] | halves[..., 1] << as_uint32(half)


def cumulative_popcounts(words: UInt[Array, "p n"]) -> Int[Array, "p n"]:
    """Count the set bits up to and including each word of a row.

    Args:
        words: `(p, n)` rows of words.

    Returns:
        `(p, n)` running sums along the rows.
    """
    counts = popcount(words).astype(jnp.float32)  # exact below 2^24; a product with a triangle of ones is fastest
    return (counts @ jnp.triu(jnp.ones((words.shape[1],) * 2, jnp.float32))).astype(jnp.int32)


def select_kth_set_bit(
    words: UInt[Array, "p n"], sums: Int[Array, "p n"], row: Int[Array, "*#m"], order: Int[Array, "*#m"]
) -> tuple[Int[Array, "*m"], Int[Array, "*m"]]:
    """Find the k-th set bit of a row of words.

    Args:
        words: `(p, n)` rows of words.
        sums: `(p, n)` running sums of the set bits from `cumulative_popcounts`.
        row: Index of the row to search.
        order: k, counted from 0. Beyond the last set bit, the result is in the last word.

    Returns:
        Index of the word in its row, and index of the bit in that word.
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
