"""Which object is there, and where: a posterior over objects and their placements from touches.

Each possible object stands in a number of places drawn from what is known of its placement, the same through an episode
(particles), and each touch is compared with what it would be like there (`i2t.recognition.outcomes`). Two things are
evidence:

  the reading   given the force: Student's t about the imagined one. Its scale is the covariance of a trained process's
                errors, sensor noise that all chips share included, plus the process's own variance at that touch;
  the position  at which the press ended: travel to contact + sinking of the skin + give of the arm. Around a particle
                the travel is linear in the placement, so each particle carries a normal distribution of what it is
                still off by and updates it as Kalman's filter does (a Gaussian sum; Alspach and Sorenson, IEEE Trans.
                Automatic Control 17, 1972). That makes a few hundred particles enough for contacts known to 0.1 mm in
                a prior of 1 mm in six dimensions; bare ones would leave none.

A touch that meets nothing is evidence as well. A share of touches may be anything (outliers). "None of these" is what
decoys have together (`i2t.objects.catalogue.decoy`), which are objects like any other here. What the sensor's zero has
drifted by is followed by a Kalman filter on what the posterior leaves of the readings.

Pure functions on one episode; metres, newtons, microtesla.
"""

from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln, log_ndtr, logsumexp
from jaxtyping import Array, Bool, Float
from scipy.stats import norm, qmc

from i2t.recognition.outcomes import Outcome, at_load
from i2t.simulation.press import PressLimits
from i2t.types import READINGS

Count = TypeVar("Count", float, np.ndarray, Array)  # of touches; one or many

WITHIN = 0.5  # standard deviation of the placement about a particle, relative to that of the prior
LEAST = 1e-30  # probability below which none is told from another
NEVER = 1e-12  # least share of touches that may be anything
STIFFNESS = PressLimits.stiffness  # N/m, arm and mount in series


class Measured(NamedTuple):
    """What a touch at a site gave."""

    reading: Float[Array, "15"]  # uT
    force: Float[Array, ""]  # N
    advance: Float[Array, ""]  # m, from the site to the tool's end, along the approach
    contact: Bool[Array, ""]  # whether anything was met


class Likelihood(NamedTuple):
    """How far a touch may be from the imagined one; fitted to touches by `likelihood` and to episodes by validation."""

    whiten: Float[Array, "15 15"]  # W, with W S W' = 1 and W diag(scale^2) W' = diag(growth), S the errors' covariance
    growth: Float[Array, "15"]
    loads: Float[Array, " l"]  # N, of the outcomes
    past: Float[Array, ""]  # m beyond the site after which a press gives up
    freedom: Float[Array, ""]  # of Student's t
    inflation: Float[Array, ""]  # of the errors' standard deviation, on objects other than those learnt from
    position: Float[Array, ""]  # m, standard deviation of where a press ends, the object's place known
    outliers: Float[Array, ""]  # share of touches that may be anything
    tactile: Float[Array, ""]  # weight of the reading's evidence; 0 leaves it out
    spatial: Float[Array, ""]  # and of the position's
    stiffness: Float[Array, ""]  # N/m
    drift: Float[Array, ""]  # uT by which the zero may drift from touch to touch; 0 where it is measured at each


class Particles(NamedTuple):
    """Placements of an object about where it is believed."""

    twist: Float[Array, "k 6"]  # m (`i2t.registration.patch.motion`)
    covariance: Float[Array, "6 6"]  # m^2, about each


class Belief(NamedTuple):
    """What is believed after some touches."""

    log_weight: Float[Array, "objects k"]  # joint with all touches so far
    mean: Float[Array, "objects k 6"]  # m, of the twist about the particle
    covariance: Float[Array, "objects k 6 6"]  # m^2
    zero: Float[Array, "15"]  # uT, the sensor's
    zero_variance: Float[Array, ""]  # uT^2


class Temper(NamedTuple):
    """How much less the touches of an episode say together than each says alone: temperature 1 + growth * (t - 1) times
    `first` after t touches.
    """

    first: float = 1.0
    growth: float = 0.0

    def temperature(self, touches: Count) -> Count:
        """After a number of touches."""
        return self.first * (1 + self.growth * (touches - 1))


# Fitted on validation objects of five pads and seeds (docs/recognition.md): what a pad taught wrongly is wrong at every
# touch, which touches that are taken one by one do not know.
TEMPER = Temper(1.04, 0.04)


class Evidence(NamedTuple):
    """Log densities of one touch under each particle, and the Kalman filter's step."""

    tactile: Float[Array, "..."]  # of the reading
    spatial: Float[Array, "..."]  # of the position
    presence: Float[Array, "..."]  # of meeting something, or nothing
    reading: Float[Array, "... 15"]  # uT, expected
    mean: Float[Array, "... 6"]
    covariance: Float[Array, "... 6 6"]


