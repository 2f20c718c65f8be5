"""Objects that are touched, and the simulated arm and skin that touch them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.reconstruct.arguments import MESH_ENDINGS, ReconstructArgs, ReconstructSizes
from i2t.geometry import apply, inverse
from i2t.objects.catalogue import random_object
from i2t.objects.mesh_files import read_mesh
from i2t.objects.solids import Mesh, Object, place_on_table
from i2t.reconstruction.library import ContactSampling, build_library
from i2t.reconstruction.local_shape import PatchLibrary, PressModel, infer_patch
from i2t.reconstruction.press_models import imagine_presses
from i2t.reconstruction.signed_distances import join_bodies
from i2t.reconstruction.surface import TouchEvidence, contact_evidence, posterior_evidence
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_heights, stack_surfaces
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors, sample_session_errors, simulate_touch
from i2t.skin.noise import add_sensor_noise
from i2t.skin.pad import numbered_pad
from i2t.types import Pad, ReturnCode, Surface

APPROACH_M, EXPLORING_OVERTRAVEL_M = 0.1, 10e-3  # straight way before a site, and beyond it
IMAGE_DEPTH_M = 1e-3  # to which a perfect tactile image sees
IMAGE_STD_M = 0.1e-3
VIEW_WINDOW_M, VIEW_PIXELS, VIEW_DISTANCE_M, VIEW_NOISE_M = 0.14, 56, 0.3, 0.3e-3
CAMERA_DIRECTION = (-0.5, 0.6, -0.62)  # in which the camera looks
PATCH_SHAPES = 40  # of which the library of local surfaces is made
PATCH_TILT_RAD = (0.0, 0.35)  # an estimated surface lies up to so far from the true one


class ObjectSplit(NamedTuple):
    """Objects, none of which is in two of these."""

    train: list[Object]
    validation: list[Object]
    test: list[Object]


class Skins(NamedTuple):
    """Simulated skins, and what is imagined of each."""

    pads: list[Pad]
    models: list[PressModel]
    library: PatchLibrary


@dataclass(frozen=True)
class Reality:
    """Facts that only the simulation knows."""

    objects: list[Object]
    surfaces: Surface  # stacked
    skins: Skins
    errors: SimulationErrors


class Session(NamedTuple):
    """One object, put down once, before one pad."""

    touch: Callable[[np.ndarray, str], TouchEvidence]  # site and kind of evidence to what the touch says
    view: Callable[[], tuple[np.ndarray, np.ndarray]]  # points of the surface that a camera sees, and its place


def split_objects(args: ReconstructArgs, sizes: ReconstructSizes) -> ObjectSplit:
    """Random objects of the catalogue, or the meshes of a folder: those whose folder or name ends in 0 are unseen."""
    if args.meshes is None:
        first = 100_000 * args.seed
        counts = np.cumsum([0, sizes.test, sizes.validation, sizes.train])
        test, validation, train = (
            [random_object(first + i) for i in range(low, high)] for low, high in pairwise(counts)
        )
        return ObjectSplit(train, validation, test)
    paths = sorted(path for path in args.meshes.rglob("*") if path.suffix.lower() in MESH_ENDINGS)
    unseen = [path for path in paths if ends_in_zero(path, args.meshes)]
    known = [path for path in paths if path not in set(unseen)]
    needed = sizes.train + sizes.validation
    if len(unseen) < 1 or len(known) < 2:
        raise ValueError(
            f"--meshes {args.meshes}: holds {len(unseen)} unseen files (folder or name ends in 0) and {len(known)} "
            "others; give at least 1 and 2"
        )
    rng = np.random.default_rng(args.seed)
    known = [known[i] for i in rng.permutation(len(known))[:needed]]
    unseen = [unseen[i] for i in np.sort(rng.permutation(len(unseen))[: sizes.test])]
    shapes = [load_scaled(path, args, i) for i, path in enumerate(known)]
    held = max(1, min(sizes.validation, len(shapes) - 1))
    return ObjectSplit(
        shapes[held:], shapes[:held], [load_scaled(path, args, 10_000 + i) for i, path in enumerate(unseen)]
    )


def ends_in_zero(path: Path, root: Path) -> bool:
    """Test whether a mesh is unseen: its folder's name ends in 0, or its own where it lies in no folder of its own."""
    return (path.stem if path.parent == root else path.parent.name).endswith("0")


def load_scaled(path: Path, args: ReconstructArgs, number: int) -> Object:
    """The outer surface of a mesh file, its largest side drawn at random, standing on the table."""
    mesh = join_bodies(read_mesh(path, args.unit, largest=False)[0].mesh)
    side = np.random.default_rng([args.seed, number]).uniform(*args.side)
    scale = side / np.ptp(mesh.vertices, axis=0).max()
    return Object(path.stem, place_on_table(Mesh(mesh.vertices * scale, mesh.faces)), "file")


