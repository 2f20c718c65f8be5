"""Expected information of a touch against quadrature; decisions against tables by hand."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special, stats

from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M
from i2t.recognition import belief, policy
from i2t.recognition.belief import Belief
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.policy import InformationGain
from i2t.skin_models.likelihood import fit_likelihood

LOADS = np.array([0.3, 0.9, 2.7])
PAST = 6e-3
SPREAD = np.full(6, 1e-3)  # m
SITES, OBJECTS, COUNT, DRAWS, PLACES = 6, 2, 8, 512, 8
RARE = 1e-6  # chance of a false alarm of a statistical test, were its key drawn anew
SIGMAS = stats.norm.isf(RARE / 2)
SHAPE = SITES, OBJECTS, COUNT
AT = 0.9  # N, where presses end: the second of the loads
CHANGE = 25.0  # uT

NOISE = 0.1  # uT, of every channel
POSITION = 1e-4  # m
# Errors so nearly normal that no 512 draws would tell.
NORMAL = fit_likelihood(
    np.eye(15), jnp.ones(15), jnp.float32(LOADS), overtravel=PAST, position_std=POSITION
)._replace(
    whiten=jnp.eye(15) / NOISE, growth=jnp.ones(15) / NOISE**2, dof=jnp.float32(1e4), outlier_rate=jnp.float32(1e-6),
    indentation_error=jnp.float32(0),
)  # fmt: skip
TACTILE = NORMAL._replace(spatial_weight=jnp.float32(0))
SPATIAL = NORMAL._replace(tactile_weight=jnp.float32(0))
PLACED = belief.sample_particles(SPREAD, COUNT)
gains = jax.jit(partial(policy.expected_information_gain, num_draws=DRAWS, num_particles=PLACES))


def touches(change: Any, approach: Any = 0.0, hit: Any = True) -> PredictedTouch:
    """Touches (sites, objects, placements) that end at AT, where readings of CHANGE differ laterally by `change` uT."""
    change = np.broadcast_to(change, SHAPE)
    reading = np.stack([np.sqrt(CHANGE**2 - change**2), change, *[0 * change] * 13], -1)
    values = (
        np.broadcast_to(approach, SHAPE), np.zeros((*SHAPE, 6)), np.tile(1e-4 * LOADS, (*SHAPE, 1)),
        reading[..., None, :] * (LOADS / AT)[:, None], np.zeros((*SHAPE, 3)),
    )  # fmt: skip
    return PredictedTouch(jnp.broadcast_to(jnp.asarray(hit), SHAPE), *map(jnp.float32, values))


def information(distance: float, prior: float) -> tuple[float, float]:
    """Mutual information (nats) between two objects and a measurement that is normal about 0 or about `distance`, in
    units of its standard deviation; and how the information varies from draw to draw.
    """
    x = np.linspace(-9, distance + 9, 20_001)
    first, second = prior * stats.norm.pdf(x), (1 - prior) * stats.norm.pdf(x, distance)
    density = first + second
    entropy = special.entr(first / density) + special.entr(second / density)
    mean, square = (integrate.trapezoid(entropy**power * density, x) for power in (1, 2))
    return stats.bernoulli(prior).entropy() - mean, np.sqrt(max(square - mean**2, 0))


def start(prior: float = 0.5) -> Belief:
    now = belief.init(PLACED, OBJECTS, channels=15)
    return now._replace(log_weight=now.log_weight + jnp.log(jnp.array([prior, 1 - prior]) * 2)[:, None])


def apart(distances: np.ndarray) -> np.ndarray:
    """Difference of the two objects at each site."""
    return (distances[:, None] * np.array([-0.5, 0.5]))[..., None]


@pytest.mark.full
@pytest.mark.parametrize("prior", [0.5, 0.85])
def test_gains_are_mutual_information(prior):
    distances = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 20.0])
    bound = stats.bernoulli(prior).entropy()
    # What is not known about a place makes the approach distance unsure along its slope.
    unsure = np.hypot(0.5 * SPREAD[2], POSITION)
    steep = touches(0.0, unsure * apart(distances))._replace(jacobian=jnp.broadcast_to(jnp.eye(6)[2], (*SHAPE, 6)))
    for likelihood, table in (
        (TACTILE, touches(NOISE * apart(distances))),
        (SPATIAL, touches(0.0, POSITION * apart(distances))),
        (SPATIAL, steep),
    ):
        gain = gains(jax.random.key(0), start(prior), table, likelihood)
        for i, distance in enumerate(distances):
            exact, sd = information(distance, prior)
            # Draws; how many of them each object gets, to one; and Student's degrees of freedom: 15^2 / 10^4 of a nat.
            loose = SIGMAS * sd / np.sqrt(DRAWS) + 1 / DRAWS + 15**2 / 1e4 * exact
            assert float(gain.object[i]) == pytest.approx(exact, abs=loose + 1e-4)
        assert (np.diff(gain.object) > 0).all()  # all sites see the same draws
        assert (gain.object < bound + 1e-4).all()
        # Places feel alike here: nothing is learned of them, and the two are estimates of one number.
        np.testing.assert_allclose(gain.object_and_pose, gain.object, atol=SIGMAS * 2 * bound / np.sqrt(DRAWS))


@pytest.mark.full
def test_simulated_errors_follow_the_distributions_of_the_likelihood():
    """Readings of a multivariate Student's t, and positions of a mixture and its outliers."""
    heavy = NORMAL._replace(
        position_std=jnp.float32([0.1e-3, 1e-3]), position_share=jnp.float32([0.8, 0.2]),
        outlier_rate=jnp.float32(0.1), dof=jnp.float32(2),
    )  # fmt: skip
    drawn = np.asarray(policy._draw_noise(jax.random.key(8), heavy, (20_000, 17)), np.float64)
    half = PAST + 10e-3

    def position(x: np.ndarray) -> np.ndarray:
        usual = 0.8 * stats.norm.cdf(x, scale=0.1e-3) + 0.2 * stats.norm.cdf(x, scale=1e-3)
        return 0.9 * usual + 0.1 * stats.uniform.cdf(x, -half, 2 * half)

    assert stats.kstest(drawn[:, 0], stats.t(2).cdf).pvalue > RARE
    assert stats.kstest((drawn[:, :15] ** 2).mean(1), stats.f(15, 2).cdf).pvalue > RARE
    assert stats.kstest(drawn[:, 15], position).pvalue > RARE


