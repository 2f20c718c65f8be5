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

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.skin.elasticity import GRID, Grid, interior, load
from i2t.types import Pad

CELL_NODES = 5  # across the thickness; `tests/skin/test_dipoles.py` refines them and the cells
MU0_OVER_4PI = 1e-7  # T m/A
MICROTESLA = 1e6


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


@partial(jax.jit, static_argnames=("grid", "dipoles", "nodes"))
def response(
    pad: Pad,
    pressure: Float[Array, "n n"],
    grid: Grid = GRID,
    *,
    dipoles: Grid | None = None,
    nodes: int = CELL_NODES,
    traction: Float[Array, "2 n n"] | None = None,
) -> Float[Array, " c"]:
    """The noise-free reading under a load: gains times the change of field, in the chips' axes.

    Args:
        pad: the skin on its board.
        pressure: Pa, on the cells of `grid`.
        grid: of the loads.
        dipoles: a coarser grid of the same period, with fewer dipoles than one under each cell of `grid`.
        nodes: sheets of dipoles across the thickness.
        traction: Pa, along x and y.

    Returns:
        The reading in uT.
    """
    dipoles = grid if dipoles is None else dipoles
    change = pressed_field(pad, pressure, grid, dipoles=dipoles, nodes=nodes, traction=traction) - rest_field(
        pad, dipoles, nodes
    )
    return pad.gains * pad.board.to_board(change)


@partial(jax.jit, static_argnames=("grid", "dipoles"))
def linear_response(pad: Pad, grid: Grid = GRID, *, dipoles: Grid | None = None) -> Float[Array, "c n n"]:
    """The derivative of `response` by the pressure at rest: what it is as long as the skin moves little.

    Args:
        pad: the skin on its board.
        grid: of the pressure.
        dipoles: as for `response`.

    Returns:
        uT/Pa, for each value of a reading and each cell.
    """
    rest = jnp.zeros((grid.cells, grid.cells))
    return jax.jacrev(lambda pressure: response(pad, pressure, grid, dipoles=dipoles))(rest)


@partial(jax.jit, static_argnames=("grid", "dipoles", "nodes"))
def pressed_field(
    pad: Pad,
    pressure: Float[Array, "n n"],
    grid: Grid = GRID,
    *,
    dipoles: Grid | None = None,
    nodes: int = CELL_NODES,
    traction: Float[Array, "2 n n"] | None = None,
) -> Float[Array, "chips 3"]:
    """Field of the pad's magnets at the chips under a load.

    Args:
        pad: The skin on its board.
        pressure: Pa, on the cells of `grid`.
        grid: Of the loads.
        dipoles: A coarser grid of the same period, with fewer dipoles than one under each cell of `grid`.
        nodes: Sheets of dipoles across the thickness.
        traction: Pa, along x and y.

    Returns:
        uT, tool axes.
    """
    dipoles = grid if dipoles is None else dipoles
    loaded = load(pad, pressure, traction, grid, dipoles)

    def sheet(magnets: tuple[Array, Array]) -> Array:
        depth, moments = magnets
        displacement, rotation = interior(pad, loaded, depth, dipoles)
        return _at_chips(pad, _places(depth, dipoles) + displacement, turn(rotation, moments))

    # One sheet after the other: a batch of all of them at once would outgrow the caches.
    return jnp.sum(jax.lax.map(sheet, sheets(pad, dipoles, nodes)), axis=0)


@partial(jax.jit, static_argnames=("dipoles", "nodes"))
def rest_field(pad: Pad, dipoles: Grid = GRID, nodes: int = CELL_NODES) -> Float[Array, "chips 3"]:
    """Field of the pad's magnets at the chips when nothing touches it.

    Args:
        pad: The skin on its board.
        dipoles: Grid with one dipole under each cell.
        nodes: Sheets of dipoles across the thickness.

    Returns:
        uT, tool axes.
    """

    def sheet(magnets: tuple[Array, Array]) -> Array:
        depth, moments = magnets
        return _at_chips(pad, _places(depth, dipoles), moments)

    return jnp.sum(jax.lax.map(sheet, sheets(pad, dipoles, nodes)), axis=0)


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


def _field(point: Array, positions: Array, moments: Array) -> Array:
    """Field at one point of dipoles whose components are on the first axis."""
    # Components are written out: XLA makes a slow loop of a sum over three of them.
    away = [point[i] - positions[i] for i in range(3)]
    inverse = jax.lax.rsqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2])
    square = inverse * inverse
    cube = square * inverse
    along = 3 * square * (moments[0] * away[0] + moments[1] * away[1] + moments[2] * away[2])
    parts = jnp.stack([cube * (along * a - m) for a, m in zip(away, moments, strict=True)])
    return MU0_OVER_4PI * jnp.sum(parts.reshape(3, -1), axis=1)
