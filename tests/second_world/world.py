"""A skin and an arm that share nothing with i2t's simulator, in NumPy and double precision.

They answer what a simulation cannot ask of itself: does a method work only because it was built with the same physics?
Nothing in i2t may be chosen by it.

  contact    a Pasternak foundation: springs that stiffen as foam does, under a membrane that pulls neighbours along
             (Pasternak 1954; Kerr, J. Appl. Mech. 31, 1964), solved by projected relaxation. i2t presses an elastic
             layer, whose pressure at a point deflects all others.
  magnet     some hundred dipoles at random places of the layer, which the layer carries along. i2t's are magnetised
             poles.

A press ends at a force drawn anew for each touch. Frames and signs are those of i2t (tool z into the object). Camera
and arm make no errors; the sensor's noise and a force gauge's stay.
"""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

CELLS, EDGE_M = 34, 17e-3  # of the skin's square
PIXELS = 24  # of a depth patch
CHIP_M = 7e-3  # the outer chips lie so far from the middle one
RELAXATIONS, BISECTIONS = 150, 13
MAX_SLOPE_DEG = 50.0  # of a site from the vertical
RAYS_FROM_M = 30e-3  # behind the tool's plane
REACH_M = 4e-3  # to which a patch is seen
NOISE_UT, FORCE_NOISE_N = 1.5, 0.1


class ReferenceSkin(NamedTuple):
    """A foundation of springs that carries magnets."""

    stiffness: float  # Pa/m, of a spring at rest
    thickness: float  # m
    tension: float  # N/m, of the membrane
    magnets: np.ndarray  # (k, 3) m, z from 0 at the surface to minus the thickness
    moments: np.ndarray  # (k, 3) A m^2
    chips: np.ndarray  # (5, 3) m


class WorldTouches(NamedTuple):
    """Records of touches."""

    patch: np.ndarray  # (n, p, p) m behind the nearest point
    force: np.ndarray  # (n,) N along tool z, positive when pressing
    reading: np.ndarray  # (n, 15) uT in contact, less the ambient


def make_skin(rng: np.random.Generator) -> ReferenceSkin:
    """A random skin, whose readings change by some tens of microtesla per newton."""
    thickness = rng.uniform(2e-3, 3e-3)
    magnets = np.c_[rng.uniform(-0.5, 0.5, (600, 2)) * EDGE_M, -thickness * rng.uniform(0.05, 0.95, 600)]
    patches = rng.normal(size=(5, 5, 3))  # regions that were magnetised alike
    where = np.clip(((magnets[:, :2] / EDGE_M + 0.5) * 5).astype(int), 0, 4)
    moments = 6e-7 * (patches[where[:, 0], where[:, 1]] + 0.5 * rng.normal(size=(600, 3)))
    below = -thickness - 1.5e-3
    chips = np.array(
        [[0, 0, below], *([x, y, below] for x, y in np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]) * CHIP_M)]
    )
    return ReferenceSkin(
        rng.uniform(0.8e7, 2.5e7), thickness, rng.uniform(10, 40), magnets, moments, chips
    )  # fmt: skip


def make_objects() -> dict[str, trimesh.Trimesh]:
    """Objects of some centimetres that stand on z = 0."""
    creation = trimesh.creation
    lying = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    meshes = {
        "block": creation.box((0.05, 0.035, 0.03)),
        "rod": creation.cylinder(0.008, 0.06, sections=48, transform=lying),
        "cone": creation.cone(0.024, 0.022, sections=48),
        "ring": creation.torus(0.018, 0.006, major_sections=48, minor_sections=24),
        "wedge": trimesh.convex.convex_hull(
            np.array([[x, y, z] for x in (-0.025, 0.025) for y, z in ((-0.018, 0), (0.018, 0), (0.0, 0.018))])
        ),
        "capsule": creation.capsule(0.04, 0.012, transform=lying),
        "stick": creation.box((0.07, 0.012, 0.02)),
    }
    for mesh in meshes.values():
        mesh.apply_translation(-np.r_[mesh.bounds.mean(0)[:2], mesh.bounds[0, 2]])
    return meshes


def touch(rng: np.random.Generator, mesh: trimesh.Trimesh, skin: ReferenceSkin, n: int) -> WorldTouches:
    """n touches of an object."""
    made: list[tuple[np.ndarray, ...]] = []
    while len(made) < n:
        T_o_t = _site(rng, mesh)
        met = _heights(mesh, T_o_t, CELLS)
        nearest, force = met.min(), rng.uniform(1.0, 6.0)
        if not np.isfinite(nearest):
            continue
        seen = _heights(mesh, T_o_t, PIXELS)
        _, sinking = press(skin, met - nearest, force)
        felt = field(skin, sinking) - field(skin, np.zeros_like(sinking))
        made.append((
            np.minimum(seen - seen.min(), REACH_M), np.array(force + rng.normal(0, FORCE_NOISE_N)),
            felt + rng.normal(0, NOISE_UT, 15),
        ))  # fmt: skip
    return WorldTouches(*(np.stack(values) for values in zip(*made, strict=True)))


