"""A skin, a camera and an arm that share nothing with i2t's simulator, in NumPy and double precision.

It answers what a simulation cannot ask of itself: does a method work only because it was built with the same physics?
Nothing in i2t may be chosen by it.

  contact    a Pasternak foundation: springs that stiffen as foam does, under a membrane that pulls neighbours along
             (Pasternak 1954; Kerr, J. Appl. Mech. 31, 1964), solved by projected relaxation. i2t presses an elastic
             layer, whose pressure at a point deflects all others.
  magnet     some hundred dipoles at random places of the layer, which the layer carries along. i2t's are magnetised
             poles.
  camera     a pinhole: rays from one point, depth in whole millimetres. i2t's is orthographic.
  errors     of placement, hand-eye, arm and sensor, drawn by NumPy.

A press ends at a force drawn anew for each touch. Frames and signs are those of i2t (tool z into the object).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

CELLS, EDGE_M = 34, 17e-3  # of the skin's square
PIXELS = 48  # of a depth image, cropped to what lies before the skin
CAMERA_BEHIND_M = 64e-3  # of the tool's origin
LOOK_M = 40e-3  # before the contact, where the camera looks
CHIP_M = 7e-3  # the outer chips lie so far from the middle one
RELAXATIONS, BISECTIONS = 150, 13
MAX_SLOPE_DEG = 50.0  # of a site from the vertical
RAYS_FROM_M = 30e-3  # behind the tool's plane, for what the skin meets


@dataclass(frozen=True)
class WorldErrors:
    """Errors of a world, one standard deviation each."""

    placement: float = 1e-3  # m, of an object in a session
    placement_angle: float = np.radians(1.0)
    hand_eye: float = 1e-3  # m, in a session
    arm: float = 5e-5  # m, of a touch
    approach_angle: float = np.radians(0.3)
    depth: float = 0.5e-3  # m, of a pixel; neighbours err alike
    depth_step: float = 1e-3  # m, of the camera's numbers
    force: float = 0.1  # N
    reading: float = 1.5  # uT, of a sample
    drift: float = 0.5  # uT, of every chip axis from touch to touch

    @classmethod
    def none(cls) -> "WorldErrors":
        """A lab whose camera and arm know everything; the sensor's noise stays."""
        return cls(placement=0, placement_angle=0, hand_eye=0, arm=0, approach_angle=0, depth=0, depth_step=1e-5)


class ReferenceSkin(NamedTuple):
    """A foundation with magnets in it."""

    stiffness: float  # Pa/m, of a spring at rest
    thickness: float  # m
    tension: float  # N/m, of the membrane
    magnets: np.ndarray  # (k, 3) m, z from 0 at the surface to minus the thickness
    moments: np.ndarray  # (k, 3) A m^2
    chips: np.ndarray  # (5, 3) m


class WorldTouches(NamedTuple):
    """Records of one session in a lab."""

    image: np.ndarray  # (n, 48, 48) m, depth from the camera
    T_w_t: np.ndarray  # (n, 4, 4) at the end of the press, as the arm reports it
    force: np.ndarray  # (n,) N along tool z, positive when pressing
    samples: np.ndarray  # (n, 15) uT in contact
    ambient: np.ndarray  # (n, 15) uT before


def make_skin(rng: np.random.Generator) -> ReferenceSkin:
    """A random skin, whose readings change by some tens of microtesla at a newton."""
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
    angles = np.arange(10) * np.pi / 5
    star = np.c_[np.cos(angles), np.sin(angles)] * np.where(np.arange(10) % 2, 11e-3, 24e-3)[:, None]
    lying = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    meshes = {
        "block": creation.box((0.05, 0.035, 0.03)),
        "nut": creation.cylinder(0.02, 0.03, sections=6),
        "rod": creation.cylinder(0.008, 0.06, sections=48, transform=lying),
        "cone": creation.cone(0.024, 0.022, sections=48),
        "ring": creation.torus(0.018, 0.006, major_sections=48, minor_sections=24),
        "wedge": trimesh.convex.convex_hull(
            np.array([[x, y, z] for x in (-0.025, 0.025) for y, z in ((-0.018, 0), (0.018, 0), (0.0, 0.018))])
        ),
        "star": _prism(star, 0.03),
        "capsule": creation.capsule(0.04, 0.012, transform=lying),
        "stick": creation.box((0.07, 0.012, 0.02)),
    }
    for mesh in meshes.values():
        mesh.apply_translation(-np.r_[mesh.bounds.mean(0)[:2], mesh.bounds[0, 2]])
    return meshes


def simulate_session(
    rng: np.random.Generator, mesh: trimesh.Trimesh, skin: ReferenceSkin, errors: WorldErrors, n: int
) -> WorldTouches:
    """n touches of an object that is placed once."""
    placed = _moved(rng, errors.placement, errors.placement_angle)
    hand_eye = _moved(rng, errors.hand_eye, 0.0)
    zero = rng.normal(0, 40, 15)
    made: list[tuple[np.ndarray, ...]] = []
    while len(made) < n:
        zero = zero + rng.normal(0, errors.drift, 15)
        touch = _touch(rng, mesh, skin, errors, placed=placed, hand_eye=hand_eye, zero=zero)
        if touch is not None:
            made.append(touch)
    return WorldTouches(*(np.stack(values) for values in zip(*made, strict=True)))


