"""The next touch of many episodes at once: by expected information, at random, or by the paper's heuristic.

A site is chosen only among those that are safe and were not touched yet. `choose_informative_sites` and
`choose_random_sites` ask that a site be safe on what may be there, all objects weighted by their probability;
`choose_heuristic_sites`, which is for simulated
comparisons, asks that it be safe on the one object that it takes as the hypothesis. An episode for which there is none
gets `i2t.recognition.policy.NO_SITE` (-1), and whoever asked draws other candidates or stops.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.batching import map_batches
from i2t.paper import loop
from i2t.recognition import belief, policy
from i2t.recognition.belief import Belief, Likelihood, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.policy import NO_SITE
from i2t.recognition.site_pool import SitePool, own_site_informativeness
from i2t.rendering.ops import element

NUM_CANDIDATES = 48  # sites that the next touch is chosen among, drawn anew for each


@jax.jit
def update_beliefs(
    beliefs: Belief,
    site: Int[Array, " e"],
    observations: TouchObservation,
    table: PredictedTouch,
    likelihood: Likelihood,
) -> tuple[Belief, Float[Array, "e objects"]]:
    """All episodes one touch further; an episode without a site (-1) stays as it is.

    Args:
        beliefs: Of e episodes.
        site: That was touched in each.
        observations: What was measured, (e,).
        table: Predicted touches, (sites, objects, k).
        likelihood: How far measurements may be from predictions.

    Returns:
        The beliefs, and the probabilities of the objects.
    """

    def one(at: tuple[Belief, Array, TouchObservation]) -> tuple[Belief, Array]:
        before, site, observation = at
        after = belief.update(before, observation, element(table, jnp.maximum(site, 0)), likelihood)
        kept = jax.tree.map(lambda new, old: jnp.where(site >= 0, new, old), after, before)
        return kept, belief.posterior(kept)

    return map_batches(one, (beliefs, site, observations), batch_size=8)


@jax.jit
def choose_informative_sites(
    keys: Key[Array, " e"],
    beliefs: Belief,
    table: PredictedTouch,
    likelihood: Likelihood,
    *,
    touched: Bool[Array, "e sites"],
    safe: Bool[Array, "sites objects"],
    skin_change: float | Float[Array, ""],
) -> Int[Array, " e"]:
    """Site of most expected information for each episode, of candidates drawn anew.

    Args:
        keys: Of the candidates and of their imagined outcomes.
        beliefs: Of e episodes.
        table: Predicted touches, (sites, objects, k).
        likelihood: How far measurements may be from predictions.
        touched: Sites that are not to be chosen again.
        safe: Whether a touch of each site would be safe on each object.
        skin_change: Change of the reading (uT) at which a press ends.

    Returns:
        Indices of sites; -1 where no candidate is allowed.
    """
    sites = touched.shape[1]

    def one(at: tuple[Array, Belief, Array]) -> Array:
        key, state, done = at
        key_some, key_gain = jax.random.split(key)
        some = jax.random.permutation(key_some, sites)[: min(NUM_CANDIDATES, sites)]
        gain = policy.expected_information_gain(
            key_gain, state, element(table, some), likelihood, skin_change=skin_change
        )
        allowed = policy.safe_sites_mask(state, safe[some]) & ~done[some]
        best = policy.choose_site(gain, allowed)
        return jnp.where(best >= 0, some[best], NO_SITE)

    return jax.lax.map(one, (keys, beliefs, touched))


@jax.jit
def choose_random_sites(
    keys: Key[Array, " e"],
    beliefs: Belief,
    *,
    touched: Bool[Array, "e sites"],
    safe: Bool[Array, "sites objects"],
) -> Int[Array, " e"]:
    """For each episode any site that may be touched, all alike.

    Args:
        keys: Of the draws.
        beliefs: Of e episodes.
        touched: Sites that are not to be chosen again.
        safe: Whether a touch of each site would be safe on each object.

    Returns:
        Indices of sites; -1 where none is allowed.
    """

    def one(key: Array, state: Belief, done: Array) -> Array:
        allowed = policy.safe_sites_mask(state, safe) & ~done
        drawn = jax.random.categorical(key, jnp.where(allowed, 0.0, -jnp.inf))
        return jnp.where(jnp.any(allowed), drawn, NO_SITE)

    return jax.vmap(one)(keys, beliefs, touched)


def heuristic_weights(sites: SitePool) -> Float[Array, "objects sites"]:
    """The paper's heuristic over a whole pool.

    Args:
        sites: The pool.

    Returns:
        Probability of every site if an object is believed in; 0 for the sites of others.
    """
    own = own_site_informativeness(sites)
    mine = sites.owner[None] == np.arange(len(own))[:, None]
    return jnp.where(mine, own.reshape(1, -1), 0.0)


@jax.jit
def choose_heuristic_sites(
    keys: Key[Array, " e"],
    beliefs: Belief,
    weights: Float[Array, "objects sites"],
    *,
    touched: Bool[Array, "e sites"],
    safe: Bool[Array, "sites objects"],
    step: int | Int[Array, ""],
) -> Int[Array, " e"]:
    """The paper's choice for each episode: an informative site of the hypothesis, an object drawn by its probability,
    or, where none is left, any other site. Either is safe on that object; whether it is on others is not asked.

    Args:
        keys: Of the draws.
        beliefs: Of e episodes.
        weights: Of every site for each object (`heuristic_weights`).
        touched: Sites that are not to be chosen again.
        safe: Whether a touch of each site would be safe on each object.
        step: Touches so far.

    Returns:
        Indices of sites; -1 where none is left.
    """

    def one(key: Array, state: Belief, done: Array) -> Array:
        key_object, key_site = jax.random.split(key)
        which = loop.choose_hypothesis(key_object, belief.posterior(state), step)
        allowed = safe[:, which] & ~done
        weight = jnp.where(allowed, weights[which], 0.0)
        weight = jnp.where(jnp.sum(weight) > 0, weight, allowed.astype(weight.dtype))
        drawn = jax.random.categorical(key_site, jnp.log(weight))
        return jnp.where(jnp.any(weight > 0), drawn, NO_SITE)

    return jax.vmap(one)(keys, beliefs, touched)
