"""Primitives, drawn as watertight triangle meshes in metres, and random ones. Needs manifold3d.

Primitives, each a function of sensible lengths in metres, are 50-70 mm across, so that the 20 mm skin meets faces,
edges and corners apart; prisms differ by their outline alone, which is the paper's recognition problem. The object
frame rests on z = 0, z up, centred in x and y; round faces are cut finely enough for the skin
(`i2t.objects.drawing.SAGITTA_MM`).
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
    """A regular prism, one flat side facing -y.

    Args:
        sides: How many.
        across: m, from corner to opposite corner (twice its circumradius).
        height: m.

    Returns:
        The mesh (m).
    """
    turn = -np.pi / 2 + np.pi / sides
    angles = turn + 2 * np.pi * np.arange(sides) / sides
    corners = 0.5 * across * MM_PER_M * np.stack([np.cos(angles), np.sin(angles)], -1)
    return mesh_from_solid(prism(outline(corners), height * MM_PER_M))


def parallelogram(width: float = 50e-3, depth: float = 40e-3, slant: float = 20e-3, height: float = 30e-3) -> Mesh:
    """A prism on a parallelogram.

    Args:
        width: m, of the sides along x.
        depth: m, between them.
        slant: m, by which one is shifted.
        height: m.

    Returns:
        The mesh (m).
    """
    w, d, s = width * MM_PER_M, depth * MM_PER_M, slant * MM_PER_M
    return mesh_from_solid(prism(outline([(0, 0), (w, 0), (w + s, d), (s, d)]), height * MM_PER_M))


def star(points: int = 5, across: float = 70e-3, waist: float = 0.5, height: float = 30e-3) -> Mesh:
    """A prism on a star.

    Args:
        points: How many tips.
        across: m, diameter of the circle on which the tips are.
        waist: That of the hollows, as a share of `across`.
        height: m.

    Returns:
        The mesh (m).
    """
    radii = 0.5 * across * MM_PER_M * np.where(np.arange(2 * points) % 2, waist, 1.0)
    return mesh_from_solid(prism(polar(radii), height * MM_PER_M))


def flower(petals: int = 6, across: float = 70e-3, relief: float = 0.15, height: float = 30e-3) -> Mesh:
    """A prism on the smooth outline r = R (1 + relief cos(petals angle)), R (1 + relief) = across / 2.

    Args:
        petals: How many.
        across: m.
        relief: As a share of R.
        height: m.

    Returns:
        The mesh (m).
    """
    angles = 2 * np.pi * np.arange(24 * petals) / (24 * petals)
    radii = 0.5 * across * MM_PER_M * (1 + relief * np.cos(petals * angles)) / (1 + relief)
    return mesh_from_solid(prism(polar(radii), height * MM_PER_M))


def cross(across: float = 60e-3, bar: float = 22e-3, height: float = 30e-3) -> Mesh:
    """A prism on a cross of two bars.

    Args:
        across: m, length of a bar.
        bar: m, its width.
        height: m.

    Returns:
        The mesh (m).
    """
    a, b = across * MM_PER_M, bar * MM_PER_M
    return mesh_from_solid(prism(rectangle(a, b) + rectangle(b, a), height * MM_PER_M))


def cylinder(diameter: float = 60e-3, height: float = 30e-3) -> Mesh:
    """A round disk.

    Args:
        diameter: m.
        height: m.

    Returns:
        The mesh (m).
    """
    return mesh_from_solid(prism(disk(0.5 * diameter * MM_PER_M), height * MM_PER_M))


def blob(seed: int, across: float = 65e-3, height: float = 30e-3, order: int = 5, relief: float = 0.2) -> Mesh:
    """A prism on a random smooth outline: a Fourier series of the radius whose terms 2 to `order` fall off as 1/k.

    Args:
        seed: Of the outline.
        across: m.
        height: m.
        order: Of the series.
        relief: Size of the terms, as a share of the radius.

    Returns:
        The mesh (m).
    """
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * np.arange(144) / 144
    k = np.arange(2, order + 1)[:, None]
    wave = (rng.normal(size=k.shape) / k * np.cos(k * angles + rng.uniform(0, 2 * np.pi, k.shape))).sum(0)
    radii = 1 + relief * wave / np.abs(wave).max()
    return mesh_from_solid(prism(polar(0.5 * across * MM_PER_M * radii / radii.max()), height * MM_PER_M))


def cone(bottom: float = 60e-3, top: float = 20e-3, height: float = 35e-3) -> Mesh:
    """A round frustum of two diameters.

    Args:
        bottom: m, the lower diameter.
        top: m, the upper.
        height: m.

    Returns:
        The mesh (m).
    """
    return mesh_from_solid(
        Manifold.cylinder(height * MM_PER_M, bottom * MM_PER_M / 2, top * MM_PER_M / 2, segments(bottom * MM_PER_M / 2))
    )


def pyramid(width: float = 60e-3, top: float = 15e-3, height: float = 35e-3) -> Mesh:
    """A square frustum.

    Args:
        width: m, of a side at the bottom.
        top: m, of a side at the top.
        height: m.

    Returns:
        The mesh (m).
    """
    base = rectangle(width * MM_PER_M, width * MM_PER_M)
    return mesh_from_solid(Manifold.extrude(base, height * MM_PER_M, scale_top=(top / width, top / width)))


def dome(diameter: float = 60e-3) -> Mesh:
    """A half ball, flat side down.

    Args:
        diameter: m.

    Returns:
        The mesh (m).
    """
    return mesh_from_solid(ball(0.5 * diameter * MM_PER_M).trim_by_plane((0, 0, 1), 0.0))


def ellipsoid(width: float = 70e-3, depth: float = 50e-3, height: float = 40e-3) -> Mesh:
    """An ellipsoid, lying.

    Args:
        width: m, along x.
        depth: m, along y.
        height: m, along z.

    Returns:
        The mesh (m).
    """
    axes = 0.5 * MM_PER_M * np.array([width, depth, height])
    return mesh_from_solid(ball(axes.max(), list(axes / axes.max())))


def torus(across: float = 68e-3, tube: float = 20e-3) -> Mesh:
    """The upper half of a ring with a round tube, flat side down.

    Args:
        across: m, the ring's outer diameter.
        tube: m, the tube's diameter.

    Returns:
        The mesh (m).
    """
    section = disk(0.5 * tube * MM_PER_M, (0.5 * (across - tube) * MM_PER_M, 0.0))
    ring = Manifold.revolve(section, segments(0.5 * across * MM_PER_M))
    return mesh_from_solid(ring.trim_by_plane((0, 0, 1), 0.0))


def wedge(width: float = 60e-3, depth: float = 50e-3, low: float = 10e-3, high: float = 35e-3) -> Mesh:
    """A block whose top rises along x.

    Args:
        width: m, along x.
        depth: m, along y.
        low: m, its height at one end.
        high: m, and at the other.

    Returns:
        The mesh (m).
    """
    side = outline([(0, 0), (width * MM_PER_M, 0), (width * MM_PER_M, high * MM_PER_M), (0, low * MM_PER_M)])
    return mesh_from_solid(prism(side, depth * MM_PER_M).rotate((90, 0, 0)))


def stairs(steps: int = 3, width: float = 60e-3, depth: float = 50e-3, height: float = 36e-3) -> Mesh:
    """Equal steps that rise along x.

    Args:
        steps: How many.
        width: m, along x.
        depth: m, along y.
        height: m, of the last.

    Returns:
        The mesh (m).
    """
    run, rise = width * MM_PER_M / steps, height * MM_PER_M / steps
    corners = [(run * (i + j), rise * (i + 1)) for i in range(steps) for j in (0, 1)]
    side = outline([(0, 0), *corners, (run * steps, 0)])
    return mesh_from_solid(prism(side, depth * MM_PER_M).rotate((90, 0, 0)))


def ridge(width: float = 60e-3, depth: float = 50e-3, height: float = 20e-3, radius: float = 12e-3) -> Mesh:
    """A block with a half round bar along y on its top.

    Args:
        width: m, along x.
        depth: m, along y.
        height: m, of the block.
        radius: m, of the bar.

    Returns:
        The mesh (m).
    """
    w, h, r = width * MM_PER_M, height * MM_PER_M, radius * MM_PER_M
    bar = disk(r, (0.0, h)) ^ rectangle(w, 2 * r, (0.0, h + r))
    return mesh_from_solid(prism(rectangle(w, h, (0.0, h / 2)) + bar, depth * MM_PER_M).rotate((90, 0, 0)))


def stamp(region: CrossSection) -> Mesh:
    """A relief on a stamp's base, pointing up.

    Args:
        region: mm, the outline of the relief.

    Returns:
        The mesh (m).
    """
    edge, height = STAMP_BASE_MM
    return mesh_from_solid(prism(rectangle(edge, edge), height) + prism(region, STAMP_RELIEF_MM + 1.0, height - 1.0))


def draw_random(seed: int) -> Object:
    """Draw a primitive of a random family and proportions, 50-72 mm across, up to 40 mm high.

    Args:
        seed: One seed, one object.

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
