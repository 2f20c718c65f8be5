"""Where to touch next, and when to stop.

A touch is worth what it is expected to tell: the mutual information between its outcome and the object (Lindley, Annals
of Mathematical Statistics 27, 1956), and, for a part, between its outcome and where the object lies. It is estimated
for every site by imagining: an object and a place are drawn from the belief, the press ends where the skin's change or
the force crosses its limit, noise is added, and what is then read is compared with every other object and place, as in
`i2t.recognition.belief`. All sites see the same draws, so that differences between sites are less noisy than the
values.

Only sites that are allowed are chosen among: within reach, not spent, and safe on the objects that are still possible
(`permitted`). The paper's heuristic is `i2t.recognition.ensemble.telling`.

Pure functions on one episode; information in nats.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp, xlogy
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.recognition.belief import Belief, Likelihood, Measured, evidence, posterior, weighed
from i2t.recognition.outcomes import Outcome, at_load
from i2t.types import READINGS

DRAWS = 24  # imagined outcomes of a site
PLACES = 16  # of each object, with which they are compared
RISK = 0.05  # largest probability of an object on which a site is not safe


class Gain(NamedTuple):
    """What a touch is expected to tell (nats)."""

    object: Float[Array, ""]  # which object it is
    both: Float[Array, ""]  # which object and where it lies, as far as the compared places differ


def gains(
    key: Key[Array, ""],
    belief: Belief,
    table: Outcome,
    like: Likelihood,
    skin_change: float | Float[Array, ""] = 25.0,
    force: float | Float[Array, ""] = 8.0,
    draws: int = DRAWS,
    places: int = PLACES,
) -> Gain:
    """What a touch at each site of a table (sites, objects, k) is expected to tell: arrays over sites.

    The press ends at `skin_change` (uT) or `force` (N); `draws` and `places` are static.
    """
    key_place, key_draw, key_which, key_noise, key_off = jax.random.split(key, 5)
    weight = logsumexp(belief.log_weight, axis=1)
    objects = len(weight)
    prior = weight - logsumexp(weight)
    # Systematic resampling: the places of each object that are believed in, with equal weights.
    share = jnp.cumsum(jax.nn.softmax(belief.log_weight, axis=1), axis=1)
    comb = (jnp.arange(places) + jax.random.uniform(key_place)) / places
    place = jax.vmap(lambda total: jnp.searchsorted(total, comb * total[-1]))(share)
    place = jnp.minimum(place, share.shape[1] - 1)
    mean = jnp.take_along_axis(belief.mean, place[:, :, None], axis=1)
    covariance = jnp.take_along_axis(belief.covariance, place[:, :, None, None], axis=1)
    comb = (jnp.arange(draws) + jax.random.uniform(key_draw)) / draws
    drawn = jnp.minimum(jnp.searchsorted(jnp.cumsum(jnp.exp(prior)), comb), objects - 1)
    which = jax.random.randint(key_which, (draws,), 0, places)
    noise = jax.random.normal(key_noise, (draws, READINGS + 1))
    root = jnp.linalg.cholesky(covariance + 1e-12 * jnp.eye(6)[None, None])
    off = mean[drawn, which] + jnp.einsum("nij,nj->ni", root[drawn, which], jax.random.normal(key_off, (draws, 6)))

    def site(row: Outcome) -> Gain:
        some = jax.tree.map(lambda x: jax.vmap(lambda x, i: x[i])(x, place), row)  # (objects, places)
        true = jax.tree.map(lambda x: x[drawn, which], some)
        imagined = jax.vmap(partial(imagine, like=like, skin_change=skin_change, force=force))(true, off, noise)

        def compare(measured: Measured) -> Array:
            found = jax.vmap(jax.vmap(partial(evidence, measured, like=like)))(some, mean, covariance)
            return weighed(found, like)

        density = jax.vmap(compare)(imagined)  # (draws, objects, places)
        of_object = logsumexp(density, axis=2) - jnp.log(places)
        total = logsumexp(of_object + prior[None], axis=1)
        after = jnp.exp(of_object + prior[None] - total[:, None])
        uncertain = -jnp.sum(xlogy(after, after), axis=1)
        before = -jnp.sum(xlogy(jnp.exp(prior), jnp.exp(prior)))
        own = density[jnp.arange(draws), drawn, which]
        return Gain(before - jnp.mean(uncertain), jnp.mean(own - total))

    return jax.lax.map(site, table, batch_size=16)


def imagine(
    outcome: Outcome,
    off: Float[Array, "6"],
    noise: Float[Array, "16"],
    like: Likelihood,
    skin_change: float | Float[Array, ""],
    force: float | Float[Array, ""],
) -> Measured:
    """What would be measured at a touch, of a place off by `off` (m); `noise` is standard normal."""
    load = stop_load(outcome, like.loads, skin_change, force)
    sunk, reading, variance = at_load(outcome, like.loads, load)
    spread = like.inflation * jnp.sqrt(1 + like.growth * variance)
    error = jnp.linalg.solve(like.whiten, spread * noise[:READINGS])
    travel = outcome.travel + jnp.dot(outcome.slope, off)
    contact = outcome.hit & (travel < like.past)
    advance = travel + sunk + load / like.stiffness + like.position * noise[READINGS]
    return Measured(reading + error, load, advance, contact)


def stop_load(
    outcome: Outcome,
    loads: Float[Array, " l"],
    skin_change: float | Float[Array, ""],
    force: float | Float[Array, ""],
) -> Float[Array, ""]:
    """The load (N) at which an imagined press would end: a reading grows about as a power of its load."""
    size = jnp.log(jnp.maximum(jnp.linalg.norm(outcome.reading, axis=1), 1e-3))
    knots, goal = jnp.log(loads), jnp.log(skin_change)
    i = jnp.clip(jnp.sum(size < goal) - 1, 0, len(loads) - 2)
    slope = jnp.maximum((size[i + 1] - size[i]) / (knots[i + 1] - knots[i]), 0.2)
    return jnp.clip(jnp.exp(knots[i] + (goal - size[i]) / slope), loads[0] / 10, force)


def permitted(belief: Belief, safe: Bool[Array, "sites objects"], risk: float = RISK) -> Bool[Array, " sites"]:
    """Sites that are safe but for objects of at most a probability of `risk` together."""
    probability = posterior(belief)
    return jnp.sum(jnp.where(safe, 0.0, probability[None]), axis=1) <= risk


def choose(gain: Gain, allowed: Bool[Array, " sites"], pose: float = 0.1) -> Int[Array, ""]:
    """The allowed site that is expected to tell most, what it tells of the place counting `pose` times; any of all
    where none is allowed.
    """
    value = gain.object + pose * (gain.both - gain.object)
    return jnp.argmax(jnp.where(allowed | ~jnp.any(allowed), value, -jnp.inf))


def stops(probability: Float[Array, " objects"], error: float) -> Bool[Array, ""]:
    """Whether the most probable object is wrong with at most the probability `error`, as far as the probabilities are
    calibrated (`i2t.recognition.belief.tempered`).
    """
    return jnp.max(probability) >= 1 - error
