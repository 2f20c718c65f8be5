"""Environments for Gymnasium: a vector of them, compiled, and one alone; and for ap_gym, where it is installed.

Actions are dictionaries of "action", a site or the six numbers of a pose, and "prediction", as ap_gym has them;
observations are dictionaries of arrays. Gymnasium is the extra `environments`, and needed by this file only.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from i2t.environments.core import (
    POSE_NUMBERS,
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
NAMESPACE = "i2t"


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
        self.single_observation_space = observation_space(params)
        self.single_action_space = action_space(environment, params)
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
        first = int(self.np_random.integers(2**31))
        self._key, key = jax.random.split(jax.random.key(first))
        keys = jax.random.split(key, self.num_envs)
        if seeds:
            keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
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
        infos: dict[str, Any] = {name: np.asarray(info[name]) for name in ("refused", "loss", "target", "object")}
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
        self.observation_space = observation_space(params)
        self.action_space = action_space(environment, params)
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
        said = {name: np.asarray(info[name]) for name in ("refused", "loss", "target", "object")}
        return _as_dict(obs), float(reward), bool(done), False, said


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


def action_space(environment: TouchEnvironment, params: EnvironmentParams) -> Any:
    """Space of actions.

    Args:
        environment: its rules.
        params: what may be there.

    Returns:
        The space.
    """
    size = environment.task.prediction_size(params.objects)
    where: spaces.Space = spaces.Discrete(params.sites)
    if environment.config.actions == "pose":
        where = spaces.Box(-1.0, 1.0, (POSE_NUMBERS,), np.float32)
    return spaces.Dict({"action": where, "prediction": spaces.Box(-np.inf, np.inf, (size,), np.float32)})


def register_environments() -> tuple[str, ...]:
    """Make environments known to Gymnasium, and to ap_gym where it is installed.

    Returns:
        Their names, for `gymnasium.make`.
    """
    names = [f"{NAMESPACE}/WhichObject-v0"]
    gymnasium.register(names[0], entry_point=SingleTouchEnv)
    try:
        import ap_gym
    except ImportError:
        return tuple(names)
    names.append(f"{NAMESPACE}/ActiveWhichObject-v0")
    ap_gym.register(names[1], _active_env, None)
    return tuple(names)


def _active_env(**making: Any) -> Any:
    """An environment of ap_gym, whose loss is its own cross entropy."""
    import ap_gym

    class ActiveTouchEnv(ap_gym.ActiveClassificationEnv):
        """The same touches, with the truth as prediction target."""

        metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

        def __init__(self) -> None:
            self.inner = SingleTouchEnv(**making)
            inner_space = action_space(self.inner.environment, self.inner.params).spaces["action"]
            super().__init__(self.inner.params.objects, inner_space)
            self.observation_space = self.inner.observation_space

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
            """Begin an episode."""
            super().reset(seed=seed)
            return self.inner.reset(seed=seed)

        def _step(self, action: Any, prediction: Any) -> tuple[Any, float, bool, bool, dict[str, Any], Any]:
            said = {"action": action, "prediction": np.zeros_like(prediction)}
            truth = self._truth()
            obs, _, terminated, truncated, info = self.inner.step(said)
            cost = self.inner.environment.config.refusal_cost * float(info["refused"])
            return obs, -cost, terminated, truncated, info, truth

        def _truth(self) -> np.int64:
            assert self.inner._state is not None
            return np.int64(self.inner._state.object)

    return ActiveTouchEnv()


def _as_action(action: dict[str, Any]) -> TouchAction:
    where = jnp.asarray(action["action"])
    if jnp.issubdtype(where.dtype, jnp.integer):
        where = where.astype(jnp.int32)
    return TouchAction(where, jnp.asarray(action["prediction"], jnp.float32))


def _as_dict(obs: EnvironmentObservation) -> dict[str, np.ndarray]:
    def host(value: Array) -> np.ndarray:
        found = np.asarray(value)
        return found.astype(np.int8 if found.dtype == bool else np.float32)

    return {name: host(value) for name, value in obs._asdict().items()}