def make_skins(key: jax.Array, train: list[Object], sizes: ReconstructSizes) -> Skins:
    """Simulated skins, and what each would read at patches of the known shapes."""
    shapes = [prepare_surface(item.mesh) for item in train[:PATCH_SHAPES]]
    sampling = ContactSampling(tilt=PATCH_TILT_RAD, limits=None)
    library = build_library(key, shapes, sizes.patches, sampling=sampling)
    pads = [numbered_pad(number) for number in range(sizes.pads)]
    return Skins(pads, [imagine_presses(pad, library) for pad in pads], library)


def make_reality(objects: list[Object], skins: Skins) -> Reality:
    """A lab with the errors of a usual one."""
    surfaces = stack_surfaces([prepare_surface(item.mesh) for item in objects])
    return Reality(objects, surfaces, skins, SimulationErrors())


@partial(jax.jit, static_argnames=("errors",))
def _touch(key: Any, surface: Surface, site: Any, session: Any, pad: Pad, *, errors: SimulationErrors) -> Any:
    key_touch, key_noise = jax.random.split(key)
    limits = PressLimits(approach_distance=APPROACH_M, overtravel=EXPLORING_OVERTRAVEL_M)
    touch = simulate_touch(key_touch, surface, jnp.eye(4), site, session=session, pad=pad, errors=errors, limits=limits)
    return touch._replace(reading=add_sensor_noise(key_noise, touch.reading, pad.board, errors.noise))


_infer = jax.jit(infer_patch, static_argnames=("samples",))
_see = jax.jit(partial(render_heights, window=VIEW_WINDOW_M, pixels=VIEW_PIXELS))


def begin_session(reality: Reality, number: int, *, seed: int) -> Session:
    """Put an object down, once, within the errors of its placement."""
    key_session, key_touches, key_view = jax.random.split(jax.random.fold_in(jax.random.key(seed), number), 3)
    surface = element(reality.surfaces, number)
    session = sample_session_errors(key_session, reality.errors)
    which = (number + seed) % len(reality.skins.pads)
    pad, model = reality.skins.pads[which], reality.skins.models[which]
    made: list[int] = []

    def touch(site: np.ndarray, kind: str) -> TouchEvidence:
        key = jax.random.fold_in(key_touches, len(made))
        made.append(1)
        end = _touch(key, surface, jnp.asarray(site, jnp.float32), session, pad, errors=reality.errors)
        return evidence_of(jax.device_get(end), kind, model, reality.skins.library)

    def view() -> tuple[np.ndarray, np.ndarray]:
        return see(key_view, surface, session.T_o_placed)

    return Session(touch, view)


def evidence_of(touch: Any, kind: str, model: PressModel, library: PatchLibrary) -> TouchEvidence:
    """Evidence of a touch on the surface: where it was, and what its reading or a perfect tactile image adds."""
    T_o_t = np.asarray(touch.T_w_t, np.float64)  # the object is believed at the world's origin
    hit = int(touch.code) != ReturnCode.AIR
    if not hit:
        return contact_evidence(T_o_t, hit=False, swept=APPROACH_M)
    T_o_t[:3, 3] -= float(touch.depth) * T_o_t[:3, 2]  # back to first contact
    if kind == "contact":
        return contact_evidence(T_o_t, swept=APPROACH_M)
    if kind == "image":
        rim = (touch.truth.wide.shape[0] - touch.patch.shape[0]) // 2
        height = touch.truth.wide[rim:-rim, rim:-rim]
        felt = height < IMAGE_DEPTH_M
        std, free = np.where(felt, IMAGE_STD_M, np.inf), np.where(felt, 0.0, IMAGE_DEPTH_M)
        return contact_evidence(T_o_t, swept=APPROACH_M, height=height, std=std, free=free)
    found = _infer(touch.reading, touch.force, touch.depth, model=model, library=library)
    return posterior_evidence(T_o_t, np.asarray(found.patch), swept=APPROACH_M)


def see(key: jax.Array, surface: Surface, T_o_placed: Any) -> tuple[np.ndarray, np.ndarray]:
    """One depth view from above and aside, where the object is believed: points, and the camera's place."""
    z = np.array(CAMERA_DIRECTION) / np.linalg.norm(CAMERA_DIRECTION)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    T_o_c = np.eye(4)
    T_o_c[:3, :3] = np.stack([x, np.cross(z, x), z], -1)
    T_o_c[:3, 3] = [0, 0, 20e-3] - VIEW_DISTANCE_M * z
    seen = np.asarray(_see(surface, inverse(jnp.asarray(T_o_c, jnp.float32))))
    row, column = np.nonzero(np.isfinite(seen))
    place = ((np.arange(VIEW_PIXELS) + 0.5) / VIEW_PIXELS - 0.5) * VIEW_WINDOW_M
    depth = seen[row, column] + VIEW_NOISE_M * np.asarray(jax.random.normal(key, row.shape))
    local = np.stack([place[column], place[row], depth], -1)
    T_placed_c = np.asarray(T_o_placed, np.float64) @ T_o_c  # the object stands elsewhere than it is believed to
    return np.asarray(apply(T_placed_c, local)), T_placed_c[:3, 3]
