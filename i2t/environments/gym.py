"""Environments for Gymnasium: a vector of them, compiled, and one alone.

Actions are dictionaries of "action", the number of a site, and "prediction", a logit of each object; observations are
dictionaries of arrays. Gymnasium is the extra `environments`, and needed by this file only.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from i2t.environments.core import (
    EnvironmentObservation,
    EnvironmentParams,
    EnvironmentState,
    TouchAction,
    TouchEnvironment,
)
from i2t.environments.tables import make_environment

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("i2t.environments.gym needs Gymnasium; run pip install 'imagine2touch[environments]'") from error

DEFAULT_OBJECTS = ("star", "hexagon", "cylinder", "cross", "square", "triangle")
ENVIRONMENT_ID = "i2t/WhichObject-v0"
INFOS = ("refused", "loss", "object")


class TouchVectorEnv(gymnasium.vector.VectorEnv):
    """Many episodes at once, each followed by another in the same step (`AutoresetMode.SAME_STEP`).

    The last observations of episodes that ended are `infos["final_obs"]`, where `infos["_final_obs"]` is true.
    """

    metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(self, environment: TouchEnvironment, params: EnvironmentParams, num_envs: int) -> None:
        """Compile an environment for a number of episodes.

        Args:
            environment: its rules.
            params: what may be there.
            num_envs: episodes side by side.
        """
        self.num_envs, self.environment, self.params = num_envs, environment, params
        self.single_observation_space, self.single_action_space = observation_space(params), action_space(params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = None
        self._reset = jax.jit(jax.vmap(environment.reset, (0, None)))
        self._step = jax.jit(jax.vmap(environment.step, (0, 0, 0, None)))
        self._state: EnvironmentState | None = None
        self._key = jax.random.key(0)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin all episodes.

        Args:
            seed: the same seed gives the same episodes; a list has one for each.
            options: none are known.

        Returns:
            Observations, and nothing else.
        """
        seeds = list(seed) if isinstance(seed, list | tuple) else None
        super().reset(seed=seeds[0] if seeds else None if isinstance(seed, list) else seed)
        self._key, key = jax.random.split(jax.random.key(int(self.np_random.integers(2**31))))
        keys = jax.vmap(jax.random.key)(jnp.asarray(seeds)) if seeds else jax.random.split(key, self.num_envs)
        obs, self._state = self._reset(keys, self.params)
        return _as_dict(obs), {}

    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One touch of each episode.

        Args:
            actions: of the action space.

        Returns:
            Observations, rewards, whether episodes ended, whether they were cut short (never), and infos.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step before reset; call reset first")
        self._key, key = jax.random.split(self._key)
        keys = jax.random.split(key, self.num_envs)
        obs, self._state, reward, done, info = self._step(keys, self._state, _as_action(actions), self.params)
        ended = np.asarray(done)
        infos: dict[str, Any] = {name: np.asarray(info[name]) for name in INFOS}
        if ended.any():
            infos |= {"final_obs": _as_dict(info["final"]), "_final_obs": ended}
        return _as_dict(obs), np.asarray(reward, np.float64), ended, np.zeros_like(ended), infos


class SingleTouchEnv(gymnasium.Env):
    """One episode at a time."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self, environment: TouchEnvironment | None = None, params: EnvironmentParams | None = None, **making: Any
    ) -> None:
        """Compile an environment.

        Args:
            environment: its rules; by default it is made.
            params: what may be there.
            making: of `i2t.environments.tables.make_environment`, where it is made.
        """
        if environment is None or params is None:
            environment, params = make_environment(**({"objects": DEFAULT_OBJECTS} | making))
        self.environment, self.params = environment, params
        self.observation_space, self.action_space = observation_space(params), action_space(params)
        self._reset, self._step = jax.jit(environment.reset), jax.jit(environment.step_env)
        self._state: EnvironmentState | None = None
        self._key = jax.random.key(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: the same seed gives the same episode.
            options: none are known.

        Returns:
            The observation, and nothing else.
        """
        super().reset(seed=seed)
        self._key, key = jax.random.split(jax.random.key(int(self.np_random.integers(2**31))))
        obs, self._state = self._reset(key, self.params)
        return _as_dict(obs), {}

    def step(self, action: dict[str, Any]) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """One touch.

        Args:
            action: of the action space.

        Returns:
            Observation, reward, whether the episode ended, whether it was cut short (never), and info.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step before reset; call reset first")
        self._key, key = jax.random.split(self._key)
        obs, self._state, reward, done, info = self._step(key, self._state, _as_action(action), self.params)
        return _as_dict(obs), float(reward), bool(done), False, {name: np.asarray(info[name]) for name in INFOS}


def observation_space(params: EnvironmentParams) -> gymnasium.Space:
    """Space of observations.

    Args:
        params: what may be there.

    Returns:
        The space.
    """

    def box(*shape: int, low: float = -np.inf, high: float = np.inf) -> gymnasium.Space:
        return spaces.Box(low, high, shape, np.float32)

    flag = partial(spaces.Box, 0, 1, (), np.int8)
    return spaces.Dict(
        {
            "reading": box(params.channels),
            "force": box(),
            "advance": box(),
            "T_w_t": box(4, 4),
            "contact": flag(),
            "refused": flag(),
            "left": box(low=0.0, high=1.0),
            "posterior": box(params.objects if params.beliefs is not None else 0, low=0.0, high=1.001),
        }
    )


def action_space(params: EnvironmentParams) -> Any:
    """Space of actions.

    Args:
        params: what may be there.

    Returns:
        The space.
    """
    logits = spaces.Box(-np.inf, np.inf, (params.objects,), np.float32)
    return spaces.Dict({"action": spaces.Discrete(params.sites), "prediction": logits})


def register_environments() -> str:
    """Make the environment known to Gymnasium.

    Returns:
        Its name, for `gymnasium.make`.
    """
    gymnasium.register(ENVIRONMENT_ID, entry_point=SingleTouchEnv)
    return ENVIRONMENT_ID


def _as_action(action: dict[str, Any]) -> TouchAction:
    return TouchAction(jnp.asarray(action["action"], jnp.int32), jnp.asarray(action["prediction"], jnp.float32))


def _as_dict(obs: EnvironmentObservation) -> dict[str, np.ndarray]:
    arrays = {name: np.asarray(value) for name, value in obs._asdict().items()}
    return {name: value.astype(np.int8 if value.dtype == bool else np.float32) for name, value in arrays.items()}
