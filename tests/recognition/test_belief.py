"""Beliefs against textbook statistics in double precision, and against worlds drawn from the model itself."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M
from i2t.recognition import belief
from i2t.recognition.belief import Belief, Particles, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.skin_models.layer import MIN_LOAD_N
from i2t.skin_models.likelihood import Likelihood, fit_likelihood

LOADS = np.array([0.3, 0.9, 2.7])
PAST = 6e-3
POSITION = 0.1e-3  # m
SPREAD = np.array([1, 1, 1, 0.4, 0.4, 0.4]) * 1e-3  # m
EPS = np.finfo(np.float32).eps
SIGMAS = stats.norm.isf(1e-6 / 2)  # a false alarm of a statistical test in a million, were its seed drawn anew
STRAY = 2 * PAST + 20e-3  # m, over which a stray press may end

ERRORS = np.random.default_rng(0).normal(size=(200, 15)) @ np.random.default_rng(1).normal(size=(15, 15))
# The sample covariance, shrunk towards its diagonal by 15 of 215 parts, plus sensor noise of a thousandth.
SAMPLE = np.cov(ERRORS.T)
COVARIANCE = (200 * SAMPLE + 15 * np.diag(np.diag(SAMPLE))) / 215 + 1e-3 * np.eye(15)
SCALE = np.linspace(5, 40, 15)
LIKE = fit_likelihood(ERRORS, jnp.float32(SCALE), jnp.float32(LOADS), overtravel=PAST, position_std=POSITION)._replace(
    indentation_error=jnp.float32(0)
)


def like(**changes: Any) -> Likelihood:
    return LIKE._replace(**{name: jnp.float32(value) for name, value in changes.items()})


evidence = jax.jit(jax.vmap(belief.evidence, (0, 0, 0, 0, None)))
update, posterior = jax.jit(belief.update), jax.jit(belief.posterior)
by_source = jax.jit(belief.evidence_by_source)


def outcomes(rng: np.random.Generator, *shape: int) -> PredictedTouch:
    """Touches that all meet something, well before they give up."""
    slope = rng.normal(scale=0.5, size=(*shape, 6)) + np.eye(6)[2]
    sunk = np.cumsum(rng.uniform(1e-4, 3e-4, (*shape, 3)), -1)
    reading = rng.normal(scale=15, size=(*shape, 1, 15)) * LOADS[:, None]
    variance = rng.uniform(0, 0.1, (*shape, 1)) * LOADS**2
    values = np.ones(shape, bool), rng.uniform(-2e-3, -1e-3, shape), slope, sunk, reading, variance
    return PredictedTouch(*(jnp.asarray(x, None if x.dtype == bool else jnp.float32) for x in values))


def expected(outcome: PredictedTouch, load: int) -> np.ndarray:
    """Positions (m) at which presses end at the load of this number, without the error of the placement."""
    sunk = np.asarray(outcome.indentation[..., load], np.float64)
    return np.asarray(outcome.approach_distance, np.float64) + sunk + LOADS[load] / ARM_STIFFNESS_N_PER_M


def effective(now: Belief) -> np.ndarray:
    """Effective number of particles of each object (Kong, Liu and Wong, JASA 89, 1994)."""
    return np.asarray(1 / jnp.sum(jax.nn.softmax(now.log_weight, axis=1) ** 2, axis=1))


def measured(reading, force, advance, contact) -> TouchObservation:
    return TouchObservation(jnp.float32(reading), jnp.float32(force), jnp.float32(advance), jnp.asarray(contact))


def test_the_density_of_a_whitened_reading_error_is_student_t():
    likelihood = like(dof=5, inflation=1.3)
    whiten = np.asarray(likelihood.whiten, np.float64)
    loss = 15 * EPS * np.linalg.cond(COVARIANCE)  # of factors in float32
    assert loss < 0.1
    np.testing.assert_allclose(whiten @ COVARIANCE @ whiten.T, np.eye(15), atol=loss)
    turned = whiten @ np.diag(SCALE**2) @ whiten.T
    np.testing.assert_allclose(turned, np.diag(LIKE.growth), atol=15 * EPS * np.abs(turned).max())

    rng = np.random.default_rng(2)
    error = rng.normal(size=(20, 15)) @ np.linalg.cholesky(COVARIANCE).T * rng.uniform(0.3, 30, (20, 1))
    variance = np.append(0, rng.uniform(0, 0.5, 19))
    density = jax.jit(jax.vmap(belief.reading_log_density, (0, 0, None)))
    value = np.asarray(density(jnp.float32(error), jnp.float32(variance), likelihood))
    exact = [
        stats.multivariate_t(shape=1.3**2 * (COVARIANCE + v * np.diag(SCALE**2)), df=5).logpdf(e)
        for e, v in zip(error, variance, strict=True)
    ]
    # Densities are those of whitened coordinates, whose volume is the same for all that are compared. A condition
    # number of roundings in the distance, of which the density takes (5 + 15) / 2 logarithms.
    volume = np.linalg.slogdet(whiten)[1]
    np.testing.assert_allclose(value + volume, exact, atol=10 * 15 * EPS * np.sqrt(np.linalg.cond(COVARIANCE)))
    grown = np.asarray(density(jnp.float32(100 * error), jnp.float32(variance), likelihood))
    assert (grown - value > -20 * np.log(100) - 1e-3).all()  # heavy tails: a power, no exponential


# --- one touch --------------------------------------------------------------------------------------------------------

MANY = 24
PRIOR = np.tile(np.diag(SPREAD**2), (MANY, 1, 1))


def judged(outcome, error=0.0, *, likelihood=LIKE, mean=0.0, covariance=PRIOR, load=1, contact=True):
    """Evidence of presses that end `error` (m) beyond where they would without an error of the placement."""
    at = measured(np.zeros((MANY, 15)), np.full(MANY, LOADS[load]), expected(outcome, load) + error, [contact] * MANY)
    return evidence(at, outcome, jnp.float32(np.broadcast_to(mean, (MANY, 6))), jnp.float32(covariance), likelihood)


@pytest.mark.parametrize(
    ("std", "share", "rate", "deep"),
    [([POSITION], [1.0], 1e-12, 0), ([POSITION], [1.0], 1e-12, 0.3), ([5e-5, 2e-4, 1e-3], [0.6, 0.3, 0.1], 0.01, 0)],
)
def test_a_position_updates_the_pose_by_a_mixture_of_kalman_steps_and_outliers_do_not(std, share, rate, deep):
    """Density, mean and covariance by the mixture's components, in double precision; the error of a deep indentation
    adds to that of the position.
    """
    rng = np.random.default_rng(19)
    outcome, root = outcomes(rng, MANY), rng.normal(scale=0.1e-3, size=(MANY, 6, 6))
    mean, covariance = rng.normal(scale=0.1e-3, size=(MANY, 6)), root @ root.swapaxes(1, 2)
    errors = np.resize([0.0, 0.3e-3, 1e-3, 0.5], MANY)  # half a metre
    likelihood = like(position_std=std, position_share=share, outlier_rate=rate, indentation_error=deep)
    compared = judged(outcome, errors, likelihood=likelihood, mean=mean, covariance=covariance)
    for i, error in enumerate(errors):
        P, slope = covariance[i], np.asarray(outcome.jacobian[i], np.float64)
        toward, surprise = P @ slope, error - slope @ mean[i]
        variance = slope @ toward + np.array(std) ** 2 + (deep * float(outcome.indentation[i, 1])) ** 2
        usual = np.array(share) * stats.norm.pdf(surprise, scale=np.sqrt(variance))
        joint = np.append((1 - rate) * usual, rate / STRAY)
        assert float(compared.spatial[i]) == pytest.approx(np.log(joint.sum()), abs=1e-3)
        weight = joint / joint.sum()
        gains = np.append(np.outer(1 / variance, toward), np.zeros((1, 6)), axis=0)
        step = weight @ gains * surprise
        off = gains * surprise - step
        mixed = P + np.einsum("c,ci,cj->ij", weight, off, off) - np.outer(weight @ gains, toward)
        np.testing.assert_allclose(compared.mean[i], mean[i] + step, atol=1e-7)
        np.testing.assert_allclose(compared.covariance[i], mixed, atol=1e-3 * P.max())


def test_probabilities_of_contact_and_of_none_sum_to_one_plus_outliers():
    rng = np.random.default_rng(5)
    outcome, hit = outcomes(rng, MANY), np.arange(MANY) % 3 != 0
    approach = np.where(hit, PAST + rng.normal(scale=2e-3, size=MANY), PAST)
    outcome = outcome._replace(hit=jnp.asarray(hit), approach_distance=jnp.float32(approach))
    mean = np.float32(rng.normal(size=(MANY, 6)) * SPREAD)
    met, missed = (judged(outcome, mean=mean, contact=contact) for contact in (True, False))
    np.testing.assert_allclose(np.exp(met.presence) + np.exp(missed.presence), 1.02, atol=1e-5)
    slope = np.asarray(outcome.jacobian, np.float64)
    unsure = np.sqrt(np.einsum("ni,nij,nj->n", slope, PRIOR, slope) + POSITION**2)
    short = (PAST - approach - (slope * mean).sum(1)) / unsure
    np.testing.assert_allclose(np.exp(met.presence) - 0.01, np.where(hit, stats.norm.cdf(short), 0), atol=1e-4)
    # A miss alone is evidence then, and moves nothing.
    for values, same in ((missed.tactile, 0), (missed.spatial, 0), (missed.mean, mean)):
        np.testing.assert_array_equal(values, same)
    np.testing.assert_array_equal(missed.covariance, np.float32(PRIOR))


def test_a_force_below_the_smallest_load_counts_as_that_load():
    outcome = outcomes(np.random.default_rng(60), MANY)
    force = np.tile([-0.1, 0.0, 1e-6, MIN_LOAD_N], MANY // 4)
    same = jax.tree.map(lambda x: jnp.repeat(x[::4], 4, axis=0), outcome)
    # Readings and indentations are those of the least load; the arm gives by the force that was measured.
    advance = np.asarray(same.approach_distance) + force / ARM_STIFFNESS_N_PER_M
    at = measured(np.asarray(same.reading)[:, 0] / 20, force, advance, np.ones(MANY, bool))
    compared = evidence(at, same, jnp.zeros((MANY, 6)), jnp.float32(PRIOR), LIKE)
    for values in (compared.tactile, compared.spatial, compared.mean):
        values = np.asarray(values).reshape(MANY // 4, 4, -1)
        np.testing.assert_allclose(values, values[:, -1:].repeat(4, 1), rtol=1e-4, atol=1e-7)
    assert np.isfinite(compared.tactile).all()


def test_evidence_of_extreme_touches_is_finite():
    outcome, covariance = outcomes(np.random.default_rng(6), MANY), PRIOR.copy()
    reading, force, advance = np.zeros((MANY, 15)), np.ones(MANY), np.zeros(MANY)
    reading[0], force[1], force[2], advance[3], advance[4] = 1e6, 0, 1e5, 1e3, -1e3
    slope, approach = np.array(outcome.jacobian), np.array(outcome.approach_distance)
    slope[5], slope[6], approach[7], approach[8], covariance[10] = 0, 1e4, 1.0, -1.0, 0
    outcome = outcome._replace(jacobian=jnp.asarray(slope), approach_distance=jnp.asarray(approach))
    outcome = jax.tree.map(lambda x: x.at[9].set(jnp.zeros_like(x[9])), outcome)
    for contact in (True, False):
        at = measured(reading, force, advance, np.full(MANY, contact))
        for likelihood in (LIKE, like(outlier_rate=1e-12)):
            compared = evidence(at, outcome, jnp.zeros((MANY, 6)), jnp.float32(covariance), likelihood)
            assert all(np.isfinite(values).all() for values in compared)
            assert (np.linalg.eigvalsh(np.asarray(compared.covariance, np.float64)) > -1e-6 * SPREAD.max() ** 2).all()


# --- particles --------------------------------------------------------------------------------------------------------


def total_covariance(twist, covariance) -> np.ndarray:
    """Covariance of all particles together."""
    return np.cov(np.asarray(twist, np.float64).T) + np.asarray(covariance, np.float64).mean(0)


def test_particles_have_the_variance_of_the_prior():
    half = np.random.default_rng(0).normal(size=(6, 5)) * 1e-3
    # Of independent coordinates; of a registered pose, correlated and known exactly in one direction.
    for told, prior, loose in ((SPREAD, np.diag(SPREAD**2), 3), (half @ half.T, half @ half.T, 10)):
        many, scale = belief.sample_particles(told, 4096, seed=3), np.sqrt(np.diagonal(prior))
        # Quasi-random: an error of some log(n) / n, against 1 / sqrt(n) = 0.016 of random ones.
        off = (total_covariance(many.twist, many.covariance) - prior) / np.outer(scale, scale)
        np.testing.assert_allclose(off, 0, atol=np.log(4096) / 4096 * loose)
        np.testing.assert_allclose(many.twist.mean(0) / scale, 0, atol=np.log(4096) / 4096 * loose)
        np.testing.assert_array_equal(many.twist[0], 0)
    narrow = belief.sample_particles(SPREAD, 8, std_ratio=1.0)  # all of it about the origin
    np.testing.assert_allclose(narrow.twist, 0, atol=1e-9)
    np.testing.assert_allclose(narrow.covariance, np.tile(np.diag(SPREAD**2), (8, 1, 1)), rtol=1e-6)


# --- an episode -------------------------------------------------------------------------------------------------------

OBJECTS, COUNT = 2, 2048
PLACES = belief.sample_particles(SPREAD, COUNT)


def lines(outcome: PredictedTouch, places: Particles) -> PredictedTouch:
    """Approach distances that are the same line over all places of an object: exact for a Gaussian sum."""
    moved = jnp.einsum("oi,ki->ok", outcome.jacobian, places.twist)
    outcome = jax.tree.map(lambda x: jnp.repeat(x[:, None], COUNT, 1), outcome)
    return outcome._replace(approach_distance=outcome.approach_distance + moved)


def after_touches(rng, places: Particles, twist: np.ndarray, touches: int):
    """A belief after touches of the first object, displaced by `twist`, of which positions alone count (to 0.5 mm);
    their slopes and how much further they ended than without a displacement, of each object.
    """
    likelihood = like(outlier_rate=1e-12, tactile_weight=0, position_std=[0.5e-3])
    now, slopes, errors = belief.init(places, OBJECTS, channels=15), [], []
    for _ in range(touches):
        outcome = outcomes(rng, OBJECTS)
        slopes.append(np.asarray(outcome.jacobian, np.float64))
        ends = expected(outcome, 1)
        advance = ends[0] + slopes[-1][0] @ twist + rng.normal(scale=0.5e-3)
        errors.append(advance - ends)
        now = update(now, measured(np.zeros(15), LOADS[1], advance, True), lines(outcome, places), likelihood)
    return now, np.stack(slopes), np.stack(errors)


@pytest.mark.full
def test_touches_are_a_linear_regression():
    rng = np.random.default_rng(7)
    now, slopes, errors = after_touches(rng, PLACES, rng.normal(size=6) * SPREAD, 4)
    mean, covariance = belief.twist_estimate(now, PLACES)
    evidences, prior = [], np.diag(SPREAD**2)
    for o in range(OBJECTS):
        H, y = slopes[:, o], errors[:, o]
        S = H @ prior @ H.T + 0.5e-3**2 * np.eye(4)
        K = prior @ H.T @ np.linalg.inv(S)
        evidences.append(stats.multivariate_normal(cov=S).logpdf(y))
        # Particles that share a posterior: an error of its width over the square root of how many they are.
        left, loose = np.sqrt(np.diag(prior - K @ H @ prior)), SIGMAS / np.sqrt(effective(now)[o])
        np.testing.assert_array_less(np.abs(np.asarray(mean[o]) - K @ y) / left, loose)
        np.testing.assert_array_less(np.abs(np.sqrt(np.diag(covariance[o])) / left - 1), loose)
    np.testing.assert_array_less(OBJECTS, effective(now))
    exact = np.exp(evidences - np.logaddexp.reduce(evidences))
    loose = SIGMAS * np.sqrt(np.sum(1 / effective(now) - 1 / COUNT)) * exact.prod()
    np.testing.assert_allclose(posterior(now), exact, atol=max(loose, 1e-3))
    assert 0.01 < exact[0] < 0.99


@pytest.fixture(scope="module")
def middle() -> tuple[Belief, TouchObservation, PredictedTouch]:
    """The state in the middle of an episode."""
    rng = np.random.default_rng(8)
    now = belief.init(PLACES, OBJECTS, channels=15)
    now = now._replace(
        log_weight=now.log_weight + jnp.float32(rng.normal(size=now.log_weight.shape)),
        mean=jnp.float32(rng.normal(size=now.mean.shape) * SPREAD * 0.3),
    )
    outcome = outcomes(rng, OBJECTS, COUNT)
    reading = np.asarray(outcome.reading[0, 0, 1]) + rng.normal(size=15)
    return now, measured(reading, 0.9, -1e-3, True), outcome


def test_evidence_without_weight_may_be_nan(middle):
    now, at, outcome = middle

    def apart(other: TouchObservation, **weights: float) -> float:
        """Difference of the particles' weights after another touch was measured."""
        first, second = (update(now, touch, outcome, like(**weights)).log_weight for touch in (at, other))
        return float(np.abs(first - second).max())

    felt, ended = at._replace(reading=at.reading + 30), at._replace(advance=at.advance + 1e-3)
    air, lost = at._replace(contact=jnp.asarray(False)), at._replace(reading=jnp.full(15, jnp.nan))
    assert apart(felt, tactile_weight=0) < 1e-5 < 1 < apart(felt)
    assert apart(ended, spatial_weight=0) < 1e-5 < 1 < apart(ended)
    assert apart(air, tactile_weight=0, spatial_weight=0) > 1  # presence alone
    none = like(tactile_weight=0, spatial_weight=0, presence_weight=0)
    for touch in (at, air):
        np.testing.assert_array_equal(update(now, touch, outcome, none).log_weight, now.log_weight)
    # A broken reading where only positions count, and a position where only readings do.
    after = update(now, lost, outcome, like(tactile_weight=0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
    after = update(now, ended, outcome, like(spatial_weight=0))
    np.testing.assert_array_equal(after.mean, now.mean)
    np.testing.assert_array_equal(after.covariance, now.covariance)


def test_the_evidence_of_the_sources_sums_to_the_change_of_the_log_odds(middle):
    now, at, outcome = middle
    steps = np.asarray(by_source(now, at, outcome, LIKE), np.float64)
    before, after = np.log(posterior(now)), np.log(posterior(update(now, at, outcome, LIKE)))
    np.testing.assert_allclose(steps[0] - steps[0, 0], before - before[0], atol=1e-4)
    np.testing.assert_allclose(
        np.diff(steps, axis=0).sum(0) - steps[-1, 0] + steps[0, 0], (after - before) - (after - before)[0], atol=2e-3
    )
    away = at._replace(contact=jnp.asarray(False))
    np.testing.assert_array_equal(np.diff(by_source(now, away, outcome, LIKE), axis=0)[1:], 0)  # presence alone


def pair(**second: Any) -> PredictedTouch:
    """A touch that is predicted equally for two objects of one pose, but for these fields of the second."""
    first = jax.tree.map(lambda x: jnp.tile(x, (2,) + (1,) * (x.ndim - 1)), outcomes(np.random.default_rng(3), 1, 1))
    first = first._replace(jacobian=0 * first.jacobian)
    return first._replace(**{name: getattr(first, name).at[1].set(value) for name, value in second.items()})


def weights(predicted: PredictedTouch, error: float = 0.0, contact: bool = True) -> np.ndarray:
    """Weights of evidence of presence, position and reading for the first object of a pair, which a touch matches to an
    error of its end (m).
    """
    now = belief.init(Particles(jnp.zeros((1, 6)), jnp.zeros((1, 6, 6))), 2, channels=15)
    at = measured(predicted.reading[0, 0, 1], LOADS[1], expected(predicted, 1)[0, 0] + error, contact)
    first, second = np.diff(np.asarray(by_source(now, at, predicted, LIKE), np.float64), axis=0).T
    return first - second


def test_where_only_readings_differ_only_the_reading_is_evidence():
    """Student's t of two readings that differ by 30 uT at one chip, in double precision."""
    same = pair()
    other = same.reading[1].at[..., 0].add(30.0)
    variance = float(same.variance[0, 0, 1])
    shape = float(LIKE.inflation) ** 2 * (COVARIANCE + variance * np.diag(SCALE**2))
    t = stats.multivariate_t(shape=shape, df=float(LIKE.dof))
    exact = float(LIKE.tactile_weight) * (t.logpdf(np.zeros(15)) - t.logpdf(30 * np.eye(15)[0]))
    presence, position, reading = weights(pair(reading=other))
    assert (presence, position) == (0, 0)
    assert reading == pytest.approx(exact, rel=0.02)
    assert reading > 0.1


def test_where_only_distances_differ_only_the_position_is_evidence():
    """A mixture of normals and an outlier's uniform density, of ends that differ by 0.2 mm."""
    near = pair()
    std, share = np.asarray(LIKE.position_std, np.float64), np.asarray(LIKE.position_share, np.float64)
    rate = float(LIKE.outlier_rate)

    def density(error: float) -> float:
        return (1 - rate) * float(share @ stats.norm.pdf(error, scale=std)) + rate / STRAY

    exact = float(LIKE.spatial_weight) * np.log(density(0.05e-3) / density(0.05e-3 - 0.2e-3))
    presence, position, reading = weights(pair(approach_distance=near.approach_distance[0] + 0.2e-3), 0.05e-3)
    assert presence == 0
    assert abs(reading) < 1e-5  # a rounding of the position's
    assert position == pytest.approx(exact, rel=1e-3)
    assert position > 0.1


@pytest.mark.parametrize("contact", [True, False])
def test_where_only_one_object_is_met_only_presence_is_evidence_of_no_contact(contact):
    """The object that should have been met is excluded up to outliers, and so is the one that should not if it was."""
    rate = float(LIKE.outlier_rate)
    exact = float(LIKE.presence_weight) * np.log((1 + rate) / rate) * (1 if contact else -1)
    presence, position, reading = weights(pair(hit=False), contact=contact)
    assert presence == pytest.approx(exact, rel=1e-3)
    if not contact:
        assert (position, reading) == (0, 0)


@pytest.mark.full
def test_the_bias_of_the_sensor_is_tracked():
    rng = np.random.default_rng(11)
    offset, noise = rng.normal(scale=20, size=15), np.linalg.cholesky(np.cov(ERRORS.T))

    def followed(drift: float, touches: int) -> Belief:
        now = belief.init(PLACES, OBJECTS, channels=15)
        for _ in range(touches):
            outcome = outcomes(rng, OBJECTS)
            true = np.asarray(outcome.reading[0, 1]) + offset + noise @ rng.normal(size=15)
            at = measured(true, LOADS[1], expected(outcome, 1)[0], True)
            now = update(now, at, lines(outcome, PLACES), like(drift_std=drift))
        return now

    still, now = followed(0.0, 2), followed(2.0, 40)
    np.testing.assert_array_equal(still.bias, 0)
    assert still.bias_variance == 0
    assert posterior(now)[0] > 0.999
    # The filter in closed form: its variance before a touch settles at P with drift^2 (P + R) = P^2.
    R = float(np.mean(np.diag(COVARIANCE)))
    P = (2.0**2 + np.sqrt(2.0**4 + 4 * 2.0**2 * R)) / 2
    gain = P / (P + R)
    assert float(now.bias_variance) == pytest.approx((1 - gain) * P, rel=0.02)
    # What is left is a mean of noise, gain / (2 - gain) of its variance, and of the offset what the touches left, of
    # which the last half had the settled gain.
    sd = np.sqrt(gain / (2 - gain) * np.diag(np.cov(ERRORS.T)))
    assert (np.abs(now.bias - offset) < SIGMAS * sd + np.abs(offset) * (1 - gain) ** 20).all()


@pytest.mark.full
def test_posterior_probabilities_are_frequencies_of_right_decisions():
    """Everything is drawn from the model, which is therefore correct."""
    kinds, few, episodes, sites, shape = 3, 16, 1500, 6, (1500, 3)
    model, places = like(outlier_rate=1e-9, position_std=[0.5e-3]), belief.sample_particles(SPREAD, 16)
    rng = np.random.default_rng(12)
    table = outcomes(rng, sites, kinds, few)
    # Objects are hard to tell apart: readings differ by a good part of their errors, approach distances by those of
    # positions.
    as_errors = np.linalg.cholesky(np.cov(ERRORS.T)).T * 0.35
    readings = (rng.normal(size=(*table.hit.shape, 1, 15)) @ as_errors) * LOADS[:, None]
    table = table._replace(reading=jnp.float32(readings))
    truth, site = rng.choice(kinds, episodes), rng.integers(sites, size=shape)
    place = rng.integers(few, size=episodes)[:, None]
    now = jax.tree.map(lambda x: np.asarray(x)[site, truth[:, None], place], table)
    spread = np.sqrt(1 + np.asarray(model.growth) * now.variance[..., 1:2])
    t = rng.normal(size=(*shape, 15)) / np.sqrt(rng.chisquare(8, shape) / 8)[..., None]
    reading = now.reading[..., 1, :] + (spread * t) @ np.linalg.inv(np.asarray(model.whiten, np.float64)).T
    off = rng.normal(size=(episodes, 1, 6)) * SPREAD * 0.5
    advance = expected(now, 1) + (now.jacobian * off).sum(-1) + rng.normal(scale=0.5e-3, size=shape)

    def episode(at):
        def step(now, touched):
            return belief.update(now, touched[1], jax.tree.map(lambda x: x[touched[0]], table), model), None

        return belief.posterior(jax.lax.scan(step, belief.init(places, kinds, channels=15), at)[0])

    at = jnp.asarray(site), measured(reading, np.full(shape, LOADS[1]), advance, np.ones(shape, bool))
    p = np.asarray(jax.jit(lambda at: jax.lax.map(episode, at, batch_size=50))(at), np.float64)
    np.testing.assert_allclose(p.sum(1), 1, atol=1e-4)  # logarithms of some hundred, in float32
    right, decided = truth[:, None] == np.arange(kinds), p.argmax(1)
    assert 0.4 < p.max(1).mean() < 0.9
    # Each event comes true as often as its probability says, within the spread of a sum of such events: those of an
    # episode exclude one another, so its variance is that of one draw of several values.
    for weight in (p, np.eye(kinds)[decided], *np.eye(kinds)[:, None]):
        surplus = (weight * (right - p)).sum()
        variance = ((weight**2 * p).sum(1) - (weight * p).sum(1) ** 2).sum()
        assert abs(surplus) <= SIGMAS * np.sqrt(variance) + 1e-4 * episodes