def test_information_on_the_object_and_on_the_place():
    which, place = np.meshgrid(np.arange(OBJECTS), np.arange(COUNT), indexing="ij")
    # Readings that differ do so by ten errors or more.
    kinds = np.stack([place, 8 * which, 8 * which + place, 0 * place, place % 2, 0 * place])
    hit = np.ones(kinds.shape, bool)
    hit[-1, 1] = False  # the other object is not there at all
    table = touches(20 * NOISE * (kinds - 7.5) / 2, 0.0, hit)
    information = gains(jax.random.key(1), start(), table, TACTILE)
    close = partial(np.testing.assert_allclose, atol=1e-3)
    close(information.object, np.log([1, 2, 2, 1, 1, 2]))
    close(information.object_and_pose, np.log([8, 2, 16, 1, 2, 2]))

    # Where the place is known, all information is on the object; and where the object is, all of the place.
    placed = start()._replace(log_weight=jnp.where(jnp.arange(COUNT)[None] == 5, start().log_weight, -jnp.inf))
    information = gains(jax.random.key(2), placed, table, TACTILE)
    close(information.object, np.log([1, 2, 2, 1, 1, 2]))
    close(information.object_and_pose, np.log([1, 2, 2, 1, 1, 2]))
    named = start()._replace(log_weight=jnp.zeros((OBJECTS, COUNT)).at[1].set(-jnp.inf))
    information = gains(jax.random.key(3), named, table, TACTILE)
    close(information.object, 0)
    close(information.object_and_pose, np.log([8, 1, 8, 1, 2, 1]))


