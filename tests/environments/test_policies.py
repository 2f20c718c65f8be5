"""Policies choose what may be touched, and a policy is learned that beats guessing."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.environments import CHANNELS, OBJECTS, SITES, random_environment

from i2t.environments import learning
from i2t.environments.core import EnvironmentConfig, TouchBeliefs
from i2t.environments.learning import LearnerConfig, run_learned, train_policy
from i2t.environments.policies import BASELINES, random_site, run_policy
from i2t.recognition import belief
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.policy import NO_SITE
from i2t.simulation.touches import SimulationErrors

K, LOADS = 4, 3


@pytest.mark.full
def test_random_sites_are_allowed_and_new_until_none_is_left():
    environment, params = random_environment()
    _, state = environment.reset(jax.random.key(0), params)
    touched = jnp.zeros(SITES, bool)
    for step in range(SITES - 1):  # one of them is unsafe
        site = random_site(jax.random.key(step), state, touched, params)
        assert params.allowed[site]
        assert not touched[site]
        touched = touched.at[site].set(True)
    assert random_site(jax.random.key(9), state, touched, params) == NO_SITE


def _with_predictions(params):
    """The table's first placement in place of all, and as the prediction of every particle."""
    made = jax.tree.map(lambda x: jnp.repeat(x[:, :, :1], x.shape[2], axis=2), params.table.outcome)
    params = params._replace(table=params.table._replace(outcome=made))
    first = jax.tree.map(lambda x: jnp.moveaxis(x[:, :, 0], 1, 2), made)  # pads, sites, objects, ...
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
    likelihood = belief.fit_likelihood(errors, jnp.ones(CHANNELS), loads, overtravel=6e-3, position_std=1e-3)
    particles = belief.sample_particles(np.full(6, 1e-3), K)
    return params._replace(beliefs=TouchBeliefs(predicted, likelihood, particles))


@pytest.mark.full
@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_plays_episodes_without_a_refusal(name):
    environment, params = random_environment()
    made = jax.jit(partial(run_policy, policy=BASELINES[name], environment=environment, episodes=6))(
        jax.random.key(0), params=_with_predictions(params)
    )
    assert not made.refused.any()
    assert all(len(set(row)) == len(row) for row in np.asarray(made.site).tolist())
    np.testing.assert_allclose(made.posterior.sum(-1), 1, atol=1e-5)


@pytest.mark.full
@pytest.mark.parametrize("knows_pads", [False, True])
def test_a_learned_policy_beats_guessing(knows_pads):
    """Two pads and few placements are learned by heart."""
    config = EnvironmentConfig(touches=4, errors=replace(SimulationErrors.none()))
    environment, params = random_environment(config)
    params = _with_predictions(params) if knows_pads else params
    learner = LearnerConfig(iterations=120, episodes=64, hidden=32)
    train = jax.jit(partial(train_policy, environment=environment, config=learner))
    policy = train(jax.random.key(0), params=params)
    assert policy.loss[-10:].mean() < 0.7 * np.log(OBJECTS)
    assert knows_pads or policy.loss[-10:].mean() < 0.7 * policy.loss[:3].mean()
    play = jax.jit(partial(run_learned, environment=environment, config=learner, episodes=100))
    made = play(jax.random.key(1), policy, params=params)
    assert not made.refused.any()
    assert (made.prediction[:, -1].argmax(-1) == made.object).mean() > 0.6


def test_a_learned_policy_draws_allowed_sites_and_none_where_none_is_left():
    may = jnp.array([[False, True, False, True], [False, False, False, False]])
    logits = jnp.float32([[9, 1, 8, 0], [3, 2, 1, 0]])
    log = learning._log_chances(logits, may)
    np.testing.assert_allclose(jnp.exp(log[0]), [0, np.e / (np.e + 1), 0, 1 / (np.e + 1)], atol=1e-6)
    for number in range(2):
        site = learning._drawn(jax.random.key(number), logits, may)
        assert may[0, site[0]]
        assert site[1] == NO_SITE
        chance = learning._log_chance(log, site)
        assert chance[0] == log[0, site[0]]
        assert chance[1] == 0  # which no weight of the network changes


@pytest.mark.full
def test_a_policy_learns_in_episodes_longer_than_its_sites_and_touches_nothing_twice():
    environment, params = random_environment(EnvironmentConfig(touches=SITES + 1))
    learner = LearnerConfig(iterations=3, episodes=8, minibatches=2, hidden=8)
    policy = jax.jit(partial(train_policy, environment=environment, config=learner))(jax.random.key(0), params=params)
    assert np.isfinite(policy.loss).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(policy.params))
    play = jax.jit(partial(run_learned, environment=environment, config=learner, episodes=20))
    made = play(jax.random.key(1), policy, params=params)
    allowed = np.flatnonzero(params.allowed)
    for row, refused in zip(np.asarray(made.site), np.asarray(made.refused), strict=True):
        assert sorted(row[: len(allowed)]) == allowed.tolist()
        assert (row[len(allowed) :] == NO_SITE).all()
        assert refused.tolist() == [False] * len(allowed) + [True] * (len(row) - len(allowed))
