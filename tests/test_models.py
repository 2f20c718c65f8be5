"""The ready models: they load by name from the package alone, state their origin, and their cards are correct."""

import json
import re
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import i2t
from i2t import imagine, models
from i2t.errors import SerializationError
from i2t.models import READY_MODELS, model_card, ready_path
from i2t.simulation.touches import SimulationErrors
from i2t.skin.boards import make_board, name_of_board, same_board
from i2t.skin.pad import pad_from_seed
from i2t.skin_models.pad_model import load_pad_model
from tools.ready_models import SIZES, main

ROOT = Path(__file__).parents[1]
MAX_BYTES = 5_000_000  # of all together


def test_ready_models_are_small_and_part_of_the_package():
    folders = [Path(models.__file__).parent / name for name in READY_MODELS]
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < MAX_BYTES
    text = (ROOT / "pyproject.toml").read_text()
    for folder, parts in zip(folders, READY_MODELS.values(), strict=True):
        assert f'"models/{folder.name}/**"' in text
        assert all((folder / part).exists() for part in parts)


def test_a_user_s_folder_takes_precedence_over_a_ready_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert ready_path("nominal", "predictor").is_dir()
    assert ready_path("runs/train", "predictor") == Path("runs/train")
    Path("nominal").mkdir()
    assert ready_path("nominal", "predictor") == Path("nominal")


def test_the_ready_pad_model_is_of_simulated_pad_0():
    known = load_pad_model("nominal")
    card = model_card("nominal")
    assert (known.origin.pad, known.origin.source) == ("simulated pad 0", "simulated")
    assert list(known.origin.objects) == card["trained on"]
    assert known.model.r2 == pytest.approx(card["pad model"]["r2"])
    nominal = np.asarray(i2t.reskin_board().chips)  # but for the thickness of the pad over them
    assert np.asarray(known.board.chips)[:, :2] == pytest.approx(nominal[:, :2])


def test_the_card_in_the_docs_gives_the_figures_of_the_run():
    card, page = model_card("nominal"), (ROOT / "docs" / "model_card.md").read_text()
    start = (ROOT / "docs" / "start.md").read_text()  # which has the table, and the card links to it
    assert "(start.md#first-result-of-your-own)" in page
    assert card["source"] == "simulated"
    for name, scores in card["methods"].items():
        low, high = scores["r2_interval"]
        assert f"| {name} | {scores['r2']:.2f} [{low:.2f}, {high:.2f}] | {scores['rmse']:.2f} |" in start
    for said in (f"{card['pad model']['r2']:.2f}", f"{card['megabytes']} MB", *card["trained on"], *card["tested on"]):
        assert said in page
    assert not set(card["trained on"]) & set(card["tested on"])


def test_the_ready_calibration_is_of_one_real_skin_and_holds_no_press_of_it():
    calibration = i2t.load_calibration("eflesh")
    assert calibration.metadata["source"] == "real"
    presses = calibration.gp.presses
    assert len(np.unique(np.round(presses.loads, 6))) == SIZES.grid_travels  # a grid
    assert len(np.unique(np.round(presses.position, 6), axis=0)) == SIZES.grid_positions**2
    mean, std = calibration.predict([[0.0, 0.0]] * 2, [1e-3, 3e-3])
    assert (std > 0).all()
    assert np.linalg.norm(mean[1]) > 1.2 * np.linalg.norm(mean[0])  # deeper is stronger
    assert "Venkatesh Pattabiraman" in (Path(models.__file__).parent / "eflesh" / "LICENSE").read_text()
    with pytest.raises(SerializationError, match="nominal"):
        i2t.load_calibration("nominal")  # which has none


