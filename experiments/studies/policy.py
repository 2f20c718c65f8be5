"""Which next touch makes one sure soonest: a random one, the paper's heuristic, or the one expected to tell most?"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

from experiments.recognize import figures as drawing
from experiments.studies.lab import Lab, imagine, placements_of, shown
from i2t import viz
from i2t.recognition import belief, calibrated
from i2t.recognition import metrics as scores
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import EpisodeConfig, EpisodeSimulator
from i2t.recognition.metrics import to_json
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.planning import choose_heuristic_sites, choose_informative_sites, heuristic_weights, update_beliefs
from i2t.recognition.site_pool import SitePool, safe_sites, sample_sites

POLICIES = ("random", "heuristic", "information")


def play(lab: Lab) -> dict[str, Any]:
    """The same sittings under each policy."""
    key_pool, key_play, key_choice = jax.random.split(lab.key, 3)
    sites = sample_sites(key_pool, lab.surfaces, lab.names, lab.cfg.num_sites, lab.cfg.site_limits)
    places = placements_of(lab)
    (table,) = imagine(lab, sites, places, [lab.learnt.reading_model], "policy")
    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    found = {"truth": truth}
    for name in POLICIES:
        keys = jax.random.clone(key_play), jax.random.clone(key_choice)  # the same luck for all
        found[name] = play_policy(lab, name, *keys, sites, places, jax.device_put(table), truth)
    return found


def play_policy(
    lab: Lab, name: str, key: Array, key_choice: Array, sites: SitePool, places: Particles, table: PredictedTouch,
    truth: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Beliefs (e, t, objects) of sittings whose next touch a policy chooses."""
    config = EpisodeConfig(lab.cfg.errors, lab.cfg.limits, lab.cfg.touches)
    sitting = EpisodeSimulator(key, lab.surfaces, truth, sites=sites, pad=lab.pad, config=config)
    begun = belief.init(places, len(lab.surfaces), channels=table.reading.shape[-1])
    now = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(truth), *x.shape)), begun)
    spent = np.zeros((len(truth), len(sites.owner)), bool)
    after = []
    telling, safe = heuristic_weights(sites), jnp.asarray(safe_sites(lab.surfaces, sites, lab.cfg.site_limits))
    for step in tqdm(range(lab.cfg.touches), desc=f"policy {name}", unit="touch"):
        keys = jax.random.split(jax.random.fold_in(key_choice, step), len(truth))
        if name == "information":
            limit = lab.cfg.limits.skin_change
            site = choose_informative_sites(
                keys, now, table, lab.learnt.likelihood, touched=jnp.asarray(spent), safe=safe, skin_change=limit
            )
        elif name == "heuristic":
            site = choose_heuristic_sites(keys, now, telling, touched=jnp.asarray(spent), safe=safe, step=step)
        else:
            site = jax.vmap(jax.random.categorical)(keys, jnp.where(jnp.asarray(spent), -jnp.inf, 0.0))
        site = np.asarray(site)
        # An episode without a safe site ends there: its belief stays, and what is simulated for it is not used.
        some = np.maximum(site, 0)
        spent[np.arange(len(truth)), some] |= site >= 0
        sitting.touch(some[:, None])
        last = jax.tree.map(lambda x: x[:, -1], sitting.observations())
        now, p = update_beliefs(now, jnp.asarray(site), last, table, lab.learnt.likelihood)
        after.append(np.asarray(p))
    return np.stack(after, axis=1)


def report(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Accuracy and touches until sure under each policy, and what choosing by information saves."""
    truth = np.concatenate([part["truth"] for part in parts])
    p = {name: calibrated.calibrated_beliefs(np.concatenate([part[name] for part in parts])) for name in POLICIES}
    touches = next(iter(p.values())).shape[1]
    first = {name: scores.confident_at(each) for name, each in p.items()}
    result: dict[str, Any] = {"sittings": len(truth), "policies": {}, "saved": {}}
    curves = {name: scores.accuracy(each, truth) for name, each in p.items()}
    for name, each in p.items():
        mean, until = scores.mean_accuracy(each, truth), scores.touches_to_confidence(first[name], touches)
        result["policies"][name] = {"accuracy": to_json(curves[name]), "mean": to_json(mean), "until_95": to_json(until)}
        print(f"{name:12} {shown(mean)} mean accuracy, {shown(until.mean)} touches until 95 % sure "
              f"(restricted to {touches}), never {float(until.never.mean):.2f}")  # fmt: skip
    for other in ("random", "heuristic"):
        saved = scores.touches_saved(first["information"], first[other], touches)
        result["saved"][other] = to_json(saved)
        print(f"information needs {shown(saved)} fewer touches than {other}")
    unsure = {name: scores.not_yet_confident(values, touches) for name, values in first.items()}
    viz.save_figure(drawing.not_yet_confident(unsure, "Touches until 95 % sure", True), out / "until_sure.png")
    viz.save_figure(drawing.accuracy(curves, "Accuracy of each policy", True), out / "accuracy.png")
    return result
