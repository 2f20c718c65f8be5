"""What the chips below a magnetised layer measure when it is deformed.

The layer is a sum of magnetic dipoles: one below the centre of every cell of the contact grid and at every node of a Gauss-Legendre rule across the
thickness, its moment the magnetisation there times the volume it stands for. A touch moves the dipole at P to P + u and turns its moment by the local
rotation w = curl(u) / 2, both from `i2t.skin.contact.interior`; the reading is the change of the field at the chips

    B(r) = mu0 / (4 pi) sum_i [3 (m_i . d_i) d_i / |d_i|^5 - m_i / |d_i|^3],   d_i = r - P_i - u_i,

(Jackson, Classical Electrodynamics, 5.56). The material is hard: no moment depends on the field. For a given displacement the reading is linear in the
moments. The turn is Cayley's, R = I + (2 [w] + [w]^2 / 2 ...) written out in `_turn`: a rotation about w by 2 atan(|w| / 2), which is |w| to third order
and, of the two, nearer to the polar rotation atan(|w|) of the shear that causes it.

Tool frame; metres, A/m, A m2, tesla; readings in microtesla in the board's order and the chips' own axes.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.skin.contact import GRID, Grid, interior
from i2t.types import Pad

NODES = 4  # across the thickness: `tests/skin/test_field.py` doubles them and the cells
MU0_OVER_4PI = 1e-7  # T m/A
MICROTESLA = 1e6


def dipole_field(
    points: Float[Array, "m 3"], positions: Float[Array, "n 3"], moments: Float[Array, "n 3"]
) -> Float[Array, "m 3"]:
    """Flux density (T) at `points` (m) of dipoles at `positions` (m) with `moments` (A m2). Points on a dipole give inf or NaN."""
    return _field(points, positions.T, moments.T)


def response(pad: Pad, pressure: Float[Array, "n n"], grid: Grid = GRID, nodes: int = NODES) -> Float[Array, "15"]:
    """The noise-free reading (uT) of a pad under `pressure` (Pa): gains times the change of field, turned to the chips' axes."""
    return pad.gains * pad.board.to_board(deformed_field(pad, pressure, grid, nodes) - rest_field(pad, grid, nodes))


def deformed_field(
    pad: Pad, pressure: Float[Array, "n n"], grid: Grid = GRID, nodes: int = NODES
) -> Float[Array, "5 3"]:
    """Field (uT, tool axes) of the pad's magnets at the chips under `pressure` (Pa)."""
    positions, moments, depths = magnets(pad, grid, nodes)
    displacement, rotation = interior(pad, pressure, depths, grid)
    return MICROTESLA * _field(pad.board.chips, positions + displacement, _turn(rotation, moments))


def rest_field(pad: Pad, grid: Grid = GRID, nodes: int = NODES) -> Float[Array, "5 3"]:
    """Field (uT, tool axes) of the pad's magnets at the chips when nothing touches it."""
    positions, moments, _ = magnets(pad, grid, nodes)
    return MICROTESLA * _field(pad.board.chips, positions, moments)


def magnets(
    pad: Pad, grid: Grid = GRID, nodes: int = NODES
) -> tuple[Float[Array, "3 d n n"], Float[Array, "3 d n n"], Float[Array, "d"]]:
    """Dipoles of the layer at rest: positions (m), moments (A m2) and the depths (m) of their sheets below the surface.

    A cell of the grid takes the magnetisation of the map's cell in which its centre lies.
    """
    roots, weights = np.polynomial.legendre.leggauss(nodes)
    depths = pad.thickness * (0.5 + 0.5 * roots)
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
    sheet = (nodes, grid.cells, grid.cells)
    positions = jnp.stack(
        [jnp.broadcast_to(x, sheet), jnp.broadcast_to(y, sheet), jnp.broadcast_to(-depths[:, None, None], sheet)]
    )
    size = pad.magnetisation.shape[0]
    cell = np.minimum(np.arange(grid.cells) * 2 + 1, 2 * grid.cells - 1) * size // (2 * grid.cells)
    magnetisation = jnp.moveaxis(pad.magnetisation[cell[:, None], cell[None, :]], -1, 0)[:, None]
    volumes = (weights / 2)[None, :, None, None] * pad.thickness * grid.spacing**2
    return positions, magnetisation * volumes, depths


def _field(points: Array, positions: Array, moments: Array) -> Array:
    """As `dipole_field`, with components on the first axis of `positions` and `moments`: long contiguous loops."""
    d = points.reshape(*points.shape, *(1 for _ in positions.shape[1:])) - positions[None]
    square = d[:, 0] ** 2 + d[:, 1] ** 2 + d[:, 2] ** 2
    inverse = 1 / square
    cube = inverse * jnp.sqrt(inverse)
    m = moments[None]
    along = 3 * inverse * (m[:, 0] * d[:, 0] + m[:, 1] * d[:, 1] + m[:, 2] * d[:, 2])
    axes = tuple(range(1, square.ndim))
    return MU0_OVER_4PI * jnp.stack([jnp.sum(cube * (along * d[:, i] - m[:, i]), axis=axes) for i in range(3)], axis=-1)


def _turn(w: Array, m: Array) -> Array:
    """Cayley's rotation of m by w = (wx, wy, 0): m + 4 / (4 + w.w) (w x m + w x (w x m) / 2)."""
    first = _cross(w, m)
    second = _cross(w, first)
    return m + 4 / (4 + jnp.sum(w * w, axis=0, keepdims=True)) * (first + second / 2)


def _cross(a: Array, b: Array) -> Array:
    return jnp.cross(a, b, axis=0)
