"""Accuracy of poses that the paper's rules need, and their baseline that only knows where contacts were.

The same episodes with more and more error of the object's pose, and with noisy views of the objects. Readings are
predicted by the paper's networks, where the run trained them, and by the predictor that it kept.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.runs import Part
from experiments.recognize import figures
from experiments.recognize.paper import kept_predictor, load_paper_networks
from experiments.studies.lab import Column, EpisodePlan, StudyLab, clusters_of, format_estimate, make_table
from i2t import viz
from i2t.recognition import metrics
from i2t.recognition.intervals import Estimate, rate_interval
from i2t.recognition.metrics import to_json
from i2t.recognition.paper_rules import PROPRIOCEPTION, paper_rules
from i2t.recognition.site_pool import plan_informative_touches, sample_pools

COMPARED_RULES = ("votes", "product")
NOISY_POSE_ERROR_MM = 1.0  # pose error at which noisy views are tried
M_PER_MM = 1e-3
DEBUG_POSE_ERRORS_MM, DEBUG_VIEW_NOISE_MM = (0.0, 1.0), (0.3,)


class PoseErrorWorld(NamedTuple):
    """A set of objects, the error of their poses, and the noise of their views."""

    objects: str
    pose_error: float  # mm and degrees, one sigma
    view_noise: float  # mm

    def __str__(self) -> str:
        views = f", views {self.view_noise} mm" if self.view_noise else ""
        return f"{self.objects}, {self.pose_error} mm{views}"


def evaluate(lab: StudyLab) -> Part:
    """Both of the paper's sets in every world, with common random numbers."""
    found: Part = {}
    for i, (name, names) in enumerate({"primitives": lab.cfg.primitives, "tools": lab.cfg.tools}.items()):
        for world, part in evaluate_set(lab, jax.random.fold_in(lab.key, i), name, names).items():
            found[str(len(found))] = {**world._asdict(), **part}
    return found


def evaluate_set(
    lab: StudyLab, key: jax.Array, name: str, names: Sequence[str]
) -> dict[PoseErrorWorld, dict[str, np.ndarray]]:
    """Truth and beliefs by the paper's rules with one set of objects, in each world."""
    pose_errors = DEBUG_POSE_ERRORS_MM if lab.args.debug else lab.args.pose_errors
    view_noises = DEBUG_VIEW_NOISE_MM if lab.args.debug else lab.args.view_noise
    key_sites, key_episodes, key_chosen = jax.random.split(key, 3)
    surfaces = [lab.surfaces[lab.names.index(one)] for one in names]
    truth = np.arange(lab.episodes * len(names)) % len(names)
    pool = np.arange(len(truth)) // lab.cfg.pool_episodes
    pools = sample_pools(
        key_sites, surfaces, names, pools=int(pool[-1]) + 1, each=lab.cfg.pool_sites, limits=lab.cfg.site_limits
    )
    touches = plan_informative_touches(key_chosen, pools, pool, lab.cfg.touches)
    plan = EpisodePlan(touches.sites, truth, touches.chosen, pool)
    networks = load_paper_networks(lab.folder)
    predictors = {**({} if networks is None else networks.networks), **kept_predictor(lab.run.predictor)}
    found = {}
    for pose_error in pose_errors:
        angle = np.radians(pose_error)
        errors = replace(lab.cfg.errors, placement=pose_error * M_PER_MM, placement_angle=angle)
        episodes = lab.simulate(
            jax.random.clone(key_episodes), plan, f"{name}, {pose_error} mm", surfaces=surfaces, errors=errors
        )
        for noise in (0.0, *view_noises) if pose_error == NOISY_POSE_ERROR_MM else (0.0,):
            std = lab.pad_model.reading_std
            beliefs = paper_rules(predictors, std, surfaces, episodes, view_noise=noise * M_PER_MM)
            kept = {rule: p for rule, p in beliefs.items() if rule.endswith(COMPARED_RULES)}
            found[PoseErrorWorld(name, pose_error, noise)] = {"truth": truth, "pool": pool, **kept}
    return found