def particles(
    prior: Float[np.ndarray, "6"] | Float[np.ndarray, "6 6"], count: int, seed: int = 0, within: float = WITHIN
) -> Particles:
    """`count` placements, the first of which is where the object is believed. `prior` is the covariance (m^2) of the
    twist, or the standard deviations (m) of a twist whose six parts are independent.

    Quasi-random normal (scrambled Sobol sequence; Owen, J. Complexity 14, 1998), on the host. Together with what lies
    about them they have the prior's variance.
    """
    uniform = qmc.Sobol(6, seed=seed).random_base2(int(np.ceil(np.log2(max(count, 2)))))[:count]
    prior = np.asarray(prior, np.float64)
    if prior.ndim == 1:
        root = np.diag(prior)
    else:  # a covariance, which may be singular
        values, axes = np.linalg.eigh(prior)
        root = axes * np.sqrt(np.maximum(values, 0.0))
    twist = norm.ppf(np.clip(uniform, 1e-6, 1 - 1e-6)) * np.sqrt(1 - within**2) @ root.T
    twist[0] = 0.0
    return Particles(jnp.float32(twist), jnp.float32(within**2 * root @ root.T))


def likelihood(
    errors: Float[np.ndarray, "n 15"],
    scale: Float[Array, "15"],
    loads: Float[Array, " l"],
    past: float,
    position: float,
    stiffness: float = STIFFNESS,
) -> Likelihood:
    """A likelihood from what a process left of touches that it had not learnt from (uT), in double precision.

    `scale` (uT) is that of the process's variance, `position` (m) what its touches said of where presses end.
    """
    covariance = np.cov(np.asarray(errors, np.float64).T) + 1e-3 * np.eye(READINGS)
    factor = np.linalg.inv(np.linalg.cholesky(covariance))
    growth, turn = np.linalg.eigh(factor @ np.diag(np.asarray(scale, np.float64) ** 2) @ factor.T)
    number = partial(jnp.asarray, dtype=jnp.float32)
    return Likelihood(
        number(turn.T @ factor), number(np.maximum(growth, 0)), loads, number(past), number(8.0), number(1.0),
        number(position), number(0.01), number(1.0), number(1.0), number(stiffness), number(0.0),
    )  # fmt: skip


def begin(placements: Particles, objects: int, prior: Float[np.ndarray, " objects"] | None = None) -> Belief:
    """Before the first touch: objects with the probabilities `prior`, or all alike."""
    shape = (objects, len(placements.twist))
    prior = np.full(objects, 1 / objects) if prior is None else prior
    return Belief(
        jnp.broadcast_to(jnp.log(jnp.float32(prior / shape[1]))[:, None], shape),
        jnp.zeros((*shape, 6)),
        jnp.broadcast_to(placements.covariance, (*shape, 6, 6)),
        jnp.zeros(READINGS),
        jnp.zeros(()),
    )


def update(belief: Belief, measured: Measured, outcomes: Outcome, like: Likelihood) -> Belief:
    """The belief after one more touch, whose `outcomes` were imagined for each object and particle, (objects, k)."""
    told = measured._replace(reading=measured.reading - belief.zero)
    found = jax.vmap(jax.vmap(partial(evidence, told, like=like)))(outcomes, belief.mean, belief.covariance)
    log_weight = belief.log_weight + weighed(found, like)
    zero, variance = _follow(belief, told, found.reading, log_weight, like)
    return Belief(log_weight, found.mean, found.covariance, zero, variance)


def weighed(found: Evidence, like: Likelihood) -> Float[Array, "..."]:
    """Log density of a touch from the kinds of evidence that are used; each of them knows whether anything was met."""

    def part(weight: Array, density: Array) -> Array:
        return jnp.where(weight > 0, weight * density, 0.0)  # what is left out may be NaN

    met = part(jnp.maximum(like.tactile, like.spatial), found.presence)
    return part(like.tactile, found.tactile) + part(like.spatial, found.spatial) + met