# --- skin ---


def press(skin: ReferenceSkin, heights: np.ndarray, force: float) -> tuple[float, np.ndarray]:
    """Indentation (m) at which the springs push with a force, and how far they give (cells, cells) m.

    Heights (m) are those of the surface over its nearest point, infinite where there is none.
    """
    heights = np.minimum(heights, 1.0)
    low, high, below = 0.0, 0.9 * skin.thickness, np.zeros_like(heights)
    for _ in range(BISECTIONS):
        indentation = (low + high) / 2
        given = _relaxed(skin, indentation - heights, below)
        if _spring(skin, given).sum() * (EDGE_M / CELLS) ** 2 < force:
            low, below = indentation, given
        else:
            high = indentation
    return low, below


def _spring(skin: ReferenceSkin, given: np.ndarray) -> np.ndarray:
    """Pressure (Pa) of springs that stiffen towards the end of the layer."""
    return skin.stiffness * given / (1 - np.minimum(given / skin.thickness, 0.95)) ** 2


def _relaxed(skin: ReferenceSkin, least: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Deflection under an obstacle that enforces at least `least`, by projected relaxation from a smaller one."""
    cell = EDGE_M / CELLS
    given = np.maximum(start, least)
    for _ in range(RELAXATIONS):
        edged = np.pad(given, 1, mode="edge")
        around = edged[2:, 1:-1] + edged[:-2, 1:-1] + edged[1:-1, 2:] + edged[1:-1, :-2]
        secant = skin.stiffness / (1 - np.minimum(given / skin.thickness, 0.95)) ** 2
        given = np.clip(
            skin.tension * around / cell**2 / (4 * skin.tension / cell**2 + secant),
            np.maximum(least, 0), 0.95 * skin.thickness,
        )  # fmt: skip
    return given


def field(skin: ReferenceSkin, given: np.ndarray) -> np.ndarray:
    """Field (15,) uT of the carried magnets at the chips."""
    cell = EDGE_M / CELLS
    slope_y, slope_x = np.gradient(given, cell)
    at = skin.magnets[:, [1, 0]].T / cell + (CELLS - 1) / 2  # rows along y
    indentation, tilt_x, tilt_y = (
        map_coordinates(values, at, order=1, mode="nearest") for values in (given, slope_x, slope_y)
    )
    share = 1 + skin.magnets[:, 2] / skin.thickness  # 1 at the surface, 0 at the board
    bulge = 0.3 * skin.thickness * share * (1 - share) * 4
    moved = skin.magnets + np.c_[bulge * tilt_x, bulge * tilt_y, -share * indentation]
    apart = skin.chips[:, None] - moved[None]
    distance = np.linalg.norm(apart, axis=-1, keepdims=True)
    along = np.sum(apart * skin.moments, axis=-1, keepdims=True) / distance**2
    return 1e6 * np.sum(1e-7 * (3 * along * apart - skin.moments) / distance**3, axis=1).ravel()


# --- arm ---


def _heights(mesh: trimesh.Trimesh, T_o_t: np.ndarray, cells: int) -> np.ndarray:
    """Distance (m) of the object from the tool's plane along tool z, over the skin's square; infinite beside it."""
    across = ((np.arange(cells) + 0.5) / cells - 0.5) * EDGE_M
    x, y = np.meshgrid(across, across)
    origins = np.stack([x, y, np.full_like(x, -RAYS_FROM_M)], -1).reshape(-1, 3) @ T_o_t[:3, :3].T + T_o_t[:3, 3]
    along = np.tile(T_o_t[:3, 2], (len(origins), 1))
    points, rays, _ = mesh.ray.intersects_location(origins, along, multiple_hits=False)
    found = np.full(len(origins), np.inf)
    np.minimum.at(found, rays, ((points - origins[rays]) * along[rays]).sum(-1))
    return found.reshape(x.shape) - RAYS_FROM_M


def _site(rng: np.random.Generator, mesh: trimesh.Trimesh) -> np.ndarray:
    """Tool pose (4, 4) on a random point that is not too steep, with a random rotation about its normal."""
    gentle = mesh.face_normals[:, 2] >= np.cos(np.radians(MAX_SLOPE_DEG))
    points, faces = trimesh.sample.sample_surface(
        mesh, 1, face_weight=np.where(gentle, mesh.area_faces, 0.0), seed=int(rng.integers(2**31))
    )
    normal = mesh.face_normals[faces[0]]
    down, _ = Rotation.align_vectors([-normal], [[0.0, 0.0, 1.0]])
    T = np.eye(4)
    T[:3, :3] = (down * Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))).as_matrix()
    T[:3, 3] = points[0]
    return T