def _touch(
    rng: np.random.Generator,
    mesh: trimesh.Trimesh,
    skin: ReferenceSkin,
    errors: WorldErrors,
    *,
    placed: np.ndarray,
    hand_eye: np.ndarray,
    zero: np.ndarray,
) -> tuple[np.ndarray, ...] | None:
    """Image, pose, force, samples and ambient; None where the tool meets nothing."""
    believed = _site(rng, mesh)
    true = np.linalg.inv(placed) @ believed @ _moved(rng, errors.arm, errors.approach_angle)  # in the object's frame
    heights = _cast(mesh, true, -RAYS_FROM_M, *_cell_centres()) - RAYS_FROM_M
    nearest = np.min(heights)
    if not np.isfinite(nearest):
        return None
    force = rng.uniform(1.0, 6.0)
    depth, sinking = press(skin, heights - nearest, force)
    advance = nearest + depth
    look = true @ _along_z(advance - LOOK_M - CAMERA_BEHIND_M) @ hand_eye
    image = photograph(rng, mesh, look, errors)
    felt = field(skin, sinking) - field(skin, np.zeros_like(sinking))
    noise = rng.normal(0, errors.reading, (2, 15))
    return (
        image, believed @ _along_z(advance), np.array(force + rng.normal(0, errors.force)),
        zero + felt + noise[0], zero + noise[1],
    )  # fmt: skip


# --- skin ---


def press(skin: ReferenceSkin, heights: np.ndarray, force: float) -> tuple[float, np.ndarray]:
    """Depth (m) to which a surface sinks until the springs push with a force, and how far they give (cells, cells) m.

    Heights (m) are those of the surface over its nearest point, infinite where there is none.
    """
    heights = np.minimum(heights, 1.0)
    low, high, below = 0.0, 0.9 * skin.thickness, np.zeros_like(heights)
    for _ in range(BISECTIONS):
        depth = (low + high) / 2
        given = _relaxed(skin, depth - heights, below)
        if _spring(skin, given).sum() * (EDGE_M / CELLS) ** 2 < force:
            low, below = depth, given
        else:
            high = depth
    return low, below


def _spring(skin: ReferenceSkin, given: np.ndarray) -> np.ndarray:
    """Pressure (Pa) of springs that stiffen towards the end of the layer."""
    return skin.stiffness * given / (1 - np.minimum(given / skin.thickness, 0.95)) ** 2


def _relaxed(skin: ReferenceSkin, least: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Deflection under an obstacle that presses it at least so far, by projected relaxation from a smaller one."""
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


# --- camera and arm ---


def photograph(rng: np.random.Generator, mesh: trimesh.Trimesh, T_o_c: np.ndarray, errors: WorldErrors) -> np.ndarray:
    """Depth (48, 48) m along the optical axis of a pinhole, whose picture is cropped to the window of the skin at the
    distance of the object; 0 where nothing is seen.
    """
    pitch = EDGE_M / PIXELS / (LOOK_M + CAMERA_BEHIND_M)
    across = (np.arange(PIXELS) - (PIXELS - 1) / 2) * pitch
    x, y = np.meshgrid(across, across)
    directions = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    origins = np.tile(T_o_c[:3, 3], (len(directions), 1))
    z = _first_hits(mesh, origins, directions @ T_o_c[:3, :3].T).reshape(x.shape)
    # Errors of a stereo matcher are alike over a few pixels.
    z = z + errors.depth * 3.5 * gaussian_filter(rng.normal(size=z.shape), 1.0)
    return np.where(np.isfinite(z), errors.depth_step * np.round(z / errors.depth_step), 0.0)


def _first_hits(mesh: trimesh.Trimesh, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances from origins to first hits, in lengths of the direction; infinite where nothing is met."""
    points, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    found = np.full(len(origins), np.inf)
    times = np.sum((points - origins[rays]) * directions[rays], -1) / np.sum(directions[rays] ** 2, -1)
    np.minimum.at(found, rays, times)
    return found


def _cast(mesh: trimesh.Trimesh, T_o_t: np.ndarray, start: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distance along tool z from a plane before the tool to the object."""
    origins = np.stack([x, y, np.full_like(x, start)], -1).reshape(-1, 3) @ T_o_t[:3, :3].T + T_o_t[:3, 3]
    return _first_hits(mesh, origins, np.tile(T_o_t[:3, 2], (len(origins), 1))).reshape(x.shape)


def _cell_centres() -> tuple[np.ndarray, np.ndarray]:
    across = ((np.arange(CELLS) + 0.5) / CELLS - 0.5) * EDGE_M
    x, y = np.meshgrid(across, across)
    return x, y


def _site(rng: np.random.Generator, mesh: trimesh.Trimesh) -> np.ndarray:
    """Tool pose (4, 4) on a random point that is not too steep, turned in any way about its normal."""
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


def _moved(rng: np.random.Generator, distance: float, angle: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.normal(0, 1, 3) * angle).as_matrix()
    T[:3, 3] = rng.normal(0, 1, 3) * distance
    return T


def _along_z(distance: float) -> np.ndarray:
    T = np.eye(4)
    T[2, 3] = distance
    return T


def _prism(outline: np.ndarray, height: float) -> trimesh.Trimesh:
    """A prism over a star-shaped outline about the origin."""
    n = len(outline)
    vertices = np.r_[np.c_[outline, np.zeros(n)], np.c_[outline, np.full(n, height)], [[0, 0, 0], [0, 0, height]]]
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = np.r_[
        np.c_[i, j, n + j], np.c_[i, n + j, n + i], np.c_[j, i, np.full(n, 2 * n)],
        np.c_[n + i, n + j, np.full(n, 2 * n + 1)],
    ]  # fmt: skip
    return trimesh.Trimesh(vertices, faces)
