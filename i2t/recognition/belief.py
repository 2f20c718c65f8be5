"""Belief over objects and their poses: a posterior from touches.

Each possible object has a number of pose particles: poses drawn from what is known of its placement, the same through
an episode. How far the placement may be off is taken as stated. Each touch is compared with the touch that was
predicted for every particle (`i2t.recognition.outcomes`).
Two measurements are evidence:

  the reading   given the force: Student's t about the predicted reading. Its scale matrix is the covariance of a
                Gaussian process's errors, which includes sensor noise that all chips share, plus the GP's own variance
                at that touch;
  the position  at which the press ended: distance to contact + indentation of the skin + compliance of the arm. Around
                a particle the distance to contact is linear in the pose, so each particle carries a normal distribution
                of its remaining pose error and updates it with a Kalman filter (a Gaussian sum; Alspach and Sorenson,
                IEEE Trans. Automatic Control 17, 1972). Without these normal distributions no particle of a few hundred
                would survive contacts measured to 0.1 mm in a prior of 1 mm in six dimensions. Errors of positions have
                heavy tails: they are a scale mixture of normals (Andrews and Mallows, J. R. Stat. Soc. B 36, 1974), and
                each of its components makes a Kalman step of its own, weighted by how well it predicted the touch. The
                deeper the skin is predicted to sink, the less well is it known how far.

Whether a touch met anything is evidence as well (presence), and counts by a weight of its own, as the two do. A small
share of touches may be anything (outliers). "None of these" is the sum over surrogates of unknown objects
(`i2t.objects.catalogue`), which are objects like any other here. The sensor's bias, where it drifts, is followed by a
Kalman filter on the residual of the readings.

Pure functions on one episode: `init(...) -> Belief`, `update(belief, ...) -> Belief`, `posterior(belief)`. A reading
has c = 3 * chips channels. Metres, newtons, microtesla.
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

MIN_PROBABILITY = 1e-30  # probabilities below are treated as equal
MIN_OUTLIER_RATE = 1e-12
PARTICLE_STD_RATIO = 0.5  # standard deviation of the pose about a particle, relative to that of the prior


@in_one_line
class TouchObservation(NamedTuple):
    """Measurements at a touch of a site."""

    reading: Float[Array, " c"]  # uT
    force: Float[Array, ""]  # N
    advance: Float[Array, ""]  # m, from the site to where the press ended, along the approach
    contact: Bool[Array, ""]  # whether anything was met


@in_one_line
class Particles(NamedTuple):
    """Pose particles of an object: displacements from its believed pose (`i2t.geometry.from_twist`)."""

    twist: Float[Array, "k 6"]  # m
    covariance: Float[Array, "k 6 6"]  # m^2, about each


@in_one_line
class Belief(NamedTuple):
    """Belief after some touches of an episode."""

    log_weight: Float[Array, "objects k"]  # log probability of object, particle and all touches so far
    mean: Float[Array, "objects k 6"]  # m, of the twist about the particle
    covariance: Float[Array, "objects k 6 6"]  # m^2
    bias: Float[Array, " c"]  # uT, of the sensor
    bias_variance: Float[Array, ""]  # uT^2


class Evidence(NamedTuple):
    """Log densities of one touch under each particle, and the particle's normal distribution after it."""

    tactile: Float[Array, "..."]  # of the reading
    spatial: Float[Array, "..."]  # of the position
    presence: Float[Array, "..."]  # of meeting something, or nothing
    reading: Float[Array, "... c"]  # uT, predicted
    mean: Float[Array, "... 6"]
    covariance: Float[Array, "... 6 6"]


