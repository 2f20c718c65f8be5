"""Beliefs against textbook statistics in double precision, and against worlds drawn from the model itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from i2t.recognition import belief
from i2t.recognition.belief import Belief, Likelihood, TouchObservation
from i2t.recognition.outcomes import MIN_LOAD_N, PredictedTouch

LOADS = np.array([0.3, 0.9, 2.7])
PAST = 6e-3
POSITION = 0.1e-3  # m
SPREAD = np.array([1, 1, 1, 0.4, 0.4, 0.4]) * 1e-3  # m
EPS = np.finfo(np.float32).eps
RARE = 1e-6  # chance of a false alarm of a statistical test, were its seed drawn anew
SIGMAS = stats.norm.isf(RARE / 2)
STRAY = 2 * PAST + 20e-3  # m, over which a stray press may end

ERRORS = np.random.default_rng(0).normal(size=(200, 15)) @ np.random.default_rng(1).normal(size=(15, 15))
SCALE = np.linspace(5, 40, 15)
LIKE = belief.fit_likelihood(
    ERRORS, jnp.float32(SCALE), jnp.float32(LOADS), overtravel=PAST, position_std=POSITION
)._replace(indentation_error=jnp.float32(0))  # of which there is a test below


def like(**changes: float) -> Likelihood:
    return LIKE._replace(**{name: jnp.float32(value) for name, value in changes.items()})


EXACT = like(outlier_rate=1e-12)  # linear and normal
evidence = jax.jit(jax.vmap(belief.evidence, (0, 0, 0, 0, None)))
update, posterior = jax.jit(belief.update), jax.jit(belief.posterior)
density = jax.jit(jax.vmap(belief.reading_log_density, (0, 0, None)))


def outcomes(rng: np.random.Generator, *shape: int) -> PredictedTouch:
    """Touches that all meet something, well before they give up."""
    slope = rng.normal(scale=0.5, size=(*shape, 6)) + np.eye(6)[2]
    sunk = np.cumsum(rng.uniform(1e-4, 3e-4, (*shape, 3)), -1)
    reading = rng.normal(scale=15, size=(*shape, 1, 15)) * LOADS[:, None]
    variance = rng.uniform(0, 0.1, (*shape, 1)) * LOADS**2
    values = np.ones(shape, bool), rng.uniform(-2e-3, -1e-3, shape), slope, sunk, reading, variance
    return PredictedTouch(*(jnp.asarray(x, None if x.dtype == bool else jnp.float32) for x in values))


def expected(outcome: PredictedTouch, force: np.ndarray) -> np.ndarray:
    """Where presses end (m) at loads that were imagined, but for the placement."""
    at = [int(np.argmin(np.abs(LOADS - f))) for f in np.ravel(force)]
    sunk = (
        np.asarray(outcome.indentation).reshape(-1, 3)[np.arange(len(at)), at].reshape(outcome.approach_distance.shape)
    )
    return np.asarray(outcome.approach_distance, np.float64) + sunk + force / belief.ARM_STIFFNESS_N_PER_M


def effective(now: Belief) -> np.ndarray:
    """Effective number of particles of each object (Kong, Liu and Wong, JASA 89, 1994)."""
    return np.asarray(1 / jnp.sum(jax.nn.softmax(now.log_weight, axis=1) ** 2, axis=1))


def part(tree, i):
    """An element or a slice of every array."""
    return jax.tree.map(lambda x: x[i], tree)


def measured(reading, force, advance, contact) -> TouchObservation:
    return TouchObservation(jnp.float32(reading), jnp.float32(force), jnp.float32(advance), jnp.asarray(contact))


# --- the likelihood ---------------------------------------------------------------------------------------------------


def test_whitening():
    W = np.asarray(LIKE.whiten, np.float64)
    # The sample covariance, plus sensor noise of a thousandth that keeps it invertible.
    S = np.cov(ERRORS.T) + 1e-3 * np.eye(15)
    loss = 15 * EPS * np.linalg.cond(S)  # of factors of S in float32
    assert loss < 0.1
    np.testing.assert_allclose(W @ S @ W.T, np.eye(15), atol=loss)
    turned = W @ np.diag(SCALE**2) @ W.T
    np.testing.assert_allclose(turned, np.diag(LIKE.growth), atol=15 * EPS * np.abs(turned).max())


def test_density_of_a_reading_is_student_t():
    rng = np.random.default_rng(2)
    likelihood = like(dof=5.0, inflation=1.3)
    S = np.cov(ERRORS.T) + 1e-3 * np.eye(15)
    error = rng.normal(size=(20, 15)) @ np.linalg.cholesky(S).T * rng.uniform(0.3, 30, (20, 1))
    variance = np.concatenate([[0.0], rng.uniform(0, 0.5, 19)])
    value = np.asarray(density(jnp.float32(error), jnp.float32(variance), likelihood))
    # Densities are those of whitened coordinates, whose volume is the same for all that are compared.
    volume = np.linalg.slogdet(np.asarray(likelihood.whiten, np.float64))[1]
    exact = [
        stats.multivariate_t(shape=1.3**2 * (S + v * np.diag(SCALE**2)), df=5).logpdf(e)
        for e, v in zip(error, variance, strict=True)
    ]
    # A condition number of roundings in the distance, of which the density takes (5 + 15) / 2 logarithms.
    np.testing.assert_allclose(value + volume, exact, atol=10 * 15 * EPS * np.sqrt(np.linalg.cond(S)))
    grown = np.asarray(density(jnp.float32(100 * error), jnp.float32(variance), likelihood))
    assert (grown - value > -20 * np.log(100) - 1e-3).all()  # heavy tails: a power, no exponential


# --- one touch --------------------------------------------------------------------------------------------------------

MANY = 24
PRIOR = np.tile(np.diag(SPREAD**2), (MANY, 1, 1))


def judged(outcome, error=0.0, *, likelihood=LIKE, mean=0.0, covariance=PRIOR, force=0.9, contact=True):
    """What presses tell that end `error` (m) beyond where they would without an error of the placement."""
    force, contact = np.broadcast_to(force, MANY), np.broadcast_to(contact, MANY)
    at = measured(np.zeros((MANY, 15)), force, expected(outcome, force) + error, contact)
    return evidence(at, outcome, jnp.float32(np.broadcast_to(mean, (MANY, 6))), jnp.float32(covariance), likelihood)


def test_position_is_the_marginal_over_the_placement():
    rng = np.random.default_rng(3)
    outcome = outcomes(rng, MANY)
    root = rng.normal(scale=0.3e-3, size=(MANY, 6, 6))
    mean, covariance = rng.normal(scale=0.3e-3, size=(MANY, 6)), root @ root.swapaxes(1, 2)
    force = rng.choice(LOADS, MANY)
    error = rng.normal(scale=0.5e-3, size=MANY)
    likelihood = like(outlier_rate=0.05)
    found = judged(outcome, error, likelihood=likelihood, mean=mean, covariance=covariance, force=force)
    # The placement moves the approach distance along its slope, so one dimension of it is integrated over.
    for i in range(MANY):
        slope = np.asarray(outcome.jacobian[i], np.float64)
        offset, sd = slope @ mean[i], np.sqrt(slope @ covariance[i] @ slope)
        reach = np.hypot(sd, POSITION)

        def joint(x: float, offset=offset, sd=sd, error=error[i]) -> float:
            return stats.norm.pdf(x, offset, sd) * stats.norm.pdf(error, x, POSITION)

        edge = offset + (error[i] - offset) * sd**2 / reach**2  # of the integrand's bump, a product of normals
        width = sd * POSITION / reach
        usual, _ = integrate.quad(joint, edge - 10 * width, edge + 10 * width)
        # Places are known to 1e-9 m in float32, here up to 8 reaches off: a relative error of 8e-9 / reach.
        tolerance = 20 * EPS * 3e-3 * (1 + abs(error[i] - offset) / reach) / reach + 1e-5
        assert found.spatial[i] == pytest.approx(np.log(0.95 * usual + 0.05 / STRAY), abs=tolerance)


def test_one_update_is_kalmans_and_outliers_leave_it_out():
    rng = np.random.default_rng(4)
    outcome, mean, force = outcomes(rng, MANY), rng.normal(size=(MANY, 6)) * SPREAD, rng.choice(LOADS, MANY)
    error = rng.normal(scale=1e-3, size=MANY)
    error[:4] = 0.5  # half a metre off
    contact = np.arange(MANY) % 4 != 3
    found = judged(outcome, error, likelihood=EXACT, mean=mean, force=force, contact=contact)
    slope, scale = np.asarray(outcome.jacobian, np.float64), SPREAD.max()
    toward = slope * SPREAD**2
    kept = contact & (np.arange(MANY) >= 4)
    gain = kept[:, None] * toward / ((slope * toward).sum(1, keepdims=True) + POSITION**2)
    moved = mean + gain * (error - (slope * mean).sum(1))[:, None]
    np.testing.assert_allclose(found.mean, moved, atol=1e-4 * scale)
    np.testing.assert_allclose(found.covariance, PRIOR - gain[:, :, None] * toward[:, None], atol=1e-5 * scale**2)


def test_meeting_something_and_nothing_share_one():
    rng = np.random.default_rng(5)
    outcome = outcomes(rng, MANY)
    hit = np.arange(MANY) % 3 != 0
    approach = np.where(hit, PAST + rng.normal(scale=2e-3, size=MANY), PAST)
    outcome = outcome._replace(hit=jnp.asarray(hit), approach_distance=jnp.float32(approach))
    mean = rng.normal(size=(MANY, 6)) * SPREAD
    share = []
    for contact in (True, False):
        found = judged(outcome, mean=mean, contact=contact)
        share.append(np.exp(found.presence) - 0.01)
        if not contact:  # which alone is evidence then
            np.testing.assert_array_equal(found.tactile, 0)
            np.testing.assert_array_equal(found.spatial, 0)
    np.testing.assert_allclose(share[0] + share[1], 1, atol=1e-5)
    slope = np.asarray(outcome.jacobian, np.float64)
    unsure = np.sqrt(np.einsum("ni,nij,nj->n", slope, PRIOR, slope) + POSITION**2)
    short = (PAST - approach - (slope * mean).sum(1)) / unsure
    np.testing.assert_allclose(share[0], np.where(hit, stats.norm.cdf(short), 0), atol=1e-4)


def test_a_force_that_no_wrench_sensor_can_tell_is_the_least():
    rng = np.random.default_rng(60)
    outcome = outcomes(rng, MANY)
    force = np.tile([-0.1, 0.0, 1e-6, MIN_LOAD_N], MANY // 4)
    same = jax.tree.map(lambda x: jnp.repeat(x[::4], 4, axis=0), outcome)
    # Readings and indentations are those of the least load; the arm gives by the force that was measured.
    advance = np.asarray(same.approach_distance) + force / belief.ARM_STIFFNESS_N_PER_M
    at = measured(np.asarray(same.reading)[:, 0] / 20, force, advance, np.ones(MANY, bool))
    found = evidence(at, same, jnp.zeros((MANY, 6)), jnp.float32(PRIOR), LIKE)
    for values in (found.tactile, found.spatial, found.mean):
        values = np.asarray(values).reshape(MANY // 4, 4, -1)
        np.testing.assert_allclose(values, values[:, -1:].repeat(4, 1), rtol=1e-4, atol=1e-7)
    assert np.isfinite(found.tactile).all()


def test_extremes_stay_finite():
    rng = np.random.default_rng(6)
    outcome = outcomes(rng, MANY)
    reading, force, advance = np.zeros((MANY, 15)), np.ones(MANY), np.zeros(MANY)
    reading[0], force[1], force[2], advance[3], advance[4] = 1e6, 0, 1e5, 1e3, -1e3
    slope = np.asarray(outcome.jacobian).copy()
    slope[5], slope[6] = 0, 1e4
    approach = np.asarray(outcome.approach_distance).copy()
    approach[7], approach[8] = 1.0, -1.0
    outcome = outcome._replace(jacobian=jnp.asarray(slope), approach_distance=jnp.asarray(approach))
    outcome = jax.tree.map(lambda x: x.at[9].set(jnp.zeros_like(x[9])), outcome)
    covariance = PRIOR.copy()
    covariance[10] = 0
    for contact in (True, False):
        at = measured(reading, force, advance, np.full(MANY, contact))
        for likelihood in (LIKE, EXACT):
            found = evidence(at, outcome, jnp.zeros((MANY, 6)), jnp.float32(covariance), likelihood)
            for values in found:
                assert np.isfinite(values).all()
            assert (np.linalg.eigvalsh(np.asarray(found.covariance, np.float64)) > -1e-6 * SPREAD.max() ** 2).all()


@pytest.mark.full
def test_a_deep_indentation_is_known_less_well():
    """Its error adds to that of the position, as of two independent normal ones."""
    outcome = jax.tree.map(lambda x: np.asarray(x)[0], outcomes(np.random.default_rng(20), 1))
    likelihood = like(indentation_error=0.3, outlier_rate=1e-12)
    std = np.hypot(POSITION, 0.3 * float(outcome.indentation[2]))
    error = 3 * POSITION
    end = measured(np.zeros(15), 2.7, expected(outcome, np.float64(2.7)) + error, True)
    found = belief.evidence(end, outcome, jnp.zeros(6), jnp.zeros((6, 6)), likelihood)
    assert float(found.spatial) == pytest.approx(stats.norm.logpdf(error, scale=std), abs=1e-3)
    assert std > 1.5 * POSITION


@pytest.mark.full
def test_heavy_tails_of_a_position_are_a_mixture_of_kalman_steps():
    """Density, mean and covariance of a mixture of normals and of outliers by its components, in double precision."""
    outcome = outcomes(np.random.default_rng(19), MANY)
    std, share, rate = np.array([0.05e-3, 0.2e-3, 1e-3]), np.array([0.6, 0.3, 0.1]), 0.01
    heavy = LIKE._replace(position_std=jnp.float32(std), position_share=jnp.float32(share))
    slope, P = np.asarray(outcome.jacobian, np.float64), np.diag(0.05 * SPREAD**2)
    errors = np.resize([0.0, 0.3e-3, 1e-3, 3e-3], MANY)
    found = judged(outcome, errors, likelihood=heavy, covariance=0.05 * PRIOR)
    for i, error in enumerate(errors):
        toward = P @ slope[i]
        variance = slope[i] @ toward + std**2
        joint = np.append((1 - rate) * share * stats.norm.pdf(error, scale=np.sqrt(variance)), rate / STRAY)
        assert float(found.spatial[i]) == pytest.approx(np.log(joint.sum()), abs=1e-3)
        weight = joint / joint.sum()
        gains = np.append(np.outer(1 / variance, toward), np.zeros((1, 6)), axis=0)
        mean = weight @ gains * error
        off = gains * error - mean
        mixed = P + np.einsum("c,ci,cj->ij", weight, off, off) - np.outer(weight @ gains, toward)
        np.testing.assert_allclose(found.mean[i], mean, rtol=1e-2, atol=1e-7)
        np.testing.assert_allclose(found.covariance[i], mixed, rtol=1e-2, atol=1e-3 * P.max())
    # Ten standard deviations of the usual error are no certain doom: the tail of one in ten bears them.
    normal = LIKE._replace(position_std=jnp.float32([0.2e-3]), outlier_rate=jnp.float32(1e-9))
    borne, doomed = (judged(outcome, 2e-3, likelihood=some, covariance=0 * PRIOR).spatial for some in (heavy, normal))
    assert (borne > doomed + 15).all()


# --- an episode -------------------------------------------------------------------------------------------------------

OBJECTS, COUNT = 2, 256
PLACES = belief.sample_particles(SPREAD, COUNT, scales=None)


def linear(rng: np.random.Generator) -> PredictedTouch:
    """A touch whose approach distance is the same line over all places of one object: exact for a Gaussian sum."""
    outcome = outcomes(rng, OBJECTS, 1)
    outcome = jax.tree.map(lambda x: jnp.repeat(x, COUNT, 1), outcome)
    moved = jnp.einsum("oki,ki->ok", outcome.jacobian, PLACES.twist)
    return outcome._replace(approach_distance=outcome.approach_distance + moved)


def test_particles_have_the_variance_of_the_prior():
    np.testing.assert_array_equal(PLACES.twist[0], 0)
    many = belief.sample_particles(SPREAD, 4096, seed=3, scales=None)
    np.testing.assert_array_equal(many.scale, 1)
    total = np.cov(np.asarray(many.twist, np.float64).T) + np.asarray(many.covariance[0])
    # Quasi-random: an error of some log(n) / n, against 1 / sqrt(n) = 0.016 of random ones.
    np.testing.assert_allclose(total / np.outer(SPREAD, SPREAD), np.eye(6), atol=np.log(4096) / 4096 * 3)
    np.testing.assert_allclose(many.twist.mean(0) / SPREAD, 0, atol=np.log(4096) / 4096 * 3)
    assert belief.sample_particles(SPREAD, 5).twist.shape == (5, 6)
    assert len(np.unique(np.asarray(many.twist)[:, 0])) > 4000
    narrow = belief.sample_particles(SPREAD, 8, std_ratio=1.0, scales=None)  # all of it about the origin
    np.testing.assert_allclose(narrow.twist, 0, atol=1e-9)
    np.testing.assert_allclose(narrow.covariance, np.tile(np.diag(SPREAD**2), (8, 1, 1)), rtol=1e-6)
    # A registered pose: correlated, and known exactly in one direction.
    half = np.random.default_rng(0).normal(size=(6, 5)) * 1e-3
    prior = half @ half.T
    particles = belief.sample_particles(prior, 4096, seed=3, scales=None)
    total = np.cov(np.asarray(particles.twist, np.float64).T) + np.asarray(particles.covariance[0])
    scale = np.sqrt(np.diagonal(prior))
    np.testing.assert_allclose((total - prior) / np.outer(scale, scale), 0, atol=np.log(4096) / 4096 * 10)


def test_scales_of_the_placement_are_those_of_their_prior():
    """Log-normal between its ends, with the particles' weights; particles of every scale have its variance."""
    prior = belief.ScalePrior(0.7, 0.25, 4.0, drawn=2.0)
    many = belief.sample_particles(SPREAD, 4096, seed=3, scales=prior)
    log = np.log(np.asarray(many.scale, np.float64))[1:]
    cut = stats.truncnorm(-np.log(4) / 0.7, np.log(4) / 0.7, scale=0.7)
    order, weight = np.argsort(log), np.exp(np.asarray(many.log_prior, np.float64))
    assert weight.sum() == pytest.approx(1, rel=1e-4)
    below = np.cumsum(weight[1:][order])
    assert np.abs(below - cut.cdf(log[order])).max() < 0.01
    assert np.median(many.scale) > 1.5  # wider than probable
    for low, high in ((0.25, 0.7), (0.7, 1.4), (1.4, 4.0)):
        some = (many.scale >= low) & (many.scale < high)
        unit = np.asarray(many.twist / many.scale[:, None], np.float64)[some]
        own = np.asarray(many.covariance / many.scale[:, None, None] ** 2)[some]
        total = np.cov(unit.T) + own.mean(0)
        np.testing.assert_allclose(total / np.outer(SPREAD, SPREAD), np.eye(6), atol=SIGMAS / np.sqrt(some.sum()))
    assert many.scale[0] == 1
    np.testing.assert_allclose(prior.draw(np.array([0.0, 1.0])), [0.25, 4.0])


