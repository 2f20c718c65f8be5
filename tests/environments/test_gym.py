"""Gymnasium's own checker, and the vector's contract."""

import numpy as np
import pytest
from helpers.environments import OBJECTS, SITES, random_environment

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from i2t.environments import gym  # noqa: E402


@pytest.mark.filterwarnings("ignore")  # of infinite bounds, which are meant
def test_gymnasium_finds_nothing_wrong_with_one_environment():
    check_env(gym.SingleTouchEnv(*random_environment()), skip_render_check=True)


@pytest.mark.full
def test_a_vector_of_them_says_what_ended():
    envs = gym.TouchVectorEnv(*random_environment(), num_envs=6)
    obs, again = (envs.reset(seed=3)[0] for _ in range(2))
    np.testing.assert_array_equal(obs["reading"], again["reading"])
    for step in range(1, 6):
        assert envs.observation_space.contains(obs)
        action = {"action": np.full(6, step % SITES), "prediction": np.zeros((6, OBJECTS), np.float32)}
        obs, reward, terminated, truncated, infos = envs.step(action)
        assert reward.shape == terminated.shape == truncated.shape == (6,)
        assert terminated.all() == (step == 4) == ("final_obs" in infos)
        assert not truncated.any()
    assert infos["refused"].sum() == 0
    envs.close()


def test_the_same_seed_is_the_same_episode_and_a_step_needs_a_reset():
    env = gym.SingleTouchEnv(*random_environment())
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(env.action_space.sample())
    runs = []
    for _ in range(2):
        env.reset(seed=5)
        runs.append(env.step({"action": 1, "prediction": np.zeros(OBJECTS, np.float32)})[0]["reading"])
    np.testing.assert_array_equal(*runs)
