"""Elastic magnetic layer over a board: its parameters, and the reading of a press for each part of its magnetization.

For a known displacement the reading is linear in the magnetization (`i2t.skin.dipoles`). The magnetization map is a
series of cosines on the pad with the covariance of `i2t.skin.pad.smooth_random`. Derivatives run forward through the
contact and the field.

Metres, newtons, pascals, microtesla. `c` is the number of channels, three for each chip of the board; `m` is the number
of cosines along an edge, `k` the number of weights.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.geometry import so3_exp
from i2t.runtime.batching import map_batches
from i2t.skin import elasticity as elastic
from i2t.skin.contact import MAX_HEIGHT_M, solve, solve_force
from i2t.skin.dipoles import DIPOLE_SHEETS, MICROTESLA, MU0_OVER_4PI, cell_means, sheets, turn
from i2t.skin.elasticity import GRID, Grid
from i2t.skin.pad import MAP_CELLS, NOMINAL_SKIN
from i2t.types import Board, Pad, in_one_line
from i2t.validation import round_tip

# Number of cosines along each edge of a magnetization map: waves of 3.6 mm, finer than any that can be distinguished
# 1.5 mm above a chip.
MODES = 12
DESIGN_BATCH = 8  # number of design matrices computed at a time, so that they fit the caches


@in_one_line
class LayerParameters(NamedTuple):
    """Parameters of a magnetic layer: size, elasticity, offsets of tip and board, gains, magnetization and noise.

    Units are m, Pa, rad, A/m and uT. The class also holds standard deviations, coordinates in the prior, or ranges.
    """

    thickness: Float[Array, ""]  # m
    gap: Float[Array, ""]  # m, gap from the layer's base to the chips
    young: Float[Array, ""]  # Pa, Young's modulus; it stays at the prior's median if presses are controlled by travel
    poisson: Float[Array, ""]
    # m, distance by which first contact is later than assumed; zero if controlled by force
    contact_offset: Float[Array, ""]
    mount_compliance: Float[Array, ""]  # m/N, compliance of an edge-clamped skin
    tip_offset: Float[Array, "2"]  # m, true minus assumed position of the tip
    tip_scale: Float[Array, ""]  # true radius of the tip divided by the stated radius
    board_offset: Float[Array, "2"]  # m, offset of the board in the plane of the skin
    board_rotation: Float[Array, "3"]  # rad, rotation vector of the board about its centre
    gains: Float[Array, " c"]  # gains of the channels
    patch_strength: Float[Array, "3"]  # A/m, strength of the map's patches along each axis
    uniform_strength: Float[Array, ""]  # A/m, strength of the uniform part of the magnetization
    patch_length: Float[Array, ""]  # m
    noise_std: Float[Array, ""]  # uT, standard deviation of a reading's noise and of model errors


# Fields of `LayerParameters` that change the design matrices; the other fields only scale their products.
DESIGN_PARAMETERS = ("thickness", "gap", "young", "poisson", "contact_offset", "mount_compliance", "tip_offset",
                     "tip_scale", "board_offset", "board_rotation")  # fmt: skip
# fields of `LayerParameters` that change the features by more than a scale
SHAPE_PARAMETERS = (*DESIGN_PARAMETERS, "patch_length")


class LayerPrior(NamedTuple):
    """Prior distribution of `LayerParameters`: the median and a standard deviation of each.

    The standard deviation is that of the parameter itself, of its logarithm, or of the root of its ratio to the median.
    """

    median: LayerParameters
    # standard deviation of the parameter, of its logarithm, or of the root of its ratio to the median
    std: LayerParameters


def layer_prior(channels: int) -> LayerPrior:
    """Build a prior that approximates `sample_pad` and the errors of a careful mount.

    Args:
        channels: Number of channels of the board, three for each chip.

    Returns:
        Medians and standard deviations of the parameters.
    """
    strength = 0.7 * NOMINAL_SKIN.magnetization  # A/m: patches and the uniform part share the variance
    median = LayerParameters(
        thickness=jnp.asarray(NOMINAL_SKIN.thickness + 0.5e-3),
        gap=jnp.asarray(NOMINAL_SKIN.chip_gap),
        young=jnp.asarray(NOMINAL_SKIN.young),
        poisson=jnp.asarray(NOMINAL_SKIN.poisson),
        contact_offset=jnp.asarray(0.0),
        mount_compliance=jnp.asarray(0.3 * NOMINAL_SKIN.mount_compliance),
        tip_offset=jnp.zeros(2),
        tip_scale=jnp.asarray(1.0),
        board_offset=jnp.zeros(2),
        board_rotation=jnp.zeros(3),
        gains=jnp.ones(channels),
        patch_strength=jnp.full(3, strength),
        uniform_strength=jnp.asarray(strength),
        patch_length=jnp.asarray(3e-3),
        noise_std=jnp.asarray(2.0),
    )
    std = LayerParameters(
        thickness=jnp.asarray(0.12),
        gap=jnp.asarray(0.17),
        young=jnp.asarray(0.15),
        poisson=jnp.asarray(0.003),
        contact_offset=jnp.asarray(1e-4),  # m
        mount_compliance=jnp.asarray(0.6),
        tip_offset=jnp.full(2, 5e-4),  # m
        tip_scale=jnp.asarray(0.03),
        board_offset=jnp.full(2, 3e-4),  # m
        board_rotation=jnp.asarray([0.015, 0.015, 0.03]),  # rad
        gains=jnp.full(channels, 0.05),
        patch_strength=jnp.full(3, 0.7),
        uniform_strength=jnp.asarray(0.7),
        patch_length=jnp.asarray(0.2),
        noise_std=jnp.asarray(1.0),
    )
    return LayerPrior(median, std)


def parameters_at(coordinates: LayerParameters, prior: LayerPrior) -> LayerParameters:
    """Convert coordinates of the prior to parameters.

    Offsets, rotations and gains have a normal prior, the other parameters a lognormal one, with two exceptions: the
    difference of Poisson's ratio from that of an incompressible layer is lognormal, and the root of the mount
    compliance, which is 0 for bonded skins, is normal.

    Args:
        coordinates: Standard deviations from the median; their prior is normal with variance 1.
        prior: Medians and standard deviations.

    Returns:
        The parameters in their units.
    """
    normal = ("contact_offset", "tip_offset", "board_offset", "board_rotation", "gains")

    def value(name: str) -> Array:
        median, std, at = (getattr(part, name) for part in (prior.median, prior.std, coordinates))
        if name in normal:
            return median + std * at
        if name == "poisson":
            return 0.5 - (0.5 - median) * jnp.exp(-std * at / (0.5 - median))
        return median * (1 + std * at) ** 2 if name == "mount_compliance" else median * jnp.exp(std * at)

    return LayerParameters(**{name: value(name) for name in LayerParameters._fields})


@runtime_checkable
class Tip(Protocol):
    """Interface of a pressing tip: the height of its surface over the skin."""

    def height(self, position: Float[Array, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Compute the distance of the tip's surface behind its lowest point over each cell.

        Args:
            position: `(2,)` position of the tip's axis on the skin (m).
            grid: Cells of the pad.

        Returns:
            `(n, n)` heights (m), row along tool y; `MAX_HEIGHT_M` if the tip is not over the cell.
        """
        ...


