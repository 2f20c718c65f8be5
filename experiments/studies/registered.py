"""Recognition of an object whose pose a view finds. It may be 5 mm and 5 degrees off; one depth image, taken from the
side, registers every candidate (`i2t.registration`), and the belief takes the poses found and their covariance.
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

from experiments.common.runs import Part
from experiments.recognize.trained_run import meshes_by_name
from experiments.studies.lab import Column, EpisodePlan, StudyLab, make_table, pool_parts, report_error, report_methods
from i2t.depth.camera import Camera
from i2t.geometry import inverse
from i2t.hardware.rig import Rig
from i2t.objects import Mesh
from i2t.progress import progress
from i2t.recognition import belief
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import run_belief, session_errors
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.site_pool import SitePool, precompute_outcomes
from i2t.registration.depth import camera_covariance, register_by_depth
from i2t.simulation.depth_camera import add_depth_noise, render_view, table_triangles
from i2t.simulation.touches import SessionErrors, SimulationErrors
from i2t.types import Array

TRANSLATION_STD_M, ROTATION_STD_RAD = 5e-3, math.radians(5.0)  # of the placement, along and about each axis
SIDE_VIEW_DISTANCE_M = 0.12  # from which the camera looks, down by 45 degrees
VIEW_HEIGHT_M = 15e-3  # above the table, of the point that it looks at
KINDS = ("fused", "readings and presence")
FOUND_BY_VIEW = "found by a view"
ERRORS = ("position_error", "rotation_error", "refused", "others_refused")


class RegisteredPoses(NamedTuple):
    """Poses of each candidate, as found by a view of each episode."""

    T_w_o: Array  # (e, objects, 4, 4); where it was believed, if its registration was refused
    covariance: Array  # (6, 6) m^2, mean of those that were found
    refused: Array  # (e, objects)


def evaluate(lab: StudyLab) -> Part:
    """Beliefs with the object known to 1 mm, known to 5 mm, and found by a view, with common random numbers."""
    key_sites, key_episodes = jax.random.split(lab.key)
    plan = lab.plan(key_sites)
    errors = replace(lab.cfg.errors, placement=TRANSLATION_STD_M, placement_angle=ROTATION_STD_RAD)
    found: dict[str, np.ndarray] = {"truth": plan.truth, "pool": plan.pool}
    for name, world in (("known to 1 mm", lab.cfg.errors), ("known to 5 mm", errors)):
        particles = lab.particles(world)
        (table,) = lab.predict(plan.sites, particles, [lab.pad_model.reading_model], name)
        episodes = lab.simulate(jax.random.clone(key_episodes), plan, name, errors=world)
        beliefs = run_belief(table, episodes, lab.pad_model.likelihood, particles, KINDS)
        found |= {f"{kind}, {name}": p for kind, p in beliefs.items()}

    sessions = jax.device_get(session_errors(jax.random.clone(key_episodes), len(plan.truth), errors))
    poses = register_views(meshes_by_name(lab.names), plan.truth, sessions, errors, lab.seed)
    beliefs = evaluate_registered(lab, jax.random.clone(key_episodes), plan, poses, errors)
    found |= {f"{kind}, {FOUND_BY_VIEW}": p for kind, p in beliefs.items()}
    return found | registration_errors(plan.truth, poses, sessions)


def evaluate_registered(
    lab: StudyLab, key: jax.Array, plan: EpisodePlan, poses: RegisteredPoses, errors: SimulationErrors
) -> dict[str, np.ndarray]:
    """Beliefs in episodes whose sites and poses come from the registered views."""
    particles = belief.sample_particles(poses.covariance, lab.cfg.num_particles, lab.seed)
    owner = plan.sites.owner[plan.chosen]
    T_w_site = (
        poses.T_w_o[np.arange(len(plan.truth))[:, None], owner] @ np.asarray(plan.sites.T_w_t, float)[plan.chosen]
    )
    sites = SitePool(jnp.float32(T_w_site.reshape(-1, 4, 4)), owner.reshape(-1))
    moved = EpisodePlan(sites, plan.truth, np.arange(plan.chosen.size).reshape(plan.chosen.shape), plan.pool)
    episodes = lab.simulate(key, moved, FOUND_BY_VIEW, errors=errors)
    table = predict_registered(lab, particles, T_w_site, poses)
    return run_belief(table, episodes, lab.pad_model.likelihood, particles, KINDS)


def predict_registered(
    lab: StudyLab, particles: Particles, T_w_site: np.ndarray, poses: RegisteredPoses
) -> PredictedTouch:
    """Predicted touches (sites, objects, k), each object standing where the episode's view has it."""
    columns = []
    for i, (name, surface) in enumerate(zip(lab.names, lab.surfaces, strict=True)):
        T_o_site = inverse(poses.T_w_o[:, i])[:, None] @ T_w_site  # as if that object stood at the origin
        columns += precompute_outcomes(
            [surface], particles.twist, jnp.float32(T_o_site.reshape(-1, 4, 4)), [lab.pad_model.reading_model],
            overtravel=lab.cfg.limits.overtravel, label=f"found: {name}",
        )  # fmt: skip
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *columns)


