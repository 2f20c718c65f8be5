"""The next touch of many episodes: nothing is chosen where nothing is allowed (of the informative ones,
`test_recognizer`).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.predicted_touches import CHANNELS, OBJECTS, PARTICLES, SITES, likelihood, measured, predicted_touches

from i2t.recognition import belief, policy

EPISODES = 3


@pytest.fixture(scope="module")
def world():
    """Predicted touches that differ by site and object, the belief of an episode, and a likelihood."""
    begun = belief.init(belief.sample_particles(np.full(6, 1e-3), PARTICLES), OBJECTS, channels=CHANNELS)
    return predicted_touches(), jax.tree.map(lambda x: jnp.asarray(x)[None], begun), likelihood()


def test_a_random_site_is_untouched_and_safe_and_none_is_drawn_where_none_is(world):
    _, beliefs, _ = world
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (100, *x.shape[1:])), beliefs)

    def draw(touched, safe) -> set[int]:
        keys = jax.random.split(jax.random.key(0), 100)
        rows = jnp.broadcast_to(jnp.asarray(touched), (100, SITES))
        return set(np.asarray(policy.choose_random_sites(keys, many, touched=rows, safe=safe)).tolist())

    none, everywhere = np.zeros(SITES, bool), jnp.ones((SITES, OBJECTS), bool)
    assert draw(none, everywhere) == set(range(SITES))
    safe = everywhere.at[0, 0].set(False)  # unsafe on an object that is as probable as not
    assert draw(np.arange(SITES) == 2, safe) == {1, 3, 4}
    assert draw(~none, everywhere) == {policy.NO_SITE}
    assert draw(none, ~everywhere) == {policy.NO_SITE}


def test_the_heuristic_keeps_to_sites_that_are_safe_on_the_object_believed_in(world):
    _, beliefs, _ = world
    sure = beliefs._replace(log_weight=beliefs.log_weight.at[:, 1].add(-20.0))  # of the first object
    sure = jax.tree.map(lambda x: jnp.repeat(x, EPISODES, axis=0), sure)
    weights = jnp.zeros((OBJECTS, SITES)).at[0, 0].set(1.0)
    safe = jnp.ones((SITES, OBJECTS), bool).at[2:, 0].set(False)
    touched = jnp.zeros((EPISODES, SITES), bool).at[1, 0].set(True).at[2, :2].set(True)
    none_informative = safe.at[0].set(False)  # the informative site itself is not safe: the only one that is
    for seed in range(5):
        for allowed, wanted in ((safe, [0, 1, -1]), (none_informative, [1, 1, -1])):
            keys = jax.random.split(jax.random.key(seed), EPISODES)
            found = policy.choose_heuristic_sites(keys, sure, weights, touched=touched, safe=allowed, step=1)
            np.testing.assert_array_equal(found, wanted)


def test_an_episode_without_a_site_keeps_its_belief(world):
    table, beliefs, errors = world
    touch = jax.tree.map(lambda x: jnp.asarray(x)[None], measured(table, 0, 0))
    after, p = policy.update_beliefs(beliefs, jnp.array([-1]), touch, table, errors)
    np.testing.assert_array_equal(after.log_weight, beliefs.log_weight)
    np.testing.assert_allclose(p, 1 / OBJECTS, rtol=1e-6)
    _, p = policy.update_beliefs(beliefs, jnp.array([0]), touch, table, errors)
    assert p[0, 0] > 0.9
