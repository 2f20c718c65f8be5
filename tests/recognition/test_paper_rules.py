"""The paper's rules over a whole episode, and its loop, against tables worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.environments import random_environment
from helpers.site_poses import TWO_POOLS

from i2t.objects import catalogue
from i2t.prediction.predictor import Predictor, Reading
from i2t.prediction.touch_model import TouchBatch, TouchModel
from i2t.recognition import paper_rules as paper_rules_module
from i2t.recognition.belief import TouchObservation
from i2t.recognition.environment import EnvironmentConfig
from i2t.recognition.episodes import Episodes, MeasuredTouches
from i2t.recognition.paper_rules import at_median_force, constant_predictor, paper_rules, run_loop, run_paper_loop
from i2t.recognition.rollout import RunningEpisodes
from i2t.recognition.site_pool import prepare_surfaces
from i2t.skin.pad import nominal_pad

CHANNELS = 12  # of a 4-chip board
STD = 2.0  # uT, of every channel
SECOND = 4.0  # standard deviations between the readings predicted on the two objects
# One episode of four touches: where presses ended (mm), and the first channel's reading in standard deviations. The
# first three are on the top of the square, 50 mm wide, or of the cylinder, 60 mm wide, both 30 mm high; the last where
# nothing is to be seen.
POINTS = np.array([[0.0, 0.0, 30.0], [24.0, 24.0, 30.0], [28.0, 0.0, 30.0], [300.0, 0.0, 30.0]])
MEASURED = np.array([1.0, 3.0, 0.0, 1.0])
# Distances from the square and the cylinder: |reading| and |reading - 4|, and nothing predicted at the last.
TAU = np.array([[1.0, 3.0], [3.0, 1.0], [0.0, 4.0], [1.0, 1.0]])


@pytest.fixture(scope="module")
def beliefs() -> dict[str, np.ndarray]:
    surfaces = prepare_surfaces([catalogue.make_object(name).mesh for name in ("square", "cylinder")])
    T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (1, 4, 1, 1))
    T[0, :, :3, 3] = POINTS * 1e-3
    reading = np.zeros((1, 4, CHANNELS))
    reading[0, :, 0] = STD * MEASURED
    observations = TouchObservation(
        jnp.float32(reading), jnp.full((1, 4), 0.5), jnp.zeros((1, 4)), jnp.ones((1, 4), bool)
    )
    episodes = Episodes(np.zeros(1, int), np.arange(4)[None], observations, np.float32(T))
    table = Predictor(Table(len(surfaces)), 17e-3, 4e-3, default_force=1.0, default_travel=0.0)
    predictors = {"table": table, "constant": constant_predictor(np.full(CHANNELS, STD * 0.25))}
    return paper_rules(predictors, np.full(CHANNELS, STD), surfaces, episodes)


class Table(TouchModel):
    """Distances that carry no information on the object asked first, and SECOND on the other."""

    def __init__(self, objects: int) -> None:
        self.asked, self.objects = 0, objects

    @property
    def channels(self) -> int:
        return CHANNELS

    def predict_batch(self, touches: TouchBatch) -> Reading:
        mean = np.zeros((len(touches.patch), CHANNELS), np.float32)
        mean[:, 0] = STD * SECOND * (self.asked % self.objects)
        self.asked += 1
        return Reading(mean, np.ones_like(mean))


def normalised(likelihood: np.ndarray) -> np.ndarray:
    return likelihood / likelihood.sum(-1, keepdims=True)


def test_votes_averages_and_products(beliefs):
    expected = {
        "table": [[1, 0], [1 / 2, 1 / 2], [2 / 3, 1 / 3], [5 / 8, 3 / 8]],
        # Both objects are met at the middle of the top.
        "proprioception": [[1 / 2, 1 / 2], [3 / 4, 1 / 4], [1 / 2, 1 / 2], [3 / 8, 5 / 8]],
        # Both are there at the first three touches, neither at the last: a constant reading tells nothing.
        "constant": np.full((4, 2), 0.5),
    }
    assert {name.rpartition(", ")[0] for name in beliefs} == set(expected)
    assert len(beliefs) == 9
    for source, votes in expected.items():
        np.testing.assert_allclose(beliefs[f"{source}, votes"][0], votes, atol=1e-6)
    average = np.cumsum(normalised(np.exp(-TAU)), 0) / np.arange(1, 5)[:, None]
    np.testing.assert_allclose(beliefs["table, average"][0], average, atol=1e-5)
    np.testing.assert_allclose(beliefs["table, product"][0], normalised(np.exp(-np.cumsum(TAU, 0))), atol=1e-5)
    for p in beliefs.values():
        np.testing.assert_allclose(p.sum(-1), np.ones((1, 4)), atol=1e-5)


class Weight(TouchModel):
    """A skin that reads the force itself in every channel."""

    channels = CHANNELS

    def predict_batch(self, touches: TouchBatch) -> Reading:
        mean = np.tile(touches.force[:, None], CHANNELS)
        return Reading(mean, np.ones_like(mean))


def test_at_the_median_force_predictions_ignore_the_measured_force():
    patch = np.zeros((2, 4, 4), np.float32)
    pressed = TouchBatch(patch, patch, 1e-3, np.array([0.1, 5.0]), np.zeros(2), np.zeros(2))
    told = Predictor(Weight(), 17e-3, 4e-3, default_force=1.5, default_travel=0.0, std_scale=2.0)
    np.testing.assert_allclose(told.predict_batch(pressed).mean[:, 0], [0.1, 5.0])
    reading = at_median_force(told).with_pressure(smooth=False).predict_batch(pressed)
    np.testing.assert_allclose(reading.mean, 1.5)
    np.testing.assert_allclose(reading.std, 2.0)


# Rows of the joined pools that touches must be at, by pool and hypothesis.
WORTH = np.array([[1, 3], [4, 6]])
POOL = np.array([0, 1, 0, 1])
# Distances from the two objects at each of three touches, the same in all episodes: after the first touch the second
# object has all votes, after two they are even.
DISTANCES = np.array([[3.0, 1.0], [1.0, 2.0], [5.0, 0.0]])


@pytest.fixture
def recorded(monkeypatch) -> list[np.ndarray]:
    """Sites that were touched. No touch is made; its number is its reading."""
    sites: list[np.ndarray] = []

    def advance(running, site, *, shared):
        sites.append(site)
        return running

    def last_touches(running):
        step = np.full(len(POOL), 1 + (len(sites) - 1) % 3, np.float32)
        return MeasuredTouches(np.tile(np.eye(4, dtype=np.float32), (len(POOL), 1, 1)), step[:, None], step)

    monkeypatch.setattr(paper_rules_module, "advance", advance)
    monkeypatch.setattr(paper_rules_module, "last_touches", last_touches)
    return sites


THREE, PARAMS = random_environment(EnvironmentConfig(touches=3))
BEGUN = RunningEpisodes(THREE, PARAMS, np.zeros(2, np.uint32), None)


def fixed_scorer(touches: MeasuredTouches) -> np.ndarray:
    """The table's distances of the touch whose number is its reading."""
    return DISTANCES[touches.reading[:, 0].astype(int) - 1]


