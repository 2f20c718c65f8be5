"""Choice of the next touch.

The value of a touch is its expected information: the mutual information between its outcome and the object (Lindley,
Annals of Mathematical Statistics 27, 1956), and, with a smaller weight, between its outcome and the pose of the object.
It is estimated for every site by simulated outcomes. An object and a pose are drawn from the belief, and the press ends
where the skin's change or the force crosses its limit. Errors are drawn from the likelihood (heavy tails of readings
and of positions, outliers of positions, and presence). The outcome is compared with every other object and pose, as in
`i2t.recognition.belief`. All sites share the same draws (common random numbers), so that differences between sites are
less noisy than the values.

Only allowed sites are candidates: within reach, not yet touched, and safe on the objects that are still possible
(`safe_sites_mask`). If no site is allowed, none is chosen (`NO_SITE`), and the caller draws other sites or stops. The
paper's heuristic (`i2t.paper.loop.site_informativeness`), which serves simulated comparisons, only requires that a site
is safe on the hypothesised object.

All functions are pure and work on one episode; information is in nats.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp, xlogy
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.contact.press import PressLimits, stop_load
from i2t.recognition.belief import Belief, TouchObservation, evidence, log_likelihood, posterior
from i2t.recognition.outcomes import PredictedTouch, interpolate_load
from i2t.rendering.ops import element
from i2t.runtime.batching import map_batches
from i2t.skin_models.likelihood import Likelihood, outlier_range

NUM_CANDIDATES = 48  # number of candidate sites from which the next touch is chosen, drawn anew for each touch
NO_SITE = -1  # index of the chosen site if no candidate site is allowed


class InformationGain(NamedTuple):
    """Expected information (nats) from a touch of each site about the object, and about object and pose together."""

    object: Float[Array, "..."]  # expected information about the object
    object_and_pose: Float[
        Array, "..."
    ]  # expected information about object and pose, as far as the compared particles differ


class _Compared(NamedTuple):
    """The particles of each object with which simulated touches are compared, all with equal weights."""

    particle: Int[Array, "objects p"]
    mean: Float[Array, "objects p 6"]
    covariance: Float[Array, "objects p 6 6"]


class _Draws(NamedTuple):
    """Hypotheses and errors, the same for all sites."""

    object: Int[Array, " n"]
    particle: Int[Array, " n"]  # index of the drawn particle among the compared particles
    twist: Float[Array, "n 6"]  # m, twist of the pose about the particle
    # c whitened errors of the reading, followed by those of position (m) and indentation
    noise: Float[Array, "n noise"]


def expected_information_gain(
    key: Key[Array, ""],
    belief: Belief,
    table: PredictedTouch,
    likelihood: Likelihood,
    *,
    skin_change: float | Float[Array, ""] = 25.0,
    num_draws: int = 24,
    num_particles: int = 16,
) -> InformationGain:
    """Estimate the expected information of a touch at each site.

    Args:
        key: Random key of the simulated outcomes.
        belief: The belief after the touches so far.
        table: Predicted touches, (sites, objects, k) for k particles of each object.
        likelihood: The distribution of measurements about predictions.
        skin_change: Change of the reading (uT) at which a press ends.
        num_draws: Number of simulated outcomes of each site; static.
        num_particles: Number of particles of each object with which they are compared; static.

    Returns:
        `(sites,)` information about the object, and `(sites,)` information about object and pose (nats).
    """
    key_place, key_draw, key_which, key_noise, key_twist = jax.random.split(key, 5)
    log_weight = logsumexp(belief.log_weight, axis=1)
    log_prior = log_weight - logsumexp(log_weight)
    compared = _resample_particles(key_place, belief, num_particles)
    objects = _systematic_draw(key_draw, jnp.exp(log_prior), num_draws)
    particle = jax.random.randint(key_which, (num_draws,), 0, num_particles)
    root = jnp.linalg.cholesky(compared.covariance + 1e-12 * jnp.eye(6)[None, None])
    normal = jax.random.normal(key_twist, (num_draws, 6))
    twist = compared.mean[objects, particle] + jnp.einsum("nij,nj->ni", root[objects, particle], normal)
    noise = _draw_noise(key_noise, likelihood, (num_draws, table.reading.shape[-1] + 2))
    draws = _Draws(objects, particle, twist, noise)
    simulate = partial(simulate_observation, likelihood=likelihood, skin_change=skin_change, force=PressLimits.force)

    def site_gain(row: PredictedTouch) -> InformationGain:
        some = jax.tree.map(lambda x: jax.vmap(lambda x, i: x[i])(x, compared.particle), row)  # (objects, particles)
        true = jax.tree.map(lambda x: x[draws.object, draws.particle], some)
        density = _compare(jax.vmap(simulate)(true, draws.twist, draws.noise), some, compared, likelihood)
        return _mutual_information(density, log_prior, draws)

    return map_batches(site_gain, table, batch_size=16)


def simulate_observation(
    predicted: PredictedTouch,
    twist: Float[Array, "6"],
    noise: Float[Array, " noise"],
    *,
    likelihood: Likelihood,
    skin_change: float | Float[Array, ""],
    force: float | Float[Array, ""],
) -> TouchObservation:
    """Simulate the measurements of a touch from its prediction, with random errors.

    Args:
        predicted: The touch as predicted for a particle.
        twist: Displacement (m) of the object from the particle.
        noise: c + 2 numbers: whitened errors of the reading's c values (Student's t with the likelihood's degrees of
            freedom), the error of the position (m), and the standard normal error of the indentation.
        likelihood: Likelihood that scales the errors of the reading and of the indentation.
        skin_change: Change of the reading (uT) at which the press ends.
        force: Force (N) at which the press ends in any case.

    Returns:
        Simulated reading, force, advance and contact.
    """
    load = stop_load(predicted.reading, likelihood.loads, skin_change=skin_change, force=force)
    indentation, reading, variance = interpolate_load(predicted, likelihood.loads, load)
    spread = likelihood.inflation * jnp.sqrt(1 + likelihood.growth * variance)
    error = jnp.linalg.solve(likelihood.whiten, spread * noise[:-2])
    offset = noise[-2] + likelihood.indentation_error * indentation * noise[-1]
    distance = predicted.approach_distance + jnp.dot(predicted.jacobian, twist)
    contact = predicted.hit & (distance + offset < likelihood.overtravel)
    advance = distance + indentation + load / likelihood.stiffness + offset
    return TouchObservation(reading + error, load, advance, contact)


def safe_sites_mask(
    belief: Belief, safe: Bool[Array, "sites objects"], max_unsafe_probability: float = 0.05
) -> Bool[Array, " sites"]:
    """Find the sites that are probably safe, given the belief about the object.

    Args:
        belief: The belief after the touches so far.
        safe: Whether a touch of each site is safe on each object.
        max_unsafe_probability: Largest total probability of the objects on which an accepted site is not safe.

    Returns:
        `(sites,)` mask of the safe sites.
    """
    probability = posterior(belief)
    return jnp.sum(jnp.where(safe, 0.0, probability[None]), axis=1) <= max_unsafe_probability


def choose_site(gain: InformationGain, allowed: Bool[Array, " sites"], pose_weight: float = 0.1) -> Int[Array, ""]:
    """Choose the allowed site with the largest expected information, or `NO_SITE` (-1) if none is allowed.

    Args:
        gain: Expected information of a touch at each site.
        allowed: Mask of the sites that may be touched.
        pose_weight: Weight of the information about the pose, relative to that about the object.

    Returns:
        Index of the site, or -1.
    """
    value = gain.object + pose_weight * (gain.object_and_pose - gain.object)
    best = jnp.argmax(jnp.where(allowed, value, -jnp.inf))
    return jnp.where(jnp.any(allowed), best, NO_SITE)


def draw_site(key: Key[Array, ""], weight: Float[Array, " sites"], allowed: Bool[Array, " sites"]) -> Int[Array, ""]:
    """Draw an allowed site by its weight, or any allowed site if all their weights are zero.

    Args:
        key: Random key of the draw.
        weight: Weight of each site, at least 0.
        allowed: Mask of the sites that may be touched.

    Returns:
        Index of the site, or -1 if none is allowed.
    """
    some = jnp.where(allowed, weight, 0.0)
    some = jnp.where(jnp.sum(some) > 0, some, allowed.astype(some.dtype))
    return jnp.where(jnp.any(allowed), jax.random.categorical(key, jnp.log(some)), NO_SITE)


@jax.jit
def choose_informative_site(
    key: Key[Array, ""],
    belief: Belief,
    table: PredictedTouch,
    likelihood: Likelihood,
    *,
    touched: Bool[Array, " sites"],
    safe: Bool[Array, "sites objects"],
    skin_change: float | Float[Array, ""],
) -> Int[Array, ""]:
    """Choose the site with the largest expected information among newly drawn candidates.

    Args:
        key: Random key of the candidates and of their simulated outcomes.
        belief: The belief after the touches so far.
        table: Predicted touches, (sites, objects, k) for k particles of each object.
        likelihood: The distribution of measurements about predictions.
        touched: Mask of the sites that must not be chosen again.
        safe: Whether a touch of each site is safe on each object.
        skin_change: Change of the reading (uT) at which a press ends.

    Returns:
        Index of the site, or -1 if no candidate is allowed.
    """
    sites = len(touched)
    key_some, key_gain = jax.random.split(key)
    some = jax.random.permutation(key_some, sites)[: min(NUM_CANDIDATES, sites)]
    gain = expected_information_gain(key_gain, belief, element(table, some), likelihood, skin_change=skin_change)
    best = choose_site(gain, safe_sites_mask(belief, safe[some]) & ~touched[some])
    return jnp.where(best >= 0, some[best], NO_SITE)


# --- simulated outcomes ---


def _resample_particles(key: Array, belief: Belief, count: int) -> _Compared:
    """Resample each object's particles systematically."""
    share = jnp.cumsum(jax.nn.softmax(belief.log_weight, axis=1), axis=1)
    comb = (jnp.arange(count) + jax.random.uniform(key)) / count
    index = jax.vmap(lambda total: jnp.searchsorted(total, comb * total[-1]))(share)
    index = jnp.minimum(index, share.shape[1] - 1)
    mean = jnp.take_along_axis(belief.mean, index[:, :, None], axis=1)
    covariance = jnp.take_along_axis(belief.covariance, index[:, :, None, None], axis=1)
    return _Compared(index, mean, covariance)


