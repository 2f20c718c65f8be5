"""Cases of `experiments.refine`: objects, sites on them, poses that are off, and what a camera sees there."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.refine.arguments import RefineArgs
from i2t.geometry import so3_exp
from i2t.objects import Object, catalogue, read_mesh
from i2t.registration.patch import pose_information
from i2t.rendering.ops import element
from i2t.rendering.render import render_patch
from i2t.simulation.sites import collect_sites
from i2t.types import PATCH_PIXELS, REACH, Patch, Surface


class Cases(NamedTuple):
    """True and believed poses of the tool: (objects, cases of each) of everything."""

    true: np.ndarray  # T_o_t
    start: np.ndarray  # T_o_t
    eigenvalues: np.ndarray  # (..., 6) of the Gauss-Newton matrix at the true pose
    directions: np.ndarray  # (..., 6, 6)


class Views(NamedTuple):
    """Patches at the true poses, a batch for each object."""

    clean: list[Patch]
    noisy: list[Patch]  # as a camera sees them


def list_objects(args: RefineArgs) -> list[Object]:
    """Named objects first, then random ones, then the meshes of a folder."""
    named = [catalogue.make_object(name) for name in catalogue.NAMES[: args.sizes.objects]]
    objects = named + [catalogue.random_object(seed) for seed in range(args.sizes.objects - len(named))]
    if args.data is not None:
        files = sorted(args.data.glob("*.stl"))
        if not files:
            raise ValueError(f"{args.data}: holds no STL file; give --data a folder of meshes in metres")
        objects += [Object(file.stem, read_mesh(file, "m")[0].mesh, "file") for file in files]
    return objects


def draw_cases(key: jax.Array, objects: Sequence[Object], surfaces: Surface, each: int, args: RefineArgs) -> Cases:
    """Safe sites of every object and poses exactly as far off as the arguments say."""
    rng = np.random.default_rng(args.seed)
    poses = [
        np.asarray(collect_sites(k, element(surfaces, i), each, name=item.name))
        for i, (k, item) in enumerate(zip(jax.random.split(key, len(objects)), objects, strict=True))
    ]
    true = np.stack(poses)
    along, axis = rng.normal(size=(2, *true.shape[:2], 3))
    motion = np.broadcast_to(np.eye(4), true.shape).copy()
    motion[..., :3, 3] = args.distance * along / np.linalg.norm(along, axis=-1, keepdims=True)
    turn = np.radians(args.angle) * axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    motion[..., :3, :3] = so3_exp(turn)
    look = jax.jit(jax.vmap(partial(pose_information, pixels=PATCH_PIXELS), (None, 0)))
    values, directions = zip(*(look(element(surfaces, i), poses[i]) for i in range(len(objects))), strict=True)
    start = (true @ motion).astype(np.float32)
    return Cases(true, start, np.stack(values), np.stack(directions))


def draw_views(key: jax.Array, surfaces: Surface, cases: Cases, noise: float) -> Views:
    """Views at the true poses, without and with noise (m) of each pixel."""
    look = jax.jit(jax.vmap(render_patch, (None, 0)))
    clean = [jax.device_get(look(element(surfaces, i), poses)) for i, poses in enumerate(cases.true)]
    each = cases.true.shape[1]
    noisy = [
        jax.device_get(jax.vmap(add_noise, (0, 0, None))(jax.random.split(key, each), patch, noise))
        for key, patch in zip(jax.random.split(key, len(clean)), clean, strict=True)
    ]
    return Views(clean, noisy)


def add_noise(key: jax.Array, patch: Patch, noise: float) -> Patch:
    """Add a camera's independent noise to every pixel of a patch: what it sees at the reach stays there."""
    heights = jnp.where(patch.depth < REACH, patch.nearest + patch.depth, jnp.inf)
    heights = heights + noise * jax.random.normal(key, heights.shape)
    nearest = jnp.min(heights)
    return Patch(jnp.minimum(heights - nearest, REACH), nearest)