@pytest.mark.full
def test_the_scale_of_the_placement_is_inferred():
    """Against Bayes' rule by quadrature: positions of a placement that is off three times as far as told."""
    rng = np.random.default_rng(21)
    places = belief.sample_particles(SPREAD, 2048, seed=1, scales=belief.ScalePrior())
    likelihood = EXACT._replace(tactile_weight=jnp.float32(0), position_std=jnp.float32([0.5e-3]))
    now = belief.init(places, 1, channels=15)
    twist = 3 * rng.choice([-1, 1], 6) * SPREAD
    rows, rights = [], []
    for _ in range(3):
        outcome = outcomes(rng, 1, 1)
        slope = np.asarray(outcome.jacobian[0, 0], np.float64)
        end = expected(part(outcome, np.s_[:, 0]), np.array([0.9]))[0]
        outcome = jax.tree.map(lambda x: jnp.repeat(x, 2048, 1), outcome)
        moved = jnp.einsum("oki,ki->ok", outcome.jacobian, places.twist)
        outcome = outcome._replace(approach_distance=outcome.approach_distance + moved)
        error = slope @ twist + rng.normal(scale=0.5e-3)
        now = update(now, measured(np.zeros(15), 0.9, end + error, True), outcome, likelihood)
        rows.append(slope)
        rights.append(error)
    H, y = np.stack(rows), np.array(rights)
    log = np.linspace(np.log(0.5), np.log(8), 400)
    density = np.exp(
        [
            stats.multivariate_normal(cov=H @ np.diag((np.exp(s) * SPREAD) ** 2) @ H.T + 0.25e-6 * np.eye(3)).logpdf(y)
            for s in log
        ]
    ) * stats.norm.pdf(log, scale=0.7)
    mean = np.sum(density * log) / density.sum()
    sd = np.sqrt(np.sum(density * (log - mean) ** 2) / density.sum())
    scale, spread = belief.scale_posterior(now, places)
    few = sd / np.sqrt(effective(now)[0])
    assert np.log(float(scale)) == pytest.approx(mean, abs=SIGMAS * few)
    assert float(spread) == pytest.approx(sd, abs=SIGMAS * few)
    assert mean > 0.5