def sample_particles(
    prior: Float[np.ndarray, "6"] | Float[np.ndarray, "6 6"],
    count: int,
    seed: int = 0,
    *,
    std_ratio: float = PARTICLE_STD_RATIO,
) -> Particles:
    """Draw pose particles from a normal prior; the first one is the believed pose itself.

    Quasi-random (scrambled Sobol sequence; Owen, J. Complexity 14, 1998), on the host. Particles and the normal
    distributions about them together have the prior's variance.

    Args:
        prior: Covariance (m^2) of the twist, which may be singular, or the standard deviations (m) of its six parts.
        count: Number of particles.
        seed: Of the sequence.
        std_ratio: Standard deviation about each particle, relative to the prior's.

    Returns:
        The particles, all as probable, with the covariance about each.
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
    """The belief before the first touch.

    Args:
        particles: Poses of each object.
        objects: How many objects there may be.
        channels: Values of a reading, three for each chip.
        prior: Probabilities of the objects; all equal by default.

    Returns:
        The belief, with all particles of an object as probable.
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
    """The belief after one more touch.

    Args:
        belief: Before the touch.
        observation: What was measured.
        predicted: What the touch was predicted to be for each object and particle, (objects, k).
        likelihood: How far measurements may be from predictions.

    Returns:
        The belief with that touch.
    """
    unbiased = observation._replace(reading=observation.reading - belief.bias)
    found = jax.vmap(jax.vmap(partial(evidence, unbiased, likelihood=likelihood)))(
        predicted, belief.mean, belief.covariance
    )
    log_weight = belief.log_weight + log_likelihood(found, likelihood)
    bias, variance = _update_bias(belief, unbiased, found.reading, log_weight, likelihood)
    return Belief(log_weight, found.mean, found.covariance, bias, variance)


def log_likelihood(found: Evidence, likelihood: Likelihood) -> Float[Array, "..."]:
    """Log density of a touch from the kinds of evidence that have weight.

    Args:
        found: Evidence of the touch under any number of particles.
        likelihood: Whose weights say what counts: the reading, the position, and whether anything was met.

    Returns:
        One log density for each particle.
    """

    def weighted(weight: Array, density: Array) -> Array:
        return jnp.where(weight > 0, weight * density, 0.0)  # what is left out may be NaN

    return (
        weighted(likelihood.tactile_weight, found.tactile)
        + weighted(likelihood.spatial_weight, found.spatial)
        + weighted(likelihood.presence_weight, found.presence)
    )


def evidence(
    observation: TouchObservation,
    predicted: PredictedTouch,
    mean: Float[Array, "6"],
    covariance: Float[Array, "6 6"],
    likelihood: Likelihood,
) -> Evidence:
    """Compare one touch with its prediction for one particle.

    Args:
        observation: The touch; its reading is free of the sensor's bias.
        predicted: The touch as predicted for the particle.
        mean: Mean (m) of the object's twist about the particle.
        covariance: Its covariance (m^2).
        likelihood: How far measurements may be from predictions.

    Returns:
        Log densities of the reading, of the position and of contact, and the twist's normal distribution given the
        position.
    """
    # A noisy wrench sensor may say less than the least load with which anything is pressed.
    force = jnp.maximum(observation.force, MIN_LOAD_N)
    indentation, reading, variance = interpolate_load(predicted, likelihood.loads, force)
    tactile = reading_log_density(observation.reading - reading, variance, likelihood)

    # Where the press should have ended, and with which variances.
    distance = predicted.approach_distance + jnp.dot(predicted.jacobian, mean)
    cross_covariance = jnp.matmul(covariance, predicted.jacobian, precision="highest")
    unsure = jnp.dot(predicted.jacobian, cross_covariance) + (likelihood.indentation_error * indentation) ** 2
    end_variance = unsure + likelihood.position_std**2
    error = observation.advance - (distance + indentation + observation.force / likelihood.stiffness)

    inliers, outlier = _end_log_densities(error, end_variance, predicted, likelihood)
    spatial = jnp.logaddexp(logsumexp(inliers), outlier)
    presence = _presence_log_probability(observation.contact, predicted, distance, end_variance, likelihood)

    # The pose is updated only with the probability that the position is no outlier.
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
    """Log density of an error of the reading: a multivariate Student's t in whitened coordinates.

    Args:
        error: Measured minus predicted reading (uT).
        variance: The GP's own variance at the touch, relative to its scale.
        likelihood: Whitening, inflation and degrees of freedom.

    Returns:
        The log density, up to the whitening's volume, which is the same for all that are compared.
    """
    channels = error.shape[-1]
    whitened = jnp.matmul(likelihood.whiten, error, precision="highest")
    spread = likelihood.inflation**2 * (1 + likelihood.growth * variance)
    square = jnp.sum(whitened**2 / spread)
    dof = likelihood.dof
    level = gammaln((dof + channels) / 2) - gammaln(dof / 2) - channels / 2 * jnp.log(dof * jnp.pi)
    return level - 0.5 * jnp.sum(jnp.log(spread)) - (dof + channels) / 2 * jnp.log1p(square / dof)


