"""Gymnasium's own checker, the vector's contract, and ap_gym where it is installed."""

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
    obs, _ = envs.reset(seed=3)
    assert envs.observation_space.contains(obs)
    again, _ = envs.reset(seed=3)
    np.testing.assert_array_equal(obs["reading"], again["reading"])
    for step in range(1, 6):
        action = {"action": np.full(6, step % SITES), "prediction": np.zeros((6, OBJECTS), np.float32)}
        obs, reward, terminated, truncated, infos = envs.step(action)
        assert envs.observation_space.contains(obs)
        assert reward.shape == terminated.shape == truncated.shape == (6,)
        assert terminated.all() == (step == 4) == ("final_obs" in infos)
        assert not truncated.any()
    assert infos["refused"].sum() == 0
    envs.close()


def test_the_same_seed_is_the_same_episode():
    env = gym.SingleTouchEnv(*random_environment())
    action = {"action": 1, "prediction": np.zeros(OBJECTS, np.float32)}
    runs = []
    for _ in range(2):
        env.reset(seed=5)
        runs.append(env.step(action)[0]["reading"])
    np.testing.assert_array_equal(*runs)


def test_a_step_needs_a_reset():
    env = gym.SingleTouchEnv(*random_environment())
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(env.action_space.sample())


@pytest.mark.full
@pytest.mark.filterwarnings("ignore")
def test_ap_gym_plays_it(monkeypatch):
    ap_gym = pytest.importorskip("ap_gym")
    monkeypatch.setattr(gym, "make_environment", lambda **_: random_environment())
    names = gym.register_environments()
    env = ap_gym.make(names[1])
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    total, done = 0.0, False
    while not done:
        obs, reward, done, _, info = env.step({"action": 1, "prediction": np.zeros(OBJECTS, np.float32)})
        total += reward
    assert info["prediction"]["loss"] == pytest.approx(1.0)  # of a guess among all, as ap_gym scales it
    assert total == pytest.approx(-4.0)
