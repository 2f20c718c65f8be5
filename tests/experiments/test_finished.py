"""Folders of finished runs: their contents, the run or pad model that a path names, and messages about other paths."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.random_touches import make

from experiments.calibrate import __main__ as calibrate
from experiments.recognize import __main__ as recognize
from experiments.studies.arguments import StudyArgs
from i2t.dataset import save_dataset
from i2t.models.finished import (
    PAD_MODEL,
    TRAINING,
    FinishedRun,
    find_pad_model,
    finished_runs,
    read_run,
    require_pad_model,
    write_training,
)
from i2t.skin.files import save_pad
from i2t.skin.pad import nominal_pad
from tools.reproduce.__main__ import main as reproduce

PREDICTORS = {"predictor": "ridge", "on_pressure": "GP", "paper-network-depth": "paper's network, depth"}


def folder_with(path: Path, **files: object) -> Path:
    path.mkdir(parents=True)
    for name, content in files.items():
        (path / f"{name}.json").write_text(json.dumps(content))
    return path


def finished(path: Path, **about: object) -> FinishedRun:
    """The folder of a finished run without its arrays."""
    folder_with(path, config={"kind": "TrainArgs"}, metrics={})
    run = FinishedRun(path, **{"pad": 0, "predictors": PREDICTORS} | about)
    write_training(run)
    return run


def test_a_run_is_read_as_it_was_written(tmp_path):
    run = finished(tmp_path / "run", pad="skin.npz")
    assert read_run(run.folder) == run
    assert run.checkpoint("paper's network, depth") == run.folder / "checkpoint" / "paper-network-depth"
    assert run.checkpoint("paper's network, mask") is None
    assert run.on_pressure == run.folder / "checkpoint" / "on_pressure"
    assert replace(run, predictors={"predictor": "ridge"}).on_pressure == run.folder / "checkpoint" / "predictor"


def test_the_message_states_what_a_folder_without_a_finished_run_holds(tmp_path):
    done = finished(tmp_path / "done")
    assert finished_runs(done.folder) == finished_runs(done.folder / PAD_MODEL) == {0: done}
    (tmp_path / "mesh.stl").write_text("solid")
    damaged = finished(tmp_path / "damaged")
    (damaged.folder / TRAINING).write_text("{")
    (folder_with(tmp_path / "touches") / "one.h5").touch()
    for folder, why in (
        (tmp_path / "nowhere", r"holds no finished run; make one: python -m experiments.train --out \S+nowhere$"),
        (folder_with(tmp_path / "empty"), "make one"),
        (tmp_path / "mesh.stl", "is a file and holds no finished run; name the folder"),
        (
            folder_with(tmp_path / "data", touches={}),
            "but no finished run; name a folder that i2t fit or python -m experiments.train wrote$",
        ),
        (tmp_path / "touches", r"train on these touches: i2t fit \S+touches$"),
        (folder_with(tmp_path / "begun", config={"kind": "TrainArgs"}), "was interrupted; .* --resume"),
        (folder_with(tmp_path / "fit", config={"kind": "FitArgs"}), "was interrupted; repeat it with --overwrite"),
        (
            folder_with(tmp_path / "calibrated", config={"kind": "CalibrateArgs"}, metrics={}),
            r"run of another command \(CalibrateArgs\)",
        ),
        (folder_with(tmp_path / "older", metrics={}), "earlier version, which kept no pad model; make it again: "),
        (damaged.folder, r"training.json cannot be read .*; restore a copy, or train again"),
    ):
        with pytest.raises(ValueError, match=why):
            finished_runs(folder)


def test_pads_of_a_study_are_chosen_by_number_and_keep_theirs(tmp_path):
    for pad in (0, 1, 2):
        finished(tmp_path / f"pad-{pad}-seed-0", pad=pad)
    assert {i: run.folder.name for i, run in finished_runs(tmp_path, ("0", "2")).items()} == {
        0: "pad-0-seed-0", 2: "pad-2-seed-0"
    }  # fmt: skip
    assert list(finished_runs(tmp_path)) == [0, 1, 2]
    with pytest.raises(ValueError, match="has no run with pad 7; its pads are 0, 1, 2"):
        finished_runs(tmp_path, ("7",))
    with pytest.raises(ValueError, match=r"holds 3 pad models; name one, such as \S+pad-0-seed-0$"):
        find_pad_model(tmp_path)


def test_a_run_its_folder_and_its_file_name_one_pad_model(tmp_path):
    run = finished(tmp_path / "run")
    file = str(run.folder / PAD_MODEL)
    assert find_pad_model(run.folder) == find_pad_model(Path(file)) == (file, run)
    assert find_pad_model(Path("nominal")) == ("nominal", None)
    assert find_pad_model(run.folder / "pad.npz") == (str(run.folder / "pad.npz"), None)
    without = finished(tmp_path / "other", no_pad_model="the force was not measured")
    with pytest.raises(ValueError, match="other has no pad model: the force was not measured"):
        find_pad_model(without.folder)


def test_a_path_without_a_pad_model_is_refused_with_the_command_that_fits_one(tmp_path):
    require_pad_model(Path("nominal"))
    save_pad(tmp_path / "left.npz", nominal_pad())
    save_dataset(tmp_path / "session.h5", make(3, pixels=8))
    (tmp_path / "junk.npz").write_bytes(b"junk")
    for path, said in (
        (Path("nominl"), r"--pad-model nominl: .*; did you mean nominal\?$"),
        (tmp_path / "none.npz", "none.npz: there is no such file"),
        (tmp_path / "junk.npz", "is damaged"),
        (tmp_path / "left.npz", r"holds a pad; .* experiments.train --pad \S+left.npz"),
        (tmp_path / "session.h5", r"holds a data set; .* i2t fit \S+session.h5"),
        (tmp_path / "nowhere", "holds no finished run; make one"),
    ):
        with pytest.raises(ValueError, match=said):
            require_pad_model(path)


def test_a_run_on_recorded_touches_explains_why_no_episodes_are_simulated(tmp_path):
    run = finished(tmp_path / "run", pad=None)
    with pytest.raises(ValueError, match="trained on recorded touches, but simulated episodes need a simulated pad"):
        StudyArgs("mismatch", pad_model=run.folder).check()


@pytest.mark.parametrize("words", [["--trained-run", "runs/train"], ["live", "--pad=nominal"]])
def test_an_option_answers_with_its_new_name(words, capsys):
    assert recognize.main(words) == 2
    assert "is called --pad-model now" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--load", "depth"], ["--targets", "position", "depth"]])
def test_a_value_of_an_option_answers_with_its_new_name(words, capsys):
    assert calibrate.main(words) == 2
    assert f"{words[0]} depth is called {words[0]} travel now" in capsys.readouterr().err


def test_a_misspelt_step_gets_a_suggestion(capsys):
    assert reproduce(["--only", "graps"]) == 2
    assert "there is no step graps; did you mean grasps?" in capsys.readouterr().err
    assert reproduce(["--only", "nothing"]) == 2
    assert "see their names with --list" in capsys.readouterr().err


def test_recorded_touches_have_a_part_of_their_own_that_their_option_names(capsys):
    for words in ([], ["simulate"], ["dataset"]):
        assert recognize.main([*words, "--dataset", "nowhere"]) == 2
        assert "--dataset nowhere: there is no such data set" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            recognize.main([*words, "--dataset", "nowhere", "--episodes", "3"])
        assert "--episodes" in capsys.readouterr().err
