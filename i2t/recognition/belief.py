"""Belief over objects and their poses: a posterior from touches.

Each possible object has a number of pose particles: poses drawn from the prior of its placement, the same throughout an
episode. The uncertainty of the placement is taken as stated. Each touch is compared with the touch that was predicted
for every particle (`i2t.recognition.outcomes`). Two measurements are evidence:

  the reading   given the force: Student's t about the predicted reading. Its scale matrix is the covariance of a
                Gaussian process's errors, which includes sensor noise that all chips share, plus the GP's own variance
                at that touch;
  the position  at which the press ended: distance to contact + indentation of the skin + compliance of the arm. Around
                a particle the distance to contact is linear in the pose, so each particle carries a normal distribution
                of its remaining pose error and updates it with a Kalman filter (a Gaussian sum; Alspach and Sorenson,
                IEEE Trans. Automatic Control 17, 1972). Without these normal distributions no particle of a few hundred
                would survive contacts measured to 0.1 mm in a prior of 1 mm in six dimensions. Errors of positions have
                heavy tails: they are a scale mixture of normals (Andrews and Mallows, J. R. Stat. Soc. B 36, 1974).
                Each of its components gives a separate Kalman step, weighted by how well it predicted the touch. The
                uncertainty of the indentation grows with its predicted value.

Whether a touch met anything is evidence as well (presence). Reading, position and presence each have a weight. A small
fraction of touches may be anything (outliers). "None of these" is the sum over surrogates of unknown objects
(`i2t.objects.catalogue`), which are treated like all other objects. A Kalman filter on the residuals of the readings
follows the drift of the sensor's bias.

All functions are pure and work on one episode: `init(...) -> Belief`, `update(belief, ...) -> Belief`,
`posterior(belief)`. A reading has c = 3 * chips channels. Units are metres, newtons and microtesla.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln, log_ndtr, logsumexp
from jaxtyping import Array, Bool, Float
from scipy.stats import norm, qmc

from i2t.recognition.outcomes import PredictedTouch, interpolate_load
from i2t.skin_models.layer import MIN_LOAD_N
from i2t.skin_models.likelihood import Likelihood, outlier_range
from i2t.types import in_one_line

MIN_PROBABILITY = 1e-30  # smallest probability in a logarithm; smaller ones are raised to it


@in_one_line
class TouchObservation(NamedTuple):
    """Measurements of one touch at a site: change of the reading (uT), force (N), travel (m) of the tool from the site
    to the end of the press, and whether it met anything.
    """

    reading: Float[Array, " c"]  # uT, change of the reading
    force: Float[Array, ""]  # N
    advance: Float[Array, ""]  # m, travel from the site to the end of the press, along the approach
    contact: Bool[Array, ""]  # whether the touch met anything


@in_one_line
class Particles(NamedTuple):
    """k pose particles of an object: twists (m) that displace it from its believed pose (`i2t.geometry.from_twist`),
    and the covariance (m^2) of the twist about each.
    """

    twist: Float[Array, "k 6"]  # m, twist of each pose particle
    covariance: Float[Array, "k 6 6"]  # m^2, covariance of the pose about each particle


@in_one_line
class Belief(NamedTuple):
    """Belief over objects and their poses after some touches of an episode: the log weight of each of the k pose
    particles of each object, mean (m) and covariance (m^2) of the twist about each, and mean (uT) and variance (uT^2)
    of the sensor's bias.
    """

    log_weight: Float[Array, "objects k"]  # log probability of object, particle and all touches so far
    mean: Float[Array, "objects k 6"]  # m, mean twist about each particle
    covariance: Float[Array, "objects k 6 6"]  # m^2, covariance of the twist about each particle
    bias: Float[Array, " c"]  # uT, mean bias of the sensor
    bias_variance: Float[Array, ""]  # uT^2, variance of the sensor's bias


class Evidence(NamedTuple):
    """Log densities of one touch's reading and position under each pose particle, log probability that it met something
    or nothing, the predicted reading (uT), and the normal distribution of the twist (m) about the particle after the
    touch.
    """

    tactile: Float[Array, "..."]  # log density of the reading
    spatial: Float[Array, "..."]  # log density of the position
    presence: Float[Array, "..."]  # log probability of having met the object, or of having met nothing
    reading: Float[Array, "... c"]  # uT, predicted reading
    mean: Float[Array, "... 6"]
    covariance: Float[Array, "... 6 6"]


def sample_particles(
    prior: Float[np.ndarray, "6"] | Float[np.ndarray, "6 6"],
    count: int,
    seed: int = 0,
    *,
    std_ratio: float = 0.5,
) -> Particles:
    """Draw pose particles of an object from a normal prior; the first one is the believed pose itself.

    The draws are quasi-random (scrambled Sobol sequence; Owen, J. Complexity 14, 1998) and made on the host. Particles
    and the normal distributions about them together have the prior's variance.

    Args:
        prior: Covariance (m^2) of the object's twist, which may be singular, or the standard deviations (m) of its six
            parts.
        count: Number of particles.
        seed: Seed of the sequence.
        std_ratio: Standard deviation about each particle, relative to the prior's.

    Returns:
        Equally probable particles, with the covariance (m^2) about each.
    """
    uniform = qmc.Sobol(6, seed=seed).random_base2(int(np.ceil(np.log2(max(count, 2)))))[:count]
    uniform = np.clip(uniform, 1e-6, 1 - 1e-6)
    prior = np.asarray(prior, np.float64)
    if prior.ndim == 1:
        root = np.diag(prior)
    else:
        values, axes = np.linalg.eigh(prior)
        root = axes * np.sqrt(np.maximum(values, 0.0))
    twist = norm.ppf(uniform) * np.sqrt(1 - std_ratio**2) @ root.T
    twist[0] = 0.0
    covariance = np.broadcast_to(std_ratio**2 * (root @ root.T), (count, 6, 6))
    return Particles(jnp.float32(twist), jnp.float32(covariance))


def init(
    particles: Particles, objects: int, *, channels: int, prior: Float[np.ndarray, " objects"] | None = None
) -> Belief:
    """Return the belief before the first touch.

    Args:
        particles: Pose particles of each object.
        objects: Number of possible objects.
        channels: Number of values in a reading, three for each chip.
        prior: Probabilities of the objects; equal by default.

    Returns:
        Belief in which all particles of an object are equally probable.
    """
    shape = (objects, len(particles.twist))
    prior = np.full(objects, 1 / objects) if prior is None else prior
    return Belief(
        jnp.log(jnp.float32(prior))[:, None] + jnp.full(shape, np.float32(-np.log(shape[1]))),
        jnp.zeros((*shape, 6)),
        jnp.broadcast_to(particles.covariance, (*shape, 6, 6)),
        jnp.zeros(channels),
        jnp.zeros(()),
    )


def update(belief: Belief, observation: TouchObservation, predicted: PredictedTouch, likelihood: Likelihood) -> Belief:
    """Update the belief with one more touch.

    Args:
        belief: The belief before the touch.
        observation: The measurements of the touch.
        predicted: The predicted touch for each object and each of its k particles, (objects, k).
        likelihood: The distribution of measurements about predictions.

    Returns:
        Belief after the touch.
    """
    unbiased, compared = _compare(belief, observation, predicted, likelihood)
    log_weight = belief.log_weight + log_likelihood(compared, likelihood)
    bias, variance = _update_bias(belief, unbiased, compared.reading, log_weight, likelihood)
    return Belief(log_weight, compared.mean, compared.covariance, bias, variance)


def evidence_by_source(
    belief: Belief, observation: TouchObservation, predicted: PredictedTouch, likelihood: Likelihood
) -> Float[Array, "4 objects"]:
    """Add the sources of a touch's evidence one after another, summed over the poses of each object.

    By the chain rule, the density of a touch is that of presence, times that of the position given presence, times that
    of the reading given both. Differences of successive rows are therefore log predictive densities, and those of two
    objects differ by the weight of evidence of that source: weights of evidence add up to the change of the log odds
    (Good, Bayesian Statistics 2, 1985, pp. 249-270). The reading comes last, so that it counts only for what presence
    and position do not reveal. These are the log odds of `posterior`, before any calibration.

    Args:
        belief: The belief before the touch.
        observation: The measurements of the touch.
        predicted: The predicted touch for each object and each of its k particles, (objects, k).
        likelihood: The distribution of measurements about predictions.

    Returns:
        `(4, objects)` log weights (nats) of the objects: before the touch, with its presence, with its position too,
        and with its reading too, which is the log weight after the touch.
    """
    _, compared = _compare(belief, observation, predicted, likelihood)
    steps = jnp.stack([belief.log_weight, *reversed(_weighted(compared, likelihood))])
    return logsumexp(jnp.cumsum(steps, axis=0), axis=2)


def log_likelihood(evidence: Evidence, likelihood: Likelihood) -> Float[Array, "..."]:
    """Compute the weighted sum of a touch's log densities: of its reading, its position, and whether it met anything.

    Args:
        evidence: Evidence of the touch under any number of particles.
        likelihood: The weights of the reading, of the position, and of whether the touch met anything.

    Returns:
        `(...)` log densities, one for each particle.
    """
    tactile, spatial, presence = _weighted(evidence, likelihood)
    return tactile + spatial + presence


def evidence(
    observation: TouchObservation,
    predicted: PredictedTouch,
    mean: Float[Array, "6"],
    covariance: Float[Array, "6 6"],
    likelihood: Likelihood,
) -> Evidence:
    """Compare one touch with its prediction for one particle.

    Args:
        observation: The touch, whose reading is corrected for the sensor's bias.
        predicted: The touch as predicted for the particle.
        mean: Mean (m) of the object's twist about the particle.
        covariance: Covariance (m^2) of that twist.
        likelihood: The distribution of measurements about predictions.

    Returns:
        Log densities of the reading and of the position (0 without contact), log probability of the contact or of its
        absence, the predicted reading (uT), and the twist's normal distribution given the position.
    """
    # A noisy wrench sensor may report less than the smallest possible load of a press.
    force = jnp.maximum(observation.force, MIN_LOAD_N)
    indentation, reading, variance = interpolate_load(predicted, likelihood.loads, force)
    tactile = reading_log_density(observation.reading - reading, variance, likelihood)

    # The expected end of the press, and its variances.
    distance = predicted.approach_distance + jnp.dot(predicted.jacobian, mean)
    cross_covariance = jnp.matmul(covariance, predicted.jacobian, precision="highest")
    unsure = jnp.dot(predicted.jacobian, cross_covariance) + (likelihood.indentation_error * indentation) ** 2
    end_variance = unsure + likelihood.position_std**2
    error = observation.advance - (distance + indentation + observation.force / likelihood.stiffness)

    inliers, outlier = _end_log_densities(error, end_variance, predicted, likelihood)
    spatial = jnp.logaddexp(logsumexp(inliers), outlier)
    presence = _presence_log_probability(observation.contact, predicted, distance, end_variance, likelihood)

    # The pose is updated only with the probability that the position is not an outlier.
    informative = observation.contact & (likelihood.spatial_weight > 0)
    new_mean, new_covariance = _kalman_mixture(
        mean, covariance, error=error, cross_covariance=cross_covariance, variance=end_variance,
        probability=jnp.where(informative, jnp.exp(inliers - spatial), 0.0),
    )  # fmt: skip
    return Evidence(
        tactile=jnp.where(observation.contact, tactile, 0.0),
        spatial=jnp.where(observation.contact, spatial, 0.0),
        presence=presence,
        reading=reading,
        mean=new_mean,
        covariance=new_covariance,
    )


def reading_log_density(
    error: Float[Array, " c"], variance: Float[Array, ""], likelihood: Likelihood
) -> Float[Array, ""]:
    """Compute the log density of a reading's error: a multivariate Student's t in whitened coordinates.

    Args:
        error: Measured minus predicted reading (uT).
        variance: The reading model's own variance at the touch, relative to the square of a channel's signal.
        likelihood: Whitening, inflation and degrees of freedom.

    Returns:
        Scalar log density, up to the whitening's volume, which is the same for all particles.
    """
    channels = error.shape[-1]
    whitened = jnp.matmul(likelihood.whiten, error, precision="highest")
    spread = likelihood.inflation**2 * (1 + likelihood.growth * variance)
    square = jnp.sum(whitened**2 / spread)
    dof = likelihood.dof
    level = gammaln((dof + channels) / 2) - gammaln(dof / 2) - channels / 2 * jnp.log(dof * jnp.pi)
    return level - 0.5 * jnp.sum(jnp.log(spread)) - (dof + channels) / 2 * jnp.log1p(square / dof)


def posterior(belief: Belief) -> Float[Array, " objects"]:
    """Compute the probabilities of the objects, summed over their particles.

    Args:
        belief: The belief after some touches.

    Returns:
        `(objects,)` probabilities that sum to 1.
    """
    return jax.nn.softmax(logsumexp(belief.log_weight, axis=1))


def twist_estimate(
    belief: Belief, particles: Particles
) -> tuple[Float[Array, "objects 6"], Float[Array, "objects 6 6"]]:
    """Estimate the pose of each object, given that it is the true one.

    Args:
        belief: The belief after some touches.
        particles: The pose particles of its `init`.

    Returns:
        Mean (m) and covariance (m^2) of each object's twist from its believed pose.
    """
    weight = jax.nn.softmax(belief.log_weight, axis=1)
    twist = particles.twist[None] + belief.mean
    mean = jnp.einsum("ok,oki->oi", weight, twist)
    deviation = twist - mean[:, None]
    between = jnp.einsum("ok,oki,okj->oij", weight, deviation, deviation)
    return mean, between + jnp.einsum("ok,okij->oij", weight, belief.covariance)


def _compare(
    belief: Belief, observation: TouchObservation, predicted: PredictedTouch, likelihood: Likelihood
) -> tuple[TouchObservation, Evidence]:
    """Correct a touch for the sensor's bias, and compare it with its predictions (objects, k)."""
    unbiased = observation._replace(reading=observation.reading - belief.bias)
    compared = jax.vmap(jax.vmap(partial(evidence, unbiased, likelihood=likelihood)))(
        predicted, belief.mean, belief.covariance
    )
    return unbiased, compared


