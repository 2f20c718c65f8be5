"""Contacts of one pad solved side by side: the layout and the convolution of a batch.

Solvers of `i2t.skin` work on lanes: the contacts of a batch are the last axis of every array. A number per contact is
then a row vector, sums over cells are sums of rows, and the convolution with the layer's compliance is three matrix
products without a transpose. `by_lanes` gives such a solver a rule for `jax.vmap`: instead of being batched, it takes
more lanes.

Cells are split into four quadrants about the pad's centre, each counted outwards: shape (2, h, 2, h, lanes) for the
halves x > 0 and x < 0, the h cells of a half, and both again along y. Sums and differences of mirrored cells are the
even and odd parts along each axis. Cosines act only on the even part and sines only on the odd one, which halves the
products. With E the waves on the outer half, S the same with the weights of the series, G the kernel, b and a the
parities along x and y, and n and m the waves along y and x of these parities:

    result = E[b].T X2,   X2[b, m, a] = T[b, m, a] X1[b, m, a],   X1 = S[b] part,
    T[b, m, a] = sum over n of E[a, n].T G[(a, n), (b, m)] S[a, n].

T depends only on the pad and its grid.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float

from i2t.skin.elasticity import Grid, half_waves


def to_quadrants(values: Float[Array, "lanes n n"]) -> Float[Array, "2 h 2 h lanes"]:
    """Split a batch of arrays over the pad into quadrants about its centre, with the batch (the lanes) last.

    Args:
        values: `(lanes, n, n)` arrays, rows along y.

    Returns:
        `(2, h, 2, h, lanes)` quadrants, with h = n / 2: the halves x > 0 and x < 0, each with h cells counted outwards,
        then the same along y.
    """
    lanes, n, _ = values.shape
    halves = jnp.transpose(values, (2, 1, 0)).reshape(2, n // 2, 2, n // 2, lanes)
    along_x = jnp.stack([halves[1], halves[0, ::-1]])
    return jnp.stack([along_x[:, :, 1], along_x[:, :, 0, ::-1]], axis=2)


def from_quadrants(quadrants: Float[Array, "2 h 2 h lanes"]) -> Float[Array, "lanes n n"]:
    """Join the quadrants of arrays over the pad; the inverse of `to_quadrants`.

    Args:
        quadrants: `(2, h, 2, h, lanes)` quadrants from `to_quadrants`.

    Returns:
        `(lanes, n, n)` arrays, rows along y.
    """
    _, h, _, _, lanes = quadrants.shape
    along_y = jnp.stack([quadrants[:, :, 1, ::-1], quadrants[:, :, 0]], axis=2)
    both = jnp.stack([along_y[1, ::-1], along_y[0]])
    return jnp.transpose(both.reshape(2 * h, 2 * h, lanes), (2, 1, 0))


def fold(quadrants: Float[Array, "2 h 2 h lanes"]) -> Float[Array, "2 h 2 h lanes"]:
    """Compute sums and differences of mirrored cells along x and y, or the cells from their even and odd parts.

    Args:
        quadrants: Quadrants of cells, or parts by their parity.

    Returns:
        Parts by their parity (even first), or cells.
    """
    along_x = jnp.stack([quadrants[0] + quadrants[1], quadrants[0] - quadrants[1]])
    return jnp.stack([along_x[:, :, 0] + along_x[:, :, 1], along_x[:, :, 0] - along_x[:, :, 1]], axis=2)


def convolution(kernel: Float[Array, "k k"], grid: Grid) -> Float[Array, "2 m 2 h h"]:
    """Compute the matrices by which `convolve` applies a kernel to quadrants.

    Args:
        kernel: `(k, k)` factors of the kernel, one for each of k x k waves (k = `grid.modes`).
        grid: Grid of cells and waves.

    Returns:
        `(2, m, 2, h, h)` matrices: one (h, h) matrix, for the h cells of half an edge, for each parity and each of the
        m = k / 2 waves along x, and each parity along y.
    """
    waves, weighted = (jnp.asarray(part, kernel.dtype) for part in half_waves(grid))
    half = grid.modes // 2
    pairs = waves[:, :, :, None] * weighted[:, :, None, :]
    kernel = kernel.reshape(2, half, 2, half)
    return jnp.einsum("anjk,anbm->bmajk", pairs, kernel, precision="highest")


def convolve(
    matrices: Float[Array, "2 m 2 h h"], quadrants: Float[Array, "2 h 2 h lanes"], grid: Grid
) -> Float[Array, "2 h 2 h lanes"]:
    """Convolve the pressures of many contacts (lanes) with a kernel, as `i2t.skin.elasticity.convolve` does for one.

    Args:
        matrices: Matrices of the kernel from `convolution`.
        quadrants: `(2, h, 2, h, lanes)` cells of each lane, from `to_quadrants`.
        grid: Grid of cells and waves.

    Returns:
        `(2, h, 2, h, lanes)` convolved cells.
    """
    waves, weighted = (jnp.asarray(part, quadrants.dtype) for part in half_waves(grid))
    along_x = _product(weighted, fold(quadrants), (2,), (1,), (0,))
    along_y = _product(matrices, along_x, (4,), (3,), (0, 1, 2))
    return fold(_product(waves, along_y, (1,), (1,), (0,)))


def vector_convolution(kernels: Float[Array, "2 k k"], grid: Grid) -> Float[Array, "2 m1 2 n n"]:
    """Compute the matrices by which `convolve_vectors` applies a kernel to vectors along the skin.

    A wave of number m along x with parity b, and with parity a along y, has vectors whose x component has these
    parities and whose y component has the opposite ones, because the derivatives that couple them change both.

    Args:
        kernels: `(2, k, k)` factors for each of k x k waves: on the vectors' component along the wave, and across it.
        grid: Grid of cells and waves.

    Returns:
        `(2, k / 2 + 1, 2, 2 h, 2 h)` matrices: one (2 h, 2 h) matrix, for both components on the h cells of half an
        edge, for each parity and wave number along x, and each parity along y.
    """
    along, across = (_by_number(kernel, grid) for kernel in kernels)
    waves, weighted = (jnp.asarray(part, kernels.dtype) for part in _numbered_half_waves(grid))
    k = np.append(grid.wavenumbers[: grid.modes // 2], grid.wavenumbers[-1])
    ky, kx = k[:, None], k[None, :]
    steep = (along - across) / np.where(kx**2 + ky**2 == 0, np.inf, kx**2 + ky**2)
    # The shortest wave's slope vanishes at the cell centres.
    slope = np.where(k == k[-1], 0, k)
    mixed = -steep * (slope[:, None] * slope[None, :])

    def matrices(left: Array, middle: Array, right: Array) -> Array:
        """Compute (a, m, i, j) from left and right waves (a, n, cells) along y and a factor (n, m) between them."""
        pairs = left[:, :, :, None] * right[:, :, None, :]
        return jnp.einsum("anij,nm->amij", pairs, middle, precision="highest")

    other, other_weighted = waves[::-1], weighted[::-1]  # of the opposite parity
    sign = jnp.asarray([1, -1], kernels.dtype)[:, None, None, None]
    rows = []
    for parity_sign in (1, -1):
        upper = [matrices(waves, across + steep * kx**2, weighted),
                 parity_sign * sign * matrices(waves, mixed, other_weighted)]  # fmt: skip
        lower = [parity_sign * sign * matrices(other, mixed, weighted),
                 matrices(other, across + steep * ky**2, other_weighted)]  # fmt: skip
        rows.append(jnp.block([[upper[0], upper[1]], [lower[0], lower[1]]]))
    return jnp.swapaxes(jnp.stack(rows), 1, 2)


def convolve_vectors(
    matrices: Float[Array, "2 m1 2 n n"], quadrants: Float[Array, "2 2 h 2 h lanes"], grid: Grid
) -> Float[Array, "2 2 h 2 h lanes"]:
    """Convolve the vectors of many contacts (lanes) with a kernel.

    Args:
        matrices: Matrices of the kernel from `vector_convolution`.
        quadrants: `(2, 2, h, 2, h, lanes)` vectors of each lane: components along x and y, each from `to_quadrants`.
        grid: Grid of cells and waves.

    Returns:
        `(2, 2, h, 2, h, lanes)` convolved vectors.
    """
    waves, weighted = (jnp.asarray(part, quadrants.dtype) for part in _numbered_half_waves(grid))
    along_x = [
        _product(weighted, fold(quadrants[0]), (2,), (1,), (0,)),
        _product(weighted[::-1], fold(quadrants[1])[::-1, :, ::-1], (2,), (1,), (0,)),
    ]
    along_y = _product(matrices, jnp.concatenate(along_x, axis=3), (4,), (3,), (0, 1, 2))
    half = grid.cells // 2
    x = _product(waves, along_y[:, :, :, :half], (1,), (1,), (0,))
    y = _product(waves[::-1], along_y[:, :, :, half:], (1,), (1,), (0,))
    return jnp.stack([fold(x), fold(y[::-1, :, ::-1])])


def _numbered_half_waves(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Order `half_waves` by wave numbers 0 ... modes / 2 of both parities, with zeros for missing cosines and sines."""
    waves, weighted = (np.pad(part, ((0, 0), (0, 1), (0, 0))) for part in half_waves(grid))
    return tuple(np.stack([part[0], np.roll(part[1], 1, axis=0)]) for part in (waves, weighted))  # type: ignore[return-value]


