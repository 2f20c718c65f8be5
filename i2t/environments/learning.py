"""A policy that is learned: where to touch next and what to believe, by proximal policy optimisation, compiled whole.

A network with memory (a gated recurrent unit) reads one observation after the other and says the next site, a
prediction and what it expects to be rewarded with. Sites are learned by PPO (Schulman et al., 2017) with generalised
advantages; predictions, as nothing that they do changes what comes next, from the truth itself. Training is one
compiled scan over iterations (Lu et al., "Discovered policy optimisation", 2022, trains so), each of which plays whole
episodes. The reward of a touch is the environment's: the negative loss of what is predicted after it.

A site that is not allowed or was touched is never chosen; where none is left the policy chooses
`i2t.recognition.policy.NO_SITE`, which an environment refuses.

Without `EnvironmentParams.beliefs` the network sees readings and poses only, and knows no pad and no object before it
is trained. With them the posterior is among what it sees, and is its prediction: then only sites are learned.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.environments.core import (
    EnvironmentParams,
    EnvironmentState,
    TouchAction,
    TouchEnvironment,
    cross_entropy,
    features,
)
from i2t.recognition.policy import NO_SITE

FORBIDDEN_LOGIT = -1e9  # logit of a site that may not be touched
MIN_PREDICTED_PROBABILITY = 1e-2  # of an object, where the posterior is the prediction: no loss outweighs all
ADVANTAGE_STD_OFFSET = 1e-6  # added to the deviation of advantages


@dataclass(frozen=True)
class LearnerConfig:
    """Configuration of the learning of a policy."""

    iterations: int = 400
    episodes: int = 256  # of each iteration
    epochs: int = 2  # passes over them
    minibatches: int = 4
    learning_rate: float = 1e-3
    clip: float = 0.2
    discount: float = 0.9
    trace: float = 0.95  # lambda of the generalised advantages
    entropy: float = 0.01
    hidden: int = 128
    max_gradient: float = 1.0


class TouchNetwork(nn.Module):
    """One step of the policy: memory and inputs to memory, logits of sites, prediction and value."""

    sites: int
    prediction: int
    hidden: int

    @nn.compact
    def __call__(self, memory: Array, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """Advance by one observation.

        Args:
            memory: (hidden,).
            inputs: features of the observation, and which sites were touched, last and ever.

        Returns:
            Memory, logits of sites, prediction, value.
        """
        x = nn.relu(nn.Dense(self.hidden)(inputs))
        memory, x = nn.GRUCell(self.hidden)(memory, x)
        logits = nn.Dense(self.sites, kernel_init=nn.initializers.orthogonal(0.01))(x)
        return memory, logits, nn.Dense(self.prediction)(x), nn.Dense(1)(x)[..., 0]


class LearnedPolicy(NamedTuple):
    """Learned policy, and its losses on the way."""

    params: Any  # of the network
    loss: Float[Array, " i"]  # of predictions after each touch of an iteration's episodes, mean over touches
    last_loss: Float[Array, " i"]  # after the last touch


class LearnedEpisodes(NamedTuple):
    """Episodes under a learned policy: e of them, t touches each."""

    prediction: Float[Array, "e t o"]  # logits, after each touch
    site: Int[Array, "e t"]
    refused: Bool[Array, "e t"]
    object: Int[Array, " e"]
    pad: Int[Array, " e"]


class _Played(NamedTuple):
    """Episodes (t, e, ...) of one iteration; `inputs` has one step more, after the last touch."""

    inputs: Array
    may: Array  # (t, e, sites), which could be chosen
    site: Array
    log_probability: Array
    value: Array  # with one step more, of nothing
    prediction: Array  # with one step more
    loss: Array  # of predictions, with one step more


def train_policy(
    key: Key[Array, ""], environment: TouchEnvironment, params: EnvironmentParams, config: LearnerConfig
) -> LearnedPolicy:
    """Learn a policy; pure, so that it can be compiled, and mapped over keys.

    Args:
        key: random key.
        environment: whose actions are sites; static.
        params: what may be there.
        config: of the training; static.

    Returns:
        The policy.
    """
    key_network, key_train = jax.random.split(key)
    network = TouchNetwork(params.sites, params.objects, config.hidden)
    weights = network.init(key_network, jnp.zeros(config.hidden), _inputs(environment, params))
    steps = config.iterations * config.epochs * config.minibatches
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_gradient),
        optax.adam(optax.linear_schedule(config.learning_rate, 0.0, steps)),
    )

    def iterate(state: tuple, key: Array) -> tuple[Any, Any]:
        key_play, key_learn = jax.random.split(key)
        played, (there, _) = _play(
            key_play, state[0], network, environment=environment, params=params, episodes=config.episodes
        )
        state = _learn(key_learn, state, played, there.object, network=network, optimizer=optimizer, config=config)
        return state, (jnp.mean(played.loss[1:]), jnp.mean(played.loss[-1]))

    start = weights, optimizer.init(weights)
    (weights, _), (loss, last) = jax.lax.scan(iterate, start, jax.random.split(key_train, config.iterations))
    return LearnedPolicy(weights, loss, last)


def run_learned(
    key: Key[Array, ""],
    policy: LearnedPolicy,
    environment: TouchEnvironment,
    params: EnvironmentParams,
    *,
    config: LearnerConfig,
    episodes: int,
) -> LearnedEpisodes:
    """Episodes under a learned policy, which draws its sites as it did in training.

    Args:
        key: random key.
        policy: what was learned.
        environment: in which.
        params: with the same objects and sites, and other pads if one likes.
        config: with which it was learned; static.
        episodes: how many; static.

    Returns:
        What was predicted, and what was touched.
    """
    network = TouchNetwork(params.sites, params.objects, config.hidden)
    played, (state, refused) = _play(
        key, policy.params, network, environment=environment, params=params, episodes=episodes
    )
    return LearnedEpisodes(
        prediction=jnp.swapaxes(played.prediction[1:], 0, 1),
        site=played.site.T,
        refused=refused.T,
        object=state.object,
        pad=state.pad,
    )


def _inputs(environment: TouchEnvironment, params: EnvironmentParams) -> Array:
    """Inputs of the shape that the network sees."""
    obs, _ = environment.reset(jax.random.key(0), params)
    return jnp.concatenate([features(obs), jnp.zeros(2 * params.sites)])


def _play(
    key: Array, weights: Any, network: TouchNetwork, *, environment: TouchEnvironment, params: EnvironmentParams,
    episodes: int,
) -> tuple[_Played, tuple[EnvironmentState, Array]]:  # fmt: skip
    """Whole episodes; their states and refusals."""
    key_reset, key_steps = jax.random.split(key)
    obs, state = jax.vmap(lambda k: environment.reset(k, params))(jax.random.split(key_reset, episodes))
    which, judge = state.object, jax.vmap(cross_entropy)
    forward: Callable[..., Any] = jax.vmap(partial(network.apply, weights))

    def say(obs: Any, last: Array, touched: Array, memory: Array) -> tuple[Array, ...]:
        seen = jax.vmap(features)(obs)
        inputs = jnp.concatenate([seen, jax.nn.one_hot(last, params.sites), touched.astype(jnp.float32)], axis=1)
        memory, logits, prediction, value = forward(memory, inputs)
        if params.beliefs is not None:
            prediction = jnp.log(jnp.maximum(obs.posterior, MIN_PREDICTED_PROBABILITY))
        return memory, inputs, logits, prediction, value

    def step(carry: tuple, key: Array) -> tuple[Any, Any]:
        obs, state, last, touched, memory = carry
        key_site, key_touch = jax.random.split(key)
        memory, inputs, logits, prediction, value = say(obs, last, touched, memory)
        may = params.allowed[None] & ~touched
        site = _drawn(key_site, logits, may)
        keys = jax.random.split(key_touch, episodes)
        touch = jax.vmap(lambda k, s, a: environment.step_env(k, s, a, params))
        obs, state, _, _, info = touch(keys, state, TouchAction(site, prediction))
        row = _Played(
            inputs=inputs,
            may=may,
            site=site,
            log_probability=_log_chance(_log_chances(logits, may), site),
            value=value,
            prediction=prediction,
            loss=judge(prediction, which),
        )
        touched = touched | (jnp.arange(params.sites)[None] == site[:, None])
        return (obs, state, site, touched, memory), (row, info["refused"])

    nowhere = jnp.full(episodes, -1), jnp.zeros((episodes, params.sites), bool)
    start = obs, state, *nowhere, jnp.zeros((episodes, network.hidden))
    keys = jax.random.split(key_steps, environment.config.touches)
    (obs, state, site, touched, memory), (played, refused) = jax.lax.scan(step, start, keys)
    _, inputs, _, prediction, _ = say(obs, site, touched, memory)
    ends = jax.tree.map(lambda rows, end: jnp.concatenate([rows, end[None]]),
                        (played.inputs, played.value, played.prediction, played.loss),
                        (inputs, jnp.zeros(episodes), prediction, judge(prediction, which)))  # fmt: skip
    full = played._replace(inputs=ends[0], value=ends[1], prediction=ends[2], loss=ends[3])
    return full, (state, refused)


def _drawn(key: Array, logits: Array, may: Array) -> Array:
    """One of the sites that may be touched; `NO_SITE` where none is left."""
    site = jax.random.categorical(key, jnp.where(may, logits, FORBIDDEN_LOGIT))
    return jnp.where(jnp.any(may, axis=-1), site, NO_SITE)


def _log_chances(logits: Array, may: Array) -> Array:
    """Logarithms of the probabilities of the sites, of which only some may be touched."""
    return jax.nn.log_softmax(jnp.where(may, logits, FORBIDDEN_LOGIT))


def _log_chance(log: Array, site: Array) -> Array:
    """Log probability of the chosen site; 0 where there was no choice."""
    chosen = jnp.take_along_axis(log, jnp.maximum(site, 0)[..., None], -1)[..., 0]
    return jnp.where(site == NO_SITE, 0.0, chosen)


def _learn(
    key: Array, state: tuple, played: _Played, which: Array, *, network: TouchNetwork,
    optimizer: optax.GradientTransformation, config: LearnerConfig,
) -> tuple[Any, Any]:  # fmt: skip
    """Some passes over the episodes of an iteration."""
    advantage = _advantages(-played.loss[1:], played.value, config)
    goal = advantage + played.value[:-1]
    episodes = len(which)

    def batch(state: tuple, rows: Array) -> tuple[Any, Any]:
        weights, moments = state
        some = jax.tree.map(lambda x: x[:, rows], played)
        loss = partial(_objective, network=network, config=config)
        slope = jax.grad(loss)(weights, some, which[rows], advantage[:, rows], goal[:, rows])
        change, moments = optimizer.update(slope, moments, weights)
        return (optax.apply_updates(weights, change), moments), None

    orders = jax.vmap(lambda k: jax.random.permutation(k, episodes))(jax.random.split(key, config.epochs))
    rows = orders.reshape(config.epochs * config.minibatches, -1)
    return jax.lax.scan(batch, state, rows)[0]


def _objective(
    weights: Any, played: _Played, which: Array, advantage: Array, goal: Array, *, network: TouchNetwork,
    config: LearnerConfig,
) -> Array:  # fmt: skip
    """The loss of some episodes: PPO's clipped one, the value's, the predictions', less the entropy of sites."""
    forward: Callable[..., Any] = jax.vmap(partial(network.apply, weights))

    def step(memory: Array, inputs: Array) -> tuple[Any, Any]:
        memory, *said = forward(memory, inputs)
        return memory, said

    _, (logits, prediction, value) = jax.lax.scan(step, jnp.zeros((len(which), network.hidden)), played.inputs)
    log = _log_chances(logits[:-1], played.may)
    entropy = -jnp.sum(jnp.exp(log) * jnp.where(played.may, log, 0.0), axis=-1)
    ratio = jnp.exp(_log_chance(log, played.site) - played.log_probability)
    standard = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + ADVANTAGE_STD_OFFSET)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    policy = -jnp.mean(jnp.minimum(ratio * standard, clipped * standard))
    judged = jax.vmap(jax.vmap(cross_entropy), (0, None))(prediction, which)
    values = 0.5 * jnp.mean((value[:-1] - goal) ** 2)
    return policy + values + jnp.mean(judged) - config.entropy * jnp.mean(entropy)


def _advantages(reward: Array, value: Array, config: LearnerConfig) -> Array:
    """Generalised advantages (t, e); `value` has one step more, 0."""

    def back(after: Array, at: tuple) -> tuple[Any, Any]:
        reward, value, following = at
        found = reward + config.discount * following - value + config.discount * config.trace * after
        return found, found

    start = jnp.zeros(reward.shape[1])
    return jax.lax.scan(back, start, (reward, value[:-1], value[1:]), reverse=True)[1]
