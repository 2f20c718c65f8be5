"""Objects that are touched, and the simulated arm, skin and camera that meet them."""

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

from experiments.reconstruct.arguments import Felt, ReconstructArgs, ReconstructSizes
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

APPROACH_M, EXPLORING_OVERTRAVEL_M = 0.1, 10e-3  # straight way before a site, and beyond it
PATCH_TILT_RAD = (0.0, 0.35)  # an estimated surface lies up to so far from the true one
PATCHES_OF_A_SHAPE = 30  # of the library of local surfaces
LATTICE = 8  # heights of a perfect patch along each edge
PERFECT_STD_M = 0.3e-3
ERRORS = SimulationErrors()
LOOSE_ERRORS = replace(ERRORS, placement=3e-3, placement_angle=math.radians(5.0))
CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
CAMERA_M, CAMERA_DIRECTION = 0.22, np.array([0.7, 0.0, 0.7])  # where it is, seen from the object
T_W_CAMERA = contact_frame(CAMERA_M * CAMERA_DIRECTION, CAMERA_DIRECTION / np.linalg.norm(CAMERA_DIRECTION), 0.0)
WALL_M = 1.0  # from the camera, behind the object
VISIBLE_M = 2e-3  # behind what was seen there, a point is hidden
MM_PER_M = 1e3
LIBRARY_KEY, SESSIONS_KEY, FIT_KEY = range(3)  # what the seed is folded with


class ObjectSplit(NamedTuple):
    """Meshes by name, the middle of each box at the origin; none is in two of these."""

    test: dict[str, Mesh]
    validation: dict[str, Mesh]
    train: dict[str, Mesh]


class ExploringSkin(NamedTuple):
    """A simulated skin, and what it is imagined to read at the library of local surfaces."""

    pad: Pad
    model: PressModel


class Reality(NamedTuple):
    """Facts that only the simulation knows, and the skins."""

    meshes: list[Mesh]
    surfaces: Surface  # stacked
    library: PatchLibrary
    skins: list[Callable[[], ExploringSkin]]  # each made when it is first asked for
    fitted_skins: list[Callable[[], ExploringSkin]]  # the same, as far as they are known from presses of a ball


class Met(NamedTuple):
    """Where a pad met an object."""

    advanced: Array  # m past the site
    hit: Array
    heights: Array  # (g, g) m, over the cells of the pad
    patch: Array  # (8, 8) m, on a lattice over the patch's window


def split_objects(args: ReconstructArgs, *, hold_out: bool = True) -> ObjectSplit:
    """Random objects of the catalogue, or those of a folder: of ten files in order one is to test, one to validate; or
    all to learn from.
    """
    sizes, found = args.sizes, ObjectSplit({}, {}, {})
    counts = (sizes.test if hold_out else 0, sizes.validation if hold_out else 0, sizes.train)
    if args.objects is None:
        seeds = iter(range(100_000 * args.seed, 100_000 * (args.seed + 1)))
        for part, count in zip(found, counts, strict=True):
            part.update((each.name, centre_box(each.mesh)) for each in map(random_object, islice(seeds, count)))
        return found
    files = sorted(path for path in args.objects.rglob("*") if path.suffix.lower() in MESH_SUFFIXES)
    names = [str(path.relative_to(args.objects).with_suffix("")) for path in files]
    if len(set(names)) < len(names):
        raise ValueError(f"{args.objects}: two files have one name but for their endings; leave one of each")
    rows = np.arange(len(files)) % 10 if hold_out else np.full(len(files), 2)
    for part, own, count in zip(found, (rows == 0, rows == 1, rows > 1), counts, strict=True):
        for number in np.flatnonzero(own):
            if len(part) == count:
                break
            try:
                mesh = load_mesh(files[number], args.unit or "m")
                part[names[number]] = _scaled(mesh, args, int(number))
            except (ValueError, OSError) as error:
                print(f"left out: {error}", flush=True)
    if not (all(found) if hold_out else found.train):
        count = sum(map(len, found))
        endings = ", ".join(MESH_SUFFIXES)
        raise ValueError(f"{args.objects}: holds {count} usable meshes ({endings}); give ten or more")
    return found


def _scaled(mesh: Mesh, args: ReconstructArgs, number: int) -> Mesh:
    """A mesh of the folder, centred, of a random size if that is wanted."""
    mesh = centre_box(mesh)
    if args.across_mm is None:
        return mesh
    across = np.random.default_rng([args.seed, number]).uniform(*args.across_mm) / MM_PER_M
    return Mesh(mesh.vertices * across / np.ptp(mesh.vertices, axis=0).max(), mesh.faces)