def evidence(
    measured: Measured,
    outcome: Outcome,
    mean: Float[Array, "6"],
    covariance: Float[Array, "6 6"],
    like: Likelihood,
) -> Evidence:
    """One touch under one particle, which lies off by `mean` with `covariance`."""
    sunk, reading, variance = at_load(outcome, like.loads, measured.force)
    tactile = jnp.where(measured.contact, reading_density(measured.reading - reading, variance, like), 0.0)

    # Where the press should have ended, and how sure that is.
    expected = outcome.travel + jnp.dot(outcome.slope, mean) + sunk + measured.force / like.stiffness
    carried = jnp.matmul(covariance, outcome.slope, precision="highest")
    unsure = jnp.dot(outcome.slope, carried) + like.position**2
    error = measured.advance - expected
    normal = -0.5 * (error**2 / unsure + jnp.log(2 * jnp.pi * unsure))
    outliers = jnp.maximum(like.outliers, NEVER)
    stray = jnp.log(outliers / _range(like))
    usual = jnp.where(outcome.hit, jnp.log1p(-outliers) + normal, -jnp.inf)
    density = jnp.logaddexp(usual, stray)
    short = (like.past - outcome.travel - jnp.dot(outcome.slope, mean)) / jnp.sqrt(unsure)
    met = jnp.where(outcome.hit, log_ndtr(short), -jnp.inf)
    missed = jnp.where(outcome.hit, log_ndtr(-short), 0.0)
    presence = jnp.logaddexp(jnp.where(measured.contact, met, missed), jnp.log(outliers))

    # With probability w the press ended where it should; the mixture of having learnt from it or not keeps its spread.
    w = jnp.where(measured.contact & (like.spatial > 0), jnp.exp(usual - density), 0.0)
    gain = carried / unsure
    left = w * (1 - w) * error**2 * jnp.outer(gain, gain)
    return Evidence(
        tactile,
        jnp.where(measured.contact, density, 0.0),
        presence,
        reading,
        mean + w * gain * error,
        covariance - w * jnp.outer(gain, carried) + left,
    )


def reading_density(error: Float[Array, "15"], variance: Float[Array, ""], like: Likelihood) -> Float[Array, ""]:
    """Log density of an error of reading (uT): Student's t in whitened coordinates."""
    whitened = jnp.matmul(like.whiten, error, precision="highest")
    spread = like.inflation**2 * (1 + like.growth * variance)
    square = jnp.sum(whitened**2 / spread)
    v = like.freedom
    level = gammaln((v + READINGS) / 2) - gammaln(v / 2) - READINGS / 2 * jnp.log(v * jnp.pi)
    return level - 0.5 * jnp.sum(jnp.log(spread)) - (v + READINGS) / 2 * jnp.log1p(square / v)


def posterior(belief: Belief) -> Float[Array, " objects"]:
    """Probabilities of the objects."""
    return jax.nn.softmax(logsumexp(belief.log_weight, axis=1))


def tempered(
    probability: Float[Array, "*t objects"], touches: Float[Array, "*t"] | float, temper: Temper = TEMPER
) -> Float[Array, "*t objects"]:
    """Probabilities after a number of touches, as sure as they should be (temperature scaling; Guo and others, ICML
    2017): the order of the objects stays.
    """
    temperature = temper.temperature(jnp.asarray(touches))
    return jax.nn.softmax(jnp.log(jnp.maximum(probability, LEAST)) / temperature[..., None], axis=-1)


def placement(belief: Belief, placements: Particles) -> tuple[Float[Array, "objects 6"], Float[Array, "objects 6 6"]]:
    """Mean (m) and covariance (m^2) of each object's twist, if it is the one."""
    share = jax.nn.softmax(belief.log_weight, axis=1)
    at = placements.twist[None] + belief.mean
    mean = jnp.einsum("ok,oki->oi", share, at)
    apart = at - mean[:, None]
    between = jnp.einsum("ok,oki,okj->oij", share, apart, apart)
    return mean, between + jnp.einsum("ok,okij->oij", share, belief.covariance)


def effective(belief: Belief) -> Float[Array, " objects"]:
    """Effective number of particles of each object (Kong, Liu and Wong, JASA 89, 1994)."""
    return 1 / jnp.sum(jax.nn.softmax(belief.log_weight, axis=1) ** 2, axis=1)


def _range(like: Likelihood) -> Array:
    """Length (m) over which a stray press may end."""
    return 2 * like.past + 20e-3


def _follow(
    belief: Belief, told: Measured, readings: Array, log_weight: Array, like: Likelihood
) -> tuple[Array, Array]:
    """The sensor's zero after a touch, from what the posterior expects the reading to be."""
    share = jax.nn.softmax(log_weight.reshape(-1)).reshape(log_weight.shape)
    left = told.reading - jnp.einsum("ok,okc->c", share, readings)
    left = jnp.where(jnp.isfinite(left) & told.contact, left, 0.0)
    error = jnp.mean(jnp.sum(jnp.linalg.inv(like.whiten) ** 2, axis=1)) * like.inflation**2
    prior = belief.zero_variance + like.drift**2
    gain = jnp.where(told.contact, prior / (prior + error), 0.0)
    return belief.zero + gain * left, (1 - gain) * prior
