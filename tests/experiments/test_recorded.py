"""Recorded touches as episodes: intervals of few episodes, and the skin that predicts them."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.recognize import __main__ as recognize
from experiments.recognize import report
from experiments.recognize.report import EpisodeResults
from i2t.hardware.rig import Rig
from i2t.skin_models.pad_model import load_pad_model


@pytest.mark.parametrize("episodes", [1, 2, 8])
def test_few_sessions_get_no_interval(episodes, capsys):
    truth = np.arange(episodes) % 2
    p = np.full((episodes, 3, 2), 0.5)
    right = np.arange(episodes) % 4 < 2  # every second one at the end
    p[:, 2] = np.where((np.eye(2)[truth] > 0) == right[:, None], 0.9, 0.1)
    sessions = np.array([f"run {i}" for i in range(episodes)])
    beliefs = dict.fromkeys(("fused", "readings"), p)
    parts = [{"recorded": EpisodeResults(("star", "mug"), truth, beliefs, None, "skin A", sessions)}]
    scores = report.score_set(report.pool_set(parts, "recorded"))
    fused = scores["methods"]["fused"]
    assert fused["accuracy"]["mean"] == [0.5, 0.5, 0.5 if episodes == 8 else 1.0]
    assert np.isfinite(fused["mean"]["low"]) == (episodes == 8)
    report.print_tables({"source": "real", **report.pads_of(parts, "sessions"), "sets": {"recorded": scores}})
    said = capsys.readouterr().out
    assert f"{episodes} sessions, 1 pads" in said
    assert "95 %, over sessions, for this pad" in said
    assert ("[" in said) == (episodes == 8)


REAL = ["live", "--arm", "ur", "--host", "127.0.0.1", "--skin", "reskin"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["live"], ('"simulated pad 0"', '"skin A"')),
        (REAL, ('the skin is "skin"', '"skin A"')),
        ([*REAL, "--pad-name", "skin B"], ('"skin B"', '"skin A"')),
        ([*REAL, "--pad-name", "skin A", "--board", "grid-4x4"], ("16 chips", "5 chips")),
        ([*REAL, "--pad-file", "b.npz"], ("--pad-file is for simulated and emulated skins",)),
    ],
)
def test_another_skin_is_refused_before_anything_moves(words, said, tmp_path, capsys):
    out, pad, rig = (tmp_path / name for name in ("live", "a.npz", "lab.toml"))
    known = load_pad_model("nominal")
    known._replace(origin=replace(known.origin, pad="skin A")).save(pad)
    Rig().write(rig)
    words = [*words, "--pad-model", str(pad), "--objects", "star", "hammer", "--rig", str(rig), "--out", str(out)]
    assert recognize.main(words) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert all(part in error for part in said)
    assert not out.exists()
