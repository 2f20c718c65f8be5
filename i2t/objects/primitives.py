"""Primitives, drawn as watertight triangle meshes in metres, and random ones. Needs manifold3d.

Each primitive is a function of lengths in metres, whose defaults make it 50-70 mm across, so that the 20 mm skin can
meet its faces, edges and corners one at a time. Prisms differ in their outline only, which is the paper's recognition
problem. The object frame has z up and its origin on the bottom, in the middle of the bounding box. Round faces are cut
finely enough for the skin (`i2t.objects.drawing.segments`).
"""

from collections.abc import Callable

import numpy as np
from manifold3d import CrossSection, Manifold

from i2t.objects.drawing import (
    ball,
    disk,
    mesh_from_solid,
    outline,
    polar,
    prism,
    rectangle,
    segments,
)
from i2t.objects.solids import MM_PER_M, STAMP_BASE_MM, STAMP_RELIEF_MM, Mesh, Object


def polygon(sides: int, across: float = 60e-3, height: float = 30e-3) -> Mesh:
    """Make a regular prism with one flat side facing -y.

    Args:
        sides: The number of sides.
        across: The diameter (m) of the circle through the corners.
        height: The height (m).

    Returns:
        The mesh in metres, placed on the table.
    """
    turn = -np.pi / 2 + np.pi / sides
    angles = turn + 2 * np.pi * np.arange(sides) / sides
    corners = 0.5 * across * MM_PER_M * np.stack([np.cos(angles), np.sin(angles)], -1)
    return mesh_from_solid(prism(outline(corners), height * MM_PER_M))


def parallelogram(width: float = 50e-3, depth: float = 40e-3, slant: float = 20e-3, height: float = 30e-3) -> Mesh:
    """Make a prism on a parallelogram.

    Args:
        width: The length (m) of the sides along x.
        depth: The distance (m) between those sides.
        slant: The shift (m) of one of them along x.
        height: The height (m).

    Returns:
        The mesh in metres, placed on the table.
    """
    w, d, s = width * MM_PER_M, depth * MM_PER_M, slant * MM_PER_M
    return mesh_from_solid(prism(outline([(0, 0), (w, 0), (w + s, d), (s, d)]), height * MM_PER_M))


def star(points: int = 5, across: float = 70e-3, waist: float = 0.5, height: float = 30e-3) -> Mesh:
    """Make a prism on a star.

    Args:
        points: The number of tips.
        across: The diameter (m) of the circle through the tips.
        waist: The diameter of the circle through the inner corners, relative to `across`.
        height: The height (m).

    Returns:
        The mesh in metres, placed on the table.
    """
    radii = 0.5 * across * MM_PER_M * np.where(np.arange(2 * points) % 2, waist, 1.0)
    return mesh_from_solid(prism(polar(radii), height * MM_PER_M))


def flower(petals: int = 6, across: float = 70e-3, relief: float = 0.15, height: float = 30e-3) -> Mesh:
    """Make a prism on the smooth outline r = R (1 + relief cos(petals angle)), R (1 + relief) = across / 2.

    Args:
        petals: The number of petals.
        across: The diameter (m) of the circle through the tips of the petals.
        relief: The amplitude relative to R.
        height: The height (m).

    Returns:
        The mesh in metres, placed on the table.
    """
    angles = 2 * np.pi * np.arange(24 * petals) / (24 * petals)
    radii = 0.5 * across * MM_PER_M * (1 + relief * np.cos(petals * angles)) / (1 + relief)
    return mesh_from_solid(prism(polar(radii), height * MM_PER_M))


def cross(across: float = 60e-3, bar: float = 22e-3, height: float = 30e-3) -> Mesh:
    """Make a prism on a cross of two bars.

    Args:
        across: The length (m) of a bar.
        bar: The width (m) of a bar.
        height: The height (m).

    Returns:
        The mesh in metres, placed on the table.
    """
    a, b = across * MM_PER_M, bar * MM_PER_M
    return mesh_from_solid(prism(rectangle(a, b) + rectangle(b, a), height * MM_PER_M))


