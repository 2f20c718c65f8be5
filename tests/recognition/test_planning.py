"""The next touch of many episodes: nothing is chosen where nothing is allowed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.recognition import belief, planning, policy
from i2t.recognition.belief import TouchObservation
from i2t.recognition.outcomes import PredictedTouch

EPISODES, SITES, OBJECTS, COUNT, CHANNELS = 3, 5, 2, 4, 12
LOADS = jnp.array([0.3, 0.9, 2.7])


@pytest.fixture(scope="module")
def world():
    """Predicted touches that differ by site and object, beliefs of three episodes, and a likelihood."""
    rng = np.random.default_rng(0)
    shape = (SITES, OBJECTS, COUNT)
    reading = (
        rng.normal(scale=10, size=(*shape[:2], 1, 1, CHANNELS)) * np.ones((COUNT, 1, 1)) * np.asarray(LOADS)[:, None]
    )
    table = PredictedTouch(
        hit=jnp.ones(shape, bool), approach_distance=jnp.zeros(shape), jacobian=jnp.zeros((*shape, 6)),
        indentation=jnp.float32(np.tile(1e-4 * LOADS, (*shape, 1))), reading=jnp.float32(reading),
        variance=jnp.full((*shape, 3), 1e-3),
    )  # fmt: skip
    likelihood = belief.fit_likelihood(
        rng.normal(size=(50, CHANNELS)), jnp.ones(CHANNELS), LOADS, overtravel=6e-3, position_std=1e-4
    )
    begun = belief.init(belief.sample_particles(np.full(6, 1e-3), COUNT), OBJECTS, channels=CHANNELS)
    beliefs = jax.tree.map(lambda x: jnp.broadcast_to(x, (EPISODES, *x.shape)), begun)
    return table, beliefs, likelihood


@pytest.mark.full
def test_nothing_is_chosen_where_nothing_is_allowed(world):
    table, beliefs, likelihood = world
    choose = planning.choose_informative_sites
    keys = jax.random.split(jax.random.key(0), EPISODES)
    touched = jnp.zeros((EPISODES, SITES), bool).at[1, 1:].set(True).at[2].set(True)
    only_first = jnp.zeros((SITES, OBJECTS), bool).at[0].set(True)
    everywhere = jnp.ones((SITES, OBJECTS), bool)
    for safe, expected in ((everywhere, [None, 0, -1]), (only_first, [0, 0, -1]), (~everywhere, [-1, -1, -1])):
        found = choose(jax.random.clone(keys), beliefs, table, likelihood, touched=touched, safe=safe, skin_change=25.0)
        for site, wanted in zip(np.asarray(found), expected, strict=True):
            assert site == wanted if wanted is not None else site >= 0
    half = jnp.ones((SITES, OBJECTS), bool).at[:, 1].set(False)  # unsafe on an object that is as probable as not
    found = choose(keys, beliefs, table, likelihood, touched=touched, safe=half, skin_change=25.0)
    np.testing.assert_array_equal(found, policy.NO_SITE)


def test_the_heuristic_keeps_to_sites_that_are_safe_on_the_object_believed_in(world):
    _, beliefs, _ = world
    sure = beliefs._replace(log_weight=beliefs.log_weight.at[:, 1].add(-20.0))  # of the first object
    weights = jnp.zeros((OBJECTS, SITES)).at[0, 0].set(1.0)
    safe = jnp.ones((SITES, OBJECTS), bool).at[2:, 0].set(False)
    touched = jnp.zeros((EPISODES, SITES), bool).at[1, 0].set(True).at[2, :2].set(True)
    for seed in range(5):
        keys = jax.random.split(jax.random.key(seed), EPISODES)
        found = planning.choose_heuristic_sites(keys, sure, weights, touched=touched, safe=safe, step=1)
        np.testing.assert_array_equal(found, [0, 1, -1])


@pytest.mark.full
def test_an_episode_without_a_site_keeps_its_belief(world):
    table, beliefs, likelihood = world
    touch = TouchObservation(
        reading=table.reading[0, :1, 0, 1].repeat(EPISODES, 0),
        force=jnp.full(EPISODES, 0.9),
        advance=jnp.full(EPISODES, 1.8e-4),
        contact=jnp.ones(EPISODES, bool),
    )
    after, p = planning.update_beliefs(beliefs, jnp.array([0, -1, 0]), touch, table, likelihood)
    np.testing.assert_array_equal(after.log_weight[1], beliefs.log_weight[1])
    np.testing.assert_allclose(p[1], 1 / OBJECTS, rtol=1e-6)
    assert p[0, 0] > 0.9
    assert p[2, 0] > 0.9
