"""Which next touch makes one sure soonest: a random one, the paper's heuristic, or the one expected to tell most?"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

from experiments import plots
from experiments import recognition_figures as drawing
from experiments import recognition_scores as scores
from experiments.recognition import Pool, Setting, Sitting, pool, telling
from experiments.recognition_scores import plain
from experiments.studies.lab import Lab, imagine, placements_of, shown
from i2t import belief, ensemble, policy
from i2t.arrays import element
from i2t.belief import Belief, Likelihood, Measured, Particles
from i2t.outcomes import Outcome

CANDIDATES = 48  # sites that the next touch is chosen among, drawn anew for each
POLICIES = ("random", "heuristic", "information")


def play(lab: Lab) -> dict[str, Any]:
    """The same sittings under each policy."""
    key_pool, key_play, key_choice = jax.random.split(lab.key, 3)
    sites = pool(key_pool, lab.surfaces, lab.names, lab.cfg.sites, lab.cfg.reach)
    places = placements_of(lab)
    (table,) = imagine(lab, sites, places, [lab.learnt.skin], "policy")
    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    found = {"truth": truth}
    for name in POLICIES:
        keys = jax.random.clone(key_play), jax.random.clone(key_choice)  # the same luck for all
        found[name] = play_policy(lab, name, *keys, sites, places, jax.device_put(table), truth)
    return found


def play_policy(
    lab: Lab, name: str, key: Array, key_choice: Array, sites: Pool, places: Particles, table: Outcome,
    truth: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Beliefs (e, t, objects) of sittings whose next touch a policy chooses."""
    sitting = Sitting(
        key, lab.surfaces, truth, sites, lab.pad, Setting(lab.cfg.errors, lab.cfg.limits, lab.cfg.touches)
    )
    begun = belief.begin(places, len(lab.surfaces))
    now = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(truth), *x.shape)), begun)
    spent = np.zeros((len(truth), len(sites.owner)), bool)
    after = []
    telling = telling_weights(sites)
    for step in tqdm(range(lab.cfg.touches), desc=f"policy {name}", unit="touch"):
        keys = jax.random.split(jax.random.fold_in(key_choice, step), len(truth))
        if name == "information":
            site = next_touches(keys, now, table, lab.learnt.like, jnp.asarray(spent), lab.cfg.limits.skin_change)
        elif name == "heuristic":
            site = heuristic_touches(keys, now, telling, jnp.asarray(spent), step)
        else:
            site = jax.vmap(jax.random.categorical)(keys, jnp.where(jnp.asarray(spent), -jnp.inf, 0.0))
        site = np.asarray(site)
        spent[np.arange(len(truth)), site] = True
        sitting.touch(site[:, None])
        last = jax.tree.map(lambda x: x[:, -1], sitting.measured())
        now, p = advance(now, jnp.asarray(site), last, table, lab.learnt.like)
        after.append(np.asarray(p))
    return np.stack(after, axis=1)


@jax.jit
def advance(now: Belief, site: Array, measured: Measured, table: Outcome, like: Likelihood) -> tuple[Belief, Array]:
    """All sittings one touch further."""

    def one(at: tuple[Belief, Array, Measured]) -> tuple[Belief, Array]:
        updated = belief.update(at[0], at[2], element(table, at[1]), like)
        return updated, belief.posterior(updated)[0]

    return jax.lax.map(one, (now, site, measured), batch_size=8)


@jax.jit
def next_touches(keys: Array, now: Belief, table: Outcome, like: Likelihood, spent: Array, skin_change: float) -> Array:
    """The site that is expected to tell most, of some drawn anew for each sitting."""
    sites = spent.shape[1]

    def one(at: tuple[Array, Belief, Array]) -> Array:
        key_some, key_gain = jax.random.split(at[0])
        some = jax.random.permutation(key_some, sites)[: min(CANDIDATES, sites)]
        gain = policy.gains(key_gain, at[1], element(table, some), like, skin_change)
        return some[policy.choose(gain, ~at[2][some])]

    return jax.lax.map(one, (keys, now, spent))


def telling_weights(sites: Pool) -> Array:
    """The heuristic's probability of every site, (objects, sites): 0 for those of other objects."""
    own = telling(sites)
    mine = sites.owner[None] == np.arange(len(own))[:, None]
    return jnp.where(mine, own.reshape(1, -1), 0.0)


@jax.jit
def heuristic_touches(keys: Array, now: Belief, telling: Array, spent: Array, step: int) -> Array:
    """The paper's: a telling site of the object believed in."""

    def one(key: Array, now: Belief, spent: Array) -> Array:
        key_object, key_site = jax.random.split(key)
        which = ensemble.hypothesis(key_object, belief.posterior(now)[0], step)
        weight = jnp.where(spent, 0.0, telling[which])
        left = jnp.where(jnp.sum(weight) > 0, weight, jnp.where(spent, 0.0, 1.0))
        return jax.random.categorical(key_site, jnp.log(left))

    return jax.vmap(one)(keys, now, spent)


def report(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Accuracy and touches until sure under each policy, and what choosing by information saves."""
    truth = np.concatenate([part["truth"] for part in parts])
    p = {name: np.concatenate([part[name] for part in parts]).astype(np.float64) for name in POLICIES}
    touches = next(iter(p.values())).shape[1]
    first = {name: scores.sure_at(each) for name, each in p.items()}
    result: dict[str, Any] = {"sittings": len(truth), "policies": {}, "saved": {}}
    curves = {name: scores.accuracy(each, truth) for name, each in p.items()}
    for name, each in p.items():
        mean, until = scores.mean_accuracy(each, truth), scores.until(first[name], touches)
        result["policies"][name] = {"accuracy": plain(curves[name]), "mean": plain(mean), "until_95": plain(until)}
        print(f"{name:12} {shown(mean)} mean accuracy, {shown(until.mean)} touches until 95 % sure "
              f"(restricted to {touches}), never {float(until.never.mean):.2f}")  # fmt: skip
    for other in ("random", "heuristic"):
        saved = scores.saved(first["information"], first[other], touches)
        result["saved"][other] = plain(saved)
        print(f"information needs {shown(saved)} fewer touches than {other}")
    unsure = {name: scores.unsure(values, touches) for name, values in first.items()}
    plots.save(drawing.until_sure(unsure, "Touches until 95 % sure", True), out / "until_sure.png")
    plots.save(drawing.accuracy(curves, "Accuracy of each policy", True), out / "accuracy.png")
    return result