def test_the_card_of_the_calibration_gives_the_figures_of_its_run():
    card, page = model_card("eflesh"), (ROOT / "docs" / "model_card.md").read_text()
    assert card["source"] == "real"
    for name, scores in card["methods"].items():
        held = f" {scores['coverage_90']:.2f} |" if "coverage_90" in scores else " |"
        assert f"| {name} | {scores['r2']:.3f} | {scores['rmse']:.1f} |{held}" in page
    for said in (f"{card['megabytes']} MB", f"{card['presses']['test']} presses at {card['places']['test']} places"):
        assert said in page
    best_baseline = max(card["methods"][name]["r2"] for name in ("mean of 3 nearest of the 1000", "mean reading"))
    assert card["methods"]["small calibration"]["r2"] > best_baseline


@pytest.mark.full
def test_the_ready_calibration_is_what_its_command_makes(tmp_path, shared_data):
    session = shared_data / "eflesh/spatial/20250316_155729_probe"
    assert main(["--eflesh", str(session), "--out", str(tmp_path / "out")]) == 0
    made, card = json.loads((tmp_path / "out" / "metrics.json").read_text()), model_card("eflesh")
    for key in ("recording", "presses", "places", "grid", "range_mm"):
        assert made[key] == card[key]
    for name, scores in card["methods"].items():
        assert made["methods"][name] == pytest.approx(scores, rel=1e-2, abs=1e-3)


def test_the_board_is_the_one_that_the_predictor_was_trained_on(capsys):
    ready = i2t.load_predictor("nominal")
    assert name_of_board(ready.board) == "reskin"
    assert same_board(imagine._board(imagine.ImagineArgs(), ready), ready.board)
    assert same_board(imagine._board(imagine.ImagineArgs(board="reskin"), ready), ready.board)
    with pytest.raises(ValueError, match=r"--board eflesh differs from the board of .*nominal, reskin"):
        imagine._board(imagine.ImagineArgs(board="eflesh"), ready)
    assert not capsys.readouterr().out
    before = replace(ready, metadata={})  # as an earlier version wrote it
    assert same_board(imagine._board(imagine.ImagineArgs(board="eflesh"), before), make_board("eflesh"))
    assert "does not name its board; its readings are drawn at the chips of eflesh" in capsys.readouterr().out


def test_a_misspelt_ready_model_gets_a_suggestion(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for load, name, meant in (
        (i2t.load_pad_model, "Nominal", "did you mean nominal?"),
        (i2t.load_calibration, "eflsh", "did you mean eflesh?"),
        (i2t.load_calibration, "skin.npz", "or a ready model, eflesh"),
    ):
        with pytest.raises(SerializationError, match=re.escape(meant)):
            load(name)


@pytest.mark.full
def test_the_ready_predictor_predicts_touches(tmp_path, monkeypatch, capsys):
    """A new user calls it where no run was made before, so that the folder for its picture does not exist."""
    monkeypatch.chdir(tmp_path)
    assert imagine.main(["star", "--sites", "2"]) == 0
    assert "+-" in capsys.readouterr().out
    assert (tmp_path / "runs" / "imagine.png").stat().st_size > 10_000
    assert imagine.main(["star", "--sites", "1", "--board", "grid-2x2", "--out", str(tmp_path / "star.png")]) == 2


@pytest.mark.full
def test_the_ready_predictor_is_as_good_as_its_card_says():
    """It is tested on new simulated touches of an unseen object, with the pad and the errors of its training."""
    surface = i2t.prepare_surface(i2t.make_object("hammer").mesh)
    made = i2t.simulate_touches(jax.random.key(7), [surface], pad_from_seed(0), SimulationErrors(), 36)
    given = {"force": made.force, "nearest": made.nearest, "travel": made.travel, "view": made.view}
    reading = i2t.load_predictor("nominal").predict(made.patch, **given)
    truth = np.asarray(made.reading)
    off = truth - reading.mean
    assert np.mean(off**2) < 0.85 * np.mean((truth - truth.mean(0)) ** 2)
    assert 0.8 < np.mean(np.abs(off) < 1.645 * reading.std) <= 1
