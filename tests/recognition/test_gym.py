"""Gymnasium's own checker, and properties that it does not check."""

import numpy as np
import pytest
from helpers.compilations import compilations
from helpers.environments import OBJECTS, random_environment

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from i2t.recognition import gym  # noqa: E402


@pytest.mark.filterwarnings("ignore")  # of infinite bounds, which are meant
def test_the_environment_passes_the_checks_of_gymnasium():
    check_env(gym.SingleTouchEnv(*random_environment()), skip_render_check=True)


def test_a_seed_determines_the_episode_and_a_step_needs_a_reset():
    env = gym.SingleTouchEnv(*random_environment())
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(env.action_space.sample())
    runs = []
    for _ in range(2):
        env.reset(seed=5)
        runs.append(env.step({"action": 1, "prediction": np.zeros(OBJECTS, np.float32)})[0]["reading"])
    np.testing.assert_array_equal(*runs)
    with compilations() as compiled:
        gym.SingleTouchEnv(*random_environment()).reset(seed=5)
    assert "jit(_reset)" not in compiled
