"""Magnetic field at the chips below a deformed magnetised layer.

The layer is a sum of magnetic dipoles: one under the centre of every cell of the contact grid at each node of a
Gauss-Legendre rule across the thickness. A touch moves the dipole at P to P + u and turns its moment m by the local
rotation w = curl(u) / 2, both from `i2t.skin.elasticity.interior`. The reading is the change of the field at the chips

    B(r) = mu0 / (4 pi) sum_i [3 (m_i . d_i) d_i / |d_i|^5 - m_i / |d_i|^3],   d_i = r - P_i - u_i

(Jackson, Classical Electrodynamics, 5.56). The material is hard: no moment depends on the field. For a given
displacement the reading is linear in the moments.

Two choices keep the number of dipoles small. First, moments are not just the magnetization M of their cell. The
integrand of the field is smooth except for M, which jumps between cells. The mean of the smooth part over a cell is
therefore estimated from its centre and its neighbours' (f + second difference / 24, the Euler-Maclaurin correction of
the midpoint rule), which amounts to sharpening M before it is multiplied by the cell's volume. Second, the turn is
Cayley's, about w by 2 atan(|w| / 2). It is exactly a rotation, by |w| to third order, between |w| and the polar
rotation atan(|w|) of the shear that causes it, and needs no trigonometry.

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

DIPOLE_SHEETS = 5  # number of dipole sheets across the skin's thickness; `tests/skin/test_dipoles.py` refines them
MU0_OVER_4PI = 1e-7  # T m/A, magnetic constant divided by 4 pi
MICROTESLA = 1e6  # uT per T
# grid of the dipoles of all sheets, or one grid for each sheet from the surface down; all of one period
Dipoles: TypeAlias = Grid | tuple[Grid, ...]


def dipole_field(
    points: Float[Array, "m 3"], positions: Float[Array, "n 3"], moments: Float[Array, "n 3"]
) -> Float[Array, "m 3"]:
    """Compute the magnetic flux density of dipoles.

    Args:
        points: `(m, 3)` points (m).
        positions: `(n, 3)` positions of the dipoles (m).
        moments: `(n, 3)` moments of the dipoles (A m2).

    Returns:
        `(m, 3)` flux density (T); not finite on a dipole.
    """
    return jax.vmap(_field, (0, None, None))(points, positions.T, moments.T)


@partial(jax.jit, static_argnames=("grid", "dipoles", "nodes", "first_sheet"))
def response(
    pad: Pad,
    pressure: Float[Array, "n n"],
    grid: Grid = GRID,
    *,
    dipoles: Dipoles | None = None,
    nodes: int = DIPOLE_SHEETS,
    traction: Float[Array, "2 n n"] | None = None,
    first_sheet: int = 0,
) -> Float[Array, " c"]:
    """Compute a pad's noise-free reading under a load: gains times the change of the field, in the chips' axes.

    Args:
        pad: The skin on its board.
        pressure: `(n, n)` pressure (Pa) on the cells of `grid`.
        grid: Grid of the loads.
        dipoles: A coarser grid of the same period, with fewer dipoles than one under each cell of `grid`, or one grid
            for each sheet from the surface down.
        nodes: Number of dipole sheets across the thickness.
        traction: `(2, n, n)` traction (Pa) along x and y.
        first_sheet: Number of sheets below the surface that are left out.

    Returns:
        `(c,)` reading (uT).
    """
    dipoles = grid if dipoles is None else dipoles
    part = {"dipoles": dipoles, "nodes": nodes, "first_sheet": first_sheet}
    change = pressed_field(pad, pressure, grid, traction=traction, **part) - rest_field(pad, **part)
    return pad.gains * pad.board.to_board(change)


@partial(jax.jit, static_argnames=("grid", "dipoles", "first_sheet"))
def linear_response(
    pad: Pad, grid: Grid = GRID, *, dipoles: Dipoles | None = None, first_sheet: int = 0
) -> Float[Array, "c n n"]:
    """Compute a pad's linear response: the derivative at rest of the reading (`response`) by the pressure.

    It is exact for small motions of the skin.

    Args:
        pad: The skin on its board.
        grid: Grid of the pressure.
        dipoles: As for `response`.
        first_sheet: As for `response`.

    Returns:
        `(c, n, n)` derivatives (uT/Pa) of each value of a reading by the pressure on each cell.
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
            # First by the motion and turn of each dipole, for each chip and component; then by what moves the dipoles.
            slopes = jnp.moveaxis(jax.vmap(lambda way: jax.jvp(field, (still,), (way,))[1])(along), 0, 2)
            return jax.vmap(jax.vmap(lambda slope: jax.linear_transpose(move, rest)(slope)[0]))(slopes)

        return jnp.sum(jax.lax.map(sheet, magnets), axis=0)

    dipoles = grid if dipoles is None else dipoles
    change = _total([response_of(*group) for group in _groups(pad, dipoles, DIPOLE_SHEETS, first_sheet)])
    to_board = jax.vmap(pad.board.to_board, -1, -1)(change.reshape(*change.shape[:2], -1))
    return (pad.gains[:, None] * to_board).reshape(-1, *rest.shape)