def test_a_simulated_observation_is_the_prediction_plus_noise():
    outcome = jax.tree.map(lambda x: x[0, 0, 0], touches(3.0, 1e-3))
    outcome = outcome._replace(jacobian=jnp.arange(6.0), variance=jnp.full(3, 0.02))
    off, noise = jnp.full(6, 1e-4), (jnp.arange(17.0) - 8).at[15:].set(jnp.array([7 * POSITION, -2.0]))
    likelihood = NORMAL._replace(inflation=jnp.float32(2), indentation_error=jnp.float32(0.25))
    simulate = jax.jit(policy.simulate_observation)
    limits = {"likelihood": likelihood, "skin_change": CHANGE, "force": 8.0}
    observation = simulate(outcome, off, noise, **limits)
    assert float(observation.force) == pytest.approx(AT, rel=1e-5)
    assert observation.contact
    advance = 1e-3 + 15e-4 + 1e-4 * AT * (1 - 2 * 0.25) + AT / ARM_STIFFNESS_N_PER_M + POSITION * 7
    assert float(observation.advance) == pytest.approx(advance, rel=1e-5)
    # Errors are those of the likelihood: twice the noise of 0.1, and the GP's variance of 1 uT^2 times 0.02.
    sd = 2 * np.sqrt(NOISE**2 + 0.02)
    np.testing.assert_allclose(
        observation.reading - outcome.reading[1], sd * np.asarray(noise[:15]), atol=1e-4 * sd * 25
    )
    assert not simulate(outcome, 4 * off, noise, **limits).contact  # after 7 mm
    assert not simulate(outcome, 3.2 * off, noise, **limits).contact  # after 5.8 mm, and 0.7 mm of error
    assert simulate(outcome, 3.2 * off, noise.at[15].set(0.0), **limits).contact
    assert not simulate(outcome._replace(hit=jnp.array(False)), off, noise, **limits).contact
    weak = simulate(outcome, off, noise, **limits | {"force": 0.5})
    assert float(weak.force) == pytest.approx(0.5)


# --- decisions --------------------------------------------------------------------------------------------------------


def probable(*probability: float) -> Belief:
    """A belief of three objects."""
    now = belief.init(PLACED, 3, channels=15)
    share = jnp.log(jnp.array(probability) / COUNT)[:, None]
    return now._replace(log_weight=jnp.broadcast_to(share, (3, COUNT)))


def test_allowed_sites_are_safe_on_the_possible_objects():
    now = probable(0.9, 0.06, 0.03)
    safe = jnp.array([[1, 1, 1], [1, 1, 0], [1, 0, 1], [1, 0, 0], [0, 1, 1]], bool)
    np.testing.assert_array_equal(policy.safe_sites_mask(now, safe), [True, True, False, False, False])
    np.testing.assert_array_equal(policy.safe_sites_mask(now, safe, 0.1), [True, True, True, True, False])
    np.testing.assert_array_equal(policy.safe_sites_mask(now, safe, 0.0), [True, False, False, False, False])


@pytest.mark.parametrize(
    ("allowed", "weight", "chosen"),
    [
        ((1, 1, 1, 1), {}, 2),  # 0.31, 0.5, 0.555, 0.39
        ((1, 1, 1, 1), {"pose_weight": 0.0}, 1),
        ((1, 1, 1, 1), {"pose_weight": 1.0}, 3),
        ((1, 0, 0, 1), {}, 3),
        ((0, 0, 0, 0), {}, policy.NO_SITE),
    ],
)
def test_the_most_informative_allowed_site_is_chosen_if_any(allowed, weight, chosen):
    gain = InformationGain(jnp.array([0.3, 0.5, 0.45, 0.1]), jnp.array([0.4, 0.5, 1.5, 3.0]))
    assert policy.choose_site(gain, jnp.array(allowed, bool), **weight) == chosen
