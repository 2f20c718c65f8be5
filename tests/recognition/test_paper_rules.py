"""The paper's rules over a whole episode against a table worked by hand."""

from unittest.mock import create_autospec

import jax.numpy as jnp
import numpy as np
import pytest

from i2t.objects import catalogue
from i2t.prediction.predictor import Predictor, Reading
from i2t.recognition.belief import TouchObservation
from i2t.recognition.episodes import Episodes
from i2t.recognition.paper_rules import paper_rules
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
    predictor = create_autospec(Predictor, instance=True)
    predictor.with_pressure.return_value = predictor
    second = np.zeros((4, CHANNELS), np.float32)
    second[:, 0] = STD * SECOND
    predictor.predict.side_effect = [Reading(x, np.ones_like(x)) for x in (np.zeros_like(second), second)]
    episodes = Episodes(np.zeros(1, int), np.arange(4)[None], observations, np.float32(T))
    return paper_rules(predictor, np.full(CHANNELS, STD), surfaces, episodes)


def normalised(likelihood: np.ndarray) -> np.ndarray:
    return likelihood / likelihood.sum(-1, keepdims=True)


def test_readings_vote(beliefs):
    np.testing.assert_allclose(
        beliefs["I2T, votes"][0], [[1, 0], [1 / 2, 1 / 2], [2 / 3, 1 / 3], [5 / 8, 3 / 8]], atol=1e-6
    )


def test_contacts_vote(beliefs):
    # Both objects are met at the middle of the top.
    expected = [[1 / 2, 1 / 2], [3 / 4, 1 / 4], [1 / 2, 1 / 2], [3 / 8, 5 / 8]]
    np.testing.assert_allclose(beliefs["proprioception, votes"][0], expected, atol=1e-6)


@pytest.mark.parametrize(("source", "distance", "loose"), [("I2T", TAU, 1e-5), ("proprioception", APART, 0.05)])
def test_averages_and_products_of_likelihoods(beliefs, source, distance, loose):
    each = normalised(np.exp(-(distance - distance.min(1, keepdims=True))))
    expected = np.cumsum(each, 0) / np.arange(1, 5)[:, None]
    # A cylinder has facets, up to a twentieth of a millimetre below its circle.
    np.testing.assert_allclose(beliefs[f"{source}, average"][0], expected, atol=loose)
    total = np.cumsum(distance, 0)
    expected = normalised(np.exp(-(total - total.min(1, keepdims=True))))
    np.testing.assert_allclose(beliefs[f"{source}, product"][0], expected, atol=loose)


def test_every_rule_gives_probabilities(beliefs):
    assert len(beliefs) == 6
    for p in beliefs.values():
        assert p.shape == (1, 4, 2)
        np.testing.assert_allclose(p.sum(-1), 1, atol=1e-5)
