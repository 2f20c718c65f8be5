"""The environment for Gymnasium, compiled. To run many at once, `jax.vmap` those of `i2t.recognition.environment`.

Actions are dictionaries of "action", the index of a site, and "prediction", a logit of each object. Observations are
dictionaries of arrays. Gymnasium is the extra `environments`, which only this module needs.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from i2t.installation import extra_advice
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
    raise ImportError(f"i2t.recognition.gym needs Gymnasium: {extra_advice('environments')}") from error


class SingleTouchEnv(gymnasium.Env):
    """Gymnasium environment for recognising an object by simulated touches; a step is one touch, without batching."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self, environment: TouchEnvironment | None = None, params: EnvironmentParams | None = None, **making: Any
    ) -> None:
        """Wrap an environment. It is compiled at its first reset and step, once for all environments of the same rules.

        Args:
            environment: The rules; made by `make_environment` if they or `params` are not given.
            params: The objects and pads of the environment.
            making: Arguments of `i2t.recognition.touch_table.make_environment`.
        """
        if environment is None or params is None:
            objects = ("star", "hexagon", "cylinder", "cross", "square", "triangle")
            environment, params = make_environment(**({"objects": objects} | making))
        self.environment, self.params = environment, params
        self.observation_space, self.action_space = observation_space(params), action_space(params)
        self._state: EpisodeState | None = None
        self._key = jax.random.key(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode with a random object and pad.

        Args:
            seed: Seed of the episode; the same seed gives the same episode.
            options: Ignored.

        Returns:
            Observation before the first touch, and an empty info.
        """
        super().reset(seed=seed)
        self._key, key = jax.random.split(jax.random.key(int(self.np_random.integers(2**31))))
        obs, self._state = _reset(self.environment, key, self.params)
        return _as_dict(obs), {}

    def step(self, action: dict[str, Any]) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Make one touch, a step of the episode.

        Args:
            action: Site of the touch and predicted object, an element of `action_space`.

        Returns:
            Observation, reward, whether the episode ended, whether it was truncated (never), and info.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step before reset; call reset first")
        self._key, key = jax.random.split(self._key)
        touch, prediction = jnp.asarray(action["action"], jnp.int32), jnp.asarray(action["prediction"], jnp.float32)
        action_arrays = TouchAction(touch, prediction)
        obs, self._state, reward, done, info = _step(self.environment, key, self._state, action_arrays, self.params)
        infos = {name: np.asarray(info[name]) for name in ("refused", "loss", "object")}
        return _as_dict(obs), float(reward), bool(done), False, infos


def observation_space(params: EnvironmentParams) -> gymnasium.Space:
    """Build the Gymnasium space of observations.

    Args:
        params: The objects and pads of the environment.

    Returns:
        Space of dictionaries as `SingleTouchEnv` returns them.
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
            "remaining": box(low=0.0, high=1.0),
            "posterior": box(params.objects if params.beliefs is not None else 0, low=0.0, high=1.001),
        }
    )


def action_space(params: EnvironmentParams) -> Any:
    """Build the Gymnasium space of actions.

    Args:
        params: The objects and pads of the environment.

    Returns:
        Space of dictionaries with "action", the site to touch, and "prediction", the logits of the objects.
    """
    logits = spaces.Box(-np.inf, np.inf, (params.objects,), np.float32)
    return spaces.Dict({"action": spaces.Discrete(params.sites), "prediction": logits})


def register_environments() -> str:
    """Register the environment with Gymnasium.

    Returns:
        Name of the environment for `gymnasium.make`, "i2t/WhichObject-v0".
    """
    name = "i2t/WhichObject-v0"
    gymnasium.register(name, entry_point=SingleTouchEnv)
    return name


_reset = jax.jit(TouchEnvironment.reset, static_argnums=0)
_step = jax.jit(TouchEnvironment.step_env, static_argnums=0)


def _as_dict(obs: EnvironmentObservation) -> dict[str, np.ndarray]:
    arrays = {name: np.asarray(value) for name, value in obs._asdict().items()}
    return {name: value.astype(np.int8 if value.dtype == bool else np.float32) for name, value in arrays.items()}