@partial(jax.jit, static_argnames=("grid", "dipoles", "nodes", "first_sheet"))
def pressed_field(
    pad: Pad,
    pressure: Float[Array, "n n"],
    grid: Grid = GRID,
    *,
    dipoles: Dipoles | None = None,
    nodes: int = DIPOLE_SHEETS,
    traction: Float[Array, "2 n n"] | None = None,
    first_sheet: int = 0,
) -> Float[Array, "chips 3"]:
    """Compute the field of the pad's magnets at the chips under a load.

    Args:
        pad: The skin on its board.
        pressure: `(n, n)` pressure (Pa) on the cells of `grid`.
        grid: Grid of the loads.
        dipoles: A coarser grid of the same period, with fewer dipoles than one under each cell of `grid`, or one grid
            for each sheet from the surface down.
        nodes: Number of dipole sheets across the thickness.
        traction: `(2, n, n)` traction (Pa) along x and y.
        first_sheet: Number of sheets below the surface that are left out.

    Returns:
        `(chips, 3)` field (uT) in tool axes.
    """

    def field_of(dipoles: Grid, magnets: tuple[Array, Array]) -> Array:
        loaded = load(pad, pressure, traction, grid, dipoles)

        def sheet(magnets: tuple[Array, Array]) -> Array:
            depth, moments = magnets
            displacement, rotation = interior(pad, loaded, depth, dipoles)
            return _at_chips(pad, _places(depth, dipoles) + displacement, turn(rotation, moments))

        # One sheet after the other, because a batch of all sheets would exceed the caches.
        return jnp.sum(jax.lax.map(sheet, magnets), axis=0)

    groups = _groups(pad, grid if dipoles is None else dipoles, nodes, first_sheet)
    return _total([field_of(*group) for group in groups])


