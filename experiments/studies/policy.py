"""Touches until one is confident under each policy: random, the paper's heuristic, the most informative."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.common.runs import Part
from experiments.recognize import figures
from experiments.studies.lab import Column, StudyLab, clusters_of, format_estimate, make_table, pool_parts
from i2t import viz
from i2t.progress import progress
from i2t.recognition import belief, calibrated, metrics
from i2t.recognition.belief import Belief, Particles
from i2t.recognition.episodes import EpisodeConfig, EpisodeSimulator
from i2t.recognition.metrics import to_json
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.planning import (
    choose_heuristic_sites,
    choose_informative_sites,
    choose_random_sites,
    heuristic_weights,
    update_beliefs,
)
from i2t.recognition.site_pool import SitePool, safe_sites

POLICIES = ("random", "heuristic", "information")
CONFIDENCE = 0.95  # that episodes are to reach


class TouchOptions(NamedTuple):
    """Sites that policies choose among, and what is known of each."""

    sites: SitePool
    table: PredictedTouch  # predicted touches, (sites, objects, k)
    weights: Array  # (objects, sites), of the paper's heuristic
    safe: Array  # (sites, objects)


def evaluate(lab: StudyLab) -> Part:
    """Beliefs (e, t, objects) in episodes with common random numbers under each policy."""
    key_sites, key_episodes, key_choice = jax.random.split(lab.key, 3)
    sites, truth, particles = lab.sample_sites(key_sites), lab.truth(), lab.particles()
    (table,) = lab.predict(sites, particles, [lab.pad_model.reading_model], "policy")
    safe = jnp.asarray(safe_sites(lab.surfaces, sites, lab.cfg.site_limits))
    choices = TouchOptions(sites, jax.device_put(table), heuristic_weights(sites), safe)
    found: dict[str, np.ndarray] = {"truth": truth}
    for policy in POLICIES:
        keys = jax.random.clone(key_episodes), jax.random.clone(key_choice)
        found[policy] = run_policy(lab, policy, keys, truth, particles, choices)
    return found


def run_policy(
    lab: StudyLab,
    policy: str,
    keys: tuple[Array, Array],
    truth: np.ndarray,
    particles: Particles,
    choices: TouchOptions,
) -> np.ndarray:
    """Beliefs (e, t, objects) in episodes whose next touch a policy chooses; keys of the episodes and the choices."""
    config = EpisodeConfig(lab.cfg.errors, lab.cfg.limits, lab.cfg.touches)
    simulator = EpisodeSimulator(keys[0], lab.surfaces, truth, sites=choices.sites, pad=lab.run.pad, config=config)
    episodes = len(truth)
    start = belief.init(particles, len(lab.surfaces), channels=choices.table.reading.shape[-1])
    beliefs = jax.tree.map(lambda x: jnp.broadcast_to(x, (episodes, *x.shape)), start)
    touched = np.zeros((episodes, len(choices.sites.owner)), bool)
    after = []
    for step in progress(range(lab.cfg.touches), desc=f"policy {policy}", unit="touch"):
        step_keys = jax.random.split(jax.random.fold_in(keys[1], step), episodes)
        site = choose_sites(lab, policy, step_keys, beliefs, jnp.asarray(touched), choices, step)
        # An episode without a safe site ends there: its belief stays, and what is simulated for it is not used.
        simulated = np.maximum(site, 0)
        touched[np.arange(episodes), simulated] |= site >= 0
        simulator.touch(simulated[:, None])
        last = jax.tree.map(lambda x: x[:, -1], simulator.observations())
        beliefs, p = update_beliefs(beliefs, jnp.asarray(site), last, choices.table, lab.pad_model.likelihood)
        after.append(np.asarray(p))
    return np.stack(after, axis=1)


def choose_sites(
    lab: StudyLab, policy: str, keys: Array, beliefs: Belief, touched: Array, choices: TouchOptions, step: int
) -> np.ndarray:
    """The next site of each episode, -1 where none is left."""
    if policy == "information":
        site = choose_informative_sites(
            keys, beliefs, choices.table, lab.pad_model.likelihood, touched=touched, safe=choices.safe,
            skin_change=lab.cfg.limits.skin_change,
        )  # fmt: skip
    elif policy == "heuristic":
        site = choose_heuristic_sites(keys, beliefs, choices.weights, touched=touched, safe=choices.safe, step=step)
    else:
        site = choose_random_sites(keys, beliefs, touched=touched, safe=choices.safe)
    return np.asarray(site)


def report(parts: Sequence[Part], out: Path, pads: Sequence[str]) -> dict[str, Any]:
    """Accuracy and touches to confidence under each policy, and what choosing by information saves."""
    columns, clusters = pool_parts(parts), clusters_of(parts, pads)
    truth = columns["truth"]
    p = {policy: calibrated.calibrated_beliefs(columns[policy]) for policy in POLICIES}
    touches = next(iter(p.values())).shape[1]
    first = {policy: metrics.confident_at(each, CONFIDENCE) for policy, each in p.items()}
    curves = {policy: metrics.accuracy(each, truth, clusters=clusters) for policy, each in p.items()}
    result: dict[str, Any] = {"episodes": len(truth), "policies": {}, "touches_saved": {}}
    for policy, each in p.items():
        mean = metrics.mean_accuracy(each, truth, clusters=clusters)
        needed = metrics.touches_to_confidence(first[policy], touches, clusters=clusters)
        result["policies"][policy] = {
            "accuracy": to_json(curves[policy]), "mean": to_json(mean), "touches_to_95": to_json(needed),
        }  # fmt: skip
        print(
            f"{policy:12} {format_estimate(mean)} mean accuracy, {format_estimate(needed.mean)} touches to "
            f"{CONFIDENCE:.0%} confidence (restricted to {touches}), never {float(needed.never.mean):.2f}"
        )
    for other in ("random", "heuristic"):
        saved = metrics.touches_saved(first["information"], first[other], touches, clusters=clusters)
        result["touches_saved"][other] = to_json(saved)
        print(f"information needs {format_estimate(saved)} fewer touches than {other}")
    result["tables"] = tables_of_policies(result)
    waiting = {
        policy: metrics.not_yet_confident(values, touches, clusters=clusters) for policy, values in first.items()
    }
    figure = figures.not_yet_confident(waiting, f"Touches to {CONFIDENCE:.0%} confidence", True, CONFIDENCE)
    viz.save_figure(figure, out / "touches_to_confidence.png")
    viz.save_figure(figures.accuracy(curves, "Accuracy of each policy", True), out / "accuracy.png")
    return result


def tables_of_policies(result: dict[str, Any]) -> dict[str, Any]:
    """Scores of each policy, and touches that choosing by information saves."""
    rows = [
        [name, scores["mean"], scores["touches_to_95"]["mean"], scores["touches_to_95"]["never"]]
        for name, scores in result["policies"].items()
    ]
    head = [
        "policy", "mean accuracy over touches", Column(f"touches until {CONFIDENCE:.0%} sure, at most those made", 2),
        Column("never so sure", 0, percent=True),
    ]  # fmt: skip
    saved = [[other, each] for other, each in result["touches_saved"].items()]
    return {
        "policies": make_table(head, rows),
        "saved": make_table(["information against", Column("fewer touches", 0, percent=True)], saved),
    }
