"""A fit from a data set alone: its split, what it records of its touches, its score on the others, and refusals."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers.baselines import placed_dataset, round_tip

import i2t
from i2t.errors import DataError
from i2t.models import model_card
from i2t.prediction import choose_split
from i2t.skin.boards import reskin_board
from i2t.types import ReturnCode


@pytest.fixture(scope="module")
def dataset():
    """160 presses of a round tip in 16 sessions, of which forces and positions determine the readings."""
    rng = np.random.default_rng(0)
    place, force = rng.uniform(-6e-3, 6e-3, (160, 2)), rng.uniform(0.5, 2.0, 160)
    board = reskin_board()
    near = np.exp(-((place[:, None] - np.asarray(board.chips)[:, :2]) ** 2).sum(-1) / 2 / 5e-3**2)
    reading = 40 * force[:, None] * np.repeat(near, 3, axis=1) + rng.normal(size=(160, 15))
    made = placed_dataset(
        place, round_tip(place, 48), reading, board=board, force=force, session=np.arange(160) // 10, source="real"
    )
    return replace(made, sessions=tuple(f"run {i}" for i in range(16)))


@pytest.fixture(scope="module")
def fitted(dataset):
    return i2t.fit_predictor(dataset, method="ridge-measured")


def test_a_fit_records_the_ranges_of_its_training_touches(dataset, fitted):
    """A flat face is unlike the round tip."""
    about, seen = fitted.metadata, dataset.select(choose_split(dataset).train).touches
    assert about["largest_reading"] == pytest.approx(abs(seen.reading).max())
    assert about["force_range"] == pytest.approx([seen.force.min(), seen.force.max()])
    depth = seen.patch.mean((1, 2))
    assert about["mean_depth_range"] == pytest.approx([depth.min(), depth.max()])
    with pytest.warns(UserWarning, match="patch has a mean depth of 0 mm"):
        fitted.predict(np.zeros((48, 48)), force=1.0, nearest=0.0)


def test_the_score_is_on_the_touches_that_the_fit_held_out(dataset, fitted):
    split = choose_split(dataset)
    score = fitted.score(dataset)
    assert (score.touches, score.used, score.source) == (split.test.sum(), 0, "real")
    assert score.groups == len(np.unique(dataset.touches.session[split.test]))
    assert score.r2 == fitted.score(dataset, split.test).r2 == fitted.score(dataset, np.flatnonzero(split.test)).r2
    assert score.r2.low < score.r2.mean < score.r2.high <= 1
    assert score.r2.mean > 0.8
    assert 0 <= score.coverage.low < score.coverage.high <= 1
    error = score.predicted.mean - dataset.touches.reading[split.test]
    assert score.rmse.mean == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-4)
    assert "none of them used in the fit" in str(score)
    assert f"{score.touches} touches of tip in {score.groups} sessions (real)" in str(score)
    assert score.to_json()["r2"] == list(score.r2)
    assert "measured" not in score.to_json()


def test_touches_of_the_fit_are_recognised_in_other_files_and_reported(dataset, fitted):
    split = choose_split(dataset)
    shuffled = dataset.select(np.random.default_rng(1).permutation(160))
    assert fitted.score(shuffled).touches == split.test.sum()
    used = dataset.select(split.train | split.validation)
    with pytest.raises(DataError, match="all its usable touches were used in the fit; give other touches"):
        fitted.score(used)
    again = fitted.score(used, np.arange(20))
    assert again.used == 20
    assert "20 OF THEM USED IN THE FIT, so this is not a test" in str(again)
    without = replace(fitted, metadata={**fitted.metadata, "used_touches": None})
    assert without.score(used).used is None
    assert "their use in the fit is unknown" in str(without.score(used))


def test_a_saved_predictor_keeps_its_record(dataset, fitted, tmp_path):
    fitted.save(tmp_path / "mine")
    loaded = i2t.load_predictor(tmp_path / "mine")
    assert loaded.score(dataset) == fitted.score(dataset)
    said = str(loaded)
    assert said.startswith("Predictor: ridge on PCA + measured (real)\n")
    assert f"fitted to {choose_split(dataset).train.sum()} touches of tip; tuned on" in said
    assert "predicts 15 values (uT) of 5 chips" in said


def test_standard_deviations_are_scaled_on_the_validation_touches(dataset, fitted):
    split = choose_split(dataset)
    score = fitted.score(dataset, split.validation)
    error = (score.predicted.mean - score.measured) / score.predicted.std
    assert np.sqrt(np.mean(error**2)) == pytest.approx(1, rel=1e-3)
    no_validation = replace(split, validation=np.zeros(160, bool))
    assert i2t.fit_predictor(dataset, no_validation, method="mean").std_scale == 1.0


def test_a_split_of_the_data_set_is_followed_where_touches_are_left_out(dataset):
    force = dataset.touches.force.copy()
    force[:5] = np.nan  # few enough to be left out
    code = np.where(np.arange(160) == 159, ReturnCode.AIR, dataset.touches.code)
    some = replace(dataset, touches=dataset.touches._replace(force=force, code=code))
    split = i2t.Split.hold_out(some, "session", validation=["run 14"], test=["run 15"])
    predictor = i2t.fit_predictor(some, split, method="mean")
    assert predictor.metadata["trained_on"]["training"] == 135
    assert predictor.metadata["notes"] == ["left out: 5 touches whose force is not known"]
    assert predictor.score(some).touches == 9  # without the press without contact, and those without a force
    assert str(split) == "Split by session: 140 training (14 groups), 10 validation (1 groups), 10 test (1 groups)"


def test_forces_of_the_other_sign_are_corrected_in_fit_and_score(dataset):
    pulled = replace(dataset, touches=dataset.touches._replace(force=-dataset.touches.force))
    predictor = i2t.fit_predictor(pulled, method="ridge-measured")
    assert "negative in 100 %" in predictor.metadata["notes"][0]
    assert predictor.default_force > 0
    assert predictor.score(pulled).r2.mean > 0.8
    assert predictor.score(dataset.select(choose_split(dataset).test)).r2.mean > 0.8


def test_the_former_order_of_arguments_and_other_boards_are_refused(dataset, fitted):
    key, split = jax.random.key(0), choose_split(dataset)
    with pytest.raises(TypeError):
        i2t.fit_predictor(key, dataset, split)
    with pytest.raises(TypeError):
        i2t.fit_predictor(dataset, split, key)
    place = np.zeros((40, 2))
    of_a_grid = placed_dataset(place, round_tip(place, 48), np.random.default_rng(0).normal(size=(40, 12)))
    parts = (np.arange(40) // 20 == part for part in (0, 1, 2))
    grid = i2t.fit_predictor(of_a_grid, i2t.Split(*parts, np.arange(40), "time"), method="mean")
    with pytest.raises(DataError, match="its board has 5 chips, and the predictor was fitted to another board with 4"):
        grid.score(dataset)
    with pytest.raises(DataError, match="patches cover 20 mm"):
        fitted.score(replace(dataset, window=20e-3))
    with pytest.raises(ValueError, match="has 160 touches, but the data set 40; split this data set"):
        i2t.fit_predictor(dataset.select(slice(40)), split)


@pytest.mark.full
def test_the_default_fit_of_the_shipped_touches_scores_as_the_card_states():
    dataset, card = i2t.load_dataset("nominal"), model_card("nominal")["data set"]
    assert (len(dataset), len(dataset.sessions), list(dataset.objects)) == (
        card["touches"], card["sessions"], card["objects"]
    )  # fmt: skip
    score = i2t.fit_predictor(dataset).score(dataset)
    assert score.objects == tuple(card["fit"]["objects"])
    assert score.r2.mean == pytest.approx(card["fit"]["r2"][0], abs=0.02)
