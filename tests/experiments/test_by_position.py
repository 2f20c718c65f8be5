"""Rows of a recording of one tip that are given its position and no image."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.baselines import placed_dataset

from experiments.train.by_position import CALIBRATED, TUNED, position_readings
from experiments.train.evaluation import Lead, MethodChoice, position_note
from i2t.dataset import Dataset, Split
from i2t.prediction.metrics import score

TOUCHES = 150


def recording() -> Dataset:
    """Presses at positions of a skin whose reading grows with the travel and is curved over the position."""
    rng = np.random.default_rng(0)
    place, travel = rng.uniform(-8e-3, 8e-3, (TOUCHES, 2)), rng.uniform(0.5e-3, 2e-3, TOUCHES)
    maps = np.sin(place @ rng.uniform(-400, 400, (2, 15)) + rng.uniform(0, 6, 15))
    readings = 40e3 * travel[:, None] * maps + rng.normal(0, 0.5, maps.shape)
    return placed_dataset(place, np.zeros((TOUCHES, 6, 6)), readings, travel=travel)


def thirds() -> Split:
    part = np.random.default_rng(1).permutation(np.arange(TOUCHES) % 5)
    return Split(part < 3, part == 3, part == 4, np.arange(TOUCHES) // 5, "block")


def test_both_rows_predict_the_touches_that_validate_and_test():
    dataset, split = recording(), thirds()
    rows = position_readings(dataset, split, 0)
    assert list(rows) == [TUNED, f"{CALIBRATED}, 90 of the presses"]
    truth = dataset.touches.reading[split.validation | split.test]
    for mean, std in rows.values():
        assert score(truth, mean).r2 > 0.8
        assert std.shape == mean.shape
        assert 0.6 < np.mean(np.abs(truth - mean) < 1.645 * std) < 1.0
    changed = replace(dataset, touches=dataset.touches._replace(reading=dataset.touches.reading.copy()))
    changed.touches.reading[split.validation | split.test] = 0.0
    for name, (mean, _) in position_readings(changed, split, 0).items():
        np.testing.assert_array_equal(mean, rows[name].mean)


@pytest.mark.parametrize("change", ["two objects", "off the skin", "no load"])
def test_touches_without_one_tip_at_known_positions_give_no_findings(change):
    dataset = recording()
    touches = dataset.touches
    if change == "two objects":
        dataset = replace(dataset, objects=("tip", "other"))
        touches = touches._replace(object=np.arange(TOUCHES) % 2)
    if change == "off the skin":
        touches.T_w_o[0, 0, 3] = 50e-3
    if change == "no load":
        touches.travel[np.flatnonzero(thirds().test)[0]] = np.nan  # of one touch to test
    assert position_readings(replace(dataset, touches=touches), thirds(), 0) == {}


def test_the_run_reports_where_position_alone_beats_every_method():
    level = Lead(0.1, 0.0, 0.2)
    choice = MethodChoice("GP", {"GP": 0.93, "mean": 0.0, TUNED: 0.92, CALIBRATED: 0.95}, "mean", level, "GP", level)
    [note] = position_note(choice, [TUNED, CALIBRATED])
    assert note.startswith(CALIBRATED)
    assert "(R2 0.950, GP 0.930)" in note
    assert position_note(choice, [TUNED]) == position_note(choice, []) == []
