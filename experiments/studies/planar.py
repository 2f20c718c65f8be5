"""Cost of not knowing where the object stands. It lies anywhere on a patch of table, turned in any way, and is pressed
straight down at random points of the table (`i2t.recognition.planar`). Where the table is, is known no better than a
placement elsewhere: its height and its tilts err by `SimulationErrors.placement` and `placement_angle`.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.common.runs import Part
from experiments.recognize import figures
from experiments.studies.lab import (
    EpisodePlan,
    StudyLab,
    clusters_of,
    format_estimate,
    make_table,
    pool_parts,
    report_error,
    touches_shown,
)
from i2t import viz
from i2t.geometry import from_twist, inverse
from i2t.progress import progress
from i2t.recognition import belief, metrics, planar
from i2t.recognition.belief import Belief, Likelihood, Particles, TouchObservation
from i2t.recognition.episodes import Episodes
from i2t.recognition.intervals import estimate_at, mean_interval
from i2t.recognition.metrics import to_json
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.planar import PlanarGrid, PlanarPose
from i2t.recognition.site_pool import SitePool, precompute_outcomes
from i2t.simulation.touches import SimulationErrors
from i2t.types import TWIST_LEVER_M

TOUCHES, DEBUG_TOUCHES = 20, 3
DEBUG_GRID = PlanarGrid(half=5e-3, reach=5e-3, step=5e-3, turns=4)
OVERTRAVEL_M = 20e-3  # beyond the sites of the table: presses end 10 mm over the table
KNOWN_POSE_STD = (1e-3, 1e-3, np.radians(2.4))  # m, m, rad: 1 mm, 1 degree and half a step of the grid's turns
SYMMETRY = {"square": 4, "star": 5, "cylinder": 0}  # turns that look alike; 0: all of them; else one
PLANAR_TOUCHES_SHOWN = (1, 5, 10, 15, 20)


class TablePresses(NamedTuple):
    """Poses of objects and sites pressed on the table."""

    truth: np.ndarray  # (e,)
    pose: np.ndarray  # (e, 3) m, m, rad
    site: np.ndarray  # (e, t, 2) m, on the table
    table: np.ndarray  # (e, 6) m, twist of the object in its own frame: how the table lies otherwise than believed


def evaluate(lab: StudyLab) -> Part:
    """Beliefs about objects anywhere on the table, with their pose unknown and known, and where they are found."""
    grid = DEBUG_GRID if lab.args.debug else PlanarGrid()
    presses = draw_presses(lab, grid)
    episodes = simulate_presses(lab, presses, grid)
    judge = Judge(lab, predict_touches(lab, grid), grid)
    unknown, known, found = [], [], []
    for i in progress(range(len(presses.truth)), desc="planar: believing", unit="episode"):
        p, poses = judge.unknown(presses, episodes, i)
        unknown.append(p)
        found.append(poses[presses.truth[i]])
        known.append(judge.known(presses, episodes, i))
    error = np.stack(found) - presses.pose
    symmetry = np.array([SYMMETRY.get(lab.names[i], 1) for i in presses.truth])
    return {
        "truth": presses.truth, "unknown pose": np.stack(unknown), "known pose": np.stack(known),
        "position_error": np.linalg.norm(error[:, :2], axis=1), "rotation_error": rotation_error(error[:, 2], symmetry),
    }  # fmt: skip


def draw_presses(lab: StudyLab, grid: PlanarGrid) -> TablePresses:
    """Random poses of the objects, and random points of the table about its middle."""
    truth, rng = lab.truth(), np.random.default_rng(lab.seed)
    touches = DEBUG_TOUCHES if lab.args.debug else TOUCHES
    pose = rng.uniform([-1, -1, -np.pi], [1, 1, np.pi], (len(truth), 3)) * [grid.half, grid.half, 1]
    radius = grid.reach * np.sqrt(rng.random((2, len(truth), touches)))[0]
    angle = rng.random((len(truth), touches))
    site = radius[..., None] * np.stack([np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)], -1)
    table = table_std(lab.cfg.errors) * rng.standard_normal((len(truth), 6))
    return TablePresses(truth, pose, site, table)


def table_std(errors: SimulationErrors) -> np.ndarray:
    """Standard deviations (6,) m of the twist by which the table lies otherwise than believed: height and tilts."""
    tilt = TWIST_LEVER_M * errors.placement_angle
    return np.array([0.0, 0.0, errors.placement, tilt, tilt, 0.0])


def add_table_errors(particles: Particles, std: np.ndarray) -> Particles:
    """Particles that may also be displaced as the table is."""
    variance = jnp.diag(jnp.float32(std**2))
    return particles._replace(covariance=particles.covariance + jnp.broadcast_to(variance, particles.covariance.shape))


def simulate_presses(lab: StudyLab, presses: TablePresses, grid: PlanarGrid) -> Episodes:
    """Simulated presses, each at a site of its own in the frame of the object that is there."""
    episodes, touches = presses.site.shape[:2]
    limits = replace(lab.cfg.limits, overtravel=OVERTRAVEL_M)
    errors = replace(lab.cfg.errors, placement=0.0, placement_angle=0.0)
    poses = jnp.float32(_object_frame_sites(presses, grid))
    sites = SitePool(poses, np.repeat(presses.truth, touches))
    plan = EpisodePlan(
        sites, presses.truth, np.arange(episodes * touches).reshape(episodes, touches), np.arange(episodes)
    )
    return lab.simulate(lab.key, plan, "planar", errors=errors, limits=limits)


def _object_frame_sites(presses: TablePresses, grid: PlanarGrid) -> np.ndarray:
    """Poses (e * t, 4, 4) of presses in the frames of the objects, on the table as it lies."""
    to_object = jax.vmap(jax.vmap(planar.object_frame_pose, (None, 0)))
    at = np.asarray(to_object(jnp.float32(presses.pose), jnp.float32(presses.site)), float).reshape(-1, 2)
    turn = np.repeat(-presses.pose[:, 2], presses.site.shape[1])
    poses = [planar.vertical_press_pose(x, y, phi, grid.height) for (x, y), phi in zip(at, turn, strict=True)]
    displaced = np.stack([inverse(np.asarray(from_twist(twist))) for twist in presses.table])
    return np.repeat(displaced, presses.site.shape[1], axis=0) @ np.stack(poses)


def predict_touches(lab: StudyLab, grid: PlanarGrid) -> PredictedTouch:
    """Predicted touches (nodes, objects) of the grid."""
    nodes, origin = jnp.asarray(planar.node_poses(grid)), jnp.zeros((1, 6))
    (found,) = precompute_outcomes(
        lab.surfaces, origin, nodes, [lab.pad_model.reading_model], overtravel=OVERTRAVEL_M, label="planar"
    )
    return jax.device_put(jax.tree.map(lambda x: x[:, :, 0], found))


class Judge:
    """Beliefs about what lies on the table."""

    def __init__(self, lab: StudyLab, predicted: PredictedTouch, grid: PlanarGrid) -> None:
        cells, particles = planar.pose_cells(grid)
        particles = add_table_errors(particles, table_std(lab.cfg.errors))
        self._cells = jnp.asarray(cells)
        self._start = belief.init(particles, len(lab.surfaces), channels=predicted.reading.shape[-1])
        likelihood = lab.pad_model.likelihood._replace(overtravel=jnp.float32(OVERTRAVEL_M))
        self._run = jax.jit(
            partial(_run_belief, predicted=predicted, cells=self._cells, likelihood=likelihood, grid=grid)
        )

    def unknown(self, presses: TablePresses, episodes: Episodes, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities (t, objects) after each touch of an episode, and the most probable pose of each object."""
        p, poses = self._run(self._start, *_touches_of(presses, episodes, i))
        return np.asarray(p), np.asarray(poses.pose)

    def known(self, presses: TablePresses, episodes: Episodes, i: int) -> np.ndarray:
        """Probabilities (t, objects) after each touch of an episode, for somebody who knows where the object lies."""
        pose = jnp.float32(presses.pose[i])
        start = planar.condition_on_pose(self._start, self._cells, pose, jnp.float32(KNOWN_POSE_STD))
        return np.asarray(self._run(start, *_touches_of(presses, episodes, i))[0])