def make_reality(seed: int, split: ObjectSplit, sizes: ReconstructSizes) -> Reality:
    """The objects of validation and test, and skins of which it is known what they read at patches of known shapes."""
    shapes = [prepare_surface(mesh) for mesh in list(split.train.values())[: sizes.patches // PATCHES_OF_A_SHAPE]]
    key = _key(seed, LIBRARY_KEY)
    library = jax.device_put(build_library(key, shapes, sizes.patches, tilt=PATCH_TILT_RAD, limits=None))

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
def _meet(key: Array, surface: Surface, T_w_o: Array, T_w_site: Array) -> Met:
    """Approach a site along its z to first contact, with the errors of the arm."""
    key_arm, key_tilt = jax.random.split(key)
    moved = random_motion(key_arm, ERRORS.repeatability, 0.0) @ random_motion(key_tilt, 0.0, ERRORS.approach_angle)
    T_o_site = inverse(T_w_o) @ T_w_site @ moved
    T_o_t, distance, hit = first_contact(surface, T_o_site, before=APPROACH_M, beyond=EXPLORING_OVERTRAVEL_M)
    heights, patch = (
        render_heights(surface, inverse(T_o_t), window, cells)
        for window, cells in ((PAD_WINDOW, GRID.cells), (PATCH_WINDOW, LATTICE))
    )
    return Met(distance, hit & jnp.isfinite(jnp.min(heights)), heights, patch)


_press = jax.jit(partial(simulate_press_curve, errors=ERRORS, limits=PressLimits()))
_infer = jax.jit(infer_patch, static_argnames=("samples",))
_meet_all = jax.jit(jax.vmap(_meet, (None, None, None, 0)))


@dataclass
class Session:
    """One object, held once within the errors of its placement, before one pad."""

    reality: Reality
    number: int  # of the object
    seed: int
    loose: bool = False  # whether it is placed with larger errors
    fitted: bool = False  # whether the pad is known from presses of a ball only
    touches: int = 0  # so far

    def __post_init__(self) -> None:
        key_session, self.key_touches, key_view = jax.random.split(
            jax.random.fold_in(_key(self.seed, SESSIONS_KEY), self.number), 3
        )
        self.surface = element(self.reality.surfaces, self.number)
        errors = LOOSE_ERRORS if self.loose else ERRORS
        self.T_w_o, self.camera_error = sample_session_errors(key_session, errors)  # believed at the world's origin
        self.view_seed = int(jax.random.bits(key_view))

    @cached_property
    def mesh(self) -> Mesh:
        """The object where it is."""
        mesh, placed = self.reality.meshes[self.number], np.asarray(self.T_w_o, np.float64)
        return Mesh(mesh.vertices @ placed[:3, :3].T + placed[:3, 3], mesh.faces)

    def touch(self, site: Float[np.ndarray, "4 4"], felt: Felt) -> SurfaceEvidence:
        """Touch a site: where it was met, and what is felt there."""
        key_meet, key_press = jax.random.split(jax.random.fold_in(self.key_touches, self.touches))
        self.touches += 1
        met = jax.device_get(_meet(key_meet, self.surface, self.T_w_o, jnp.asarray(site, jnp.float32)))
        T_w_t = reported_pose(site, met)
        if felt == "pose" or not met.hit:
            return contact_evidence(T_w_t, hit=bool(met.hit), swept=APPROACH_M)
        if felt == "patch":
            return perfect_evidence(T_w_t, met)
        skins = self.reality.fitted_skins if self.fitted else self.reality.skins
        skin = skins[(self.number + self.seed) % len(skins)]()
        press = _press(key_press, skin.pad, met.heights)
        found = _infer(press.reading, press.force, press.travel, model=skin.model, library=self.reality.library)
        return reading_evidence(T_w_t, jax.device_get(found), swept=APPROACH_M)

    def foresee(self, sites: Float[np.ndarray, "n 4 4"]) -> list[SurfaceEvidence]:
        """Evidence of touches that are not made, each of which would feel all before it."""
        key = jax.random.clone(self.key_touches)  # the errors of all touches are folded out of it
        met = jax.device_get(_meet_all(key, self.surface, self.T_w_o, jnp.asarray(sites, jnp.float32)))
        each = (element(met, i) for i in range(len(sites)))
        return [perfect_evidence(reported_pose(site, one), one) for site, one in zip(sites, each, strict=True)]

    def view(self) -> SurfaceEvidence:
        """What a depth camera sees of the object from one side above it, with the errors of its pose and image."""
        depth = true_view(self.mesh, T_W_CAMERA @ np.asarray(self.camera_error, np.float64))
        wall = np.where(np.isfinite(depth), depth, WALL_M)
        seen = add_depth_noise(wall, ERRORS, np.random.default_rng(self.view_seed))
        return view_evidence(np.where(seen > WALL_M / 2, np.inf, seen), CAMERA, T_W_CAMERA)


def reported_pose(site: Float[np.ndarray, "4 4"], met: Met) -> Float[np.ndarray, "4 4"]:
    """Pose of contact, or of the end of the way, as the arm reports it."""
    T_w_t = site.copy()
    T_w_t[:3, 3] += float(met.advanced) * site[:3, 2]
    return T_w_t


def perfect_evidence(T_w_t: Float[np.ndarray, "4 4"], met: Met) -> SurfaceEvidence:
    """Evidence of a touch that feels all of the patch before it, as far as a patch reaches."""
    touch = contact_evidence(T_w_t, hit=bool(met.hit), swept=APPROACH_M)
    at = ((np.arange(LATTICE) + 0.5) / LATTICE - 0.5) * PATCH_WINDOW
    y, x = np.meshgrid(at, at, indexing="ij")
    felt = met.patch < REACH
    if not met.hit:
        return touch
    touch = with_free_patch(touch, np.minimum(met.patch, REACH))
    local = np.stack([x[felt], y[felt], met.patch[felt]], -1)
    return with_surface_points(touch, local, np.full(len(local), PERFECT_STD_M)) if len(local) else touch


def true_view(mesh: Mesh, T_w_c: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "h w"]:
    """Depths (m) without errors; infinite where there is nothing."""
    return render_view(mesh.vertices[mesh.faces], T_w_c, CAMERA)[0]


def _key(seed: int, number: int) -> Array:
    return jax.random.fold_in(jax.random.key(seed), number)


def hidden_points(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> np.ndarray:
    """Which points of the true surface a camera at that place does not see."""
    depth = true_view(mesh, T_W_CAMERA)
    local = (points - T_W_CAMERA[:3, 3]) @ T_W_CAMERA[:3, :3]
    column, row = np.rint(np.asarray(project(CAMERA, jnp.asarray(local)))).astype(int).T
    nearest = depth[np.clip(row, 0, CAMERA.height - 1), np.clip(column, 0, CAMERA.width - 1)]
    return local[:, 2] > nearest + VISIBLE_M