@pytest.mark.full
def test_touches_are_a_linear_regression():
    rng = np.random.default_rng(7)
    likelihood = EXACT._replace(tactile_weight=jnp.float32(0), position_std=jnp.float32([0.5e-3]))
    now = belief.init(PLACES, OBJECTS, channels=15)
    twist = rng.normal(size=6) * SPREAD
    rows, rights = [], []
    for _ in range(4):
        outcome, force = linear(rng), rng.choice(LOADS)
        at = np.stack([expected(part(outcome, np.s_[:, 0]), np.full(OBJECTS, force))])[0]
        slope = np.asarray(outcome.jacobian[:, 0], np.float64)
        at = at - slope @ np.asarray(PLACES.twist[0], np.float64)
        advance = at[0] + slope[0] @ twist + rng.normal(scale=0.5e-3)
        rows.append(slope)
        rights.append(advance - at)
        now = update(now, measured(np.zeros(15), force, advance, True), outcome, likelihood)
    mean, covariance = belief.twist_estimate(now, PLACES)
    evidences = []
    for o in range(OBJECTS):
        H, y = np.stack(rows)[:, o], np.stack(rights)[:, o]
        S = H @ np.diag(SPREAD**2) @ H.T + 0.5e-3**2 * np.eye(4)
        K = np.diag(SPREAD**2) @ H.T @ np.linalg.inv(S)
        evidences.append(stats.multivariate_normal(cov=S).logpdf(y))
        # Particles that share a posterior: an error of its width over the square root of how many they are.
        left = np.sqrt(np.diag(np.diag(SPREAD**2) - K @ H @ np.diag(SPREAD**2)))
        loose = SIGMAS / np.sqrt(effective(now)[o])
        np.testing.assert_array_less(np.abs(np.asarray(mean[o]) - K @ y) / left, loose)
        np.testing.assert_array_less(np.abs(np.sqrt(np.diag(covariance[o])) / left - 1), loose)
    np.testing.assert_array_less(OBJECTS, effective(now))
    exact = np.exp(evidences - np.logaddexp.reduce(evidences))
    found = posterior(now)
    loose = SIGMAS * np.sqrt(np.sum(1 / np.asarray(effective(now)) - 1 / COUNT)) * exact.prod()
    np.testing.assert_allclose(found, exact, atol=max(loose, 1e-3))
    assert 0.01 < exact[0] < 0.99


