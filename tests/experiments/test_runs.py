"""Folders of runs."""

import json
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest

from experiments.common.runs import begin, exit_code_of_run, settle_begun
from experiments.train.configs import Simulation
from i2t.simulation.site_limits import SiteLimits


@dataclass(frozen=True)
class _Args:
    out: Path
    seed: int = 0
    resume: bool = False
    overwrite: bool = False


@dataclass(frozen=True)
class _TableArgs:
    out: Path
    tables: tuple[Path, ...]
    resume: bool = False
    overwrite: bool = False


@dataclass(frozen=True)
class _OtherArgs(_Args):
    """Options of another experiment."""


@dataclass(frozen=True)
class _Presses:
    forces: tuple[float, float] = (1.0, 3.0)
    simulation: Simulation = field(default_factory=Simulation)


@dataclass(frozen=True)
class _Experiment:
    touches: int = 1


def begun(
    out: Path, seed: int = 0, resume: bool = False, overwrite: bool = False, args=_Args, raises=None, leaves=None
):
    """A run that begins, leaves a file, and raises."""
    begin(args(out, seed, resume, overwrite), _Experiment())
    if leaves:
        (out / leaves).write_text('{"r2": 0.9}')
    if raises is not None:
        raise raises


def test_a_run_resumes_by_another_path_to_its_folder_but_not_with_other_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    begun(Path("run"))
    begun(tmp_path / "run", resume=True)
    with pytest.raises(ValueError, match="begun with other settings"):
        begun(tmp_path / "run", seed=1, resume=True)
    with pytest.raises(ValueError, match="holds an unfinished run"):
        begun(Path("run"))


def test_a_run_does_not_resume_with_other_data_under_the_same_name(tmp_path):
    table, out = tmp_path / "t.csv", tmp_path / "run"
    table.write_text("what,u")
    begin(_TableArgs(out, (table,)), _Experiment())
    begin(_TableArgs(out, (table,), resume=True), _Experiment())
    table.write_text("what,v")
    with pytest.raises(ValueError, match="other settings or data"):
        begin(_TableArgs(out, (table,), resume=True), _Experiment())


def test_a_run_with_a_former_name_of_a_setting_is_continued(tmp_path):
    begin(_TableArgs(tmp_path / "run", ()), SiteLimits())
    path = tmp_path / "run" / "config.json"
    path.write_text(path.read_text().replace('"half_edge"', '"half"'))
    begin(_TableArgs(tmp_path / "run", (), resume=True), SiteLimits())
    with pytest.raises(ValueError, match="other settings or data"):
        begin(_TableArgs(tmp_path / "run", (), resume=True), SiteLimits(half_edge=5e-3))


def test_a_run_from_before_a_setting_existed_is_continued(tmp_path):
    begin(_TableArgs(tmp_path / "run", ()), _Presses())
    path = tmp_path / "run" / "config.json"
    about = json.loads(path.read_text())
    del about["experiment"]["forces"]
    about["experiment"]["simulation"]["judging"] = about["experiment"]["simulation"].pop("selection")
    path.write_text(json.dumps(about))
    begin(_TableArgs(tmp_path / "run", (), resume=True), _Presses())
    path.write_text(json.dumps(about))
    with pytest.raises(ValueError, match="other settings or data"):
        begin(_TableArgs(tmp_path / "run", (), resume=True), _Presses(forces=(2.0, 3.0)))


def test_a_run_that_is_refused_leaves_nothing_and_brings_back_what_it_was_to_replace(tmp_path):
    """No new folder blocks the next run, and an earlier run stays as it was, also with --overwrite."""
    out = tmp_path / "run"
    refused = ValueError("the data set is damaged")
    assert exit_code_of_run(partial(begun, out, raises=refused), out) == 2
    assert not out.exists()
    begun(out, leaves="metrics.json")
    settle_begun()
    assert exit_code_of_run(partial(begun, out, seed=1, overwrite=True, raises=refused), out) == 2
    assert (out / "metrics.json").read_text() == '{"r2": 0.9}'
    assert json.loads((out / "config.json").read_text())["args"]["seed"] == 0
    # One that makes something takes its place.
    assert exit_code_of_run(partial(begun, out, seed=1, overwrite=True, leaves="other.json"), out) == 0
    assert sorted(path.name for path in out.iterdir()) == ["config.json", "other.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_refused_run_leaves_no_new_folder(tmp_path):
    (tmp_path / "mine").mkdir()
    begun(tmp_path / "runs" / "deep" / "run")
    begun(tmp_path / "mine" / "run")
    settle_begun()
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    begun(tmp_path / "runs" / "run")
    (tmp_path / "runs" / "note.txt").touch()
    settle_begun()
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["note.txt"]


def test_a_folder_with_foreign_files_is_never_replaced(tmp_path, monkeypatch):
    """This includes a folder with another program's config.json, one of another experiment, and the current one."""
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "config.json").write_text('{"port": 80}')
    with pytest.raises(ValueError, match="holds no run of this experiment"):
        begun(tmp_path / "web", overwrite=True)
    assert (tmp_path / "web" / "config.json").exists()
    begun(tmp_path / "run")
    with pytest.raises(ValueError, match="holds no run of this experiment"):
        begun(tmp_path / "run", args=_OtherArgs, overwrite=True)
    monkeypatch.chdir(tmp_path / "run")
    with pytest.raises(ValueError, match="does not replace it"):
        begun(tmp_path / "run", overwrite=True)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="is a file"):
        begun(tmp_path / "web" / "config.json" / "run")
    settle_begun()


def test_after_a_full_disk_and_ctrl_c_there_is_one_sentence_and_no_traceback(tmp_path, capsys):
    out = tmp_path / "run"
    full = OSError(28, "No space left on device", "x.h5")
    for error, code, said in (
        (full, 1, "error: x.h5: no space left on device"),
        (KeyboardInterrupt(), 130, "interrupted; nothing was made"),
    ):
        assert exit_code_of_run(partial(begun, out, raises=error), out) == code
        assert capsys.readouterr().err.strip() == said
        assert not out.exists()
    assert exit_code_of_run(partial(begun, out, leaves="part-0.npz", raises=KeyboardInterrupt()), out) == 130
    assert f"finished parts are in {out}, go on with --resume" in capsys.readouterr().err
