"""Tips that press, and the few parameters of the pressed layer with their prior.

Metres, newtons, pascals, microtesla.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.skin.contact import MAX_HEIGHT_M
from i2t.skin.elasticity import GRID, Grid
from i2t.skin.pad import (
    CHIP_GAP_M,
    FRICTION_COEFFICIENT,
    MAGNETIZATION_A_PER_M,
    MAP_CELLS,
    MOUNT_COMPLIANCE_M_PER_N,
    POISSON_RATIO,
    THICKNESS_M,
    YOUNG_PA,
)
from i2t.types import Board, Pad

NOISE_PRIOR_UT = 2.0  # prior median of a reading's noise
MAGNETIZATION_STD = 0.7 * MAGNETIZATION_A_PER_M  # A/m, prior median: patches and the uniform part share the variance
# Parameters that change the design matrices; the others only scale what the matrices give.
DESIGN_PARAMETERS = ("thickness", "gap", "young", "contact_offset", "mount_compliance", "tip_offset")
# Parameters with a normal prior; the others cannot be negative and have a lognormal one.
NORMAL_PARAMETERS = ("contact_offset", "tip_offset")


@runtime_checkable
class Tip(Protocol):
    """Any tip whose surface over the skin is known."""

    def height(self, position: Float[Array, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Distance of the tip's surface behind its lowest point over each cell.

        Args:
            position: (2,) m, of the tip's axis on the skin.
            grid: Cells of the pad.

        Returns:
            (n, n) m, row along tool y; `MAX_HEIGHT_M` where the tip is not over the cell.
        """
        ...


@dataclass(frozen=True)
class RoundTip:
    """A sphere or the flat end of an upright cylinder.

    Attributes:
        shape: Which of them.
        radius: In metres.
    """

    shape: Literal["sphere", "cylinder"]
    radius: float

    def height(self, position: Float[Array, "2"] | Float[np.ndarray, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """Distance of the tip's surface behind its lowest point over each cell.

        Args:
            position: Of the tip's axis on the skin (m).
            grid: Cells of the pad.

        Returns:
            Heights (m), row along tool y; `MAX_HEIGHT_M` where the tip is not over the cell.
        """
        y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
        square = (x - position[0]) ** 2 + (y - position[1]) ** 2
        under = square < self.radius**2
        if self.shape == "cylinder":
            return jnp.where(under, 0.0, MAX_HEIGHT_M)
        return jnp.where(under, self.radius - jnp.sqrt(jnp.where(under, self.radius**2 - square, 1.0)), MAX_HEIGHT_M)


class LayerParameters(NamedTuple):
    """Parameters that readings are nonlinear in; also their standard deviations, and coordinates in the prior."""

    thickness: Float[Array, ""]  # m
    gap: Float[Array, ""]  # m, from the layer's base to the chips
    young: Float[Array, ""]  # Pa; only the prior's where presses are controlled by depth
    contact_offset: Float[Array, ""]  # m, first contact later than believed; zero where controlled by force
    mount_compliance: Float[Array, ""]  # m/N, of an edge-clamped skin
    tip_offset: Float[Array, "2"]  # m, of the tip from where it was believed
    patch_strength: Float[Array, "3"]  # A/m, of the map's patches along each axis
    uniform_strength: Float[Array, ""]  # A/m, of the uniform part
    patch_length: Float[Array, ""]  # m
    noise_std: Float[Array, ""]  # uT, of a reading, with all that the model leaves out


class LayerPrior(NamedTuple):
    """Prior of `LayerParameters`: normal for NORMAL_PARAMETERS, lognormal for all others."""

    median: LayerParameters
    std: LayerParameters  # of the parameter where the prior is normal, of its logarithm where it is lognormal


def layer_prior(
    thickness: float = THICKNESS_M + 0.5e-3, gap: float = CHIP_GAP_M, patch_length: float = 3e-3
) -> LayerPrior:
    """Prior that approximates `sample_pad`.

    A mounting compliance is lognormal although it is exactly 0 in bonded skins; one wide prior stands for both kinds.

    Args:
        thickness: Median thickness of the layer (m).
        gap: Median distance from the layer's base to the chips (m).
        patch_length: Median length of the magnetization's patches (m).

    Returns:
        Medians and standard deviations.
    """
    median = LayerParameters(
        thickness=jnp.asarray(thickness),
        gap=jnp.asarray(gap),
        young=jnp.asarray(YOUNG_PA),
        contact_offset=jnp.asarray(0.0),
        mount_compliance=jnp.asarray(0.3 * MOUNT_COMPLIANCE_M_PER_N),
        tip_offset=jnp.zeros(2),
        patch_strength=jnp.full(3, MAGNETIZATION_STD),
        uniform_strength=jnp.asarray(MAGNETIZATION_STD),
        patch_length=jnp.asarray(patch_length),
        noise_std=jnp.asarray(NOISE_PRIOR_UT),
    )
    std = LayerParameters(
        thickness=jnp.asarray(0.12),
        gap=jnp.asarray(0.17),
        young=jnp.asarray(0.15),
        contact_offset=jnp.asarray(1e-4),  # m
        mount_compliance=jnp.asarray(1.3),
        tip_offset=jnp.full(2, 3e-4),  # m
        patch_strength=jnp.full(3, 0.7),
        uniform_strength=jnp.asarray(0.7),
        patch_length=jnp.asarray(0.2),
        noise_std=jnp.asarray(1.0),
    )
    return LayerPrior(median, std)


def parameters_at(coordinates: LayerParameters, prior: LayerPrior) -> LayerParameters:
    """Parameters from their coordinates in the prior.

    Args:
        coordinates: Standard deviations from the median; their prior is normal with variance 1.
        prior: Medians and standard deviations.

    Returns:
        The parameters in their units.
    """

    def value(name: str) -> Array:
        median, std, at = (getattr(part, name) for part in (prior.median, prior.std, coordinates))
        return median + std * at if name in NORMAL_PARAMETERS else median * jnp.exp(std * at)

    return LayerParameters(**{name: value(name) for name in LayerParameters._fields})


def make_pad(layer: LayerParameters, board: Board, magnetization: Float[Array, "cells cells 3"] | None = None) -> Pad:
    """A pad of a layer over a board, whose chips keep their positions in the plane.

    Args:
        layer: Parameters of the layer.
        board: The sensor board, any number of chips.
        magnetization: Map (A/m); by default none.

    Returns:
        A pad with gains of 1.
    """
    chips = jnp.asarray(board.chips).at[:, 2].set(-(layer.thickness + layer.gap))
    empty = jnp.zeros((MAP_CELLS, MAP_CELLS, 3)) if magnetization is None else magnetization
    return Pad(
        thickness=jnp.asarray(layer.thickness),
        young=jnp.asarray(layer.young),
        poisson=jnp.asarray(POISSON_RATIO),
        magnetization=empty,
        gains=jnp.ones(3 * len(board.chips)),
        board=Board(chips, jnp.asarray(board.rotations)),
        friction=jnp.asarray(FRICTION_COEFFICIENT),
        mount_compliance=jnp.asarray(layer.mount_compliance),
    )
