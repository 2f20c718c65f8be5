"""Magnetic field at the chips below a deformed magnetised layer.

The layer is a sum of magnetic dipoles: one under the centre of every cell of the contact grid at each node of a
Gauss-Legendre rule across the thickness. A touch moves the dipole at P to P + u and turns its moment m by the local
rotation w = curl(u) / 2, both from `i2t.skin.elasticity.interior`; the reading is the change of the field at the chips

    B(r) = mu0 / (4 pi) sum_i [3 (m_i . d_i) d_i / |d_i|^5 - m_i / |d_i|^3],   d_i = r - P_i - u_i

(Jackson, Classical Electrodynamics, 5.56). The material is hard: no moment depends on the field. For a given
displacement the reading is linear in the moments.

Two choices make few dipoles enough. Moments are not the magnetization M of their cell alone: the field's integrand is
smooth but for M, which jumps between cells, so a cell's mean of the smooth part is taken from its centre and its
neighbours' (f + second difference / 24, the Euler-Maclaurin correction of the midpoint rule), which amounts to
sharpening M before it is multiplied by the cell's volume. And the turn is Cayley's, about w by 2 atan(|w| / 2):
exactly a rotation, |w| to third order, between |w| and the polar rotation atan(|w|) of the shear that causes it, and
needs no trigonometry.

Tool frame; metres, A/m, A m2, tesla; readings in microtesla in the board's order and the chips' own axes.
"""

from collections.abc import Iterator, Sequence
from functools import partial, reduce
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.skin.elasticity import GRID, Grid, interior, load
from i2t.types import Pad

CELL_NODES = 5  # across the thickness; `tests/skin/test_dipoles.py` refines them and the cells
MU0_OVER_4PI = 1e-7  # T m/A
MICROTESLA = 1e6
Dipoles: TypeAlias = Grid | tuple[Grid, ...]  # of all sheets, or of each from the surface down; all of one period


def dipole_field(
    points: Float[Array, "m 3"], positions: Float[Array, "n 3"], moments: Float[Array, "n 3"]
) -> Float[Array, "m 3"]:
    """Flux density of dipoles.

    Args:
        points: m.
        positions: m, of the dipoles.
        moments: A m2.

    Returns:
        T; not finite on a dipole.
    """
    return jax.vmap(_field, (0, None, None))(points, positions.T, moments.T)


@partial(jax.jit, static_argnames=("grid", "dipoles", "nodes", "first_sheet"))
def response(
    pad: Pad,
    pressure: Float[Array, "n n"],
    grid: Grid = GRID,
    *,
    dipoles: Dipoles | None = None,
    nodes: int = CELL_NODES,
    traction: Float[Array, "2 n n"] | None = None,
    first_sheet: int = 0,
) -> Float[Array, " c"]:
    """The noise-free reading under a load: gains times the change of field, in the chips' axes.

    Args:
        pad: the skin on its board.
        pressure: Pa, on the cells of `grid`.
        grid: of the loads.
        dipoles: a coarser grid of the same period, with fewer dipoles than one under each cell of `grid`, or one grid
            for each sheet from the surface down.
        nodes: sheets of dipoles across the thickness.
        traction: Pa, along x and y.
        first_sheet: sheets above this one, counted from the surface, are left out.

    Returns:
        The reading in uT.
    """
    dipoles = grid if dipoles is None else dipoles
    part = {"dipoles": dipoles, "nodes": nodes, "first_sheet": first_sheet}
    change = pressed_field(pad, pressure, grid, traction=traction, **part) - rest_field(pad, **part)
    return pad.gains * pad.board.to_board(change)


