"""Design matrices: the reading of a press as a linear function of the pad's magnetization.

The map is a series of cosines on the pad (`cosine_basis`) with the covariance of `i2t.skin.pad.smooth_random`, of which
a few hundred weights of prior variance 1 are left (`weight_features`). Metres, newtons, microtesla. `c` is the number
of channels, three for each chip of the board; `m` is the number of cosines along an edge, `k` the number of weights.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.batching import map_batches
from i2t.calibration.physics.layer import LayerParameters, Tip, make_pad
from i2t.calibration.structured_gp import Presses
from i2t.skin import elasticity as elastic
from i2t.skin.contact import solve, solve_force
from i2t.skin.dipoles import CELL_NODES, MICROTESLA, MU0_OVER_4PI, cell_means, sheets, turn
from i2t.skin.elasticity import GRID, Grid
from i2t.skin.pad import MAP_CELLS
from i2t.types import Board

MODES = 12  # cosines along each edge: waves of 3.6 mm, finer than any that can be distinguished 1.5 mm above a chip
DESIGN_BATCH = 8  # at a time, for the caches
MIN_FORCE_N = 1e-3


def cosine_basis(cells: int = MAP_CELLS) -> Float[np.ndarray, "cells m"]:
    """Orthonormal cosines on the cells of an edge (the discrete cosine transform's), the slowest first.

    Args:
        cells: Cells along the edge.

    Returns:
        A column for each cosine.
    """
    k, i = np.arange(min(MODES, cells)), np.arange(cells)
    waves = np.cos(np.pi * (i[:, None] + 0.5) * k / cells) * np.sqrt(2 / cells)
    return np.where(k == 0, waves / np.sqrt(2), waves).astype(np.float32)


def cosine_prior_factor(patch_length: Float[Array, ""], window: float, cells: int = MAP_CELLS) -> Float[Array, "m m"]:
    """Cholesky factor of the covariance of an edge's cosines: that of `smooth_random`, in their basis.

    Args:
        patch_length: Length of the patches (m).
        window: Edge of the pad (m).
        cells: Cells along the edge.

    Returns:
        The lower factor.
    """
    at = (np.arange(cells) + 0.5) / cells * window
    scaled = (at[:, None] - at[None, :]) / patch_length
    waves = jnp.asarray(cosine_basis(cells))
    covariance = waves.T @ (0.999 * jnp.exp(-0.5 * scaled**2) + 0.001 * jnp.eye(cells)) @ waves
    return jnp.linalg.cholesky(covariance + 1e-5 * jnp.eye(len(covariance)))


def design_matrix(
    layer: LayerParameters,
    board: Board,
    tip: Tip,
    position: Float[Array, "2"],
    load: Float[Array, ""],
    *,
    by_force: bool,
    grid: Grid = GRID,
) -> Float[Array, "c 3 m m"]:
    """Reading of one press for each cosine of each component of the magnetization.

    Args:
        layer: Parameters of the layer.
        board: The sensor board.
        tip: What presses.
        position: Where, as believed (m).
        load: Force (N) or depth (m).
        by_force: Whether the load is a force.
        grid: Cells of the pad.

    Returns:
        Readings (uT) of 1 A/m: channels, components, cosines along y and along x.
    """
    pad = make_pad(layer, board)
    height = tip.height(position + layer.tip_offset, grid)
    if by_force:
        contact = solve_force(pad, height, jnp.maximum(load, MIN_FORCE_N), grid)
    else:
        contact = solve(pad, height, load - layer.contact_offset, grid)
    loaded = elastic.load(pad, contact.pressure, grid=grid)
    # Moments of magnetization 1 along one cosine in y and one in x are a product: the sheets' of each edge.
    share, depths = _edge_moments(grid), sheets(pad, grid)[0]
    thick = pad.thickness * np.polynomial.legendre.leggauss(CELL_NODES)[1] / 2
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")

    def sheet(at: tuple[Array, Array]) -> Array:
        depth, size = at
        displacement, rotation = elastic.interior(pad, loaded, depth, grid)
        rest = jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.broadcast_to(-depth, x.shape)])
        turned = jax.vmap(lambda one: turn(rotation, jnp.broadcast_to(one[:, None, None], rest.shape)))(jnp.eye(3))

        def chip(point: Array) -> Array:
            before, after = _dipole_tensor(point, rest), _dipole_tensor(point, rest + displacement)
            change = jnp.einsum("oqij,cqij->ocij", after, turned, precision="highest") - before
            return jnp.einsum("ocij,ia,jb->ocab", change, share, share, precision="highest")

        return size * jnp.stack([chip(point) for point in pad.board.chips])

    field = MICROTESLA * jnp.sum(jax.lax.map(sheet, (depths, thick)), axis=0)  # (chips, 3, 3, modes, modes), tool axes
    own = jnp.einsum("kqo,kqcab->kocab", pad.board.rotations, field, precision="highest")
    return own.reshape(3 * len(own), 3, *field.shape[-2:])


@partial(jax.jit, static_argnames=("tip", "by_force", "grid"))
def design_matrices(
    layer: LayerParameters, board: Board, tip: Tip, presses: Presses, *, by_force: bool, grid: Grid = GRID
) -> Float[Array, "n c 3 m m"]:
    """`design_matrix` of many presses.

    Args:
        layer: Parameters of the layer.
        board: The sensor board.
        tip: What presses; hashable.
        presses: Positions (m) and loads (m or N).
        by_force: Whether the loads are forces.
        grid: Cells of the pad.

    Returns:
        Readings (uT) of 1 A/m for each press.
    """

    def one(press: Presses) -> Array:
        return design_matrix(layer, board, tip, press.position, press.load, by_force=by_force, grid=grid)

    return map_batches(one, presses, batch_size=DESIGN_BATCH)


def weight_features(layer: LayerParameters, designs: Float[Array, "n c 3 m m"], window: float) -> Float[Array, "n c k"]:
    """Readings of weights of prior variance 1.

    Args:
        layer: Strengths and length of the magnetization's patches.
        designs: Design matrices.
        window: Edge of the pad (m).

    Returns:
        Readings (uT) of each weight: those of the patches, then three of the uniform part.
    """
    r = cosine_prior_factor(layer.patch_length, window)
    patches = jnp.einsum("nocab,ax,by,c->nocxy", designs, r, r, layer.patch_strength, precision="highest")
    level = designs[:, :, :, 0, 0] * (MAP_CELLS * layer.uniform_strength)  # the first cosines are 1 / sqrt(MAP)
    return jnp.concatenate([patches.reshape(*designs.shape[:2], -1), level], axis=-1)


def _edge_moments(grid: Grid) -> Float[np.ndarray, "n m"]:
    """Weights of the map's cosines in each cell of the grid along an edge, times the cell's width (`sheets`)."""
    cell = (2 * np.arange(grid.cells) + 1) * MAP_CELLS // (2 * grid.cells)
    return (cell_means(grid.cells).T @ cosine_basis()[cell] * grid.spacing).astype(np.float32)


def _dipole_tensor(point: Array, at: Float[Array, "3 n n"]) -> Float[Array, "3 3 n n"]:
    """Field (T) at a point per moment (A m2) at each position."""
    d = point[:, None, None] - at
    inverse = jax.lax.rsqrt(jnp.sum(d**2, axis=0))
    along = d * inverse[None]
    return MU0_OVER_4PI * (3 * along[:, None] * along[None] - jnp.eye(3)[..., None, None]) * inverse[None, None] ** 3
