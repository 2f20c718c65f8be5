"""Folders of runs."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from experiments.common.runs import begin, exit_code_of_run, settle_begun


@dataclass(frozen=True)
class _Args:
    out: Path
    seed: int = 0


@dataclass(frozen=True)
class _OtherArgs:
    out: Path


@dataclass(frozen=True)
class _Experiment:
    touches: int = 1


def test_a_run_goes_on_by_another_path_to_its_folder_but_not_with_other_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    begin(Path("run"), _Args(Path("run")), _Experiment(), False, False)
    begin(tmp_path / "run", _Args(tmp_path / "run"), _Experiment(), True, False)
    with pytest.raises(ValueError, match="begun with other settings"):
        begin(tmp_path / "run", _Args(tmp_path / "run", seed=1), _Experiment(), True, False)
    with pytest.raises(ValueError, match="holds an unfinished run"):
        begin(Path("run"), _Args(Path("run")), _Experiment(), False, False)


def test_a_run_that_is_refused_leaves_nothing_and_brings_back_what_it_was_to_replace(tmp_path, capsys):
    """Nothing made: no folder that blocks the next run; an earlier run stays as it was, also with --overwrite."""
    out = tmp_path / "run"

    def refused() -> None:
        begin(out, _Args(out), _Experiment(), False, False)
        raise ValueError("the data set is damaged")

    assert exit_code_of_run(refused, out) == 2
    assert not out.exists()

    begin(out, _Args(out), _Experiment(), False, False)
    (out / "metrics.json").write_text('{"r2": 0.9}')
    settle_begun()

    def refused_over() -> None:
        begin(out, _Args(out, seed=1), _Experiment(), False, True)
        raise ValueError("the data set is damaged")

    assert exit_code_of_run(refused_over, out) == 2
    assert (out / "metrics.json").read_text() == '{"r2": 0.9}'
    assert json.loads((out / "config.json").read_text())["args"]["seed"] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_run_that_is_refused_leaves_no_folder_that_was_made_for_it(tmp_path):
    (tmp_path / "mine").mkdir()
    begin(tmp_path / "runs" / "deep" / "run", _Args(tmp_path), _Experiment(), False, False)
    begin(tmp_path / "mine" / "run", _Args(tmp_path), _Experiment(), False, False)
    settle_begun()
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    begin(tmp_path / "runs" / "run", _Args(tmp_path), _Experiment(), False, False)
    (tmp_path / "runs" / "note.txt").touch()
    settle_begun()
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["note.txt"]


def test_a_run_that_made_something_takes_the_place_of_another(tmp_path):
    out = tmp_path / "run"
    for seed in (0, 1):

        def work(seed: int = seed) -> None:
            begin(out, _Args(out, seed=seed), _Experiment(), False, seed == 1)
            (out / f"metrics-{seed}.json").write_text("{}")

        assert exit_code_of_run(work, out) == 0
    assert sorted(path.name for path in out.iterdir()) == ["config.json", "metrics-1.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_folder_of_something_else_is_never_replaced(tmp_path, monkeypatch):
    """Neither one with another program's config.json, nor that of another experiment, nor the one we are in."""
    (tmp_path / "web").mkdir()
    (tmp_path / "web" / "config.json").write_text('{"port": 80}')
    with pytest.raises(ValueError, match="holds no run of this experiment"):
        begin(tmp_path / "web", _Args(tmp_path), _Experiment(), False, True)
    assert (tmp_path / "web" / "config.json").exists()

    begin(tmp_path / "run", _Args(tmp_path), _Experiment(), False, False)
    with pytest.raises(ValueError, match="holds no run of this experiment"):
        begin(tmp_path / "run", _OtherArgs(tmp_path), _Experiment(), False, True)
    monkeypatch.chdir(tmp_path / "run")
    with pytest.raises(ValueError, match="does not replace it"):
        begin(tmp_path / "run", _Args(tmp_path), _Experiment(), False, True)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="is a file"):
        begin(tmp_path / "web" / "config.json" / "run", _Args(tmp_path), _Experiment(), False, False)
    settle_begun()


def test_after_a_full_disk_and_ctrl_c_there_is_one_sentence_and_no_traceback(tmp_path, capsys):
    out = tmp_path / "run"
    for error, code, said in (
        (OSError(28, "No space left on device", "x.h5"), 1, "error: x.h5: no space left on device"),
        (KeyboardInterrupt(), 130, "interrupted; nothing was made"),
    ):

        def work(error: BaseException = error) -> None:
            begin(out, _Args(out), _Experiment(), False, False)
            raise error

        assert exit_code_of_run(work, out) == code
        assert capsys.readouterr().err.strip() == said
        assert not out.exists()

    def half() -> None:
        begin(out, _Args(out), _Experiment(), False, False)
        (out / "part-0.npz").write_bytes(b"")
        raise KeyboardInterrupt

    assert exit_code_of_run(half, out) == 130
    assert f"finished parts are in {out}, go on with --resume" in capsys.readouterr().err
