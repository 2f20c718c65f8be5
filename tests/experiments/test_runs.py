"""Folders of runs."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from experiments.common.runs import begin


@dataclass(frozen=True)
class _Args:
    out: Path
    seed: int = 0


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