def _touches_of(presses: TablePresses, episodes: Episodes, i: int) -> tuple[Array, TouchObservation]:
    """Sites and observations of one episode."""
    return jnp.float32(presses.site[i]), jax.tree.map(lambda x: x[i], episodes.observations)


def _run_belief(
    start: Belief,
    site: Array,
    observations: TouchObservation,
    *,
    predicted: PredictedTouch,
    cells: Array,
    likelihood: Likelihood,
    grid: PlanarGrid,
) -> tuple[Array, PlanarPose]:
    """Probabilities of the objects after each touch, and the most probable pose of each in the end."""

    def step(now: Belief, touched: tuple[Array, TouchObservation]) -> tuple[Belief, Array]:
        now = planar.update(
            now, touched[1], touched[0], cells=cells, predicted=predicted, likelihood=likelihood, grid=grid
        )
        return now, belief.posterior(now)

    now, p = jax.lax.scan(step, start, (site, observations))
    return p, planar.most_probable_poses(now, cells, grid)


def rotation_error(angle: np.ndarray, symmetry: np.ndarray) -> np.ndarray:
    """Error of a rotation (rad), as far as the symmetry of the objects lets it be seen."""
    period = 2 * np.pi / np.maximum(symmetry, 1)
    error = np.abs((angle + period / 2) % period - period / 2)
    return np.where(symmetry == 0, 0.0, error)