@partial(jax.jit, static_argnames=("dipoles", "nodes", "first_sheet"))
def rest_field(
    pad: Pad, dipoles: Dipoles = GRID, nodes: int = DIPOLE_SHEETS, first_sheet: int = 0
) -> Float[Array, "chips 3"]:
    """Compute the field of the pad's magnets at the chips when nothing touches the pad.

    Args:
        pad: The skin on its board.
        dipoles: Grid with one dipole under each cell, or one for each sheet from the surface down.
        nodes: Number of dipole sheets across the thickness.
        first_sheet: Number of sheets below the surface that are left out.

    Returns:
        `(chips, 3)` field (uT) in tool axes.
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
    """Yield the sheets of each grid, with their depths and moments."""
    grids = [dipoles] * nodes if isinstance(dipoles, Grid) else list(dipoles)
    for grid in dict.fromkeys(grids[first_sheet:]):
        depths, moments = sheets(pad, grid, nodes)
        rows = np.array([sheet for sheet in range(first_sheet, nodes) if grids[sheet] == grid])
        yield grid, (depths[rows], moments[rows])


def sheets(
    pad: Pad, dipoles: Grid = GRID, nodes: int = DIPOLE_SHEETS
) -> tuple[Float[Array, " d"], Float[Array, "d 3 n n"]]:
    """Compute the sheets of dipoles that represent a pad at rest.

    A cell of `dipoles` has the magnetization of the map's cell at its centre.

    Args:
        pad: The skin.
        dipoles: Grid with one dipole under each cell.
        nodes: Number of dipole sheets across the thickness.

    Returns:
        `(d,)` depths of the sheets (m), and `(d, 3, n, n)` moments (A m2; x, y and z) under the cell centres.
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
    """Turn magnetic moments m by Cayley's rotation w: m + 4 / (4 + w.w) (w x m + w x (w x m) / 2).

    Args:
        rotation: Rotation w (rad), components first.
        moments: Moments m (A m2), components first.

    Returns:
        The turned moments (A m2), components first.
    """
    first = _cross(rotation, moments)
    second = _cross(rotation, first)
    share = 4 / (4 + sum(w * w for w in rotation))
    return jnp.stack([m + share * (a + b / 2) for m, a, b in zip(moments, first, second, strict=True)])


def _cross(a: Sequence[Array] | Array, b: Sequence[Array] | Array) -> tuple[Array, Array, Array]:
    """Compute the cross product a x b of components, which XLA can fuse, unlike `jnp.cross`."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def cell_means(cells: int) -> np.ndarray:
    """Compute weights that convert a smooth function's values at cell centres to its means over the cells.

    They are one-sided at the ends.

    Args:
        cells: Number n of cells.

    Returns:
        `(n, n)` weights, one row for each mean.
    """
    middle = np.clip(np.arange(cells), 1, cells - 2)[:, None] - np.arange(cells)[None, :]
    return np.eye(cells) + ((np.abs(middle) == 1) * 1 - (middle == 0) * 2) / 24


def _places(depth: Array, grid: Grid) -> Array:
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
    return jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.broadcast_to(-depth, x.shape)])


def _at_chips(pad: Pad, positions: Array, moments: Array) -> Array:
    # Both are written to memory once here, instead of being recomputed in the sums for each chip and component.
    positions, moments = jax.lax.optimization_barrier((positions, moments))
    return MICROTESLA * jnp.stack([_field(chip, positions, moments) for chip in jnp.asarray(pad.board.chips)])


def _fields(pad: Pad, positions: Float[Array, "3 n n"], moments: Float[Array, "3 n n"]) -> Float[Array, "chips 3 n n"]:
    """Compute the contribution of each dipole to the field at each chip (uT)."""
    return MICROTESLA * jax.vmap(_fields_at, (0, None, None))(jnp.asarray(pad.board.chips), positions, moments)


def _field(point: Array, positions: Array, moments: Array) -> Array:
    """Compute the field at one point of dipoles whose components are on the first axis."""
    return jnp.sum(_fields_at(point, positions, moments).reshape(3, -1), axis=1)


def _fields_at(point: Array, positions: Array, moments: Array) -> Array:
    """Compute the field of each dipole at one point."""
    # Components are written out, because XLA turns a sum over three of them into a slow loop.
    away = [point[i] - positions[i] for i in range(3)]
    inverse = jax.lax.rsqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2])
    square = inverse * inverse
    cube = MU0_OVER_4PI * square * inverse
    along = 3 * square * (moments[0] * away[0] + moments[1] * away[1] + moments[2] * away[2])
    return jnp.stack([cube * (along * a - m) for a, m in zip(away, moments, strict=True)])
