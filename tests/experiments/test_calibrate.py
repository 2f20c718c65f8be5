"""The calibration experiment on a small synthetic skin, and its refusals."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers.baselines import placed_dataset

from experiments.calibrate import __main__ as command
from experiments.calibrate import arguments, methods, pad, prior_search, simulated, skins
from experiments.calibrate.evaluate import explained, learning_curves, over_blocks
from experiments.calibrate.held_out import EACH_PRESS, RANDOM, HeldOut, hold_out, share_masks
from experiments.train.configs import PRESETS as TRAINING
from experiments.train.configs import Simulation
from experiments.train.prepare import split_dataset
from experiments.train.sources import SimulatedSource
from i2t import dataset as data
from i2t import skin_models as calibration
from i2t.dataset import Dataset, square_blocks
from i2t.errors import DataError
from i2t.files import serialization
from i2t.intervals import grouped_interval
from i2t.recordings.loads import loaded_presses
from i2t.recordings.presses import LoadedPresses
from i2t.skin import boards
from i2t.skin.files import load_pad, load_pad_about, save_pad
from i2t.skin.pad import sample_pad
from i2t.skin_models import load_calibration
from i2t.skin_models.layer_fit import LayerPosterior
from i2t.skin_models.magnetic_layer import RoundTip, layer_prior
from i2t.skin_models.magnetization import PadFit
from i2t.skin_models.tip_gp.prior import PRIOR_KIND, KernelPrior, load_prior


def recording(n: int, pads: int = 1, **columns) -> Dataset:
    """Presses of one tip on a generated skin, some of whose columns may be replaced."""
    rng = np.random.default_rng(0)
    place, travel = rng.uniform(-12e-3, 12e-3, (n, 2)), rng.uniform(0.5e-3, 4e-3, n)
    centres = rng.uniform(-15e-3, 15e-3, (20, 2))
    g = np.exp(-((place[:, None] - centres) ** 2).sum(-1) / 2 / 9e-3**2) @ rng.normal(scale=60, size=(20, 15))
    reading = g * ((travel + 3e-3) / 5e-3)[:, None] ** 1.75 + rng.normal(size=(n, 15))
    known = {"nearest": -travel, "travel": travel, "pad": np.arange(n) % pads} | columns
    board = boards.eflesh_board()
    made = placed_dataset(place, np.zeros((n, 8, 8)), reading, board=board, source="simulated", **known)
    return replace(made, pads=tuple(f"skin {i}" for i in range(pads)))


@pytest.mark.full
def test_the_experiment_runs_and_is_not_overwritten(tmp_path, capsys):
    """For presses at few travels, `i2t.calibrate` is no worse than neighbours or the plain process."""
    travel = 1e-3 * np.round(1e3 * recording(400).touches.travel)
    data.save_dataset(tmp_path / "set.h5", recording(400, travel=travel, nearest=-travel))
    args = ["--dataset", str(tmp_path / "set.h5"), "--out", str(tmp_path / "out"), "--preset", "debug"]
    assert command.main(args) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["source"] == "simulated"
    assert metrics["warnings"] == []
    assert (tmp_path / "out" / "curves.png").stat().st_size > 1e4
    kept = load_calibration(tmp_path / "out" / "calibration.npz")
    assert kept.load_kind == "travel"
    assert kept.predict(np.zeros(2), 2e-3)[0].shape == (15,)
    assert set(metrics["r2"]["random presses"]) == {*methods.BASELINES, methods.CALIBRATED}
    assert metrics["kept"]["board_shares"] == kept.board_shares
    assert f"kept in calibration.npz: {kept.about_board}" in capsys.readouterr().out
    for by_method in metrics["r2"].values():
        for by_count in by_method.values():
            assert list(by_count) == ["5", "20"]
    r2 = metrics["r2"]["random presses"]
    best = max(r2[name]["20"]["mean"] for name in (methods.PLAIN, methods.NEIGHBOURS))
    assert r2[methods.CALIBRATED]["20"]["mean"] > best - 0.03
    assert metrics["differences"]["random presses"][f"{methods.CALIBRATED} - {methods.MEAN}"]["20"]["mean"] > 0
    capsys.readouterr()
    assert command.main(args) == 2
    assert "finished run" in capsys.readouterr().err


def test_held_out_presses_are_never_in_a_pool():
    cfg = arguments.PRESETS["paper"]
    presses = loaded_presses(recording(600), "auto")
    of_press = square_blocks(1e3 * presses.position, cfg.block_mm)
    held, blocks = share_masks(of_press, cfg, 0)
    assert held.sum() == 150
    cell = np.floor((1e3 * presses.position - (1e3 * presses.position).min(0)) / 6).astype(int)
    inside = {tuple(c) for c in cell[blocks]}
    assert inside.isdisjoint({tuple(c) for c in cell[~blocks]})
    again, _ = share_masks(of_press, cfg, 0)
    np.testing.assert_array_equal(held, again)
    (split,) = hold_out(presses, cfg, 0, np.ones(600, bool), "set").splits
    np.testing.assert_array_equal(split.tests[RANDOM], np.flatnonzero(held))
    np.testing.assert_array_equal(split.tests["blocks of 6 mm"], np.flatnonzero(blocks))
    np.testing.assert_array_equal(split.pool, np.flatnonzero(~held & ~blocks))


SPREAD = np.random.default_rng(1).uniform(-8e-3, 8e-3, (24, 2))
GRID = np.stack(np.meshgrid(*2 * [np.linspace(-8e-3, 8e-3, 5)]), -1).reshape(-1, 2)


def held_out_of(place: np.ndarray, usable: np.ndarray | None = None) -> HeldOut:
    """Presses at these positions by many travels, held out as in `experiments.calibrate`."""
    n = len(place)
    presses = LoadedPresses(place, np.linspace(1e-3, 3e-3, n), np.zeros((n, 15)), load_kind="travel")
    return hold_out(presses, arguments.PRESETS["paper"], 0, np.ones(n, bool) if usable is None else usable, "set")


@pytest.mark.parametrize(
    ("place", "also", "says"),
    [
        (SPREAD, "each block of 6 mm left out", "blocks of 6 mm is left out in turn, too"),
        (GRID, "each block of 6 mm left out", "9 blocks of 6 mm is left out in turn, too"),
        (GRID / 4, None, "each press has a place to itself"),  # all in one block
        (np.repeat(SPREAD[:5] / 4, 4, axis=0), "each place left out", "5 places is left out in turn, too"),
        (np.repeat(SPREAD[:2], 10, axis=0), "each place left out", "there is no interval: presses are in 2 places"),
        (np.zeros((20, 2)), None, "all 20 presses are at one place, so places cannot be left out"),
        (np.r_[np.zeros((15, 2)), SPREAD[:6]], None, "more than half of the 21 presses are at one place"),
        (SPREAD[:8], "each block of 6 mm left out", "8 presses are fewer than 60"),
    ],
)
def test_few_presses_are_left_out_in_turn_at_any_position(place, also, says):
    """Each press is predicted once from all others, and each block or position from all presses outside it."""
    held, every = held_out_of(place), np.arange(len(place))
    assert held.in_turn
    assert any(says in sentence for sentence in held.sentences), held.sentences
    assert set(held.tests) == {EACH_PRESS} | ({also} if also else set())
    for rows in held.tests.values():
        np.testing.assert_array_equal(np.sort(rows), every)
    for split in held.splits:
        (rows,) = split.tests.values()
        np.testing.assert_array_equal(np.sort(np.r_[rows, split.pool]), every)
        if also in split.tests:
            apart = np.linalg.norm(place[rows][:, None] - place[split.pool], axis=2)
            assert apart.min() > 0


@pytest.mark.parametrize("place", [np.zeros((100, 2)), np.random.default_rng(2).uniform(0, 5e-3, (100, 2))])
def test_many_presses_in_one_block_are_held_out_without_it(place):
    """With one position, no position is left out; with many positions in one block, some of these are."""
    held = held_out_of(place)
    assert not held.in_turn
    assert list(held.tests) == ([RANDOM, "places"] if place.any() else [RANDOM])
    (split,) = held.splits
    assert len(split.pool) >= 50
    assert "other places" in held.sentences[0] or "farther away" in held.sentences[0]


def test_unusable_presses_are_neither_trained_on_nor_held_out():
    usable = np.arange(24) != 5
    held = held_out_of(SPREAD, usable)
    assert not any(5 in np.r_[split.pool, *split.tests.values()] for split in held.splits)
    assert held.clusters.of_press[5] == -1
    assert "predicted from the 22 others" in held.sentences[0]


def test_too_few_or_equal_presses_are_refused_with_the_number_needed():
    with pytest.raises(ValueError, match=r"7 usable presses, too few .* 8 are enough .* some 20"):
        held_out_of(SPREAD[:7])
    alike = LoadedPresses(np.zeros((20, 2)), np.full(20, 1e-3), np.zeros((20, 15)), load_kind="travel")
    with pytest.raises(ValueError, match="one place and one travel, so they cannot predict other presses"):
        hold_out(alike, arguments.PRESETS["paper"], 0, np.ones(20, bool), "set")


def test_presses_left_out_in_turn_are_scored_as_one_test(monkeypatch):
    """The mean of the others misses each press by n / (n - 1) times its distance from the mean of all."""
    monkeypatch.setattr("experiments.calibrate.evaluate.BASELINES", {methods.MEAN: methods.mean})
    simple = lambda r, rows, test: (methods.mean(r, rows, test), np.ones((len(test), 15)))  # noqa: E731
    monkeypatch.setattr("experiments.calibrate.evaluate.calibrated", simple)
    readings = np.random.default_rng(0).normal(size=(24, 15))
    presses = LoadedPresses(SPREAD, np.linspace(1e-3, 3e-3, 24), readings, load_kind="travel")
    splits = hold_out(presses, arguments.PRESETS["paper"], 0, np.ones(24, bool), "set").splits
    scores = learning_curves(presses, splits, counts=(23,), draws=1, seed=0)
    assert scores.r2[EACH_PRESS][methods.MEAN][23] == pytest.approx([1 - (24 / 23) ** 2])
    assert len(scores.errors[EACH_PRESS][methods.MEAN][23][0]) == 24


@pytest.mark.full
@pytest.mark.parametrize("one_place", [False, True])
def test_few_presses_are_calibrated_from_the_command_line(tmp_path, capsys, one_place):
    recorded = recording(12)
    if one_place:
        T_w_o = np.repeat(recorded.touches.T_w_o[:1], 12, axis=0)
        recorded = replace(recorded, touches=recorded.touches._replace(T_w_o=T_w_o))
    data.save_dataset(tmp_path / "set.h5", recorded)
    assert command.main(["--dataset", str(tmp_path / "set.h5"), "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["held_out_in_turn"]
    over = metrics["calibrate_over_blocks"][EACH_PRESS]["r2"]["11"]
    assert (over["low"] is None) == one_place
    printed = capsys.readouterr().out
    assert "held out: 12 presses are fewer than 60" in printed
    assert ("places cannot be left out" in printed) == one_place
    assert load_calibration(tmp_path / "out" / "calibration.npz").load_kind == "travel"


@pytest.mark.parametrize(("n", "pads", "message"), [(400, 2, "several skins"), (7, 1, "8 are enough")])
def test_unusable_data_are_refused_for_calibration(tmp_path, capsys, n, pads, message):
    data.save_dataset(tmp_path / "set.h5", recording(n, pads))
    args = ["--dataset", str(tmp_path / "set.h5"), "--out", str(tmp_path / "out"), "--preset", "debug"]
    assert command.main(args) == 2
    assert message in capsys.readouterr().err


def test_intervals_over_blocks_are_those_of_whole_blocks():
    rng = np.random.default_rng(0)
    readings, block = rng.normal(size=(90, 15)), np.repeat([0, 1, 2], 30)
    error = 15 * rng.uniform(0, 1, 90) * np.array([0.01, 0.2, 0.5])[block]
    draws = [error * (1 + share) for share in (-0.5, 0.5)]  # whose mean is the error
    errors = {methods.CALIBRATED: {20: draws}, methods.PLAIN: {20: [2 * error]}}
    found = over_blocks(readings, errors, block)
    assert found["blocks"] == 3
    # Sums over whole blocks are resampled; the same of the presses themselves.
    ends = np.array(grouped_interval(lambda rows: explained(readings[rows], error[rows]), block))
    both = found["r2"][20]
    np.testing.assert_allclose([both["low"], both["high"]], np.minimum(ends, 1), rtol=1e-9)
    assert both["mean"] == pytest.approx(explained(readings, error))
    # Twice the error costs what the error itself explains less than all.
    gain = found["differences"][f"{methods.CALIBRATED} - {methods.PLAIN}"][20]
    np.testing.assert_allclose([gain["low"], gain["high"]], 1 - ends[::-1], rtol=1e-9)


NO_TRAVEL = {"travel": np.full(60, np.nan)}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"force": -np.linspace(4, 8, 60)} | NO_TRAVEL, "negative in 100 % of the presses"),
        ({"travel": np.zeros(60)}, "all presses have the same travel"),
        ({"force": np.r_[-1.0, np.linspace(1, 3, 59)]} | NO_TRAVEL, "1 presses with a negative force"),
    ],
)
def test_irregular_loads_are_reported_before_anything_is_computed(change, said):
    found = loaded_presses(recording(60, **change), "auto")
    assert said in found.notes[0]
    assert (found.load >= 0).all()
    assert loaded_presses(recording(60), "auto").notes == ()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"T_w_t": np.full((60, 4, 4), np.nan)}, "no press has a known position and travel"),
        ({"force": np.zeros(60)} | NO_TRAVEL, "every force is zero"),
    ],
)
def test_uninformative_loads_are_refused_at_once(change, said):
    with pytest.raises(ValueError, match=said):
        loaded_presses(recording(60, **change), "auto")


def test_a_pad_of_presses_is_fitted_by_force_and_kept_with_its_errors(tmp_path, capsys, monkeypatch):
    made = recording(60)
    made = replace(made, objects=("sphere:4.0",), touches=made.touches._replace(force=1e3 * made.touches.travel))
    data.save_dataset(tmp_path / "set.h5", made)
    fitted, given = sample_pad(jax.random.key(0)), {}

    def fitting(model, _, pressed):
        given.update(model=model, load=np.asarray(pressed.load), readings=np.asarray(pressed.reading))
        given.update(board=pressed.board)
        errors = np.full((60, len(fitted.gains)), 2.0)
        return PadFit(fitted, LayerPosterior(*3 * [layer_prior(len(fitted.gains)).median], True), errors, 1.5 * errors)

    monkeypatch.setattr(pad.MagnetizationModel, "fit", fitting)
    words = ["--dataset", str(tmp_path / "set.h5"), "--save-pad", str(tmp_path / "pad.npz")]
    assert command.main(words) == 0
    assert given["model"].tip == RoundTip("sphere", 4e-3)
    assert given["model"].by_force
    order, wanted = np.argsort(given["load"]), np.argsort(made.touches.force)
    np.testing.assert_allclose(given["load"][order], made.touches.force[wanted], rtol=1e-6)
    np.testing.assert_allclose(given["readings"][order], made.touches.reading[wanted], rtol=1e-5)
    np.testing.assert_allclose(given["board"].chips, boards.eflesh_board().chips, atol=1e-7)
    about = load_pad_about(tmp_path / "pad.npz")
    assert (about.name, about.made_from) == ("skin 0", ", fitted to 60 simulated presses")
    assert about.error_std == pytest.approx(3.0, rel=1e-3)  # at places left out
    spread = np.var(made.touches.reading, axis=0).sum()
    assert about.r2_places == pytest.approx(1 - 9 * len(fitted.gains) / spread, abs=1e-3)
    assert "thickness (mm)               2.5 [2.5, 2.5]" in capsys.readouterr().out
    np.testing.assert_array_equal(load_pad(tmp_path / "pad.npz").magnetization, fitted.magnetization)
    assert command.main(words) == 2
    assert "pass --overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(("r2", "refused"), [(0.49, True), (float("nan"), True), (0.51, False)])
def test_a_pad_that_does_not_explain_its_skin_is_refused_where_it_would_be_simulated(tmp_path, r2, refused):
    save_pad(tmp_path / "pad.npz", sample_pad(jax.random.key(0)), about={"presses": 60, "r2_places": r2})
    source = SimulatedSource(str(tmp_path / "pad.npz"), Simulation())
    if refused:
        with pytest.raises(ValueError, match=f"explains {r2:.2f} of the variance .* less than 0.5"):
            source.read_pad()
    else:
        assert source.read_pad()[1].r2_places == r2


def test_the_prior_of_the_package_is_what_the_search_makes_of_its_constants():
    _, about = serialization.load(Path(calibration.__file__).parent / "tip_gp" / "prior.npz", PRIOR_KIND, KernelPrior)
    cfg = prior_search.PRESETS["paper"]
    assert about["source"] == "simulated"
    assert about["seed"] == prior_search.POPULATION_SEED != simulated.SKINS_SEED
    assert tuple(about["kinds"]) == skins.SKIN_KINDS
    assert about["skins_of_each"] == cfg.skins
    assert about["candidates"] == cfg.wide + len(prior_search.ANCHORS) * cfg.anchored + cfg.second
    assert len(load_prior().kernels.load_power) == cfg.kept


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:the fitted board_offset is more than 3")  # the drawn board is that far off
@pytest.mark.parametrize("what", ["prior", "simulated", "recovery"])
def test_a_debug_run_without_presses_ends_with_its_results(what, tmp_path):
    assert command.main([f"--{what}", "--preset", "debug", "--out", str(tmp_path)]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    if what == "prior":
        assert (tmp_path / "prior.npz").stat().st_size < 100_000
    elif what == "recovery":
        # Board pose 5, tip 3, layer 4, gains 15, and stiffness or first contact.
        assert [part["inside_all"][1] for part in metrics["by_load"].values()] == [28, 28]
        assert all(part["inside_all"][0] > 14 for part in metrics["by_load"].values())
    else:
        assert set(metrics["cases"]["lattice, travel"]["r2"]) == {*methods.BASELINES, methods.CALIBRATED}


def test_a_split_of_too_few_touches_is_refused_with_the_numbers_needed():
    """For training, six presses in order of time leave one to test, but each part needs two."""
    with pytest.raises(DataError, match=r"of 6 usable touches, splitting by time leaves 1 to .*, which needs 2; .*"):
        split_dataset(recording(6), TRAINING["debug"], "time", 0)
