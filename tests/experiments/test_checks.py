"""What stands where a command looks for a run, a pad or a step is named, and a slip in a name is told."""

import json
from pathlib import Path

import pytest

from experiments.common.checks import finished_runs, require_pad
from tools.reproduce.__main__ import main as reproduce


def folder_with(path: Path, **files: object) -> Path:
    path.mkdir()
    for name, content in files.items():
        (path / f"{name}.json").write_text(json.dumps(content))
    return path


def test_a_folder_without_a_finished_run_is_named_for_what_it_is(tmp_path):
    done = folder_with(tmp_path / "done", config={"kind": "TrainArgs"}, metrics={})
    older = folder_with(tmp_path / "older", metrics={})  # before runs noted their kind
    assert finished_runs(done) == [done]
    assert finished_runs(older) == [older]
    (tmp_path / "mesh.stl").write_text("solid")
    for folder, why in (
        (tmp_path / "nowhere", r"holds no finished run; make one: python -m experiments.train --out \S+nowhere$"),
        (folder_with(tmp_path / "empty"), "make one"),
        (tmp_path / "mesh.stl", "is a file and holds no finished run; name the folder"),
        (folder_with(tmp_path / "data", touches={}), "but other files; name a folder that experiments.train wrote"),
        (folder_with(tmp_path / "begun", config={"kind": "TrainArgs"}), "was interrupted; .* --resume"),
        (
            folder_with(tmp_path / "calibrated", config={"kind": "CalibrateArgs"}, metrics={}),
            r"run of another command \(CalibrateArgs\)",
        ),
    ):
        with pytest.raises(ValueError, match=why):
            finished_runs(folder)


def test_a_slip_in_the_name_of_a_ready_model_or_a_step_is_told(capsys):
    with pytest.raises(ValueError, match=r"--pad nominl: .*; did you mean nominal\?$"):
        require_pad(Path("nominl"))
    require_pad(Path("nominal"))
    assert reproduce(["--only", "graps"]) == 2
    assert "there is no step graps; did you mean grasps?" in capsys.readouterr().err
    assert reproduce(["--only", "nothing"]) == 2
    assert "see their names with --list" in capsys.readouterr().err