@dataclass(frozen=True)
class RoundTip:
    """Pressing tip that is a sphere, or the flat end of an upright cylinder.

    Attributes:
        shape: "sphere" or "cylinder".
        radius: Radius in metres.
    """

    shape: Literal["sphere", "cylinder"]
    radius: float | Float[Array, ""]

    def height(self, position: Float[Array, "2"] | Float[np.ndarray, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Compute the distance of the tip's surface behind its lowest point over each cell.

        Args:
            position: `(2,)` position of the tip's axis on the skin (m).
            grid: Cells of the pad.

        Returns:
            `(n, n)` heights (m), row along tool y; `MAX_HEIGHT_M` if the tip is not over the cell.
        """
        y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
        square = (x - position[0]) ** 2 + (y - position[1]) ** 2
        under = square < self.radius**2
        if self.shape == "cylinder":
            return jnp.where(under, 0.0, MAX_HEIGHT_M)
        return jnp.where(under, self.radius - jnp.sqrt(jnp.where(under, self.radius**2 - square, 1.0)), MAX_HEIGHT_M)


def parse_tip(text: str) -> RoundTip:
    """Parse a tip's name, as `i2t convert presses --indenter` writes it.

    Args:
        text: `sphere:RADIUS` or `cylinder:RADIUS`, the radius in mm.

    Returns:
        The tip, with its radius in metres.

    Raises:
        ValueError: The text has neither form, or the radius is out of range.
    """
    max_radius_mm = 50.0
    try:
        shape, millimetres = round_tip(text, max_radius_mm)
    except ValueError as error:
        forms = f"--tip sphere:RADIUS or cylinder:RADIUS takes one in mm, up to {max_radius_mm:g}"
        raise ValueError(f'"{text}" is not a tip that a pad can be fitted to ({forms}): {error}') from None
    return RoundTip("sphere" if shape == "sphere" else "cylinder", 1e-3 * millimetres)


def make_pad(layer: LayerParameters, board: Board, magnetization: Float[Array, "cells cells 3"] | None = None) -> Pad:
    """Build the pad of a layer over a board.

    Args:
        layer: Parameters of the layer.
        board: The sensor board; all of its chips lie in one plane.
        magnetization: Magnetization map (A/m); by default none.

    Returns:
        The pad, with the nominal coefficient of friction.
    """
    turned = so3_exp(jnp.asarray(layer.board_rotation))
    chips = jnp.matmul(jnp.asarray(board.chips).at[:, 2].set(0.0), turned.T, precision="highest")
    shift = jnp.concatenate([layer.board_offset, -(layer.thickness + layer.gap)[None]])
    empty = jnp.zeros((MAP_CELLS, MAP_CELLS, 3)) if magnetization is None else magnetization
    return Pad(
        thickness=jnp.asarray(layer.thickness),
        young=jnp.asarray(layer.young),
        poisson=jnp.asarray(layer.poisson),
        magnetization=empty,
        gains=jnp.asarray(layer.gains),
        board=Board(chips + shift[None], jnp.matmul(turned, jnp.asarray(board.rotations), precision="highest")),
        friction=jnp.asarray(NOMINAL_SKIN.friction),
        mount_compliance=jnp.asarray(layer.mount_compliance),
    )


def cosine_basis() -> Float[np.ndarray, "cells m"]:
    """Compute the cosines in which magnetization maps are expanded along an edge, orthonormal and the slowest first.

    Returns:
        `(cells, m)` values at the map's cells, one column for each of m cosines (discrete cosine transform).
    """
    k, i = np.arange(MODES), np.arange(MAP_CELLS)
    waves = np.cos(np.pi * (i[:, None] + 0.5) * k / MAP_CELLS) * np.sqrt(2 / MAP_CELLS)
    return np.where(k == 0, waves / np.sqrt(2), waves).astype(np.float32)


def cosine_prior_factor(patch_length: Float[Array, ""], window: float) -> Float[Array, "m m"]:
    """Compute a Cholesky factor of the prior covariance of a magnetization map's cosine coefficients along an edge.

    The covariance is that of `i2t.skin.pad.smooth_random`.

    Args:
        patch_length: Correlation length of the patches (m).
        window: Edge of the pad (m).

    Returns:
        `(m, m)` lower factor.
    """
    at = (np.arange(MAP_CELLS) + 0.5) / MAP_CELLS * window
    scaled = (at[:, None] - at[None, :]) / patch_length
    waves = jnp.asarray(cosine_basis())
    covariance = waves.T @ (0.999 * jnp.exp(-0.5 * scaled**2) + 0.001 * jnp.eye(MAP_CELLS)) @ waves
    return jnp.linalg.cholesky(covariance + 1e-5 * jnp.eye(MODES))


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
    """Compute the reading of one press for each cosine of each component of the magnetization.

    Args:
        layer: Parameters of the layer.
        board: The sensor board.
        tip: The pressing tip.
        position: `(2,)` assumed position of the tip (m).
        load: Force (N) or travel (m).
        by_force: Whether the load is a force.
        grid: Cells of the pad.

    Returns:
        `(c, 3, m, m)` readings (uT) of 1 A/m: channels, components, cosines along y and along x.
    """
    pad = make_pad(layer, board)
    if isinstance(tip, RoundTip):
        tip = replace(tip, radius=tip.radius * layer.tip_scale)
    height = tip.height(position + layer.tip_offset, grid)
    if by_force:
        contact = solve_force(pad, height, jnp.maximum(load, 1e-3), grid)  # N; a force of zero has no solution
    else:
        contact = solve(pad, height, load - layer.contact_offset, grid)
    return pressure_design(pad, contact.pressure, grid)


def pressure_design(pad: Pad, pressure: Float[Array, "n n"], grid: Grid = GRID) -> Float[Array, "c 3 m m"]:
    """Compute the reading under a pressure for each cosine of each component of the magnetization.

    Args:
        pad: A skin; its own magnetization is ignored.
        pressure: `(n, n)` pressure (Pa) on its cells.
        grid: Cells of the pad.

    Returns:
        `(c, 3, m, m)` readings (uT) of 1 A/m: channels, components, cosines along y and along x.
    """
    loaded = elastic.load(pad, pressure, grid=grid)
    # The moments of magnetization 1 along one cosine in y and one in x are a product of the edges' moments (`sheets`).
    share, depths = _edge_moments(grid), sheets(pad, grid)[0]
    thick = pad.thickness * np.polynomial.legendre.leggauss(DIPOLE_SHEETS)[1] / 2
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")

    def sheet(at: tuple[Array, Array]) -> Array:
        depth, size = at
        displacement, rotation = elastic.interior(pad, loaded, depth, grid)
        rest = jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.broadcast_to(-depth, x.shape)])
        turned = jax.vmap(lambda axis: turn(rotation, jnp.broadcast_to(axis[:, None, None], rest.shape)))(jnp.eye(3))

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
    layer: LayerParameters,
    board: Board,
    tip: Tip,
    position: Float[Array, "n 2"],
    load: Float[Array, " n"],
    *,
    by_force: bool,
    grid: Grid = GRID,
) -> Float[Array, "n c 3 m m"]:
    """Compute `design_matrix` for many presses.

    Args:
        layer: Parameters of the layer.
        board: The sensor board.
        tip: The pressing tip; hashable.
        position: `(n, 2)` assumed positions (m).
        load: `(n,)` forces (N) or travels (m).
        by_force: Whether the loads are forces.
        grid: Cells of the pad.

    Returns:
        `(n, c, 3, m, m)` readings (uT) of 1 A/m for each press.
    """

    def design(press: tuple[Array, Array]) -> Array:
        return design_matrix(layer, board, tip, *press, by_force=by_force, grid=grid)

    return map_batches(design, (position, load), batch_size=DESIGN_BATCH)


def weight_features(layer: LayerParameters, designs: Float[Array, "n c 3 m m"], window: float) -> Float[Array, "n c k"]:
    """Compute the readings for each of k magnetization weights with prior variance 1.

    Args:
        layer: Strengths and length of the magnetization's patches.
        designs: `(n, c, 3, m, m)` design matrices.
        window: Edge of the pad (m).

    Returns:
        `(n, c, k)` readings (uT) of each weight: those of the patches, then three of the uniform part.
    """
    r = cosine_prior_factor(layer.patch_length, window)
    patches = jnp.einsum("nocab,ax,by,c->nocxy", designs, r, r, layer.patch_strength, precision="highest")
    level = designs[:, :, :, 0, 0] * (MAP_CELLS * layer.uniform_strength)  # the first cosines are 1 / sqrt(MAP_CELLS)
    return jnp.concatenate([patches.reshape(*designs.shape[:2], -1), level], axis=-1)


def _edge_moments(grid: Grid) -> Float[np.ndarray, "n m"]:
    """Compute the weights of the map's cosines in each cell along an edge, times the cell's width (`sheets`)."""
    cell = (2 * np.arange(grid.cells) + 1) * MAP_CELLS // (2 * grid.cells)
    return (cell_means(grid.cells).T @ cosine_basis()[cell] * grid.spacing).astype(np.float32)


def _dipole_tensor(point: Array, at: Float[Array, "3 n n"]) -> Float[Array, "3 3 n n"]:
    """Compute the field (T) at a point per moment (A m2) at each position."""
    d = point[:, None, None] - at
    inverse = jax.lax.rsqrt(jnp.sum(d**2, axis=0))
    along = d * inverse[None]
    return MU0_OVER_4PI * (3 * along[:, None] * along[None] - jnp.eye(3)[..., None, None]) * inverse[None, None] ** 3


def magnetization_map(
    layer: LayerParameters, weights: Float[Any, " k"], window: float
) -> Float[Array, "cells cells 3"]:
    """Compute the magnetization map from its weights, which have prior variance 1.

    Args:
        layer: Strengths and length of the magnetization's patches.
        weights: k weights in the order of `weight_features`.
        window: Edge of the pad (m).

    Returns:
        `(cells, cells, 3)` magnetization (A/m).
    """
    weights = jnp.float32(weights)
    patches, level = weights[:-3].reshape(3, MODES, MODES), weights[-3:]
    edge = jnp.matmul(cosine_basis(), cosine_prior_factor(layer.patch_length, window), precision="highest")
    patches = jnp.einsum("ia,jb,cab,c->ijc", edge, edge, patches, layer.patch_strength, precision="highest")
    return patches + layer.uniform_strength * level[None, None]
