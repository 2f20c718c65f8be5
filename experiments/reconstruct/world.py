"""Objects, and the simulated arm, skin and camera that observe them."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import islice
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.reconstruct.arguments import ReconstructArgs, ReconstructSizes, Sensing
from experiments.reconstruct.fitted_pad import fit_pad
from i2t.contact.approach import first_contact
from i2t.contact.press import PressLimits
from i2t.depth.camera import Camera
from i2t.depth.distortion import project
from i2t.files.kinds import MESH_SUFFIXES
from i2t.geometry import contact_frame, inverse, random_motion
from i2t.objects.catalogue import random_object
from i2t.objects.mesh_files import load_mesh
from i2t.objects.solids import Mesh, centre_box
from i2t.patches.dimensions import PAD_WINDOW, PATCH_WINDOW, REACH
from i2t.reconstruction.evidence import (
    SurfaceEvidence,
    contact_evidence,
    reading_evidence,
    view_evidence,
    with_free_patch,
    with_surface_points,
)
from i2t.reconstruction.library import build_library
from i2t.reconstruction.local_shape import PatchLibrary, PressModel, infer_patch
from i2t.reconstruction.press_models import predict_presses
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_heights, stack_surfaces
from i2t.simulation.depth_camera import add_depth_noise, render_view
from i2t.simulation.press_curves import simulate_press_curve
from i2t.simulation.touches import SimulationErrors, sample_session_errors
from i2t.skin.contact import GRID
from i2t.skin.pad import pad_from_seed
from i2t.types import Array, Pad, Surface

APPROACH_M, EXPLORING_OVERTRAVEL_M = 0.1, 10e-3  # straight path before a site, and beyond it
PATCHES_PER_SHAPE = 30
PERFECT_PATCH_SIZE = 8  # heights along each edge of a perfect patch
ERRORS = SimulationErrors()
LOOSE_ERRORS = replace(ERRORS, placement=3e-3, placement_angle=math.radians(5.0))
CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
CAMERA_DIRECTION = np.array([0.7, 0.0, 0.7])  # from the object
T_W_CAMERA = contact_frame(0.22 * CAMERA_DIRECTION, CAMERA_DIRECTION / np.linalg.norm(CAMERA_DIRECTION), 0.0)
WALL_M = 1.0  # distance from the camera of the wall behind the object
MM_PER_M = 1e3
LIBRARY_KEY, SESSIONS_KEY, FIT_KEY = range(3)  # folded into the run's key


class ObjectSplit(NamedTuple):
    """Meshes by name, disjoint between parts, with the centre of each bounding box at the origin."""

    test: dict[str, Mesh]
    validation: dict[str, Mesh]
    train: dict[str, Mesh]


class ExploringSkin(NamedTuple):
    """A simulated skin, and the readings predicted for it at the library of local surfaces."""

    pad: Pad
    model: PressModel


class Reality(NamedTuple):
    """The simulated objects and skins."""

    meshes: list[Mesh]
    surfaces: Surface  # stacked
    library: PatchLibrary
    skins: list[Callable[[], ExploringSkin]]  # created on first use
    fitted_skins: list[Callable[[], ExploringSkin]]  # the same, with pads fitted to presses of a ball


class PadContact(NamedTuple):
    """First contact of a pad with an object."""

    advance: Array  # m, travel past the site
    hit: Array  # bool
    heights: Array  # (g, g) m, over the cells of the pad
    patch: Array  # (8, 8) m, on a lattice over the patch's window


def split_objects(args: ReconstructArgs, *, hold_out: bool = True) -> ObjectSplit:
    """Split random catalogue objects, or the meshes of a folder, into test, validation and training.

    Args:
        args: Options of the command.
        hold_out: Whether one file in ten is for test and one for validation; else all are for training.

    Returns:
        Centred meshes by name.

    Raises:
        ValueError: Two files share a name, or a part has no usable mesh.
    """
    sizes, split = args.sizes, ObjectSplit({}, {}, {})
    counts = (sizes.test if hold_out else 0, sizes.validation if hold_out else 0, sizes.train)
    if args.objects is None:
        seeds = iter(range(100_000 * args.seed, 100_000 * (args.seed + 1)))
        for part, count in zip(split, counts, strict=True):
            part.update((drawn.name, centre_box(drawn.mesh)) for drawn in map(random_object, islice(seeds, count)))
        return split
    files = sorted(path for path in args.objects.rglob("*") if path.suffix.lower() in MESH_SUFFIXES)
    names = [str(path.relative_to(args.objects).with_suffix("")) for path in files]
    if len(set(names)) < len(names):
        raise ValueError(f"{args.objects}: two files have one name with different extensions; keep one")
    rows = np.arange(len(files)) % 10 if hold_out else np.full(len(files), 2)
    for part, own, count in zip(split, (rows == 0, rows == 1, rows > 1), counts, strict=True):
        for number in np.flatnonzero(own):
            if len(part) == count:
                break
            try:
                mesh = load_mesh(files[number], args.unit or "m")
                part[names[number]] = _scaled(mesh, args, int(number))
            except (ValueError, OSError) as error:
                print(f"left out: {error}", flush=True)
    if not (all(split) if hold_out else split.train):
        count = sum(map(len, split))
        endings = ", ".join(MESH_SUFFIXES)
        raise ValueError(f"{args.objects}: holds {count} usable meshes ({endings}); give ten or more")
    return split


def _scaled(mesh: Mesh, args: ReconstructArgs, number: int) -> Mesh:
    """Centre a mesh, and scale it to a random size if --across-mm is given."""
    mesh = centre_box(mesh)
    if args.across_mm is None:
        return mesh
    across = np.random.default_rng([args.seed, number]).uniform(*args.across_mm) / MM_PER_M
    return Mesh(mesh.vertices * across / np.ptp(mesh.vertices, axis=0).max(), mesh.faces)


def make_reality(seed: int, split: ObjectSplit, sizes: ReconstructSizes) -> Reality:
    """Build the validation and test objects, and skins with their predicted readings at the library's patches."""
    shapes = [prepare_surface(mesh) for mesh in list(split.train.values())[: sizes.patches // PATCHES_PER_SHAPE]]
    key = _key(seed, LIBRARY_KEY)
    tilt = (0.0, 0.35)  # rad, range between the normals of an estimated and the true surface
    library = jax.device_put(build_library(key, shapes, sizes.patches, tilt=tilt, limits=None))

    def skin(number: int, fitted: bool) -> ExploringSkin:
        pad = pad_from_seed(number)
        if not fitted:
            return ExploringSkin(pad, predict_presses(pad, library))
        key_fit = jax.random.fold_in(_key(seed, FIT_KEY), number)
        return ExploringSkin(pad, predict_presses(fit_pad(key_fit, pad, ERRORS, sizes.fit_presses), library))

    meshes = [*split.validation.values(), *split.test.values()]
    surfaces = stack_surfaces([prepare_surface(mesh) for mesh in meshes])

    def skins(fitted: bool) -> list[Callable[[], ExploringSkin]]:
        return [cache(partial(skin, number, fitted)) for number in range(sizes.pads)]

    return Reality(meshes, surfaces, library, skins(fitted=False), skins(fitted=True))


@jax.jit
def _meet(key: Array, surface: Surface, T_w_o: Array, T_w_site: Array) -> PadContact:
    """Approach a site along its z axis to first contact, with the errors of the arm."""
    key_arm, key_tilt = jax.random.split(key)
    moved = random_motion(key_arm, ERRORS.repeatability, 0.0) @ random_motion(key_tilt, 0.0, ERRORS.approach_angle)
    T_o_site = inverse(T_w_o) @ T_w_site @ moved
    T_o_t, distance, hit = first_contact(surface, T_o_site, before=APPROACH_M, beyond=EXPLORING_OVERTRAVEL_M)
    heights, patch = (
        render_heights(surface, inverse(T_o_t), window, cells)
        for window, cells in ((PAD_WINDOW, GRID.cells), (PATCH_WINDOW, PERFECT_PATCH_SIZE))
    )
    return PadContact(distance, hit & jnp.isfinite(jnp.min(heights)), heights, patch)


_press = jax.jit(partial(simulate_press_curve, errors=ERRORS, limits=PressLimits()))
_infer = jax.jit(infer_patch, static_argnames=("samples",))
_meet_all = jax.jit(jax.vmap(_meet, (None, None, None, 0)))


@dataclass
class Session:
    """One object, mounted once with random errors of its placement, touched with one pad."""

    reality: Reality
    number: int  # object number
    seed: int
    loose: bool = False  # whether the errors of its placement are the larger ones
    fitted: bool = False  # whether readings are interpreted with the fitted pad
    touches: int = 0  # so far

    def __post_init__(self) -> None:
        key_session, self.key_touches, key_view = jax.random.split(
            jax.random.fold_in(_key(self.seed, SESSIONS_KEY), self.number), 3
        )
        self.surface = element(self.reality.surfaces, self.number)
        errors = LOOSE_ERRORS if self.loose else ERRORS
        self.T_w_o, self.camera_error = sample_session_errors(key_session, errors)  # nominally at the world's origin
        self.view_seed = int(jax.random.bits(key_view))

    @cached_property
    def mesh(self) -> Mesh:
        """The object at its true pose."""
        mesh, placed = self.reality.meshes[self.number], np.asarray(self.T_w_o, np.float64)
        return Mesh(mesh.vertices @ placed[:3, :3].T + placed[:3, 3], mesh.faces)

    def touch(self, site: Float[np.ndarray, "4 4"], sensing: Sensing) -> SurfaceEvidence:
        """Touch a site, and return the evidence of the contact and of what is measured there."""
        key_meet, key_press = jax.random.split(jax.random.fold_in(self.key_touches, self.touches))
        self.touches += 1
        met = jax.device_get(_meet(key_meet, self.surface, self.T_w_o, jnp.asarray(site, jnp.float32)))
        T_w_t = reported_pose(site, met)
        if sensing == "pose" or not met.hit:
            return contact_evidence(T_w_t, hit=bool(met.hit), swept=APPROACH_M)
        if sensing == "patch":
            return perfect_evidence(T_w_t, met)
        skins = self.reality.fitted_skins if self.fitted else self.reality.skins
        skin = skins[(self.number + self.seed) % len(skins)]()
        press = _press(key_press, skin.pad, met.heights)
        posterior = _infer(press.reading, press.force, press.travel, model=skin.model, library=self.reality.library)
        return reading_evidence(T_w_t, jax.device_get(posterior), swept=APPROACH_M)

    def foresee(self, sites: Float[np.ndarray, "n 4 4"]) -> list[SurfaceEvidence]:
        """Evidence of touches that are only simulated ahead, with perfect patches."""
        key = jax.random.clone(self.key_touches)  # keys of actual touches are folded from the same key
        met = jax.device_get(_meet_all(key, self.surface, self.T_w_o, jnp.asarray(sites, jnp.float32)))
        contacts = (element(met, i) for i in range(len(sites)))
        return [
            perfect_evidence(reported_pose(site, contact), contact)
            for site, contact in zip(sites, contacts, strict=True)
        ]

    def view(self) -> SurfaceEvidence:
        """Evidence of a depth image of the object from one side and above, with errors of pose and image."""
        depth = true_view(self.mesh, T_W_CAMERA @ np.asarray(self.camera_error, np.float64))
        wall = np.where(np.isfinite(depth), depth, WALL_M)
        seen = add_depth_noise(wall, ERRORS, np.random.default_rng(self.view_seed))
        return view_evidence(np.where(seen > WALL_M / 2, np.inf, seen), CAMERA, T_W_CAMERA)


def reported_pose(site: Float[np.ndarray, "4 4"], contact: PadContact) -> Float[np.ndarray, "4 4"]:
    """Pose of contact, or of the end of the path, as the arm reports it."""
    T_w_t = site.copy()
    T_w_t[:3, 3] += float(contact.advance) * site[:3, 2]
    return T_w_t


def perfect_evidence(T_w_t: Float[np.ndarray, "4 4"], contact: PadContact) -> SurfaceEvidence:
    """Evidence of a touch that measures the whole patch in front of the pad, up to the patch's reach."""
    touch = contact_evidence(T_w_t, hit=bool(contact.hit), swept=APPROACH_M)
    at = ((np.arange(PERFECT_PATCH_SIZE) + 0.5) / PERFECT_PATCH_SIZE - 0.5) * PATCH_WINDOW
    y, x = np.meshgrid(at, at, indexing="ij")
    reached = contact.patch < REACH
    if not contact.hit:
        return touch
    touch = with_free_patch(touch, np.minimum(contact.patch, REACH))
    local = np.stack([x[reached], y[reached], contact.patch[reached]], -1)
    return with_surface_points(touch, local, np.full(len(local), 0.3e-3)) if len(local) else touch


def true_view(mesh: Mesh, T_w_c: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "h w"]:
    """Depth image (m) without errors, infinite where the ray meets nothing."""
    return render_view(mesh.vertices[mesh.faces], T_w_c, CAMERA)[0]


def _key(seed: int, number: int) -> Array:
    return jax.random.fold_in(jax.random.key(seed), number)


def hidden_points(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> np.ndarray:
    """Mask `(n,)` of the surface points that the camera does not see, which are 2 mm or more behind the depth image."""
    depth = true_view(mesh, T_W_CAMERA)
    local = (points - T_W_CAMERA[:3, 3]) @ T_W_CAMERA[:3, :3]
    column, row = np.rint(np.asarray(project(CAMERA, jnp.asarray(local)))).astype(int).T
    nearest = depth[np.clip(row, 0, CAMERA.height - 1), np.clip(column, 0, CAMERA.width - 1)]
    return local[:, 2] > nearest + 2e-3