def _by_number(kernel: Float[Array, "k k"], grid: Grid) -> Float[Array, "m1 m1"]:
    """Order a kernel that depends only on wave numbers by the numbers 0 ... modes / 2 along y and x."""
    rows = np.append(np.arange(grid.modes // 2), grid.modes - 1)
    return kernel[rows[:, None], rows[None, :]]


def cell_axes(values: Float[Array, "*cells lanes"]) -> tuple[int, ...]:
    """List all axes of an array except the last one, that of the lanes.

    Args:
        values: Array with any axes of cells, lanes last.

    Returns:
        Numbers of the axes of cells.
    """
    return tuple(range(values.ndim - 1))


def lane_sum(values: Float[Array, "*cells lanes"]) -> Float[Array, "*ones lanes"]:
    """Sum the values of each lane over its cells.

    Args:
        values: Array with any axes of cells, lanes last.

    Returns:
        Sums in the unit of `values`, with axes of length 1 for the cells.
    """
    return jnp.sum(values, cell_axes(values), keepdims=True)


def lane_max(values: Float[Array, "*cells lanes"]) -> Float[Array, "*ones lanes"]:
    """Find the largest absolute value among the cells of each lane.

    Args:
        values: Array with any axes of cells, lanes last.

    Returns:
        The values, with axes of length 1 for the cells.
    """
    return jnp.max(jnp.abs(values), cell_axes(values), keepdims=True)


def _product(
    left: Array | np.ndarray, right: Array, left_sum: tuple[int], right_sum: tuple[int], shared: tuple[int, ...]
) -> Array:
    """Multiply a batch of matrices in full float32; shared axes come first, then those left of `left` and `right`."""
    axes = (left_sum, right_sum), (shared, shared)
    return jax.lax.dot_general(jnp.asarray(left), right, axes, precision="highest")


def by_lanes(solver: Callable[..., Any]) -> Callable[..., Any]:
    """Give a solver on lanes a batching rule: `jax.vmap` adds lanes.

    Args:
        solver: Function of a tree of arrays that all lanes share, and of arrays and trees whose leading axis counts
            lanes; it returns a tree of such arrays and is not differentiated.

    Returns:
        The solver with the rule. If the shared tree differs from item to item of a batch, it is batched as usual.
    """
    batched = custom_vmap(solver)

    @batched.def_vmap
    def add_lanes(size: int, in_batched: list[Any], shared: Any, *rows: Any) -> tuple[Any, Any]:
        if any(jax.tree.leaves(in_batched[0])):
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, in_batched)
            result = jax.vmap(solver, tuple(axes), axis_size=size)(shared, *rows)
        else:
            spread = jax.tree.map(
                lambda row, is_batched: row if is_batched else jnp.broadcast_to(row, (size, *row.shape)),
                list(rows), in_batched[1:],
            )  # fmt: skip
            merged = jax.tree.map(lambda row: row.reshape(size * row.shape[1], *row.shape[2:]), spread)
            result = batched(shared, *merged)
            result = jax.tree.map(lambda row: row.reshape(size, -1, *row.shape[1:]), result)
        return result, jax.tree.map(lambda _: True, result)

    return batched