def report(parts: Sequence[Part], out: Path, pads: Sequence[str]) -> dict[str, Any]:
    """Cost of not knowing the pose, and errors of the pose found."""
    columns, clusters = pool_parts(parts), clusters_of(parts, pads)
    truth = columns["truth"]
    result: dict[str, Any] = {"episodes": len(truth), "methods": {}}
    curves = {}
    for name in ("known pose", "unknown pose"):
        p = columns[name].astype(np.float64)
        curves[name] = metrics.accuracy(p, truth, clusters=clusters)
        result["methods"][name] = {
            "accuracy": to_json(curves[name]), "log_loss": metrics.log_loss(p, truth).mean(0).tolist(),
        }  # fmt: skip
        shown = touches_shown(p.shape[1], PLANAR_TOUCHES_SHOWN)
        print(f"{name:14} " + "   ".join(f"{t}: {format_estimate(estimate_at(curves[name], t - 1))}" for t in shown))
    hits = {name: metrics.hits(columns[name], truth) for name in curves}
    lost = metrics.compare_paired(hits["known pose"], hits["unknown pose"], clusters=clusters)
    lost_at = mean_interval(hits["known pose"] - hits["unknown pose"], clusters)
    result["lost"] = to_json(lost)
    print(f"accuracy lost after the last touch: {format_estimate(lost.last)}")
    shown = touches_shown(len(curves["known pose"].mean), PLANAR_TOUCHES_SHOWN)
    rows = [[name, *(estimate_at(curve, t - 1) for t in shown)] for name, curve in curves.items()]
    rows.append(["lost by not knowing it", *(estimate_at(lost_at, t - 1) for t in shown)])
    result["tables"] = {"curves": make_table(["", *(f"after {t} [95 %]" for t in shown)], rows)}
    right, where = hits["unknown pose"][:, -1] > 0.5, "where the object is right"
    for key, unit, factor in (("position_error", "mm", 1e3), ("rotation_error", "degrees", np.degrees(1.0))):
        result[key] = report_error(key.replace("_", " "), unit, factor * columns[key][right], where)
    viz.save_figure(figures.accuracy(curves, "Anywhere on the table", True), out / "accuracy.png")
    return result