def some_belief(rng: np.random.Generator) -> tuple[Belief, TouchObservation, PredictedTouch]:
    """The middle of an episode."""
    now = belief.init(PLACES, OBJECTS, channels=15)
    now = now._replace(
        log_weight=now.log_weight + jnp.float32(rng.normal(size=now.log_weight.shape)),
        mean=jnp.float32(rng.normal(size=now.mean.shape) * SPREAD * 0.3),
    )
    outcome = outcomes(rng, OBJECTS, COUNT)
    reading = np.asarray(outcome.reading[0, 0, 1]) + rng.normal(size=15)
    return now, measured(reading, 0.9, -1e-3, True), outcome


@pytest.mark.full
def test_probabilities_add_up_and_follow_a_permutation():
    rng = np.random.default_rng(8)
    now, at, outcome = some_belief(rng)
    likelihood = like(drift_std=1.0)
    after = update(now, at, outcome, likelihood)
    found = posterior(after)
    assert float(found.sum()) == pytest.approx(1, abs=1e-5)
    order, shuffle = np.array([1, 0]), rng.permutation(COUNT)

    def turned(tree):
        return jax.tree.map(lambda x: x[order][:, shuffle], tree)

    mixed = Belief(*turned(tuple(now[:3])), *now[3:])
    again = update(mixed, at, turned(outcome), likelihood)
    other = posterior(again)
    # Sums over 512 places, in another order.
    np.testing.assert_allclose(other, found[order], rtol=1e-4)
    np.testing.assert_allclose(again.bias, after.bias, atol=1e-4)
    np.testing.assert_allclose(again.mean, after.mean[order][:, shuffle], atol=1e-9)


