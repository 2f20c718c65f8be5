"""Watertight solids from outlines: the small vocabulary in which primitives are drawn.

Solids are drawn in millimetres as manifold3d values (`a + b` union, `a - b` difference), whose booleans keep a mesh
closed; `mesh_from_solid` turns one into metres. A curve of radius r is cut into so many segments that its chords stay
within `SAGITTA_MM` of it, a tenth of a usual indentation of the skin: n = pi / acos(1 - SAGITTA / r).
"""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

from i2t.objects.solids import Mesh, place_on_table

Real: TypeAlias = float | int  # of a drawing

SAGITTA_MM = 0.03  # between a chord and its arc


def mesh_from_solid(solid: Manifold) -> Mesh:
    """Turn a solid into a mesh.

    Args:
        solid: Drawn in millimetres.

    Returns:
        Its mesh in metres, placed on the table.
    """
    drawn = solid.to_mesh64()
    vertices = np.asarray(drawn.vert_properties, np.float64)[:, :3] * 1e-3
    return place_on_table(Mesh(vertices, np.asarray(drawn.tri_verts).astype(np.int32)))


def segments(radius: Real) -> int:
    """Number of chords that replace a circle within `SAGITTA`.

    Args:
        radius: mm.

    Returns:
        The number, a multiple of four and at least eight.
    """
    return max(8, 4 * math.ceil(math.pi / math.acos(1 - SAGITTA_MM / max(radius, 2 * SAGITTA_MM)) / 4))


def outline(points: Sequence[Sequence[Real]] | NDArray) -> CrossSection:
    """The region inside a closed polygon that does not cross itself, in either direction.

    Args:
        points: (n, 2) mm.

    Returns:
        The region.
    """
    corners = np.asarray(points, np.float64)
    x, y = corners.T
    area = float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return CrossSection([corners if area > 0 else corners[::-1]])


def polar(radii: NDArray) -> CrossSection:
    """The region inside a closed curve given by its radii.

    Args:
        radii: (n,) mm, at equally spaced angles from the x axis.

    Returns:
        The region.
    """
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    return outline(np.stack([radii * np.cos(angles), radii * np.sin(angles)], -1))


def disk(radius: Real, centre: tuple[Real, Real] = (0.0, 0.0)) -> CrossSection:
    """A circle.

    Args:
        radius: mm.
        centre: mm.

    Returns:
        The region.
    """
    return CrossSection.circle(radius, segments(radius)).translate(centre)


def rectangle(width: Real, depth: Real, centre: tuple[Real, Real] = (0.0, 0.0)) -> CrossSection:
    """A rectangle.

    Args:
        width: mm, along x.
        depth: mm, along y.
        centre: mm.

    Returns:
        The region.
    """
    return CrossSection.square((width, depth), center=True).translate(centre)


def prism(region: CrossSection, height: Real, base: Real = 0.0) -> Manifold:
    """Extrude a region upwards.

    Args:
        region: mm.
        height: mm.
        base: mm, z at which it begins.

    Returns:
        The solid.
    """
    return Manifold.extrude(region, height).translate((0, 0, base))


def ball(radius: Real, scale: Sequence[Real] = (1.0, 1.0, 1.0)) -> Manifold:
    """A sphere, or an ellipsoid along the axes.

    Args:
        radius: mm.
        scale: Factors along the axes.

    Returns:
        The solid.
    """
    return Manifold.sphere(radius, segments(radius)).scale(tuple(scale))