def cylinder(diameter: float = 60e-3, height: float = 30e-3) -> Mesh:
    """Make an upright cylinder.

    Args:
        diameter: The diameter (m).
        height: The height (m).

    Returns:
        The mesh in metres, placed on the table.
    """
    return mesh_from_solid(prism(disk(0.5 * diameter * MM_PER_M), height * MM_PER_M))


def blob(seed: int, across: float = 65e-3, height: float = 30e-3, order: int = 5, relief: float = 0.2) -> Mesh:
    """Make a prism on a random smooth outline.

    The radius is a Fourier series of the angle, whose terms k = 2 to `order` fall off as 1/k.

    Args:
        seed: The seed of the outline.
        across: Twice the largest radius (m).
        height: The height (m).
        order: The order of the series.
        relief: The amplitude of the series relative to the mean radius.

    Returns:
        The mesh in metres, placed on the table.
    """
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * np.arange(144) / 144
    k = np.arange(2, order + 1)[:, None]
    wave = (rng.normal(size=k.shape) / k * np.cos(k * angles + rng.uniform(0, 2 * np.pi, k.shape))).sum(0)
    radii = 1 + relief * wave / np.abs(wave).max()
    return mesh_from_solid(prism(polar(0.5 * across * MM_PER_M * radii / radii.max()), height * MM_PER_M))


def cone(bottom: float = 60e-3, top: float = 20e-3, height: float = 35e-3) -> Mesh:
    """Make a frustum of a cone.

    Args:
        bottom: The diameter (m) of the bottom.
        top: The diameter (m) of the top.
        height: The height (m).

    Returns:
        The mesh in metres, placed on the table.
    """
    return mesh_from_solid(
        Manifold.cylinder(height * MM_PER_M, bottom * MM_PER_M / 2, top * MM_PER_M / 2, segments(bottom * MM_PER_M / 2))
    )


def pyramid(width: float = 60e-3, top: float = 15e-3, height: float = 35e-3) -> Mesh:
    """Make a frustum of a square pyramid.

    Args:
        width: The side (m) of the bottom.
        top: The side (m) of the top.
        height: The height (m).

    Returns:
        The mesh in metres, placed on the table.
    """
    base = rectangle(width * MM_PER_M, width * MM_PER_M)
    return mesh_from_solid(Manifold.extrude(base, height * MM_PER_M, scale_top=(top / width, top / width)))


def dome(diameter: float = 60e-3) -> Mesh:
    """Make a half ball with its flat side down.

    Args:
        diameter: The diameter (m).

    Returns:
        The mesh in metres, placed on the table.
    """
    return mesh_from_solid(ball(0.5 * diameter * MM_PER_M).trim_by_plane((0, 0, 1), 0.0))


def ellipsoid(width: float = 70e-3, depth: float = 50e-3, height: float = 40e-3) -> Mesh:
    """Make an ellipsoid.

    Args:
        width: The length (m) along x.
        depth: The length (m) along y.
        height: The length (m) along z.

    Returns:
        The mesh in metres, placed on the table.
    """
    axes = 0.5 * MM_PER_M * np.array([width, depth, height])
    return mesh_from_solid(ball(axes.max(), list(axes / axes.max())))


def torus(across: float = 68e-3, tube: float = 20e-3) -> Mesh:
    """Make the upper half of a ring with a round tube, flat side down.

    Args:
        across: The outer diameter (m) of the ring.
        tube: The diameter (m) of the tube.

    Returns:
        The mesh in metres, placed on the table.
    """
    section = disk(0.5 * tube * MM_PER_M, (0.5 * (across - tube) * MM_PER_M, 0.0))
    ring = Manifold.revolve(section, segments(0.5 * across * MM_PER_M))
    return mesh_from_solid(ring.trim_by_plane((0, 0, 1), 0.0))


def wedge(width: float = 60e-3, depth: float = 50e-3, low: float = 10e-3, high: float = 35e-3) -> Mesh:
    """Make a block whose top rises along x.

    Args:
        width: The length (m) along x.
        depth: The length (m) along y.
        low: The height (m) at the lower end.
        high: The height (m) at the higher end.

    Returns:
        The mesh in metres, placed on the table.
    """
    side = outline([(0, 0), (width * MM_PER_M, 0), (width * MM_PER_M, high * MM_PER_M), (0, low * MM_PER_M)])
    return mesh_from_solid(prism(side, depth * MM_PER_M).rotate((90, 0, 0)))


