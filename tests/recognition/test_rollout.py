"""Rollouts: sites that a policy may touch, touches that methods share, and one simulation for one or many episodes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.environments import CHANNELS, OBJECTS, SITES, random_environment

from i2t.recognition import belief, rollout
from i2t.recognition.environment import EnvironmentConfig, TouchAction, TouchBeliefs
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.policy import NO_SITE
from i2t.recognition.rollout import POLICIES, advance, begin_episodes, episodes_of, last_touches
from i2t.skin_models.likelihood import fit_likelihood

K, LOADS = 4, 3


def _with_predictions(params):
    """Replace all placements by the table's first, which is also the prediction of every particle."""
    touches = jax.tree.map(lambda x: jnp.repeat(x[:, :, :1], x.shape[2], axis=2), params.table.touches)
    params = params._replace(table=params.table._replace(touches=touches))
    first = jax.tree.map(lambda x: jnp.moveaxis(x[:, :, 0], 1, 2), touches)  # pads, sites, objects, ...
    spread = jax.tree.map(lambda x: jnp.repeat(x[:, :, :, None], K, 3), first)
    loads = jnp.float32([0.5, 1.0, 2.0])
    predicted = PredictedTouch(
        hit=spread.contact,
        approach_distance=spread.advance,
        jacobian=jnp.zeros((*spread.force.shape, 6)),
        indentation=jnp.full((*spread.force.shape, LOADS), 1e-4),
        reading=spread.reading[..., None, :] * loads.reshape(1, 1, 1, 1, LOADS, 1),
        variance=jnp.zeros((*spread.force.shape, LOADS)),
    )
    errors = np.random.default_rng(0).normal(scale=4, size=(200, CHANNELS))
    likelihood = fit_likelihood(errors, jnp.ones(CHANNELS), loads, overtravel=6e-3, position_std=1e-3)
    particles = belief.sample_particles(np.full(6, 1e-3), K)
    return params._replace(beliefs=TouchBeliefs(predicted, likelihood, particles))


@pytest.mark.full
@pytest.mark.parametrize("name", POLICIES)
def test_no_policy_touches_a_site_twice_even_in_episodes_longer_than_its_sites(name):
    environment, params = random_environment(EnvironmentConfig(touches=SITES + 1))
    params = _with_predictions(params)

    @jax.jit
    def episode(key):
        def step(state, key):
            key_policy, key_touch = jax.random.split(key)
            site = POLICIES[name](key_policy, state, params)
            _, state, _, _, info = environment.step_env(key_touch, state, TouchAction(site), params)
            return state, (site, info["refused"])

        key_reset, key_steps = jax.random.split(key)
        _, state = environment.reset(key_reset, params)
        return jax.lax.scan(step, state, jax.random.split(key_steps, SITES + 1))[1]

    allowed = np.flatnonzero(params.allowed)
    for key in jax.random.split(jax.random.key(0), 6):
        row, refused = map(np.asarray, episode(key))
        assert sorted(row[: len(allowed)]) == allowed.tolist()
        assert (row[len(allowed) :] == NO_SITE).all()
        assert refused.tolist() == [False] * len(allowed) + [True] * (len(row) - len(allowed))


@pytest.mark.full
def test_parallel_episodes_equal_those_of_the_environment():
    """The readings, the belief and the end of an episode are those that its own steps give."""
    environment, params = random_environment(EnvironmentConfig(touches=3))
    params = _with_predictions(params)
    truth, pad = np.arange(4) % OBJECTS, np.array([0, 1, 1, 0])
    episodes, posterior = rollout.rollout(jax.random.key(0), environment, params, POLICIES["random"], truth, pad)
    running = begin_episodes(jax.random.split(jax.random.key(0))[0], environment, params, truth, pad)
    step = jax.jit(partial(environment.step_env, params=params))
    for e in range(len(truth)):
        state = jax.tree.map(lambda x, e=e: jnp.asarray(x[e]), running.states)
        for i in range(3):
            obs, state, _, done, _ = step(jax.random.key(0), state, TouchAction(jnp.int32(episodes.site[e, i])))
            np.testing.assert_allclose(obs.reading, episodes.observations.reading[e, i], atol=1e-4)
            np.testing.assert_allclose(obs.posterior, posterior[e, i], atol=1e-4)
            np.testing.assert_allclose(obs.T_w_t, episodes.T_w_t[e, i], atol=1e-7)
        assert done


def test_methods_share_the_touches_that_both_make(monkeypatch):
    """A second method gets the touches that it would have made itself, in its own order."""
    environment, params = random_environment(EnvironmentConfig(touches=2))
    truth, batches = np.array([0, 1, 0]), []
    touch = rollout._touch

    def counted(episodes, keys, site, missing):
        batches.append(len(missing))
        return touch(episodes, keys, site, missing)

    monkeypatch.setattr(rollout, "_touch", counted)
    begun = begin_episodes(jax.random.key(0), environment, params, truth)
    first, second = np.array([[0, 1], [2, 3], [3, 0]]), np.array([[0, 2], [2, 3], [1, 0]])
    shared: dict = {}
    episodes = []
    for chosen, reused in ((second, None), (first, shared), (second, shared)):
        running = begun
        for step in range(2):
            running = advance(running, chosen[:, step : step + 1], shared=reused)
            if reused is not None:
                shared |= running.new
        episodes.append(episodes_of(running))
    assert batches == [3, 3, 3, 3, 1, 1]  # the third only where the second method touches elsewhere
    jax.tree.map(np.testing.assert_array_equal, tuple(episodes[0]), tuple(episodes[2]))
    jax.tree.map(np.testing.assert_array_equal, episodes[2].site, second)
    last = last_touches(running)
    np.testing.assert_array_equal(last.T_w_t, episodes[2].T_w_t[:, -1])
    np.testing.assert_array_equal(last.reading, episodes[2].observations.reading[:, -1])
    together = advance(begun, second)
    jax.tree.map(np.testing.assert_array_equal, together.states, running.states)
    with pytest.raises(ValueError, match="no site"):
        advance(begun, np.full((3, 1), NO_SITE))