def report(parts: Sequence[Part], out: Path, pads: Sequence[str]) -> dict[str, Any]:
    """Accuracy after the last touch in every world, and the pose error at which the baseline overtakes."""
    result: dict[str, Any] = {"worlds": {}}
    differences: dict[str, list[Estimate]] = {}
    sizes: set[float] = set()
    for number, first in parts[0].items():
        world = PoseErrorWorld(str(first["objects"]), float(first["pose_error"]), float(first["view_noise"]))
        sizes.add(world.pose_error)
        entry, by_rule = compare_rules([part[number] for part in parts], pads)
        result["worlds"][str(world)] = entry
        for rule, difference in by_rule.items() if not world.view_noise else ():
            differences.setdefault(f"{world.objects}, {rule}", []).append(difference)
        print(f"{world!s}, proprioception and each source less proprioception:")
        for rule, scores in entry["rules"].items():
            base = scores[PROPRIOCEPTION]["accuracy"]["mean"]
            line = [
                f"{source} {score['accuracy']['mean']:.3f} ({format_estimate(by_rule[f'{source}, {rule}'])})"
                for source, score in scores.items()
                if source != PROPRIOCEPTION
            ]
            print(f"  {rule:8} {base:.3f}   " + "   ".join(line))
    result["tables"] = {"worlds": table_of_worlds(result["worlds"])}
    columns = {name: zip(*each, strict=True) for name, each in differences.items()}
    lines = {name: Estimate(*(np.array(x, float) for x in each)) for name, each in columns.items()}
    result["equal_at_mm"] = {name: sign_changes(sorted(sizes), line.mean) for name, line in lines.items()}
    for name, at in result["equal_at_mm"].items():
        where = " and ".join(f"{x:.2f} mm" for x in at) or "no pose error"
        print(f"{name}: readings and contact positions are equally good at {where}")
    if len(sizes) > 1:
        viz.save_figure(figures.accuracy_differences(sorted(sizes), lines, True), out / "pose_error.png")
    return result


def table_of_worlds(worlds: dict[str, Any]) -> dict[str, Any]:
    """Accuracies of the paper's rules in every world, and how much better they are than contact positions alone."""
    rows = [
        [world, f"{source}, {rule}", score["accuracy"], score.get("difference", "-")]
        for world, entry in worlds.items()
        for rule, scores in entry["rules"].items()
        for source, score in scores.items()
    ]
    head = ["objects, error of placement", "method", "after the last [95 %]"]
    return make_table([*head, Column("minus proprioception", signed=True)], rows)


def compare_rules(parts: Sequence[Part], pads: Sequence[str]) -> tuple[dict[str, Any], dict[str, Estimate]]:
    """Accuracies from each source in one world, by rule; and how much better each source of readings is than contact
    positions, by source and rule.
    """
    columns = {
        name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name not in PoseErrorWorld._fields
    }
    truth, _ = columns.pop("truth"), columns.pop("pool")
    clusters = clusters_of(parts, pads)
    entry: dict[str, Any] = {"episodes": len(truth), "rules": {}}
    differences = {}
    for rule in COMPARED_RULES:
        hits = {
            name.removesuffix(f", {rule}"): metrics.hits(p, truth)
            for name, p in columns.items()
            if name.endswith(f", {rule}")
        }
        entry["rules"][rule] = {}
        for source, hit in hits.items():
            scores = {"accuracy": to_json(rate_interval(hit[:, -1], clusters))}
            if source != PROPRIOCEPTION:
                difference = metrics.compare_paired(hit, hits[PROPRIOCEPTION], clusters=clusters).last
                differences[f"{source}, {rule}"] = difference
                scores["difference"] = to_json(difference)
            entry["rules"][rule][source] = scores
    return entry, differences


def sign_changes(sizes: Sequence[float], values: Sequence[float] | np.ndarray) -> list[float]:
    """Sizes at which values change sign, on the straight lines between those measured."""
    steps = zip(pairwise(sizes), pairwise(values), strict=True)
    return [float(a + (b - a) * x / (x - y)) for (a, b), (x, y) in steps if x * y < 0]