def stairs(steps: int = 3, width: float = 60e-3, depth: float = 50e-3, height: float = 36e-3) -> Mesh:
    """Make stairs of equal steps that rise along x.

    Args:
        steps: The number of steps.
        width: The length (m) along x.
        depth: The length (m) along y.
        height: The height (m) of the last step.

    Returns:
        The mesh in metres, placed on the table.
    """
    run, rise = width * MM_PER_M / steps, height * MM_PER_M / steps
    corners = [(run * (i + j), rise * (i + 1)) for i in range(steps) for j in (0, 1)]
    side = outline([(0, 0), *corners, (run * steps, 0)])
    return mesh_from_solid(prism(side, depth * MM_PER_M).rotate((90, 0, 0)))


def ridge(width: float = 60e-3, depth: float = 50e-3, height: float = 20e-3, radius: float = 12e-3) -> Mesh:
    """Make a block with a half-round bar along y on its top.

    Args:
        width: The length (m) of the block along x.
        depth: The length (m) of the block along y.
        height: The height (m) of the block.
        radius: The radius (m) of the bar.

    Returns:
        The mesh in metres, placed on the table.
    """
    w, h, r = width * MM_PER_M, height * MM_PER_M, radius * MM_PER_M
    bar = disk(r, (0.0, h)) ^ rectangle(w, 2 * r, (0.0, h + r))
    return mesh_from_solid(prism(rectangle(w, h, (0.0, h / 2)) + bar, depth * MM_PER_M).rotate((90, 0, 0)))


def stamp(region: CrossSection) -> Mesh:
    """Make a stamp: a relief that points up, on the base of all stamps.

    Args:
        region: The outline of the relief, in millimetres.

    Returns:
        The mesh in metres, placed on the table.
    """
    edge, height = STAMP_BASE_MM
    return mesh_from_solid(prism(rectangle(edge, edge), height) + prism(region, STAMP_RELIEF_MM + 1.0, height - 1.0))


def draw_random(seed: int) -> Object:
    """Draw a primitive of a random family and random proportions, 50-72 mm across and up to 40 mm high.

    Args:
        seed: The seed, which determines the object.

    Returns:
        The object, named by its family and seed.
    """
    rng = np.random.default_rng(seed)
    across, height = rng.uniform(50e-3, 72e-3), rng.uniform(20e-3, 40e-3)

    def part(low: float, high: float) -> float:
        return across * rng.uniform(low, high)

    families: dict[str, Callable[[], Mesh]] = {
        "polygon": lambda: polygon(int(rng.integers(3, 9)), across, height),
        "parallelogram": lambda: parallelogram(part(0.6, 0.75), part(0.5, 0.9), part(0.1, 0.3), height),
        "star": lambda: star(int(rng.integers(3, 8)), across, rng.uniform(0.45, 0.75), height),
        "flower": lambda: flower(int(rng.integers(3, 8)), across, rng.uniform(0.06, 0.2), height),
        "cross": lambda: cross(across, part(0.25, 0.5), height),
        "blob": lambda: blob(int(rng.integers(2**31)), across, height, int(rng.integers(3, 8)), rng.uniform(0.1, 0.3)),
        "cylinder": lambda: cylinder(across, height),
        "cone": lambda: cone(across, part(0.1, 0.7), height),
        "pyramid": lambda: pyramid(0.85 * across, part(0.1, 0.6), height),
        "dome": lambda: dome(across),
        "ellipsoid": lambda: ellipsoid(across, part(0.6, 0.95), height),
        "torus": lambda: torus(across, part(0.2, 0.32)),
        "wedge": lambda: wedge(across, part(0.7, 1.0), rng.uniform(0.2, 0.6) * height, height),
        "stairs": lambda: stairs(int(rng.integers(2, 5)), across, part(0.7, 1.0), height),
        "ridge": lambda: ridge(across, part(0.7, 1.0), 0.6 * height, rng.uniform(0.2, 0.55) * height),
    }
    family = list(families)[rng.integers(len(families))]
    return Object(f"{family}-{seed}", families[family](), "primitive")
