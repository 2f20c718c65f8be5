"""Presses are segmented from streams at any rate, simulated and real."""

import numpy as np
import pytest

from i2t.recordings.segmentation import segment_presses

RATE, NOISE = 400.0, 1.5


def stream(seed: int, amplitude: float, presses: int = 8, drift: float = 4.0, channels: int = 15):
    """Presses with ramps on a drifting, noisy rest: times, rows, and where each begins and ends and its level."""
    rng = np.random.default_rng(seed)
    rows, spans, levels, at = np.zeros((int(RATE * (2 + 3 * presses)), channels)), [], [], int(0.8 * RATE)
    for _ in range(presses):
        ramp, hold = int(RATE * rng.uniform(0.08, 0.3)), int(RATE * rng.uniform(0.3, 1.0))
        level = amplitude * rng.normal(size=channels)
        shape = np.concatenate([np.linspace(0, 1, ramp), np.ones(hold), np.linspace(1, 0, ramp)])
        rows[at : at + len(shape)] += shape[:, None] * level
        spans.append((at, at + len(shape)))
        levels.append(level)
        at += len(shape) + int(RATE * rng.uniform(0.25, 0.5))
    rows = rows[: at + int(0.5 * RATE)]
    ambient = 500 * rng.normal(size=channels) + np.linspace(0, drift, len(rows))[:, None] * rng.normal(size=channels)
    return np.arange(len(rows)) / RATE, rows + ambient + NOISE * rng.normal(size=rows.shape), spans, np.array(levels)


@pytest.mark.parametrize("amplitude", [5.0, 40.0, 400.0])
def test_presses_of_a_stream_are_found_with_their_ends_and_levels(amplitude):
    time, readings, spans, levels = stream(3, amplitude)
    presses = segment_presses(time, readings)
    assert len(presses.start) == len(spans)
    late = 0.1 * RATE if amplitude < 10 else 0.02 * RATE + 1  # a weak press leaves the noise late on its ramp
    np.testing.assert_allclose(np.column_stack([presses.start, presses.end]), spans, atol=late)
    # The median of 60 rows or more on a drift of a few uT over the whole stream.
    assert np.abs(presses.reading - levels).mean() < 0.5
    assert (presses.steady_start >= presses.start).all()
    assert (presses.steady_end <= presses.end).all()
    np.testing.assert_allclose(presses.start_time, time[presses.start])


def test_noise_and_drift_at_rest_are_not_presses():
    for seed in range(5):
        time, readings, *_ = stream(seed, 0.0, drift=10.0)
        assert len(segment_presses(time, readings).start) == 0


def test_a_skin_that_stays_displaced_has_a_new_rest():
    time, readings, spans, levels = stream(1, 60.0)
    after = spans[2][1]
    readings[after:] += 0.08 * levels[2]  # eight in a hundred stay, as on a real lattice
    presses = segment_presses(time, readings)
    assert len(presses.start) == len(spans)
    np.testing.assert_allclose(presses.reading[3], levels[3], atol=2.0)
    np.testing.assert_allclose(presses.baseline[3] - presses.baseline[2], 0.08 * levels[2], atol=2.0)


def test_a_recording_that_begins_pressed_loses_only_that_press():
    time, readings, spans, levels = stream(4, 60.0)
    begin = (spans[0][0] + spans[0][1]) // 2
    presses = segment_presses(time[begin:], readings[begin:])
    np.testing.assert_allclose(presses.reading, levels[1:], atol=2.0)


def test_a_press_held_too_long_hides_no_other():
    time, readings, spans, levels = stream(5, 60.0)
    middle = (spans[3][0] + spans[3][1]) // 2
    rows = readings[np.r_[:middle, np.full(int(70 * RATE), middle), middle : len(time)]]
    rows[middle : middle + int(70 * RATE)] += NOISE * np.random.default_rng(0).normal(size=(int(70 * RATE), 15))
    presses = segment_presses(np.arange(len(rows)) / RATE, rows)
    np.testing.assert_allclose(presses.reading, np.delete(levels, 3, axis=0), atol=2.0)


def test_spikes_change_no_press_and_three_rows_are_too_short_for_one():
    time, readings, _, levels = stream(6, 60.0)
    rng = np.random.default_rng(0)
    spiked = rng.uniform(size=len(time)) < 0.005
    presses = segment_presses(time, readings + spiked[:, None] * 500 * rng.normal(size=readings.shape))
    np.testing.assert_allclose(presses.reading, levels, atol=2.0)
    short = NOISE * rng.normal(size=(200, 15))
    for at in range(20, 200, 20):
        short[at : at + 3] += 60
    assert len(segment_presses(np.arange(200) / 25, short).start) == 9


def test_one_weak_chip_is_enough_at_any_rate():
    time, readings, spans, _ = stream(2, 0.0, channels=48)
    rows = np.zeros(len(time))
    for start, end in spans:
        rows[start:end] = 30.0
    readings[:, 7] += rows
    assert len(segment_presses(time, readings).start) == len(spans)
    some = slice(None, None, 16)  # 25 rows a second, unevenly
    jitter = time[some] + 0.01 * np.random.default_rng(0).uniform(size=len(time[some]))
    assert len(segment_presses(jitter, readings[some]).start) == len(spans)


def test_invalid_recordings_are_refused():
    time, readings, *_ = stream(0, 10.0, presses=1)
    back, damaged = time.copy(), np.where(readings > 500, np.nan, readings)
    back[4] = 0.0
    for times, rows, word in (
        (time[:-1], readings, "do not form a recording"),
        (back, readings, "at row 5"),
        (time, damaged, "non-finite"),
    ):
        with pytest.raises(ValueError, match=word):
            segment_presses(times, rows)


def test_ten_real_strokes_are_ten_presses(shared_data):
    """A probe goes 12 mm down and up ten times; raw rows of the sensor, without any label."""
    folder = shared_data / "eflesh" / "normal" / "20250401_014340_probe"
    sensor, states = (np.loadtxt(folder / f"{name}.csv.gz", delimiter=",") for name in ("sensor", "states"))
    height = states[:, 3]
    presses = segment_presses(sensor[:, 0] - sensor[0, 0], sensor[:, 1:])
    assert len(presses.start) == 10
    for press in range(10):
        rows = slice(presses.start[press], presses.end[press])
        steady = slice(presses.steady_start[press], presses.steady_end[press])
        assert height[rows].min() < height.min() + 0.1
        assert height[steady].max() < height.min() + 1.0  # steady at the bottom
        assert height[rows.start] > height.max() - 2.0  # the tip meets the skin in the stroke's first tenths
        assert height[rows.stop] > height.max() - 2.0
