"""Watertight solids from outlines, by which primitives are drawn.

Solids are drawn in millimetres as manifold3d values (`a + b` is the union, `a - b` the difference), whose booleans keep
a mesh closed. `mesh_from_solid` converts one to metres.
"""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

from i2t.objects.solids import Mesh, place_on_table

Real: TypeAlias = float | int  # a number of a drawing


def mesh_from_solid(solid: Manifold) -> Mesh:
    """Convert a manifold3d solid to a mesh.

    Args:
        solid: The solid, drawn in millimetres.

    Returns:
        Its mesh in metres, placed on the table.
    """
    drawn = solid.to_mesh64()
    vertices = np.asarray(drawn.vert_properties, np.float64)[:, :3] * 1e-3
    return place_on_table(Mesh(vertices, np.asarray(drawn.tri_verts).astype(np.int32)))


def segments(radius: Real, sagitta: Real = 0.03) -> int:
    """Compute the number of chords that replace a circle, n = pi / acos(1 - sagitta / radius), rounded up.

    Args:
        radius: The radius (mm).
        sagitta: The largest distance (mm) between a chord and its arc; 0.03 is a tenth of a usual indentation of the
            skin.

    Returns:
        The number of chords, a multiple of four and at least eight.
    """
    return max(8, 4 * math.ceil(math.pi / math.acos(1 - sagitta / max(radius, 2 * sagitta)) / 4))


def outline(points: Sequence[Sequence[Real]] | NDArray) -> CrossSection:
    """Make the region inside a closed polygon that does not cross itself.

    Args:
        points: `(n, 2)` corners (mm), in either direction.

    Returns:
        The region inside the polygon.
    """
    corners = np.asarray(points, np.float64)
    x, y = corners.T
    area = float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return CrossSection([corners if area > 0 else corners[::-1]])


def polar(radii: NDArray) -> CrossSection:
    """Make the region inside a closed curve that is given by its radii.

    Args:
        radii: `(n,)` radii (mm), at equally spaced angles from the x axis.

    Returns:
        The region inside the curve.
    """
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    return outline(np.stack([radii * np.cos(angles), radii * np.sin(angles)], -1))


def disk(radius: Real, centre: tuple[Real, Real] = (0.0, 0.0)) -> CrossSection:
    """Make a circular region.

    Args:
        radius: The radius (mm).
        centre: The centre's x and y (mm).

    Returns:
        The region inside the circle.
    """
    return CrossSection.circle(radius, segments(radius)).translate(centre)


def rectangle(width: Real, depth: Real, centre: tuple[Real, Real] = (0.0, 0.0)) -> CrossSection:
    """Make a rectangular region.

    Args:
        width: The length (mm) along x.
        depth: The length (mm) along y.
        centre: The centre's x and y (mm).

    Returns:
        The region inside the rectangle.
    """
    return CrossSection.square((width, depth), center=True).translate(centre)


def prism(region: CrossSection, height: Real, base: Real = 0.0) -> Manifold:
    """Extrude a region upwards.

    Args:
        region: The region, in millimetres.
        height: The height of the prism (mm).
        base: z (mm) of the prism's bottom.

    Returns:
        The prism, in millimetres.
    """
    return Manifold.extrude(region, height).translate((0, 0, base))


def ball(radius: Real, scale: Sequence[Real] = (1.0, 1.0, 1.0)) -> Manifold:
    """Make a sphere, or an ellipsoid along the axes.

    Args:
        radius: The radius (mm) before scaling.
        scale: The factors along x, y and z.

    Returns:
        The solid, in millimetres, centred at the origin.
    """
    return Manifold.sphere(radius, segments(radius)).scale(tuple(scale))
