"""The comparison of policies runs whole."""

import json

import pytest

from experiments.active_touch import run
from experiments.active_touch.__main__ import main
from experiments.active_touch.run import table
from i2t.intervals import Estimate
from i2t.recognition.rollout import POLICIES


@pytest.mark.full
def test_the_debug_preset_compares_policies(tmp_path, capsys, monkeypatch):
    """One policy represents all; each is played in tests/recognition/test_rollout.py."""
    monkeypatch.setattr(run, "POLICIES", {"random": POLICIES["random"]})
    assert main(["--preset", "debug", "--objects", "star", "hexagon", "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert report["source"] == "simulated"
    assert set(report["accuracy"]) == {"random"}
    for curve in report["accuracy"].values():
        assert len(curve) == 3
        assert all(low <= mean <= high for mean, low, high in curve)
    assert (tmp_path / "out" / "accuracy.png").exists()
    assert "| random |" in capsys.readouterr().out


def test_the_table_shows_some_touches_with_intervals():
    curve = Estimate(*([value] * 16 for value in (0.5, 0.4, 0.6)))
    lines = table({"random": curve}).splitlines()
    assert lines[-1] == "| random |" + " 0.50 [0.40, 0.60] |" * 8