@partial(jax.jit, static_argnames=("grid", "dipoles", "first_sheet"))
def linear_response(
    pad: Pad, grid: Grid = GRID, *, dipoles: Dipoles | None = None, first_sheet: int = 0
) -> Float[Array, "c n n"]:
    """The derivative of `response` by the pressure at rest: what it is as long as the skin moves little.

    Args:
        pad: the skin on its board.
        grid: of the pressure.
        dipoles: as for `response`.
        first_sheet: as for `response`.

    Returns:
        uT/Pa, for each value of a reading and each cell.
    """
    rest = jnp.zeros((grid.cells, grid.cells), pad.thickness.dtype)

    def response_of(dipoles: Grid, magnets: tuple[Array, Array]) -> Array:
        def sheet(magnets: tuple[Array, Array]) -> Array:
            depth, moments = magnets

            def field(motion: Array) -> Array:
                return _fields(pad, _places(depth, dipoles) + motion[:3], turn(motion[3:], moments))

            def move(pressure: Array) -> Array:
                return jnp.concatenate(interior(pad, load(pad, pressure, None, grid, dipoles), depth, dipoles))

            still = jnp.zeros((6, dipoles.cells, dipoles.cells), rest.dtype)
            along = jnp.broadcast_to(jnp.eye(6)[:, :, None, None], (6, *still.shape))
            # Of each chip and component, by the motion and turn of each dipole; then by what moves the dipoles.
            slopes = jnp.moveaxis(jax.vmap(lambda way: jax.jvp(field, (still,), (way,))[1])(along), 0, 2)
            return jax.vmap(jax.vmap(lambda slope: jax.linear_transpose(move, rest)(slope)[0]))(slopes)

        return jnp.sum(jax.lax.map(sheet, magnets), axis=0)

    dipoles = grid if dipoles is None else dipoles
    change = _total([response_of(*group) for group in _groups(pad, dipoles, CELL_NODES, first_sheet)])
    to_board = jax.vmap(pad.board.to_board, -1, -1)(change.reshape(*change.shape[:2], -1))
    return (pad.gains[:, None] * to_board).reshape(-1, *rest.shape)


@partial(jax.jit, static_argnames=("grid", "dipoles", "nodes", "first_sheet"))
def pressed_field(
    pad: Pad,
    pressure: Float[Array, "n n"],
    grid: Grid = GRID,
    *,
    dipoles: Dipoles | None = None,
    nodes: int = CELL_NODES,
    traction: Float[Array, "2 n n"] | None = None,
    first_sheet: int = 0,
) -> Float[Array, "chips 3"]:
    """Field of the pad's magnets at the chips under a load.

    Args:
        pad: The skin on its board.
        pressure: Pa, on the cells of `grid`.
        grid: Of the loads.
        dipoles: A coarser grid of the same period, with fewer dipoles than one under each cell of `grid`, or one grid
            for each sheet from the surface down.
        nodes: Sheets of dipoles across the thickness.
        traction: Pa, along x and y.
        first_sheet: sheets above this one, counted from the surface, are left out.

    Returns:
        uT, tool axes.
    """

    def field_of(dipoles: Grid, magnets: tuple[Array, Array]) -> Array:
        loaded = load(pad, pressure, traction, grid, dipoles)

        def sheet(magnets: tuple[Array, Array]) -> Array:
            depth, moments = magnets
            displacement, rotation = interior(pad, loaded, depth, dipoles)
            return _at_chips(pad, _places(depth, dipoles) + displacement, turn(rotation, moments))

        # One sheet after the other: a batch of all of them at once would outgrow the caches.
        return jnp.sum(jax.lax.map(sheet, magnets), axis=0)

    groups = _groups(pad, grid if dipoles is None else dipoles, nodes, first_sheet)
    return _total([field_of(*group) for group in groups])


@partial(jax.jit, static_argnames=("dipoles", "nodes", "first_sheet"))
def rest_field(
    pad: Pad, dipoles: Dipoles = GRID, nodes: int = CELL_NODES, first_sheet: int = 0
) -> Float[Array, "chips 3"]:
    """Field of the pad's magnets at the chips when nothing touches it.

    Args:
        pad: The skin on its board.
        dipoles: Grid with one dipole under each cell, or one for each sheet from the surface down.
        nodes: Sheets of dipoles across the thickness.
        first_sheet: Sheets above this one, counted from the surface, are left out.

    Returns:
        uT, tool axes.
    """

    def field_of(dipoles: Grid, magnets: tuple[Array, Array]) -> Array:
        def sheet(magnets: tuple[Array, Array]) -> Array:
            depth, moments = magnets
            return _at_chips(pad, _places(depth, dipoles), moments)

        return jnp.sum(jax.lax.map(sheet, magnets), axis=0)

    return _total([field_of(*group) for group in _groups(pad, dipoles, nodes, first_sheet)])


def _total(parts: list[Array]) -> Array:
    return reduce(jnp.add, parts)


