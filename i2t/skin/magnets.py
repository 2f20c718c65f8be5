"""Discrete magnets: readings of the chips when solid magnets inside a soft lattice are moved and rotated (eFlesh).

A magnet is a cylinder of radius a and height 2b, magnetised by M along its axis, which is equivalent to a sheet of
current M around its side (Jackson, Classical Electrodynamics, section 5.8). Along the axis Biot and Savart's integral
is elementary. With e the unit vector to the sheet at the angle t, p and z the point's distances off and along the axis,
R = |p - a e|, z+- = z +- b and D+- = sqrt(R^2 + z+-^2),

    B_side = mu0 M a / (4 pi) integral e (1 / D- - 1 / D+) dt
    B_axis = mu0 M a / (4 pi) integral (a - p . e) (z+ / D+ - z- / D-) / R^2 dt

Derby and Olbert (Am. J. Phys. 78, 229, 2010) reduce these to elliptic integrals. Here they are evaluated by the
trapezoidal rule, whose error for periodic integrands is about (1 + d / a)^-N with N nodes at the distance d from the
magnet's surface (Trefethen and Weideman, SIAM Review 56, 2014): 64 nodes give 4e-5 at d = a / 6, and rounding error
from a / 4 on. Both differences, which would cancel far away, are rewritten as quotients, so that single precision is
enough, also on the axis.

Tool frame; metres, A/m, tesla; readings in microtesla in the board's order and the chips' own axes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t import geometry
from i2t.skin.dipoles import MICROTESLA, MU0_OVER_4PI
from i2t.types import Board

CYLINDER_NODES = 64  # number of nodes of the integral around a cylindrical magnet


class Magnets(NamedTuple):
    """k hard cylinder magnets in the tool frame: positions, rotations, radii, heights (m) and magnetizations (A/m)."""

    positions: Float[Array, "k 3"]  # m, positions of the magnets' centres
    # rotations from a magnet's own axes, in which it is magnetised along z, to tool axes
    rotations: Float[Array, "k 3 3"]
    radii: Float[Array, " k"]  # m
    heights: Float[Array, " k"]  # m
    magnetizations: Float[Array, " k"]  # A/m, magnetizations: remanence over mu0, negative for a magnet upside down


def cylinder_field(
    point: Float[Array, "3"],
    radius: Float[Array, ""] | float,
    height: Float[Array, ""] | float,
    magnetization: Float[Array, ""] | float,
    nodes: int = CYLINDER_NODES,
) -> Float[Array, "3"]:
    """Compute the flux density of one cylinder magnet centred at the origin, in the magnet's own axes, also inside it.

    Args:
        point: `(3,)` point (m).
        radius: Radius of the cylinder (m).
        height: Height of the cylinder (m).
        magnetization: Magnetization along the axis (A/m).
        nodes: Number of nodes of the integral around the cylinder.

    Returns:
        `(3,)` flux density (T); not finite on the curved surface.
    """
    angles = 2 * np.pi * np.arange(nodes) / nodes
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y, z = point
    across = x * cosine + y * sine
    square = (x - radius * cosine) ** 2 + (y - radius * sine) ** 2
    top, bottom = z + height / 2, z - height / 2
    far, near = jnp.sqrt(square + top**2), jnp.sqrt(square + bottom**2)

    # 1 / D- - 1 / D+, and z+ / D+ - z- / D- over R^2. Beyond the ends both z have the same sign, and R^2 cancels.
    change = 2 * z * height
    side = change / (far * near * (far + near))
    beyond = top * bottom > 0
    mixed = jnp.where(beyond, far * near * (top * near + bottom * far), 1.0)
    between = (top / far - bottom / near) / jnp.where(beyond, 1.0, square)
    axial = (radius - across) * jnp.where(beyond, change / mixed, between)
    integrals = jnp.stack([jnp.mean(cosine * side), jnp.mean(sine * side), jnp.mean(axial)])
    return 2 * np.pi * MU0_OVER_4PI * magnetization * radius * integrals


@geometry.full_precision
def field(points: Float[Array, "m 3"], magnets: Magnets, nodes: int = CYLINDER_NODES) -> Float[Array, "m 3"]:
    """Compute the flux density of all magnets together.

    Args:
        points: `(m, 3)` points (m) in the tool frame.
        magnets: Magnets in the tool frame.
        nodes: Number of nodes of the integral around each magnet.

    Returns:
        `(m, 3)` flux density (T) in tool axes.
    """

    def field_of(point: Array, magnet: Magnets) -> Array:
        local = magnet.rotations.T @ (point - magnet.positions)
        own = cylinder_field(local, magnet.radii, magnet.heights, magnet.magnetizations, nodes)
        return magnet.rotations @ own

    return jnp.sum(jax.vmap(jax.vmap(field_of, (None, 0)), (0, None))(points, magnets), axis=1)


@geometry.full_precision
def move(magnets: Magnets, displacement: Float[Array, "k 3"], rotation: Float[Array, "k 3"]) -> Magnets:
    """Displace and rotate magnets, each about its own centre.

    Args:
        magnets: The k magnets at rest.
        displacement: `(k, 3)` displacements (m) in tool axes.
        rotation: `(k, 3)` rotation vectors (rad) in tool axes.

    Returns:
        The moved magnets.
    """
    return magnets._replace(
        positions=magnets.positions + displacement,
        rotations=jax.vmap(geometry.so3_exp)(rotation) @ magnets.rotations,
    )


def response(
    board: Board,
    magnets: Magnets,
    displacement: Float[Array, "k 3"],
    rotation: Float[Array, "k 3"],
    nodes: int = CYLINDER_NODES,
) -> Float[Array, " c"]:
    """Compute a board's noise-free reading of magnets moved from rest: the change of the field at the chips.

    Args:
        board: The board that measures the field.
        magnets: The k magnets at rest.
        displacement: `(k, 3)` displacements (m) in tool axes.
        rotation: `(k, 3)` rotation vectors (rad) in tool axes.
        nodes: Number of nodes of the integral around each magnet.

    Returns:
        `(c,)` reading (uT).
    """
    chips = jnp.asarray(board.chips)
    change = field(chips, move(magnets, displacement, rotation), nodes) - field(chips, magnets, nodes)
    return MICROTESLA * board.to_board(change)
