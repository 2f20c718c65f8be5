"""The paper's rules over a whole episode, and its loop, against tables worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.site_poses import TWO_POOLS

from i2t.objects import catalogue
from i2t.prediction.predictor import Reading
from i2t.recognition.belief import TouchObservation
from i2t.recognition.episodes import Episodes, MeasuredTouches
from i2t.recognition.paper_rules import ConstantPredictor, paper_rules, run_loop
from i2t.recognition.site_pool import prepare_surfaces

CHANNELS = 12  # of a 4-chip board
STD = 2.0  # uT, of every channel
SECOND = 4.0  # standard deviations between the readings predicted on the two objects
# One episode of four touches: where presses ended (mm), and the first channel's reading in standard deviations. The
# first three are on the top of the square, 50 mm wide, or of the cylinder, 60 mm wide, both 30 mm high; the last where
# nothing is to be seen.
POINTS = np.array([[0.0, 0.0, 30.0], [24.0, 24.0, 30.0], [28.0, 0.0, 30.0], [300.0, 0.0, 30.0]])
MEASURED = np.array([1.0, 3.0, 0.0, 1.0])
# Distances from the square and the cylinder: |reading| and |reading - 4|, and nothing predicted at the last.
TAU = np.array([[1, 3], [3, 1], [0, 4], [1, 1]])
CORNER = np.hypot(24, 24) - 30  # mm from the cylinder
APART = np.array([[0, 0], [0, CORNER], [3, 0], [275, 270]])  # mm


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
    predictors = {"table": Table(surfaces), "constant": ConstantPredictor(np.full(CHANNELS, STD * 0.25))}
    return paper_rules(predictors, np.full(CHANNELS, STD), surfaces, episodes)


class Table:
    """Says nothing at all on the object that it is asked of first, and SECOND on the other."""

    def __init__(self, surfaces: list) -> None:
        self.asked, self.objects = 0, len(surfaces)

    def predict_views(self, patch, *, force=None, nearest=None, depth=None, wide=None) -> Reading:
        mean = np.zeros((len(patch), CHANNELS), np.float32)
        mean[:, 0] = STD * SECOND * (self.asked % self.objects)
        self.asked += 1
        return Reading(mean, np.ones_like(mean))


def normalised(likelihood: np.ndarray) -> np.ndarray:
    return likelihood / likelihood.sum(-1, keepdims=True)


def test_readings_vote(beliefs):
    np.testing.assert_allclose(
        beliefs["table, votes"][0], [[1, 0], [1 / 2, 1 / 2], [2 / 3, 1 / 3], [5 / 8, 3 / 8]], atol=1e-6
    )


def test_contacts_vote(beliefs):
    # Both objects are met at the middle of the top.
    expected = [[1 / 2, 1 / 2], [3 / 4, 1 / 4], [1 / 2, 1 / 2], [3 / 8, 5 / 8]]
    np.testing.assert_allclose(beliefs["proprioception, votes"][0], expected, atol=1e-6)


@pytest.mark.parametrize(("source", "distance", "loose"), [("table", TAU, 1e-5), ("proprioception", APART, 0.05)])
def test_averages_and_products_of_likelihoods(beliefs, source, distance, loose):
    each = normalised(np.exp(-(distance - distance.min(1, keepdims=True))))
    expected = np.cumsum(each, 0) / np.arange(1, 5)[:, None]
    # A cylinder has facets, up to a twentieth of a millimetre below its circle.
    np.testing.assert_allclose(beliefs[f"{source}, average"][0], expected, atol=loose)
    total = np.cumsum(distance, 0)
    expected = normalised(np.exp(-(total - total.min(1, keepdims=True))))
    np.testing.assert_allclose(beliefs[f"{source}, product"][0], expected, atol=loose)


def test_every_rule_gives_probabilities(beliefs):
    sources = {name.rpartition(", ")[0] for name in beliefs}
    assert sources == {"table", "constant", "proprioception"}
    assert len(beliefs) == 9
    for p in beliefs.values():
        assert p.shape == (1, 4, 2)
        np.testing.assert_allclose(p.sum(-1), 1, atol=1e-5)


def test_a_constant_reading_knows_only_where_an_object_is(beliefs):
    # Both objects are there at the first three touches, neither at the last: no touch tells them apart.
    np.testing.assert_allclose(beliefs["constant, votes"], 0.5, atol=1e-6)


# Rows of the joined pools that touches must be at, by pool and hypothesis.
WORTH = np.array([[1, 3], [4, 6]])
POOL = np.array([0, 1, 0, 1])
# Distances from the two objects at each of three touches, the same in all episodes: after the first touch the second
# object has all votes, after two they are even.
DISTANCES = np.array([[3.0, 1.0], [1.0, 2.0], [5.0, 0.0]])


class Recorder:
    """Makes no touch, but keeps what it was asked for."""

    def __init__(self) -> None:
        self.sites: list[np.ndarray] = []

    def touch(self, site: np.ndarray) -> None:
        self.sites.append(site)

    def last_touches(self) -> MeasuredTouches:
        step = np.full(len(POOL), len(self.sites), np.float32)
        return MeasuredTouches(np.tile(np.eye(4, dtype=np.float32), (len(POOL), 1, 1)), step[:, None], step)


def fixed_scorer(touches: MeasuredTouches) -> np.ndarray:
    """The table's distances of the touch whose number is its reading."""
    return DISTANCES[touches.reading[:, 0].astype(int) - 1]


@pytest.fixture(scope="module")
def loops():
    made = []
    for key in jax.random.split(jax.random.key(0), 30):
        recorder = Recorder()
        made.append((run_loop(key, fixed_scorer, recorder, TWO_POOLS, POOL, count=3), recorder))
    return made


@pytest.mark.full
def test_the_loop_samples_its_hypotheses_from_its_own_votes(loops):
    hypotheses = np.concatenate([result.hypothesis for result, _ in loops])  # (120, 3)
    assert 0.3 < hypotheses[:, 0].mean() < 0.7  # nothing is believed yet
    assert (hypotheses[:, 1] == 1).all()  # all votes are for the second object
    assert 0.3 < hypotheses[:, 2].mean() < 0.7  # one vote each: an argmax would always take the first


def test_the_loop_touches_where_the_heuristic_says_on_the_hypothesis(loops):
    for result, recorder in loops:
        np.testing.assert_array_equal(result.site, WORTH[POOL[:, None], result.hypothesis])
        np.testing.assert_array_equal(np.concatenate(recorder.sites, 1), result.site)


def test_the_loop_is_scored_by_its_own_distances(loops):
    for result, _ in loops:
        np.testing.assert_allclose(result.distance, np.tile(DISTANCES, (len(POOL), 1, 1)))


def test_hypotheses_follow_the_rule_that_is_asked_for():
    """By the product of likelihoods the second object has e^2 / (1 + e^2) = .88 after one touch and .73 after two."""
    shares = []
    for key in jax.random.split(jax.random.key(1), 60):
        shares.append(run_loop(key, fixed_scorer, Recorder(), TWO_POOLS, POOL, count=3, rule="product").hypothesis)
    share = np.concatenate(shares).mean(0)
    assert abs(share[1] - 0.88) < 0.08
    assert abs(share[2] - 0.73) < 0.1