def _groups(pad: Pad, dipoles: Dipoles, nodes: int, first_sheet: int) -> Iterator[tuple[Grid, tuple[Array, Array]]]:
    """The sheets of each grid, with their depths and moments."""
    grids = [dipoles] * nodes if isinstance(dipoles, Grid) else list(dipoles)
    for grid in dict.fromkeys(grids[first_sheet:]):
        depths, moments = sheets(pad, grid, nodes)
        rows = np.array([sheet for sheet in range(first_sheet, nodes) if grids[sheet] == grid])
        yield grid, (depths[rows], moments[rows])


def sheets(
    pad: Pad, dipoles: Grid = GRID, nodes: int = CELL_NODES
) -> tuple[Float[Array, " d"], Float[Array, "d 3 n n"]]:
    """The dipoles at rest. A cell of `dipoles` takes the magnetization of the map's cell in which its centre lies.

    Args:
        pad: The skin.
        dipoles: Grid with one dipole under each cell.
        nodes: Sheets of dipoles across the thickness.

    Returns:
        Depths (m) of the sheets, and moments (A m2, x, y and z) under the cell centres.
    """
    roots, weights = np.polynomial.legendre.leggauss(nodes)
    depths = pad.thickness * (0.5 + 0.5 * roots)
    size = pad.magnetization.shape[0]
    cell = (2 * np.arange(dipoles.cells) + 1) * size // (2 * dipoles.cells)
    magnetization = jnp.moveaxis(pad.magnetization[cell[:, None], cell[None, :]], -1, 0)
    mean = cell_means(dipoles.cells)
    area = jnp.einsum("ai,bj,cab->cij", mean, mean, magnetization) * dipoles.spacing**2
    return depths, (weights / 2)[:, None, None, None] * (pad.thickness * area)[None]


def turn(rotation: Float[Array, "3 ..."], moments: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """Cayley's rotation of m by w: m + 4 / (4 + w.w) (w x m + w x (w x m) / 2).

    Args:
        rotation: w (rad), components first.
        moments: m, components first.

    Returns:
        The turned moments.
    """
    first = _cross(rotation, moments)
    second = _cross(rotation, first)
    share = 4 / (4 + sum(w * w for w in rotation))
    return jnp.stack([m + share * (a + b / 2) for m, a, b in zip(moments, first, second, strict=True)])


def _cross(a: Sequence[Array] | Array, b: Sequence[Array] | Array) -> tuple[Array, Array, Array]:
    """Cross product a x b of components, left to be fused, unlike `jnp.cross`."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def cell_means(cells: int) -> np.ndarray:
    """Weights that take a smooth function's values at cell centres to its means over the cells; one-sided at the ends.

    Args:
        cells: Their number n.

    Returns:
        (n, n).
    """
    middle = np.clip(np.arange(cells), 1, cells - 2)[:, None] - np.arange(cells)[None, :]
    return np.eye(cells) + ((np.abs(middle) == 1) * 1 - (middle == 0) * 2) / 24


def _places(depth: Array, grid: Grid) -> Array:
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
    return jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.broadcast_to(-depth, x.shape)])


def _at_chips(pad: Pad, positions: Array, moments: Array) -> Array:
    # Both are written to memory once here, not worked out again within the sums for each chip and component.
    positions, moments = jax.lax.optimization_barrier((positions, moments))
    return MICROTESLA * jnp.stack([_field(chip, positions, moments) for chip in jnp.asarray(pad.board.chips)])


def _fields(pad: Pad, positions: Float[Array, "3 n n"], moments: Float[Array, "3 n n"]) -> Float[Array, "chips 3 n n"]:
    """Part of each dipole in the field at each chip, uT."""
    return MICROTESLA * jax.vmap(_fields_at, (0, None, None))(jnp.asarray(pad.board.chips), positions, moments)


def _field(point: Array, positions: Array, moments: Array) -> Array:
    """Field at one point of dipoles whose components are on the first axis."""
    return jnp.sum(_fields_at(point, positions, moments).reshape(3, -1), axis=1)


def _fields_at(point: Array, positions: Array, moments: Array) -> Array:
    """Field at one point of each dipole."""
    # Components are written out: XLA makes a slow loop of a sum over three of them.
    away = [point[i] - positions[i] for i in range(3)]
    inverse = jax.lax.rsqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2])
    square = inverse * inverse
    cube = MU0_OVER_4PI * square * inverse
    along = 3 * square * (moments[0] * away[0] + moments[1] * away[1] + moments[2] * away[2])
    return jnp.stack([cube * (along * a - m) for a, m in zip(away, moments, strict=True)])
