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
from i2t.recognition import belief
from i2t.recognition import calibrated
from i2t.recognition import metrics as scores
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import SitePool, EpisodeConfig, Sitting, sample_sites
from i2t.recognition.metrics import to_json
from i2t.recognition.outcomes import Outcome
from i2t.recognition.planning import advance, choose_heuristic_sites, choose_informative_sites, safe_sites, heuristic_weights
from i2t.viz import touches as plots

POLICIES = ("random", "heuristic", "information")


def play(lab: Lab) -> dict[str, Any]:
    """The same sittings under each policy."""
    key_pool, key_play, key_choice = jax.random.split(lab.key, 3)
    sites = sample_sites(key_pool, lab.surfaces, lab.names, lab.cfg.sites, lab.cfg.reach)
    places = placements_of(lab)
    (table,) = imagine(lab, sites, places, [lab.learnt.reading_model], "policy")
    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    found = {"truth": truth}
    for name in POLICIES:
        keys = jax.random.clone(key_play), jax.random.clone(key_choice)  # the same luck for all
        found[name] = play_policy(lab, name, *keys, sites, places, jax.device_put(table), truth)
    return found


def play_policy(
    lab: Lab, name: str, key: Array, key_choice: Array, sites: SitePool, places: Particles, table: Outcome,
    truth: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Beliefs (e, t, objects) of sittings whose next touch a policy chooses."""
    sitting = Sitting(
        key, lab.surfaces, truth, sites, lab.pad, EpisodeConfig(lab.cfg.errors, lab.cfg.limits, lab.cfg.touches)
    )
    begun = belief.init(places, len(lab.surfaces))
    now = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(truth), *x.shape)), begun)
    spent = np.zeros((len(truth), len(sites.owner)), bool)
    after = []
    telling, safe = heuristic_weights(sites), jnp.asarray(safe_sites(lab.surfaces, sites, lab.cfg.reach))
    for step in tqdm(range(lab.cfg.touches), desc=f"policy {name}", unit="touch"):
        keys = jax.random.split(jax.random.fold_in(key_choice, step), len(truth))
        if name == "information":
            limit = lab.cfg.limits.skin_change
            site = choose_informative_sites(keys, now, table, lab.learnt.likelihood, jnp.asarray(spent), safe, limit)
        elif name == "heuristic":
            site = choose_heuristic_sites(keys, now, telling, jnp.asarray(spent), step)
        else:
            site = jax.vmap(jax.random.categorical)(keys, jnp.where(jnp.asarray(spent), -jnp.inf, 0.0))
        site = np.asarray(site)
        spent[np.arange(len(truth)), site] = True
        sitting.touch(site[:, None])
        last = jax.tree.map(lambda x: x[:, -1], sitting.measured())
        now, p = advance(now, jnp.asarray(site), last, table, lab.learnt.likelihood)
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
    plots.save(drawing.until_sure(unsure, "Touches until 95 % sure", True), out / "until_sure.png")
    plots.save(drawing.accuracy(curves, "Accuracy of each policy", True), out / "accuracy.png")
    return result
