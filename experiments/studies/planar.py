"""What does it cost not to know where the object stands? It lies anywhere on a patch of table, turned in any way, and
is pressed straight down at random points of the table (`i2t.recognition.planar`).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

from experiments.recognize import figures as drawing
from experiments.studies.lab import Lab, shown, sit, spread
from i2t import viz
from i2t.recognition import belief, planar
from i2t.recognition import metrics as scores
from i2t.recognition.belief import Belief, Likelihood, TouchObservation
from i2t.recognition.metrics import to_json
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.planar import PlanarGrid, PlanarPose
from i2t.recognition.site_pool import SitePool, precompute_outcomes

TOUCHES = 20
PAST = 20e-3  # m, how far presses go below the table's sites: to 10 mm over the table
KNOWN = (1e-3, 1e-3, np.radians(2.4))  # of the pose, where it is: 1 mm, 1 degree and half a step of the turns
TURNS = {"square": 4, "star": 5, "cylinder": 0}  # turns that look alike; 0: all of them; else one


def play(lab: Lab) -> dict[str, Any]:
    """Sittings with objects anywhere on the table, judged with their pose unknown and known."""
    debug = lab.args.preset == "debug"
    table = PlanarGrid(half=5e-3, reach=5e-3, step=5e-3, turns=4) if debug else PlanarGrid()
    touches = 3 if debug else TOUCHES
    limits = replace(lab.cfg.limits, overtravel=PAST)
    errors = replace(lab.cfg.errors, placement=0.0, placement_angle=0.0)
    nothing = jnp.zeros((1, 6))
    (found,) = precompute_outcomes(
        lab.surfaces, nothing, jnp.asarray(planar.node_poses(table)), [lab.learnt.reading_model],
        overtravel=PAST, label="planar",
    )  # fmt: skip
    imagined = jax.device_put(jax.tree.map(lambda x: x[:, :, 0], found))

    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    rng = np.random.default_rng(lab.seed)
    pose = rng.uniform([-1, -1, -np.pi], [1, 1, np.pi], (len(truth), 3)) * [table.half, table.half, 1]
    radius, angle = table.reach * np.sqrt(rng.random((2, len(truth), touches)))[0], rng.random((len(truth), touches))
    site = radius[..., None] * np.stack([np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)], -1)
    sites = SitePool(jnp.float32(_seen_from(pose, site, table)), np.repeat(truth, touches))
    chosen = np.arange(len(truth) * touches).reshape(len(truth), touches)
    episodes = sit(lab, lab.key, sites, truth, chosen, "planar", errors=errors, limits=limits)

    cells, places = planar.pose_cells(table)
    like = lab.learnt.likelihood._replace(overtravel=jnp.float32(PAST))
    start = belief.init(places, len(lab.surfaces), channels=imagined.reading.shape[-1])
    judge = jax.jit(partial(_judge, imagined=imagined, pose=jnp.asarray(cells), like=like, table=table))
    unknown, known, stands = [], [], []
    for i in tqdm(range(len(truth)), desc="planar: believing", unit="sitting"):
        at = jax.tree.map(lambda x, i=i: x[i], episodes.observations)
        p, stood = judge(start, jnp.float32(site[i]), at)
        told = planar.condition_on_pose(start, jnp.asarray(cells), jnp.float32(pose[i]), jnp.float32(KNOWN))
        q, _ = judge(told, jnp.float32(site[i]), at)
        unknown.append(np.asarray(p))
        known.append(np.asarray(q))
        stands.append(np.asarray(stood.pose)[truth[i]])
    found_pose = np.stack(stands)
    turns = np.array([TURNS.get(lab.names[i], 1) for i in truth])
    return {
        "truth": truth, "unknown pose": np.stack(unknown), "known pose": np.stack(known),
        "off": np.linalg.norm(found_pose[:, :2] - pose[:, :2], axis=1),
        "turned": turned(found_pose[:, 2] - pose[:, 2], turns),
    }  # fmt: skip


def _seen_from(pose: np.ndarray, site: np.ndarray, table: PlanarGrid) -> np.ndarray:
    """Sites (e * t, 4, 4) of presses at points of the table (e, t, 2), in the frames of objects in poses (e, 3)."""
    seen = jax.vmap(jax.vmap(planar.object_frame_pose, (None, 0)))(jnp.float32(pose), jnp.float32(site))
    at = np.asarray(seen, float).reshape(-1, 2)
    turn = np.repeat(-pose[:, 2], site.shape[1])
    return np.stack([planar.vertical_press_pose(x, y, phi, table.height) for (x, y), phi in zip(at, turn, strict=True)])


def _judge(
    start: Belief, site: Array, measured: TouchObservation, imagined: PredictedTouch, pose: Array, like: Likelihood, table: PlanarGrid
) -> tuple[Array, PlanarPose]:
    """Probabilities of the objects after each touch, and where each would stand in the end."""

    def step(now: Belief, touched: tuple[Array, TouchObservation]) -> tuple[Belief, Array]:
        now = planar.update(
            now, touched[1], touched[0], cells=pose, predicted=imagined, likelihood=like, grid=table
        )
        return now, belief.posterior(now)

    now, p = jax.lax.scan(step, start, (site, measured))
    return p, planar.most_probable_poses(now, pose, table)


def turned(angle: np.ndarray, alike: np.ndarray) -> np.ndarray:
    """Error of a turn (rad), as far as it can be seen."""
    period = 2 * np.pi / np.maximum(alike, 1)
    error = np.abs((angle + period / 2) % period - period / 2)
    return np.where(alike == 0, 0.0, error)


def report(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """What not knowing the pose costs, and how well it is found."""
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    truth = columns["truth"]
    result: dict[str, Any] = {"sittings": len(truth), "methods": {}}
    curves = {}
    for name in ("known pose", "unknown pose"):
        p = columns[name].astype(np.float64)
        curves[name] = scores.accuracy(p, truth)
        result["methods"][name] = {
            "accuracy": to_json(curves[name]),
            "log_loss": scores.log_loss(p, truth).mean(0).tolist(),
        }
        shown_at = sorted({min(t, p.shape[1]) for t in (1, 5, 10, 15, 20)})
        print(f"{name:14} " + "   ".join(
            f"{t}: {shown(scores.Estimate(*(x[t - 1] for x in curves[name])))}" for t in shown_at))  # fmt: skip
    lost = scores.compare_paired(*(scores.hits(columns[name], truth) for name in ("known pose", "unknown pose")))
    result["lost"] = to_json(lost)
    print(f"lost after the last touch: {shown(lost.last)}")
    right = scores.hits(columns["unknown pose"], truth)[:, -1] > 0.5
    where = "where the object is right"
    result["off"] = spread("off", "mm", 1e3 * columns["off"][right], where)
    result["turned"] = spread("turned", "degrees", np.degrees(columns["turned"][right]), where)
    viz.save_figure(drawing.accuracy(curves, "Anywhere on the table", True), out / "accuracy.png")
    return result
