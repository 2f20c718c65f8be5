"""The next touch of many sittings at once: by what it is expected to tell, or by the paper's heuristic."""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from i2t.recognition import belief, ensemble, policy
from i2t.recognition.belief import Belief, Likelihood, Measured
from i2t.recognition.episodes import Pool, telling
from i2t.recognition.outcomes import Outcome
from i2t.rendering.ops import element
from i2t.simulation import sites as touch_sites
from i2t.types import Surface

CANDIDATES = 48  # sites that the next touch is chosen among, drawn anew for each


@jax.jit
def advance(now: Belief, site: Array, measured: Measured, table: Outcome, like: Likelihood) -> tuple[Belief, Array]:
    """All sittings one touch further, and the probabilities of their objects."""

    def one(at: tuple[Belief, Array, Measured]) -> tuple[Belief, Array]:
        updated = belief.update(at[0], at[2], element(table, at[1]), like)
        return updated, belief.posterior(updated)

    return jax.lax.map(one, (now, site, measured), batch_size=8)


@jax.jit
def next_touches(
    keys: Array, now: Belief, table: Outcome, like: Likelihood, spent: Array, safe: Array, skin_change: float
) -> Array:
    """The site that is expected to tell most, of some drawn anew for each sitting, and safe as far as is believed."""
    sites = spent.shape[1]

    def one(at: tuple[Array, Belief, Array]) -> Array:
        key_some, key_gain = jax.random.split(at[0])
        some = jax.random.permutation(key_some, sites)[: min(CANDIDATES, sites)]
        gain = policy.gains(key_gain, at[1], element(table, some), like, skin_change)
        allowed = policy.permitted(at[1], safe[some]) & ~at[2][some]
        return some[policy.choose(gain, allowed)]

    return jax.lax.map(one, (keys, now, spent))


def safe_on(surfaces: Sequence[Surface], sites: Pool, limits: touch_sites.Limits) -> np.ndarray:
    """Whether each site would be safe on each object, (sites, objects): each is on its own."""
    check = jax.jit(jax.vmap(partial(touch_sites.is_safe, limits=limits), (None, 0)))
    return np.stack([np.asarray(check(surface, sites.T_w_t)) for surface in surfaces], axis=1)


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
        which = ensemble.hypothesis(key_object, belief.posterior(now), step)
        weight = jnp.where(spent, 0.0, telling[which])
        left = jnp.where(jnp.sum(weight) > 0, weight, jnp.where(spent, 0.0, 1.0))
        return jax.random.categorical(key_site, jnp.log(left))

    return jax.vmap(one)(keys, now, spent)