def _weighted(evidence: Evidence, likelihood: Likelihood) -> tuple[Array, Array, Array]:
    """Compute the weighted log densities of the reading, of the position, and of presence."""

    def weighted(weight: Array, density: Array) -> Array:
        return jnp.where(weight > 0, weight * density, 0.0)  # evidence without weight may be NaN

    return (
        weighted(likelihood.tactile_weight, evidence.tactile),
        weighted(likelihood.spatial_weight, evidence.spatial),
        weighted(likelihood.presence_weight, evidence.presence),
    )


def _end_log_densities(
    error: Float[Array, ""], variance: Float[Array, " s"], predicted: PredictedTouch, likelihood: Likelihood
) -> tuple[Float[Array, " s"], Float[Array, ""]]:
    """Compute log densities of the end of a press: as predicted, with each component's variance (m^2), and as an
    outlier, uniform over its range. They include the probabilities of the components and of an outlier.
    """
    normal = -0.5 * (error**2 / variance + jnp.log(2 * jnp.pi * variance))
    rate = _outlier_rate(likelihood)
    inliers = jnp.where(predicted.hit, jnp.log1p(-rate) + jnp.log(likelihood.position_share) + normal, -jnp.inf)
    return inliers, jnp.log(rate / outlier_range(likelihood.overtravel))


