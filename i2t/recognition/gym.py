"""The environment for Gymnasium, compiled; many at once are `jax.vmap` of `i2t.recognition.environment`.

Actions are dictionaries of "action", the number of a site, and "prediction", a logit of each object; observations are
dictionaries of arrays. Gymnasium is the extra `environments`, and needed by this file only.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from i2t.recognition.environment import (
    EnvironmentObservation,
    EnvironmentParams,
    EpisodeState,
    TouchAction,
    TouchEnvironment,
)
from i2t.recognition.touch_table import make_environment

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as error:
    raise ImportError("i2t.recognition.gym needs Gymnasium; run pip install 'imagine2touch[environments]'") from error

DEFAULT_OBJECTS = ("star", "hexagon", "cylinder", "cross", "square", "triangle")
ENVIRONMENT_ID = "i2t/WhichObject-v0"
INFOS = ("refused", "loss", "object")


class SingleTouchEnv(gymnasium.Env):
    """One episode at a time."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self, environment: TouchEnvironment | None = None, params: EnvironmentParams | None = None, **making: Any
    ) -> None:
        """Wrap an environment, which is compiled at its first reset and step, once for all of the same rules.

        Args:
            environment: its rules; by default it is made.
            params: what may be there.
            making: of `i2t.recognition.touch_table.make_environment`, where it is made.
        """
        if environment is None or params is None:
            environment, params = make_environment(**({"objects": DEFAULT_OBJECTS} | making))
        self.environment, self.params = environment, params
        self.observation_space, self.action_space = observation_space(params), action_space(params)
        self._state: EpisodeState | None = None
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
        obs, self._state = _reset(self.environment, key, self.params)
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
        touch, prediction = jnp.asarray(action["action"], jnp.int32), jnp.asarray(action["prediction"], jnp.float32)
        made = _step(self.environment, key, self._state, TouchAction(touch, prediction), self.params)
        obs, self._state, reward, done, info = made
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


_reset = jax.jit(TouchEnvironment.reset, static_argnums=0)
_step = jax.jit(TouchEnvironment.step_env, static_argnums=0)


def _as_dict(obs: EnvironmentObservation) -> dict[str, np.ndarray]:
    arrays = {name: np.asarray(value) for name, value in obs._asdict().items()}
    return {name: value.astype(np.int8 if value.dtype == bool else np.float32) for name, value in arrays.items()}
