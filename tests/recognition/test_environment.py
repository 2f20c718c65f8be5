"""Environments are pure, end when their touches are used up, and never make an unsafe touch."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.environments import OBJECTS, SITES, random_environment

from i2t.recognition.environment import EnvironmentConfig, TouchAction, record
from i2t.simulation.touches import SimulationErrors

QUIET = EnvironmentConfig(touches=4, errors=SimulationErrors.error_free())


def touch(site: int, logits=(0.0,) * OBJECTS) -> TouchAction:
    return TouchAction(jnp.int32(site), jnp.array(logits))


@pytest.fixture
def begun():
    environment, params = random_environment(QUIET)
    return environment, params, environment.reset(jax.random.key(0), params)[1]


def test_a_step_looks_up_the_table_and_its_reward_is_the_negative_cross_entropy(begun):
    environment, params, state = begun
    above = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.15], [0, 0, 0, 1]]  # the origin, looking down
    fresh, _ = environment.reset(jax.random.key(0), params)
    np.testing.assert_array_equal(fresh.T_w_t, np.float32(above))
    logits = np.array([1.0, -2.0, 0.5], np.float32)
    after, _, reward, _, _ = environment.step_env(jax.random.key(1), state, touch(2, logits), params)
    row, outcome = (int(state.pad), int(state.object), int(state.placement), 2), params.table.touches
    np.testing.assert_allclose(after.reading, outcome.reading[row], atol=1e-5)
    assert after.contact == outcome.contact[row]
    end = params.T_w_site[2] @ np.array([0, 0, outcome.advance[row], 1])
    np.testing.assert_allclose(after.T_w_t[:, 3], end, atol=1e-7)
    probability = np.exp(logits) / np.exp(logits).sum()
    assert reward == pytest.approx(float(np.log(probability[int(state.object)])), abs=1e-5)
    with pytest.raises(ValueError, match="prediction"):  # where there is no posterior
        environment.step_env(jax.random.key(1), state, TouchAction(jnp.int32(0)), params)


def test_an_unsafe_touch_moves_nothing_and_costs_a_step(begun):
    environment, params, state = begun
    _, state, before, _, _ = environment.step_env(jax.random.key(1), state, touch(1), params)
    for site in (SITES - 1, SITES, -1):
        obs, after, reward, _, info = environment.step_env(jax.random.key(2), state, touch(site), params)
        assert info["refused"]
        assert obs.refused
        assert not obs.contact
        assert not np.any(obs.reading)
        np.testing.assert_array_equal(after.outcomes.T_w_t, state.outcomes.T_w_t)
        assert after.num_refused == state.num_refused + 1
        assert reward == pytest.approx(float(before) - QUIET.refusal_cost)


def test_an_episode_ends_after_its_last_touch_and_the_next_begins(begun):
    environment, params, state = begun

    def step(state, key):
        obs, state, _, done, info = environment.step(key, state, touch(0), params)
        return state, (done, obs.remaining, info["final"].remaining)

    state, (done, left, final) = jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 8))
    np.testing.assert_array_equal(done, [False, False, False, True] * 2)
    np.testing.assert_allclose(left, [0.75, 0.5, 0.25, 1.0] * 2)
    np.testing.assert_allclose(final, [0.75, 0.5, 0.25, 0.0] * 2)


@pytest.mark.full
def test_objects_and_pads_are_drawn_in_every_episode_and_held_out_pads_are_other_rows():
    environment, params = random_environment(QUIET)
    _, states = jax.vmap(partial(environment.reset, params=params))(jax.random.split(jax.random.key(0), 200))
    for drawn, of in ((states.object, OBJECTS), (states.pad, 2), (states.placement, 4)):
        assert np.bincount(drawn, minlength=of).min() > 200 / of / 2
    some = params.with_pads(np.array([1]))
    np.testing.assert_array_equal(some.table.touches.force[0], params.table.touches.force[1])
    assert some.response.linear.shape[0] == some.pads.gains.shape[0] == 1


def test_future_touches_do_not_change_past_readings():
    """The sensor has a memory: a touch reads the same whether the episode continues or not."""
    environment, params = random_environment(EnvironmentConfig(touches=4))
    _, state = environment.reset(jax.random.key(0), params)
    readings = []
    for site in (0, 2, 1):
        outcome = environment.touch(jax.random.key(site), state, jnp.int32(site), params)
        state = record(state, jnp.int32(site), outcome)
        readings.append(environment.measure(state, params).reading)
    for count, reading in enumerate(readings[:2], 1):
        np.testing.assert_array_equal(reading[:count], readings[2][:count])
    assert not np.array_equal(readings[2][:3], state.outcomes.reading[:3])  # which is that of an ideal skin


def test_press_errors_exclude_those_of_the_sensor():
    """Worlds that differ only in the sensor's errors share compiled programs."""
    none, usual = SimulationErrors.error_free(), SimulationErrors()
    assert EnvironmentConfig(usual).press_errors == replace(usual, noise=none.noise, faults=none.faults)
    often = replace(usual, faults=replace(usual.faults, ambient_every=10))
    assert EnvironmentConfig(often).press_errors == EnvironmentConfig(usual).press_errors