@pytest.mark.full
def test_places_that_are_ruled_out_change_nothing():
    rng = np.random.default_rng(9)
    now, at, outcome = some_belief(rng)
    half = now._replace(log_weight=now.log_weight.at[:, COUNT // 2 :].set(-jnp.inf))
    strange = jax.tree.map(lambda x: x.at[:, COUNT // 2 :].set(jnp.zeros_like(x[0, 0])), outcome)
    first = update(half, at, outcome, LIKE)
    other = update(half, at, strange, LIKE)
    assert np.isfinite(posterior(first)).all()
    np.testing.assert_allclose(posterior(first), posterior(other), rtol=1e-5)
    np.testing.assert_allclose(
        belief.twist_estimate(first, PLACES)[0], belief.twist_estimate(other, PLACES)[0], atol=1e-9
    )


def test_weights_leave_evidence_out():
    rng = np.random.default_rng(10)
    now, at, outcome = some_belief(rng)
    pairs = (
        (like(tactile_weight=0), at._replace(reading=at.reading + 30)),
        (like(spatial_weight=0), at._replace(advance=at.advance + 1e-3)),
    )
    for likelihood, changed in pairs:
        found, other = update(now, at, outcome, likelihood), update(now, changed, outcome, likelihood)
        np.testing.assert_allclose(found.log_weight, other.log_weight, atol=1e-5)
        full, apart = update(now, at, outcome, LIKE), update(now, changed, outcome, LIKE)
        assert np.abs(full.log_weight - apart.log_weight).max() > 1
    air, alone = at._replace(contact=jnp.asarray(False)), like(tactile_weight=0, spatial_weight=0)
    found, other = update(now, at, outcome, alone), update(now, air, outcome, alone)
    assert np.abs(found.log_weight - other.log_weight).max() > 1  # presence alone
    none = alone._replace(presence_weight=jnp.float32(0))
    for observation in (at, air):
        np.testing.assert_array_equal(update(now, observation, outcome, none).log_weight, now.log_weight)


def test_what_is_left_out_may_be_nan_and_moves_nothing():
    """A broken reading where only positions count, and a position where only readings do."""
    now, at, outcome = some_belief(np.random.default_rng(8))
    lost = at._replace(reading=jnp.full(15, jnp.nan))
    after = update(now, lost, outcome, like(tactile_weight=0.0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
    after = update(now, at._replace(advance=jnp.float32(5e-3)), outcome, like(spatial_weight=0.0))
    np.testing.assert_array_equal(after.mean, now.mean)
    np.testing.assert_array_equal(after.covariance, now.covariance)


@pytest.mark.full
def test_the_zero_of_the_sensor_is_followed():
    rng = np.random.default_rng(11)
    offset = rng.normal(scale=20, size=15)
    noise = np.linalg.cholesky(np.cov(ERRORS.T))
    for drift, touches in ((0.0, 2), (2.0, 40)):
        now = belief.init(PLACES, OBJECTS, channels=15)
        for _ in range(touches):
            outcome = linear(rng)
            true = np.asarray(outcome.reading[0, 0, 1]) + offset + noise @ rng.normal(size=15)
            advance = expected(part(outcome, np.s_[:1, 0]), np.array([0.9]))[0]
            now = update(now, measured(true, 0.9, advance, True), outcome, like(drift_std=drift))
        if drift == 0:
            np.testing.assert_array_equal(now.bias, 0)
            assert now.bias_variance == 0
            continue
        assert posterior(now)[0] > 0.999
        # The filter in closed form: its variance before a touch settles at P with drift^2 (P + R) = P^2.
        R = float(np.mean(np.diag(np.cov(ERRORS.T))) + 1e-3)
        P = (drift**2 + np.sqrt(drift**4 + 4 * drift**2 * R)) / 2
        gain = P / (P + R)
        assert float(now.bias_variance) == pytest.approx((1 - gain) * P, rel=0.02)
        # What is left is a mean of noise, gain / (2 - gain) of its variance, and of the offset what the touches left,
        # of which the last half had the settled gain.
        sd = np.sqrt(gain / (2 - gain) * np.diag(np.cov(ERRORS.T)))
        assert (np.abs(now.bias - offset) < SIGMAS * sd + np.abs(offset) * (1 - gain) ** 20).all()


@pytest.mark.full
def test_any_board():
    """Objects that only the readings of another board tell apart, here of 16 chips."""
    rng, channels = np.random.default_rng(13), 48
    likelihood = belief.fit_likelihood(
        rng.normal(size=(200, channels)), jnp.full(channels, 10.0), jnp.float32(LOADS),
        overtravel=PAST, position_std=POSITION,
    )  # fmt: skip
    reading = jnp.float32(rng.normal(scale=15, size=(2, 1, 1, channels)) * LOADS[:, None])
    table = jax.tree.map(lambda x: x.repeat(2, 0), outcomes(rng, 1, 1))._replace(reading=reading)
    advance = expected(part(table, np.s_[1:, 0]), np.array([0.9]))[0]
    table = jax.tree.map(lambda x: jnp.repeat(x, 4, 1), table)
    places = belief.sample_particles(SPREAD, 4, scales=None)
    now = belief.init(places, 2, channels=channels, prior=np.array([0.9, 0.1]))
    now = update(now, measured(reading[1, 0, 1] + rng.normal(size=channels), 0.9, advance, True), table, likelihood)
    assert now.bias.shape == (channels,)
    assert posterior(now)[1] > 0.99


# --- a world drawn from the model -------------------------------------------------------------------------------------

KINDS, FEW, TOUCHES, EPISODES = 3, 16, 3, 1500
TOY = like(outlier_rate=1e-9)._replace(position_std=jnp.float32([0.5e-3]))
TOY_PLACES = belief.sample_particles(SPREAD, FEW, scales=None)


@jax.jit
def judge(table: PredictedTouch, site: jnp.ndarray, at: TouchObservation):
    """Posteriors at the ends of many episodes."""

    def episode(site, at):
        def step(now, touched):
            return belief.update(now, touched[1], part(table, touched[0]), TOY), None

        now, _ = jax.lax.scan(step, belief.init(TOY_PLACES, KINDS, channels=15), (site, at))
        return belief.posterior(now)

    return jax.lax.map(lambda x: episode(*x), (site, at), batch_size=50)


@pytest.mark.full
def test_probabilities_are_those_of_being_right():
    rng = np.random.default_rng(12)
    sites = 6
    table = outcomes(rng, sites, KINDS, FEW)
    # Objects are hard to tell apart: readings differ by a good part of their errors, approach
    # distances by those of positions.
    as_errors = np.linalg.cholesky(np.cov(ERRORS.T)).T * 0.35
    readings = (rng.normal(size=(*table.hit.shape, 1, 15)) @ as_errors) * LOADS[:, None]
    table = table._replace(reading=jnp.float32(readings))

    # All that happens is drawn from the model, which is known to be right then.
    truth = rng.choice(KINDS, EPISODES)
    shape = (EPISODES, TOUCHES)
    site = rng.integers(sites, size=shape)
    place = rng.integers(FEW, size=EPISODES)[:, None]
    now = jax.tree.map(lambda x: np.asarray(x)[site, truth[:, None], place], table)
    spread = np.sqrt(1 + np.asarray(TOY.growth) * now.variance[..., 1:2])
    t = rng.normal(size=(*shape, 15)) / np.sqrt(rng.chisquare(8, shape) / 8)[..., None]
    unwhiten = np.linalg.inv(np.asarray(TOY.whiten, np.float64))
    reading = now.reading[..., 1, :] + (spread * t) @ unwhiten.T
    off = rng.normal(size=(EPISODES, 1, 6)) * SPREAD * belief.PARTICLE_STD_RATIO
    advance = (
        now.approach_distance
        + now.indentation[..., 1]
        + LOADS[1] / belief.ARM_STIFFNESS_N_PER_M
        + (now.jacobian * off).sum(-1)
    )
    advance += rng.normal(scale=float(TOY.position_std[0]), size=shape)

    at = measured(reading, np.full(shape, LOADS[1]), advance, np.ones(shape, bool))
    p = np.asarray(judge(table, jnp.asarray(site), at), np.float64)
    np.testing.assert_allclose(p.sum(1), 1, atol=1e-4)  # logarithms of some hundred, in float32
    right = truth[:, None] == np.arange(KINDS)
    decided = p.argmax(1)
    share = p[np.arange(EPISODES), decided]
    assert 0.4 < share.mean() < 0.9
    # Each event comes true as often as its probability says, within the spread of a sum of such events.
    for weight in (p, np.eye(KINDS)[decided], *np.eye(KINDS)[:, None]):
        surplus = (weight * (right - p)).sum()
        # An episode's events exclude one another: the variance of one draw of several values.
        mean = (weight * p).sum(1)
        variance = ((weight**2 * p).sum(1) - mean**2).sum()
        assert abs(surplus) <= SIGMAS * np.sqrt(variance) + 1e-4 * EPISODES
