"""A skin's health from samples at rest: healthy ones pass, and each defect is named by chip and axis."""

import subprocess
import sys

import numpy as np
import pytest
from helpers.closed_form import make
from scipy.signal import lfilter

from i2t.emulators import reskin_board
from i2t.errors import DeviceError
from i2t.hardware.protocols import Samples
from i2t.hardware.reskin import monitor
from i2t.hardware.skin_health import (
    CONVERTER_END_UT,
    check_skin,
    press_defect,
    require_healthy,
    rest_samples,
)

STEPS = np.array([0.150, 0.150, 0.242])
SIGMA = np.array([3.1, 3.1, 4.6])


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


def harmed(harm, **how):
    samples = at_rest(**how)
    by_chip = samples.reading.reshape(len(samples.number), -1, 3)
    harm(by_chip)
    return samples


def said(samples):
    return [defect.sentence for defect in check_skin(samples).defects]


@pytest.mark.parametrize(
    ("chips", "count", "rate"), [(5, 200, 400.0), (1, 200, 400.0), (16, 200, 400.0), (5, 24, 10.0)]
)
def test_a_healthy_skin_has_no_defect(chips, count, rate):
    for seed in range(40):
        health = check_skin(at_rest(seed, count, chips, rate))
        assert health.defects == ()
        assert health.rate == pytest.approx(rate)
        require_healthy(health, "the skin")


def test_a_coarse_converter_is_no_frozen_one():
    """eFlesh's boards count in steps sixteen times as large: with little noise an axis hardly changes."""
    for seed in range(20):
        samples = at_rest(seed)
        coarse = np.rint(samples.reading / np.tile(16 * STEPS, 5)) * np.tile(16 * STEPS, 5)
        assert not [defect for defect in check_skin(samples._replace(reading=coarse)).defects if defect.stops]


def _zeros(by_chip):
    by_chip[:, 2] = 0.0


def _frozen_chip(by_chip):
    by_chip[:, 3] = by_chip[0, 3]


def _frozen_axis(by_chip):
    by_chip[:, 1, 1] = by_chip[0, 1, 1]


def _saturated(by_chip):
    by_chip[:, 4, 2] = CONVERTER_END_UT[2]


def _clipped(by_chip):
    by_chip[:, 0, 0] = np.minimum(by_chip[:, 0, 0] - by_chip[:, 0, 0].mean() + 4914.0, 4915.0)


def _all_frozen(by_chip):
    by_chip[:] = by_chip[0]


def _all_dead(by_chip):
    by_chip[:] = 0.0


def _few_left(by_chip):
    by_chip[:, 1:4] = np.nan


@pytest.mark.parametrize(
    ("harm", "sentence"),
    [
        (_zeros, "chip 2 sends zeros"),
        (_frozen_chip, "chip 3's x, y and z stand still"),
        (_frozen_axis, "chip 1's y stands still"),
        (_saturated, "chip 4's z is at the end of its range, at 7930.0 uT"),
        (_clipped, "chip 0's x is at the end of its range"),
        (_all_frozen, "every axis of every chip stands still"),
        (_all_dead, "every chip sends zeros"),
        (_few_left, "only 2 of 5 chips answer, without chip 1, chip 2, chip 3"),
    ],
)
def test_readings_that_lie_stop_a_session_in_one_sentence(harm, sentence):
    samples = harmed(harm)
    (found,) = said(samples)
    assert found.startswith(sentence)
    with pytest.raises(DeviceError, match="cannot be used: " + sentence.split(",")[0]):
        require_healthy(check_skin(samples), "the skin on /dev/ttyACM0")


def test_two_defects_are_two_sentences_and_the_first_stops():
    def harm(by_chip):
        _zeros(by_chip)
        _frozen_axis(by_chip)

    samples = harmed(harm)
    assert len(said(samples)) == 2
    with pytest.raises(DeviceError, match=r"and 1 more"):
        require_healthy(check_skin(samples), "the skin")


def _noisy(by_chip):
    by_chip[:, 2, 0] += 12 * np.random.default_rng(1).standard_normal(len(by_chip))


def _step(by_chip):
    by_chip[120:, 3, 2] += 40.0


def _room_step(by_chip):
    by_chip[120:] += 40.0


@pytest.mark.parametrize(
    ("harm", "sentence"),
    [
        (_noisy, "chip 2's x has 1"),
        (_step, "chip 3's z made a step of 4"),
        (_room_step, "the field of most chips made a step"),
    ],
)
def test_what_makes_readings_worse_is_said_and_stops_nothing(harm, sentence):
    (found,) = said(harmed(harm))
    assert found.startswith(sentence)
    require_healthy(check_skin(harmed(harm)), "the skin")


def test_temperatures_are_those_of_a_lab():
    samples = at_rest()
    samples.temperature[:, 1] = 45.0
    assert said(samples) == ["chip 1 says 45 C where the others say 25; is it damaged?"]
    samples.temperature[:, 1] = 71.0
    assert "chip 1 says 71 C, outside" in said(samples)[0]
    samples.temperature[:] = np.nan  # framed formats tell none
    assert said(samples) == []


def test_a_missing_chip_is_named_and_is_no_defect():
    def harm(by_chip):
        by_chip[:, 2] = np.nan

    health = check_skin(harmed(harm))
    assert health.defects == ()
    assert health.missing == (2,)
    assert "without chip 2" in health.summary


def test_a_press_that_changes_nothing_is_a_defect():
    assert press_defect(np.full(15, 5.0), 2.0) == ""
    assert press_defect(np.zeros(15), 0.5) == ""  # too light to tell
    assert "changed its reading by 1.5 uT" in press_defect(np.append(np.full(9, 0.5), np.full(6, np.nan)), 2.0)


def test_a_slow_board_is_read_until_there_is_enough():
    procedure = make()
    skin, clock, sent = procedure.skin, procedure.clock, [0]

    def read_slowly(count, timeout=None):
        clock.sleep(count / 10)
        first, sent[0] = sent[0], sent[0] + count
        numbers = np.arange(first, first + count)
        return at_rest(count=count)._replace(number=numbers, time=numbers / 10)

    skin.read = read_slowly
    samples = rest_samples(skin, clock)
    assert len(samples.number) == 24
    assert check_skin(samples).rate == pytest.approx(10.0)


@pytest.mark.full
def test_the_monitor_says_what_is_wrong(capsys):
    with reskin_board.started("--noise", "3") as (port, _):
        assert monitor.main(["--port", port, "--seconds", "5"]) == 0
    assert "healthy at rest" in capsys.readouterr().out
    with reskin_board.started("--noise", "0") as (port, _):
        assert monitor.main(["--port", port, "--seconds", "5"]) == 0
    assert "UNHEALTHY: every axis of every chip stands still" in capsys.readouterr().out


def test_the_check_needs_no_jax():
    code = "import sys, i2t.hardware.skin_health\nassert 'jax' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
