"""What does it take to know where the object stands? It may be 5 mm and 5 degrees off; one depth image, taken from
aside, registers what it might be (`i2t.registration.touch.by_depth`), and the belief takes the pose found and its
covariance.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from experiments.recognize.trained_run import meshes_by_name
from experiments.studies.lab import Lab, imagine, report_methods, sit, spread
from i2t.depth.camera import Camera
from i2t.emulators.scene import add_depth_noise, render_view, table_triangles
from i2t.hardware.rig import Rig
from i2t.objects.catalogue import Mesh
from i2t.recognition import belief
from i2t.recognition.episodes import run_belief, session_errors
from i2t.recognition.site_pool import SitePool, draw_random_sites, pose_particles, precompute_outcomes, sample_sites
from i2t.registration.touch import camera_covariance, register_by_depth
from i2t.simulation.touches import SessionErrors, SimulationErrors
from i2t.types import Array

DISTANCE, ANGLE = 5e-3, math.radians(5.0)  # one sigma, each axis
ASIDE = 0.12  # m, from which the camera looks, down by 45 degrees
KINDS = ("fused", "tactile only")


class Found(NamedTuple):
    """Where a view of each sitting has each candidate."""

    T_w_o: Array  # (e, objects, 4, 4); where it was believed, if its registration was refused
    covariance: Array  # (6, 6) m^2, of those that were found
    refused: Array  # (e, objects)


def play(lab: Lab) -> dict[str, Any]:
    """The same luck with the object known to 1 mm, known to 5 mm, and found by a view."""
    key_pool, key_play, key_site = jax.random.split(lab.key, 3)
    sites = sample_sites(key_pool, lab.surfaces, lab.names, lab.cfg.num_sites, lab.cfg.site_limits)
    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    chosen = draw_random_sites(key_site, sites, len(truth), lab.cfg.touches)
    errors = replace(lab.cfg.errors, placement=DISTANCE, placement_angle=ANGLE)
    result: dict[str, Any] = {"truth": truth}
    for what, world in (("known to 1 mm", lab.cfg.errors), ("known to 5 mm", errors)):
        places = pose_particles(world, lab.cfg.num_particles, lab.seed)
        (table,) = imagine(lab, sites, places, [lab.learnt.reading_model], what)
        episodes = sit(lab, jax.random.clone(key_play), sites, truth, chosen, what, errors=world)
        told = run_belief(table, episodes, lab.learnt.likelihood, places, KINDS)
        result |= {f"{kind}, {what}": p for kind, p in told.items()}

    runs = jax.device_get(session_errors(jax.random.clone(key_play), len(truth), errors))
    found = look(meshes_by_name(lab.names), truth, runs, errors, lab.seed)
    places = belief.sample_particles(found.covariance, lab.cfg.num_particles, lab.seed)
    owner = sites.owner[chosen]
    T_w_site = found.T_w_o[np.arange(len(truth))[:, None], owner] @ np.asarray(sites.T_w_t, float)[chosen]
    there = SitePool(jnp.float32(T_w_site.reshape(-1, 4, 4)), owner.reshape(-1))
    every = np.arange(chosen.size).reshape(chosen.shape)
    episodes = sit(lab, jax.random.clone(key_play), there, truth, every, "found by a view", errors=errors)
    columns = []
    for i, surface in enumerate(lab.surfaces):
        seen = np.linalg.inv(found.T_w_o[:, i])[:, None] @ T_w_site  # as if that object stood at the origin
        sites_i = jnp.float32(seen.reshape(-1, 4, 4))
        past = lab.cfg.limits.overtravel
        columns += precompute_outcomes(
            [surface], places.twist, sites_i, [lab.learnt.reading_model], overtravel=past, label=f"found: {lab.names[i]}"
        )
    table = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *columns)
    told = run_belief(table, episodes, lab.learnt.likelihood, places, KINDS)
    result |= {f"{kind}, found by a view": p for kind, p in told.items()}

    at = np.arange(len(truth)), truth
    apart = np.linalg.inv(runs.T_o_placed) @ found.T_w_o[at]
    turn = np.linalg.norm(Rotation.from_matrix(apart[:, :3, :3]).as_rotvec(), axis=1)
    return result | {
        "off": np.linalg.norm(apart[:, :3, 3], axis=1), "turned": turn, "refused": found.refused[at],
        "strangers refused": found.refused.sum(1) - found.refused[at],
    }  # fmt: skip


def look(meshes: dict[str, Mesh], truth: np.ndarray, runs: SessionErrors, errors: SimulationErrors, seed: int) -> Found:
    """Register every candidate to one view of each sitting."""
    lens, T_w_c = Rig().camera, _aside()
    poses = np.tile(np.eye(4), (len(truth), len(meshes), 1, 1))
    refused = np.zeros(poses.shape[:2], bool)
    spreads = []
    things = list(meshes.values())
    for e, which in enumerate(tqdm(truth, desc="registering", unit="view")):
        depth = _view(things[which], runs.T_o_placed[e], T_w_c @ runs.T_t_camera[e], lens, errors, (seed, e))
        for o, mesh in enumerate(things):
            try:
                found = register_by_depth(mesh, np.eye(4), depth, lens, T_w_c, DISTANCE, ANGLE)
            except ValueError:  # it does not look like this one
                refused[e, o] = True
                continue
            poses[e, o] = found.T_w_o
            T_c_o = np.linalg.inv(T_w_c) @ poses[e, o]
            spreads.append(camera_covariance(found.covariance, T_c_o, errors.hand_eye, errors.hand_eye_angle))
    return Found(poses, np.mean(spreads, axis=0), refused)


def _aside() -> Array:
    """A camera that looks at the object from aside and above."""
    z = -np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    y = np.cross(z, [0.0, 1.0, 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    T[:3, 3] = -ASIDE * z + [0.0, 0.0, 15e-3]
    return T


def _view(mesh: Mesh, T_w_o: Array, T_w_c: Array, lens: Camera, errors: SimulationErrors, seed: tuple[int, int]) -> Array:
    triangles = mesh.vertices[mesh.faces] @ T_w_o[:3, :3].T + T_w_o[:3, 3]
    depth, _ = render_view(np.concatenate([triangles, table_triangles(np.eye(4))]), T_w_c, lens)
    return add_depth_noise(depth, errors, np.random.default_rng(seed))


def report(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """What knowing the place is worth, and how well a view finds it."""
    beside = ("off", "turned", "refused", "strangers refused")
    columns = {key: np.concatenate([part[key] for part in parts]) for key in beside}
    result = report_methods([{key: p for key, p in part.items() if key not in beside} for part in parts], out)
    kept = ~columns["refused"]
    where = "as the view has the object"
    result["off"] = spread("off", "mm", 1e3 * columns["off"][kept], where)
    result["turned"] = spread("turned", "degrees", np.degrees(columns["turned"][kept]), where)
    itself, others = int(columns["refused"].sum()), int(columns["strangers refused"].sum())
    result["refused"] = {"itself": itself, "others": others}
    print(f"registrations refused: {itself} of the object, {others} of others")
    return result
