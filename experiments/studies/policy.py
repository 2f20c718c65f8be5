"""Touches until one is confident, where they are chosen at random, by the paper's heuristic and by information."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.common.runs import Part
from experiments.studies.lab import StudyLab
from experiments.studies.report import Column, clusters_of, make_table, pool_parts
from i2t.progress import progress
from i2t.recognition import belief, calibrated, metrics
from i2t.recognition.episodes import EpisodeConfig, EpisodeSimulator
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.policy import (
    choose_heuristic_sites,
    choose_informative_sites,
    choose_random_sites,
    heuristic_weights,
    update_beliefs,
)
from i2t.recognition.site_pool import SitePool, safe_sites, sample_sites

CONFIDENCE = 0.95  # that episodes are to reach
Policy: TypeAlias = Callable[..., Array]  # of keys, beliefs, touched sites and the number of touches so far


def evaluate(lab: StudyLab) -> Part:
    """Beliefs (e, t, objects) in episodes with common random numbers under each policy."""
    key_sites, key_episodes, key_choice = jax.random.split(lab.key, 3)
    sites = sample_sites(key_sites, lab.surfaces, lab.names, lab.cfg.num_sites, lab.cfg.site_limits)
    (table,) = jax.device_put(lab.predict(sites, lab.particles(), [lab.pad_model.reading_model], "policy"))
    safe = jnp.asarray(safe_sites(lab.surfaces, sites, lab.cfg.site_limits))
    weights, informed = heuristic_weights(sites), {"likelihood": lab.pad_model.likelihood, "table": table}
    change = lab.cfg.limits.skin_change
    policies: dict[str, Policy] = {
        "random": lambda keys, beliefs, touched, step: choose_random_sites(keys, beliefs, touched=touched, safe=safe),
        "heuristic": lambda keys, beliefs, touched, step: choose_heuristic_sites(
            keys, beliefs, weights, touched=touched, safe=safe, step=step
        ),
        "information": lambda keys, beliefs, touched, step: choose_informative_sites(
            keys, beliefs, **informed, touched=touched, safe=safe, skin_change=change
        ),
    }
    run = partial(run_policy, lab, sites=sites, table=table)
    found: Part = {"truth": lab.truth()}
    for name, policy in policies.items():
        found[name] = run(policy, name, (jax.random.clone(key_episodes), jax.random.clone(key_choice)))
    return found


def run_policy(
    lab: StudyLab, policy: Policy, name: str, keys: tuple[Array, Array], *, sites: SitePool, table: PredictedTouch
) -> np.ndarray:
    """Beliefs (e, t, objects) in episodes whose next touch a policy chooses; keys of the episodes and the choices."""
    truth = lab.truth()
    config = EpisodeConfig(lab.cfg.errors, lab.cfg.limits, lab.cfg.touches)
    simulator = EpisodeSimulator(keys[0], lab.surfaces, truth, sites=sites, pad=lab.run.pad, config=config)
    start = belief.init(lab.particles(), len(lab.surfaces), channels=table.reading.shape[-1])
    beliefs = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(truth), *x.shape)), start)
    touched = np.zeros((len(truth), len(sites.owner)), bool)
    after = []
    for step in progress(range(lab.cfg.touches), desc=f"policy {name}", unit="touch"):
        step_keys = jax.random.split(jax.random.fold_in(keys[1], step), len(truth))
        site = np.asarray(policy(step_keys, beliefs, jnp.asarray(touched), step))
        # An episode without a safe site ends there: its belief stays, and what is simulated for it is not used.
        simulated = np.maximum(site, 0)
        touched[np.arange(len(truth)), simulated] |= site >= 0
        simulator.touch(simulated[:, None])
        last = jax.tree.map(lambda x: x[:, -1], simulator.observations())
        beliefs, p = update_beliefs(beliefs, jnp.asarray(site), last, table, lab.pad_model.likelihood)
        after.append(np.asarray(p))
    return np.stack(after, axis=1)


def report(parts: Sequence[Part], pads: Sequence[str]) -> dict[str, Any]:
    """Accuracy and touches to confidence under each policy, and what choosing by information saves."""
    columns, clusters = pool_parts(parts), clusters_of(parts, pads)
    truth = columns.pop("truth")
    first, rows = {}, []
    for name, raw in columns.items():
        p = calibrated.calibrated_beliefs(raw)
        touches, first[name] = p.shape[1], metrics.confident_at(p, CONFIDENCE)
        needed = metrics.touches_to_confidence(first[name], touches, clusters=clusters)
        rows.append([name, metrics.mean_accuracy(p, truth, clusters=clusters), needed.mean, needed.never])
    saved = [
        [name, metrics.touches_saved(first["information"], first[name], touches, clusters=clusters)]
        for name in first
        if name != "information"
    ]
    head = [
        "policy", "mean accuracy over touches", Column(f"touches until {CONFIDENCE:.0%} sure, at most those made", 2),
        Column("never so sure", 0, percent=True),
    ]  # fmt: skip
    tables = {
        "policies": make_table(head, rows),
        "saved": make_table(["information against", Column("fewer touches", 0, percent=True)], saved),
    }
    return {"episodes": len(truth), "tables": tables}
