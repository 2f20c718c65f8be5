"""The commands `i2t fit` and `i2t recognize`: their files, what they print, and wrong options."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.baselines import placed_dataset

import i2t
from i2t.commands import fit, recognize
from i2t.models.finished import find_pad_model, read_run


@pytest.mark.full
def test_a_fit_writes_a_run_that_recognises(tmp_path, capsys, monkeypatch):
    out = tmp_path / "fit"
    assert fit.main(["nominal", "--method", "ridge-measured", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "180 touches (simulated). Split by object: 90 training (9 groups)" in said
    assert "60 touches of 2 objects in 6 sessions (simulated), none of them used in the fit" in said
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["counts"] == {"train": 90, "validation": 30, "test": 60}
    predictor = i2t.load_predictor(out)
    score = predictor.score(i2t.load_dataset("nominal"))
    assert metrics["methods"][metrics["best"]]["r2"] == pytest.approx(list(score.r2))
    assert (out / "agreement.png").stat().st_size > 1000
    assert find_pad_model(out) == (str(out / "pad_model.npz"), read_run(out))
    assert i2t.load_pad_model(out / "pad_model.npz").origin.pad == "simulated pad 0"

    words = ["nominal", "--pad-model", str(out), "--objects", "star", "hammer", "--touches", "3"]
    assert recognize.main([*words, "--poses", "4"]) == 0
    said = capsys.readouterr().out
    assert "18 sessions of 3 touches, 2 objects (simulated)" in said
    assert "cylinder (no candidate)" in said
    assert said.count("  used in the fit") == 9
    assert " of 3 sessions that were not used in the fit: " in said  # those of the star

    assert fit.main(["nominal", "--out", str(out)]) == 2
    assert "holds an earlier fit; pass --overwrite" in capsys.readouterr().err


def test_presses_of_one_tip_are_followed_by_a_calibration_and_others_by_predictions(monkeypatch):
    tip = placed_dataset(np.zeros((6, 2)), np.zeros((6, 48, 48)), np.zeros((6, 15)))
    args = fit.FitArgs(Path("DATA"), out=Path("OUT"))
    steps = "next: calibrate the skin for this tip: python -m experiments.calibrate --dataset DATA"
    assert fit._next_steps(args, tip, pad_model=True)[-1] == steps
    assert fit._next_steps(replace(args, skin_name="a"), tip, pad_model=True)[-1] == f"{steps} --skin-name a"
    monkeypatch.setattr(fit, "checkout", lambda: None)
    assert fit._next_steps(args, tip, pad_model=True)[-1].endswith("for this tip: i2t.calibrate")
    tip.touches.T_w_t[0, :3, :3] = np.diag([1.0, -1, -1])  # one press from another side
    touched = i2t.load_dataset("nominal")
    hammer = touched.select(touched.touches.object == touched.objects.index("hammer"))
    for other in (tip, touched, hammer):
        assert fit._next_steps(args, other, pad_model=False) == ["next: i2t imagine star --model OUT"]
    assert fit._next_steps(args, touched, pad_model=True)[1].strip() == "i2t recognize DATA --pad-model OUT"


def test_wrong_options_of_a_fit_are_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    (tmp_path / "file").write_text("a file")
    for words, reason in (
        (["nowhere"], "DATASET nowhere: there is no such data set; check the name"),
        (["nominl"], "DATASET nominl: there is no such data set; did you mean nominal?"),
        (["nominal", "--out", "mine", "--overwrite"], "--out mine: is not empty and holds no earlier fit"),
        (["nominal", "--out", "file"], "--out file: is a file; name a folder"),
        (["nominal", "--method", "best"], "there is no method best; choose mean"),
        (["nominal", "--unit", "mm"], "--unit is the unit of the mesh files of --objects"),
    ):
        assert fit.main(words) == 2
        assert reason in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]
    for words, reason in (
        (["--help"], "[OPTIONS] DATASET"),
        (["nominal", "--epochs", "3x"], "not a whole number; give one, without a unit"),
        (["nominal", "--epochs", "2.5"], "'2.5' is not a whole number"),
    ):
        with pytest.raises(SystemExit):
            fit.main(words)
        assert reason in " ".join("".join(capsys.readouterr()).replace("│", " ").split())


def test_wrong_options_of_a_recognition_are_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, reason in (
        (["nowhere"], "DATASET nowhere: there is no such data set"),
        (["nominal", "--pad-model", "none.npz"], "--pad-model none.npz: there is no such file"),
        (["nominal", "--objects", "star"], "--objects needs at least two objects"),
    ):
        assert recognize.main(words) == 2
        assert reason in capsys.readouterr().err