def _systematic_draw(key: Array, probability: Array, count: int) -> Array:
    """Draw categories in proportion to their probabilities, within one draw of each."""
    comb = (jnp.arange(count) + jax.random.uniform(key)) / count
    return jnp.minimum(jnp.searchsorted(jnp.cumsum(probability), comb), len(probability) - 1)


def _draw_noise(key: Key[Array, ""], likelihood: Likelihood, shape: tuple[int, int]) -> Float[Array, "n noise"]:
    """Draw whitened errors of readings, errors of positions (m), and standard normal errors of indentations.

    Errors of readings are rows of a multivariate Student's t: a normal vector over the square root of one chi-square
    variable per degree of freedom. The error of a position is normal with the standard deviation of its component, or
    that of an outlier.
    """
    key_normal, key_scale, key_component, key_outlier = jax.random.split(key, 4)
    normal = jax.random.normal(key_normal, shape)
    scale = jnp.sqrt(likelihood.dof / jax.random.chisquare(key_scale, likelihood.dof, (shape[0], 1)))
    component = jax.random.categorical(key_component, jnp.log(likelihood.position_share), shape=shape[:1])
    place, which = jax.random.uniform(key_outlier, (2, shape[0]))
    stray = (place - 0.5) * outlier_range(likelihood.overtravel)
    position = jnp.where(
        which < likelihood.outlier_rate, stray, likelihood.position_std[component] * normal[:, -2]
    )  # fmt: skip
    return jnp.concatenate([scale * normal[:, :-2], position[:, None], normal[:, -1:]], axis=1)


