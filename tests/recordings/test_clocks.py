"""Time stamps: damage is distinguished from a restarted clock, and rows of a coarse clock keep order and rate."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from i2t.errors import DataError
from i2t.recordings.clocks import check_stamps, even_times, row_clock

TIME = np.arange(400) * 0.01


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_sound_stamps_increase_until_the_clock_restarts(data):
    time = TIME + 1.7e9
    for _ in range(data.draw(st.integers(1, 4))):
        first, length = data.draw(st.integers(0, 399)), data.draw(st.integers(1, 90))
        time[first : first + length] += data.draw(st.sampled_from([-1e5, -3600.0, -0.5, 0.2, 3600.0]))
    verdict = check_stamps(time)
    ends = [0, *verdict.restarts.tolist(), len(time)]
    assert (np.diff(ends) >= 0).all()
    for start, end in pairwise(ends):
        assert (np.diff(time[start:end][~verdict.damaged[start:end]]) >= 0).all()


@given(first=st.integers(1, 390), length=st.integers(1, 60), by=st.sampled_from([-1e9, -60.0, 60.0, 1e9]))
@settings(max_examples=60, deadline=None)
def test_only_the_rows_that_stand_out_are_damaged(first, length, by):
    time = TIME.copy()
    time[first : first + length] += by
    away = np.zeros(400, bool)
    away[first : first + length] = True
    verdict = check_stamps(time)
    if first + length < 400:
        np.testing.assert_array_equal(verdict.damaged, away)
        assert not len(verdict.restarts)


def test_judging_rows_in_two_parts_gives_the_same_result():
    time = TIME.copy()
    time[[100, 240]] += 3600
    time[250:270] -= 50
    whole = check_stamps(time)
    first = check_stamps(time[:300], last=False)
    context = np.flatnonzero(~first.damaged)[-1]
    rest = check_stamps(np.concatenate([[time[context]], time[first.settled :]]), begun=True)
    np.testing.assert_array_equal(np.concatenate([first.damaged, rest.damaged[1:]]), whole.damaged)
    assert whole.damaged.sum() == 22


@pytest.mark.parametrize("resolution", [0.015625, 0.1, 1.0])
def test_rows_of_a_coarse_clock_are_evenly_spaced(resolution):
    stamps = np.floor(TIME / resolution) * resolution
    clock = row_clock(stamps, "a clock")
    np.testing.assert_allclose(clock.step, 0.01, rtol=0.02)
    even = even_times(stamps, clock)
    assert (np.diff(even) >= 0).all()
    assert np.abs(even - TIME).max() < resolution
    halves = [
        even_times(part, clock, shared)
        for part, shared in ((stamps[:203], 0), (stamps[203:], int(np.sum(stamps[:203] == stamps[203]))))
    ]
    np.testing.assert_allclose(np.concatenate(halves), even, atol=resolution / 10)


@pytest.mark.parametrize("rows", [2, 3, 25])
def test_rows_of_a_batch_get_the_times_at_which_they_were_measured(rows):
    within = np.arange(400) % rows
    arrived = TIME + 0.01 * (rows - 1 - within) + 2e-4 * within
    clock = row_clock(arrived, "a clock")
    np.testing.assert_allclose(clock.step, 0.01, rtol=0.02)
    np.testing.assert_allclose(even_times(arrived, clock), TIME, atol=0.011)


def test_lost_rows_and_a_changing_rate_are_not_batches():
    lost = TIME[np.random.default_rng(0).uniform(size=400) < 0.5]
    idle = np.concatenate([np.arange(100) * 0.2, 20 + np.arange(800) * 0.0025])
    for time in (lost, idle):
        assert row_clock(time, "a clock").within == 0
        np.testing.assert_array_equal(even_times(time, row_clock(time, "a clock")), time)


def test_a_clock_without_steps_determines_no_rate():
    for stamps in (np.float32(1.76e9 + TIME).astype(float), np.zeros(400)):
        clock = row_clock(stamps, "a clock")
        assert clock.assumed
        assert clock.by_rows
    with pytest.raises(DataError, match="a log goes back at 399 of 400 rows"):
        row_clock(TIME[::-1], "a log")
