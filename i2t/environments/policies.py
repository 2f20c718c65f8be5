"""Policies of environments, and episodes under them: random touches, the paper's heuristic, expected information.

A policy is `policy(key, state, touched, params) -> site`; `touched` says which sites the episode has touched. Those
here never choose a site that is not allowed or was touched: where none is left they choose
`i2t.recognition.policy.NO_SITE`, which an environment refuses.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.environments.core import EnvironmentParams, EnvironmentState, TouchAction, TouchEnvironment
from i2t.paper import loop
from i2t.recognition import belief
from i2t.recognition.policy import choose_site, draw_site, expected_information_gain
from i2t.runtime.batching import map_batches

SitePolicy = Callable[[Array, EnvironmentState, Array, EnvironmentParams], Array]
POLICY_BATCH = 8  # episodes whose sites are chosen at a time
IMAGINED_OUTCOMES, IMAGINED_PARTICLES = 16, 8  # of the imagined outcomes of a site


class PolicyEpisodes(NamedTuple):
    """Episodes under a policy: e of them, t touches each."""

    posterior: Float[Array, "e t o"]  # after each touch
    site: Int[Array, "e t"]
    refused: Bool[Array, "e t"]
    object: Int[Array, " e"]
    pad: Int[Array, " e"]


def random_site(
    key: Key[Array, ""], state: EnvironmentState, touched: Bool[Array, " sites"], params: EnvironmentParams
) -> Int[Array, ""]:
    """Any site that is allowed and was not touched.

    Args:
        key: random key.
        state: the episode, which does not matter.
        touched: sites that the episode has touched.
        params: what may be there.

    Returns:
        The site.
    """
    return draw_site(key, jnp.ones(params.sites), params.allowed & ~touched)


def heuristic_site(
    key: Key[Array, ""], state: EnvironmentState, touched: Bool[Array, " sites"], params: EnvironmentParams
) -> Int[Array, ""]:
    """The paper's heuristic: an informative site of the most probable object
    (`i2t.paper.loop.site_informativeness`), or any other where none is left.

    Args:
        key: random key.
        state: the episode, with its belief.
        touched: sites that the episode has touched.
        params: what may be there.

    Returns:
        The site.
    """
    key_object, key_site = jax.random.split(key)
    which = loop.choose_hypothesis(key_object, belief.posterior(_belief(state)), state.touches)
    own = params.owner[None] == jnp.arange(params.objects)[:, None]
    everywhere = jnp.broadcast_to(params.T_w_site[None], (params.objects, *params.T_w_site.shape))
    weight = loop.site_informativeness(everywhere[..., :3, 3], -everywhere[..., :3, 2], own, which)
    return draw_site(key_site, weight, params.allowed & ~touched)


def informative_site(
    key: Key[Array, ""], state: EnvironmentState, touched: Bool[Array, " sites"], params: EnvironmentParams
) -> Int[Array, ""]:
    """The site that is expected to tell most about the object (`i2t.recognition.policy`).

    Args:
        key: random key of the imagined outcomes.
        state: the episode, with its belief.
        touched: sites that the episode has touched.
        params: what may be there.

    Returns:
        The site.
    """
    assert params.beliefs is not None
    table = jax.tree.map(lambda x: x[state.pad], params.beliefs.predicted)
    gain = expected_information_gain(
        key, _belief(state), table, params.beliefs.likelihood,
        num_draws=IMAGINED_OUTCOMES, num_particles=IMAGINED_PARTICLES,
    )  # fmt: skip
    return choose_site(gain, params.allowed & ~touched)


BASELINES: dict[str, SitePolicy] = {
    "random": random_site,
    "heuristic": heuristic_site,
    "information": informative_site,
}


def run_policy(
    key: Key[Array, ""],
    policy: SitePolicy,
    environment: TouchEnvironment,
    params: EnvironmentParams,
    episodes: int,
) -> PolicyEpisodes:
    """Episodes under a policy, judged by the environment's posterior; the same key draws the same episodes.

    Args:
        key: random key.
        policy: chooses sites.
        environment: whose actions are sites.
        params: with beliefs.
        episodes: how many; static.

    Returns:
        What was believed, and what was touched.
    """
    key_reset, key_steps = jax.random.split(key)
    _, state = jax.vmap(lambda k: environment.reset(k, params))(jax.random.split(key_reset, episodes))

    def step(carry: tuple, key: Array) -> tuple[Any, Any]:
        state, touched = carry
        key_policy, key_touch = jax.random.split(key)

        def choose(at: tuple[Array, EnvironmentState, Array]) -> Array:
            return policy(at[0], at[1], at[2], params)

        site = map_batches(choose, (jax.random.split(key_policy, episodes), state, touched), batch_size=POLICY_BATCH)
        make = partial(environment.step_env, params=params)
        keys = jax.random.split(key_touch, episodes)
        _, after, _, _, info = jax.vmap(lambda k, s, a: make(k, s, TouchAction(a)))(keys, state, site)
        touched = touched | (jnp.arange(params.sites)[None] == site[:, None])
        return (after, touched), (jax.vmap(belief.posterior)(_belief(after)), site, info["refused"])

    start = state, jnp.zeros((episodes, params.sites), bool)
    keys = jax.random.split(key_steps, environment.config.touches)
    _, (posterior, site, refused) = jax.lax.scan(step, start, keys)
    return PolicyEpisodes(jnp.swapaxes(posterior, 0, 1), site.T, refused.T, state.object, state.pad)


def _belief(state: EnvironmentState) -> belief.Belief:
    if state.belief is None:
        raise ValueError("this policy needs an environment with beliefs; see i2t.environments.beliefs.with_beliefs")
    return state.belief
