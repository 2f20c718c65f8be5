"""Run a random policy in the environment for recognition by active touch. Everything is simulated.

Replace the random site and the empty prediction of the object by those of your own policy.

python examples/11_active_touch_environment.py
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import i2t
from i2t.recognition import EnvironmentConfig, EnvironmentParams, EpisodeState, TouchAction, make_environment
from i2t.runtime.compiling import jit_quickly


def main(touches: int = 4) -> np.ndarray:
    """Run one episode of a random policy, and return its rewards."""
    config = EnvironmentConfig(touches=touches, law=None)
    environment, params = make_environment(("star", "hexagon"), config=config, sites=4, pads=1)

    @jit_quickly
    def episode(key: Array, params: EnvironmentParams) -> tuple[Array, Array]:
        def touch_at_random(state: EpisodeState, key: Array) -> tuple[EpisodeState, tuple[Array, Array]]:
            key_site, key_touch = jax.random.split(key)
            site = jax.random.randint(key_site, (), 0, params.sites)
            action = TouchAction(site, prediction=jnp.zeros(params.objects))
            obs, state, reward, _, _ = environment.step_env(key_touch, state, action, params)
            return state, (obs.force, reward)

        key_reset, key_steps = jax.random.split(key)
        _, state = environment.reset(key_reset, params)
        return jax.lax.scan(touch_at_random, state, jax.random.split(key_steps, touches))[1]

    force, reward = episode(jax.random.key(0), params)
    print("forces:", ", ".join(f"{f:.2f} N" for f in force), "- rewards:", ", ".join(f"{r:.2f}" for r in reward))
    return np.asarray(reward)


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
