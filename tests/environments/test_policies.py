"""Policies choose what may be touched."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.environments import CHANNELS, SITES, random_environment

from i2t.environments.core import EnvironmentConfig, TouchBeliefs
from i2t.environments.policies import BASELINES, run_policy
from i2t.recognition import belief
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.policy import NO_SITE
from i2t.skin_models.likelihood import fit_likelihood

K, LOADS = 4, 3


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
    likelihood = fit_likelihood(errors, jnp.ones(CHANNELS), loads, overtravel=6e-3, position_std=1e-3)
    particles = belief.sample_particles(np.full(6, 1e-3), K)
    return params._replace(beliefs=TouchBeliefs(predicted, likelihood, particles))


@pytest.mark.full
@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_touches_nothing_twice_in_episodes_longer_than_its_sites(name):
    environment, params = random_environment(EnvironmentConfig(touches=SITES + 1))
    made = jax.jit(partial(run_policy, policy=BASELINES[name], environment=environment, episodes=6))(
        jax.random.key(0), params=_with_predictions(params)
    )
    allowed = np.flatnonzero(params.allowed)
    for row, refused in zip(np.asarray(made.site), np.asarray(made.refused), strict=True):
        assert sorted(row[: len(allowed)]) == allowed.tolist()
        assert (row[len(allowed) :] == NO_SITE).all()
        assert refused.tolist() == [False] * len(allowed) + [True] * (len(row) - len(allowed))
    np.testing.assert_allclose(made.posterior.sum(-1), 1, atol=1e-5)