@pytest.mark.full
def test_the_loop_samples_hypotheses_from_its_votes_and_touches_by_the_heuristic(recorded):
    hypotheses = []
    for key in jax.random.split(jax.random.key(0), 30):
        result = run_loop(key, fixed_scorer, BEGUN, TWO_POOLS, POOL)
        np.testing.assert_array_equal(result.site, WORTH[POOL[:, None], result.hypothesis])
        np.testing.assert_array_equal(np.concatenate(recorded[-3:], 1), result.site)
        np.testing.assert_allclose(result.distance, np.tile(DISTANCES, (len(POOL), 1, 1)))
        hypotheses.append(result.hypothesis)
    share = np.concatenate(hypotheses).mean(0)  # of 120
    assert 0.3 < share[0] < 0.7  # nothing is believed yet
    assert share[1] == 1  # all votes are for the second object
    assert 0.3 < share[2] < 0.7  # one vote each: an argmax would always take the first


@pytest.mark.full
def test_methods_meet_the_same_episodes_and_proprioception_is_among_them():
    names, pad = ("square", "cylinder"), nominal_pad()
    surfaces = dict(zip(names, prepare_surfaces([catalogue.make_object(name).mesh for name in names]), strict=True))
    constant = {name: constant_predictor(np.ones(15)) for name in ("one", "same")}
    counts = []
    results = run_paper_loop(
        jax.random.split(jax.random.key(0), 3), constant, surfaces, pad,
        reading_std=np.ones(15), episodes=3, touches=2, sites_per_object=4, episodes_per_pool=2,
        progress=counts.append,
    )  # fmt: skip
    assert list(results) == ["one", "same", "proprioception"]
    assert sum(counts) == 3 * 3 * 2
    np.testing.assert_array_equal(results["one"].distance, results["same"].distance)
    np.testing.assert_array_equal(results["one"].truth, [0, 1, 0])
    np.testing.assert_array_equal(results["one"].pool, [0, 0, 1])
    assert results["proprioception"].hits().shape == (3, 2)
    np.testing.assert_allclose(results["proprioception"].beliefs("average").sum(-1), 1, rtol=1e-5)


def test_hypotheses_follow_the_requested_rule(recorded):
    """By the product of likelihoods the second object has e^2 / (1 + e^2) = .88 after one touch and .73 after two."""
    share = np.mean(
        [
            run_loop(key, fixed_scorer, BEGUN, TWO_POOLS, POOL, rule="product").hypothesis.mean(0)
            for key in jax.random.split(jax.random.key(1), 60)
        ],
        axis=0,
    )
    assert abs(share[1] - 0.88) < 0.08
    assert abs(share[2] - 0.73) < 0.1