def _presence_log_probability(
    contact: Bool[Array, ""],
    predicted: PredictedTouch,
    distance: Float[Array, ""],
    variance: Float[Array, " s"],
    likelihood: Likelihood,
) -> Float[Array, ""]:
    """Compute the log probability of contact, or of none, before the press gives up; either may be an outlier."""
    margin = (likelihood.overtravel - distance) / jnp.sqrt(variance)
    share = jnp.log(likelihood.position_share)
    met = jnp.where(predicted.hit, logsumexp(share + log_ndtr(margin)), -jnp.inf)
    missed = jnp.where(predicted.hit, logsumexp(share + log_ndtr(-margin)), 0.0)
    rate = _outlier_rate(likelihood)
    return jnp.logaddexp(jnp.where(contact, met, missed), jnp.log(rate))


def _outlier_rate(likelihood: Likelihood) -> Array:
    return jnp.maximum(likelihood.outlier_rate, 1e-12)  # above zero for its logarithm


def _kalman_mixture(
    mean: Float[Array, "6"],
    covariance: Float[Array, "6 6"],
    *,
    error: Float[Array, ""],
    cross_covariance: Float[Array, "6"],
    variance: Float[Array, " s"],
    probability: Float[Array, " s"],
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Mix Kalman steps by their probabilities, one step for each component of the error, and no step otherwise.

    Return mean and covariance of the mixture. All steps go along the same direction.
    """
    none = jnp.clip(1 - jnp.sum(probability), 0.0, 1.0)
    gain = 1 / variance  # along the cross-covariance
    expected = jnp.sum(probability * gain)
    between = error**2 * (jnp.sum(probability * (gain - expected) ** 2) + none * expected**2)
    return (
        mean + expected * error * cross_covariance,
        covariance + (between - expected) * jnp.outer(cross_covariance, cross_covariance),
    )


def _update_bias(
    belief: Belief, observation: TouchObservation, predicted: Array, log_weight: Array, likelihood: Likelihood
) -> tuple[Array, Array]:
    """Update the sensor's bias (uT) and its variance after a touch, from the posterior mean of the predicted readings
    (objects, k, c).
    """
    weight = jax.nn.softmax(log_weight.reshape(-1)).reshape(log_weight.shape)
    residual = observation.reading - jnp.einsum("ok,okc->c", weight, predicted)
    residual = jnp.where(jnp.isfinite(residual) & observation.contact, residual, 0.0)
    noise = jnp.mean(jnp.sum(jnp.linalg.inv(likelihood.whiten) ** 2, axis=1)) * likelihood.inflation**2
    prior = belief.bias_variance + likelihood.drift_std**2
    gain = jnp.where(observation.contact, prior / (prior + noise), 0.0)
    return belief.bias + gain * residual, (1 - gain) * prior