def register_views(
    meshes: dict[str, Mesh], truth: np.ndarray, sessions: SessionErrors, errors: SimulationErrors, seed: int
) -> RegisteredPoses:
    """Register every candidate to one view of each episode."""
    camera, T_w_c, candidates = Rig().camera, _camera_pose(), list(meshes.values())
    T_w_o = np.tile(np.eye(4), (len(truth), len(meshes), 1, 1))
    refused = np.zeros(T_w_o.shape[:2], bool)
    covariances = []
    for e, which in enumerate(progress(truth, desc="registering", unit="view")):
        T_w_lens = T_w_c @ sessions.T_t_camera[e]
        depth = _depth_view(candidates[which], sessions.T_o_placed[e], T_w_lens, camera, errors, (seed, e))
        for o, mesh in enumerate(candidates):
            try:
                found = register_by_depth(
                    mesh, np.eye(4), depth, camera, T_w_c, translation_std=TRANSLATION_STD_M,
                    rotation_std=ROTATION_STD_RAD,
                )  # fmt: skip
            except ValueError:  # the view does not look like this candidate
                refused[e, o] = True
                continue
            T_w_o[e, o] = found.T_w_o
            T_c_o = inverse(T_w_c) @ T_w_o[e, o]
            covariances.append(camera_covariance(found.covariance, T_c_o, errors.hand_eye, errors.hand_eye_angle))
    return RegisteredPoses(T_w_o, np.mean(covariances, axis=0), refused)


def registration_errors(truth: np.ndarray, poses: RegisteredPoses, sessions: SessionErrors) -> dict[str, np.ndarray]:
    """Errors of the view's pose of the true object (m, rad), and which registrations were refused."""
    rows = np.arange(len(truth)), truth
    difference = inverse(sessions.T_o_placed) @ poses.T_w_o[rows]
    refused = poses.refused[rows]
    return {
        "position_error": np.linalg.norm(difference[:, :3, 3], axis=1),
        "rotation_error": np.linalg.norm(Rotation.from_matrix(difference[:, :3, :3]).as_rotvec(), axis=1),
        "refused": refused,
        "others_refused": poses.refused.sum(1) - refused,
    }


def _camera_pose() -> Array:
    """A camera that looks at the object from the side and above."""
    z = -np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    y = np.cross(z, [0.0, 1.0, 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    T[:3, 3] = -SIDE_VIEW_DISTANCE_M * z + [0.0, 0.0, VIEW_HEIGHT_M]
    return T


def _depth_view(
    mesh: Mesh, T_w_o: Array, T_w_c: Array, camera: Camera, errors: SimulationErrors, seed: tuple[int, int]
) -> Array:
    """A simulated depth image (m) of an object on the table."""
    triangles = mesh.vertices[mesh.faces] @ T_w_o[:3, :3].T + T_w_o[:3, 3]
    depth, _ = render_view(np.concatenate([triangles, table_triangles(np.eye(4))]), T_w_c, camera)
    return add_depth_noise(depth, errors, np.random.default_rng(seed))


def report(parts: Sequence[Part], out: Path, pads: Sequence[str]) -> dict[str, Any]:
    """Gain from knowing the pose, and errors of the pose that a view finds."""
    columns = pool_parts([{key: part[key] for key in ERRORS} for part in parts])
    result = report_methods([{key: p for key, p in part.items() if key not in ERRORS} for part in parts], out, pads)
    kept, where = ~columns["refused"], "as the view has the object"
    for key, unit, factor in (("position_error", "mm", 1e3), ("rotation_error", "degrees", np.degrees(1.0))):
        result[key] = report_error(key.replace("_", " "), unit, factor * columns[key][kept], where)
    refused = {"true_object": int(columns["refused"].sum()), "others": int(columns["others_refused"].sum())}
    result["refused"] = refused
    quantiles = [
        [key.replace("_", " "), result[key]["unit"], *result[key]["percentiles_25_50_75_90"]] for key in ERRORS[:2]
    ]
    head = ["error", "unit", *(Column(name, 2) for name in ("25 %", "median", "75 %", "90 % below"))]
    result["tables"]["view"] = make_table(head, quantiles)
    print(f"registrations refused: {refused['true_object']} of the true object, {refused['others']} of others")
    return result