def posterior(belief: Belief) -> Float[Array, " objects"]:
    """Probabilities of the objects, particles summed out.

    Args:
        belief: After some touches.

    Returns:
        Probabilities that sum to 1.
    """
    return jax.nn.softmax(logsumexp(belief.log_weight, axis=1))


def twist_estimate(
    belief: Belief, particles: Particles
) -> tuple[Float[Array, "objects 6"], Float[Array, "objects 6 6"]]:
    """Pose of each object, if it is the one that is there.

    Args:
        belief: After some touches.
        particles: The pose particles it began with.

    Returns:
        Mean (m) and covariance (m^2) of each object's twist from its believed pose.
    """
    weight = jax.nn.softmax(belief.log_weight, axis=1)
    twist = particles.twist[None] + belief.mean
    mean = jnp.einsum("ok,oki->oi", weight, twist)
    deviation = twist - mean[:, None]
    between = jnp.einsum("ok,oki,okj->oij", weight, deviation, deviation)
    return mean, between + jnp.einsum("ok,okij->oij", weight, belief.covariance)


def _end_log_densities(
    error: Float[Array, ""], variance: Float[Array, " s"], predicted: PredictedTouch, likelihood: Likelihood
) -> tuple[Float[Array, " s"], Float[Array, ""]]:
    """Log densities of the end of a press: as predicted, with each component's variance (m^2), and as an outlier
    (uniform over its range); shares included.
    """
    normal = -0.5 * (error**2 / variance + jnp.log(2 * jnp.pi * variance))
    rate = jnp.maximum(likelihood.outlier_rate, MIN_OUTLIER_RATE)
    inliers = jnp.where(predicted.hit, jnp.log1p(-rate) + jnp.log(likelihood.position_share) + normal, -jnp.inf)
    return inliers, jnp.log(rate / outlier_range(likelihood.overtravel))


def _presence_log_probability(
    contact: Bool[Array, ""],
    predicted: PredictedTouch,
    distance: Float[Array, ""],
    variance: Float[Array, " s"],
    likelihood: Likelihood,
) -> Float[Array, ""]:
    """Log probability of contact (or of none) before the press gives up; either may be an outlier."""
    margin = (likelihood.overtravel - distance) / jnp.sqrt(variance)
    share = jnp.log(likelihood.position_share)
    met = jnp.where(predicted.hit, logsumexp(share + log_ndtr(margin)), -jnp.inf)
    missed = jnp.where(predicted.hit, logsumexp(share + log_ndtr(-margin)), 0.0)
    rate = jnp.maximum(likelihood.outlier_rate, MIN_OUTLIER_RATE)
    return jnp.logaddexp(jnp.where(contact, met, missed), jnp.log(rate))


def _kalman_mixture(
    mean: Float[Array, "6"],
    covariance: Float[Array, "6 6"],
    *,
    error: Float[Array, ""],
    cross_covariance: Float[Array, "6"],
    variance: Float[Array, " s"],
    probability: Float[Array, " s"],
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Kalman steps that hold with probabilities, one for each component of the error: mean and covariance of the
    mixture of having made each, or none. All steps go along the same direction.
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
    """The sensor's bias (uT) and its variance after a touch, from the posterior mean of the `predicted` readings
    (objects, k, c).
    """
    weight = jax.nn.softmax(log_weight.reshape(-1)).reshape(log_weight.shape)
    residual = observation.reading - jnp.einsum("ok,okc->c", weight, predicted)
    residual = jnp.where(jnp.isfinite(residual) & observation.contact, residual, 0.0)
    noise = jnp.mean(jnp.sum(jnp.linalg.inv(likelihood.whiten) ** 2, axis=1)) * likelihood.inflation**2
    prior = belief.bias_variance + likelihood.drift_std**2
    gain = jnp.where(observation.contact, prior / (prior + noise), 0.0)
    return belief.bias + gain * residual, (1 - gain) * prior
