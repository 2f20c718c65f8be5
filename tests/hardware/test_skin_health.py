"""A skin's health from samples at rest: healthy ones pass, and each defect is named by chip and axis."""

import numpy as np
import pytest
from scipy.signal import lfilter

from i2t.hardware.protocols import Samples
from i2t.hardware.skin_health import CONVERTER_RANGE_UT, check_skin, frozen_sentence, press_defect

STEPS = np.array([0.150, 0.150, 0.242])
SIGMA = np.array([3.1, 3.1, 4.6])
END_UT = CONVERTER_RANGE_UT[2]


def at_rest(seed=0, count=200, chips=5, rate=400.0):
    """Samples with the noise, slow field and steps of real boards."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-1 / rate)
    news = rng.standard_normal((count + 2000, 3)) * np.sqrt(1 - kept**2)
    slow = lfilter([1.0], [1.0, -kept], news, axis=0)[-count:] * np.sqrt(0.26) * SIGMA
    white = rng.standard_normal((count, chips, 3)) * np.sqrt(0.74) * SIGMA
    reading = np.rint((rng.normal(0, 300, (chips, 3)) + slow[:, None] + white) / STEPS) * STEPS
    celsius = 24.6 + 0.1 * rng.standard_normal((count, chips))
    return Samples(np.arange(count), np.arange(count) / rate, reading.reshape(count, -1), celsius)


def harmed(*harms):
    """Samples in which given parts (samples, chips, axes) are changed."""
    samples = at_rest()
    by_chip = samples.reading.reshape(200, 5, 3)
    for part, change in harms:
        by_chip[part] = change(by_chip[part])
    return samples


@pytest.mark.parametrize(
    ("chips", "count", "rate"), [(5, 200, 400.0), (1, 200, 400.0), (16, 200, 400.0), (5, 24, 10.0)]
)
def test_a_healthy_skin_has_no_defect(chips, count, rate):
    for seed in range(40):
        health = check_skin(at_rest(seed, count, chips, rate))
        assert health.defects == ()
        assert health.rate == pytest.approx(rate)


def test_a_coarse_converter_does_not_count_as_frozen():
    """eFlesh's boards count in steps sixteen times as large: with little noise an axis hardly changes."""
    for seed in range(20):
        samples = at_rest(seed)
        coarse = np.rint(samples.reading / np.tile(16 * STEPS, 5)) * np.tile(16 * STEPS, 5)
        assert not [defect for defect in check_skin(samples._replace(reading=coarse)).defects if defect.stops]


def frozen(values):
    return values[:1]


def clipped(values):
    return np.minimum(values - values.mean() + 4914, 4915)


@pytest.mark.parametrize(
    ("part", "change", "sentence", "stops"),
    [
        (np.s_[:, 2], np.zeros_like, "chip 2 sends zeros", True),
        (np.s_[:, 3], frozen, "chip 3 stands still along x, y, z", True),
        (np.s_[:, 1, 1], frozen, "chip 1 stands still along y", True),
        (np.s_[:, 4, 2], lambda x: END_UT, "chip 4 is at the end of its range along z, at 7930.0 uT", True),
        (np.s_[:, 0, 0], clipped, "chip 0 is at the end of its range along x", True),
        (np.s_[:], frozen, "every chip stands still", True),
        (np.s_[:], np.zeros_like, "every chip sends zeros", True),
        (np.s_[:, 1:4], lambda x: np.nan, "only 2 of 5 chips answer, without chip 1, chip 2, chip 3", True),
        # What makes readings worse stops nothing.
        (np.s_[:, 2, 0], lambda x: x + 12 * np.random.default_rng(1).standard_normal(200), "chip 2's x has 1", False),
    ],
)
def test_each_defect_is_one_sentence_and_serious_ones_stop_a_session(part, change, sentence, stops):
    samples = harmed((part, change))
    (defect,) = check_skin(samples).defects
    assert defect.sentence.startswith(sentence)
    assert defect.stops == stops


def test_two_defects_are_two_sentences_and_a_missing_chip_is_not_a_defect():
    assert len(check_skin(harmed((np.s_[:, 2], np.zeros_like), (np.s_[:, 1, 1], frozen))).defects) == 2
    health = check_skin(harmed((np.s_[:, 2], lambda x: np.nan)))
    assert (health.defects, health.missing) == ((), (2,))
    assert "without chip 2" in health.summary
    same = health._replace(temperature=np.float64([24.61, 24.62]), missing=())
    assert same.summary.endswith(", 24.6 C")
    assert same._replace(temperature=np.float64([24.6, 25.0])).summary.endswith(", 24.6 to 25.0 C")


@pytest.mark.parametrize("chips", [1, 5])
def test_a_board_without_any_change_in_24_samples_is_frozen(chips):
    for seed in range(100):
        reading = at_rest(seed, 24, chips).reading
        assert frozen_sentence(reading) == ""
        assert "did not change once in 24 samples" in frozen_sentence(np.tile(reading[0], (24, 1)))
        assert frozen_sentence(np.tile(reading[0], (23, 1))) == ""


def test_a_frozen_board_is_judged_by_the_chips_that_answer():
    still = np.tile(at_rest().reading[0], (40, 1))
    still[:, 3:6] = np.nan
    still[20:, 6:9] = np.nan
    assert "frozen" in frozen_sentence(still)
    still[30, 0] += 0.15  # one axis of one chip moves once
    assert frozen_sentence(still) == ""
    assert frozen_sentence(np.full((40, 15), np.nan)) == ""
    assert frozen_sentence(np.empty((0, 15))) == ""


def test_a_press_that_changes_nothing_is_a_defect():
    assert press_defect(np.full(15, 5.0), 2.0) == ""
    assert press_defect(np.zeros(15), 0.5) == ""  # too light to tell
    assert "changed its reading by 1.5 uT" in press_defect(np.append(np.full(9, 0.5), np.full(6, np.nan)), 2.0)
