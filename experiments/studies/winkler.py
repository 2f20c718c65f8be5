"""A skin of independent elastic columns (a Winkler foundation)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.skin.contact import GRID, Grid
from i2t.skin.dipoles import MICROTESLA, dipole_field, rest_field, sheets, turn
from i2t.skin.pad import Press
from i2t.types import Pad


def winkler_press(
    pad: Pad,
    height: Float[Array, "n n"],
    indentation: Float[Array, ""] | float,
    grid: Grid = GRID,
    start: Float[Array, "n n"] | None = None,
) -> Press:
    """Press law in which each column is compressed uniformly by the overlap u with the surface, p = E u / h.

    Magnets move straight down. The pressure is explicit, so `start` is unused.
    """
    compression = jnp.maximum(indentation - height, 0.0)
    pressure = pad.young / pad.thickness * compression
    ratio = grid.cells // GRID.cells  # each cell of GRID consists of whole cells of `grid`
    means = compression.reshape(GRID.cells, ratio, GRID.cells, ratio).mean((1, 3))
    reading = pad.gains * pad.board.to_board(_column_field(pad, means) - rest_field(pad, GRID))
    force = jnp.sum(pressure) * grid.spacing**2
    return Press(reading, force, jnp.asarray(indentation), pressure, jnp.asarray(True))


def _column_field(pad: Pad, compression: Float[Array, "m m"]) -> Float[Array, "chips 3"]:
    """Field (uT, tool axes) at the chips, of columns compressed uniformly by `compression` (m).

    A magnet's displacement is proportional to its height, and it rotates by half the curl of the displacement.
    """
    y, x = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")
    along_y, along_x = (jnp.asarray(jnp.gradient(compression, GRID.spacing, axis=axis)) for axis in (0, 1))

    def sheet(magnets: tuple[Array, Array]) -> Array:
        depth, moments = magnets
        part = 1 - depth / pad.thickness
        position = jnp.stack([jnp.asarray(x), jnp.asarray(y), -depth - part * compression])
        rotation = part / 2 * jnp.stack([-along_y, along_x, jnp.zeros_like(compression)])
        turned = turn(rotation, moments)
        return dipole_field(jnp.asarray(pad.board.chips), position.reshape(3, -1).T, turned.reshape(3, -1).T)

    return MICROTESLA * jnp.sum(jax.lax.map(sheet, sheets(pad, GRID)), axis=0)