def _compare(
    simulated: TouchObservation, predicted: PredictedTouch, compared: _Compared, likelihood: Likelihood
) -> Float[Array, "n objects p"]:
    """Compute the log likelihood of each simulated touch under each compared particle."""

    def compare(observation: TouchObservation) -> Array:
        under = jax.vmap(jax.vmap(partial(evidence, observation, likelihood=likelihood)))
        return log_likelihood(under(predicted, compared.mean, compared.covariance), likelihood)

    return jax.vmap(compare)(simulated)


def _mutual_information(
    density: Float[Array, "n objects p"], log_prior: Float[Array, " objects"], draws: _Draws
) -> InformationGain:
    """Compute the decrease of the object's entropy, and the log likelihood ratio of the truth to all hypotheses."""
    of_object = logsumexp(density, axis=2) - jnp.log(density.shape[2])
    total = logsumexp(of_object + log_prior[None], axis=1)
    after = jnp.exp(of_object + log_prior[None] - total[:, None])
    entropy_after = -jnp.sum(xlogy(after, after), axis=1)
    entropy_before = -jnp.sum(xlogy(jnp.exp(log_prior), jnp.exp(log_prior)))
    own = density[jnp.arange(len(density)), draws.object, draws.particle]
    return InformationGain(entropy_before - jnp.mean(entropy_after), jnp.mean(own - total))
