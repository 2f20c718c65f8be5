"""Collected, trained, recognised: the very commands of docs/collecting.md, with fewer touches."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from i2t import dataset

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"## From touches to recognition\n.*?```\n(.*?)```", re.S)
SMALLER = {
    "for s in 1 2 3 4": "for s in 1",
    "for s in 1 2;": "for s in 1;",
    "--touches 36": "--touches 22",
    "star square cylinder screwdriver hammer": "star hammer",
    "--touches 10": "--touches 3",
    "experiments.train": "experiments.train --preset debug --epochs 2",
    "experiments.recognize --dataset": "experiments.recognize --preset debug --dataset",
    "live --trained-run": "live --num-sites 3 --num-particles 8 --max-touches 2 --trained-run",
}


def block() -> str:
    """The commands as they are printed."""
    found = BLOCK.search((ROOT / "docs" / "collecting.md").read_text())
    assert found
    return found[1]


def test_the_block_has_what_is_made_smaller():
    for words in SMALLER:
        assert words in block(), words


@pytest.mark.full
def test_what_is_collected_is_trained_on_and_recognised(tmp_path):
    """With simulated devices; with emulated ones a touch takes its time (tests/collect/test_emulated_lab.py)."""
    commands = block().replace("python -m", f"{sys.executable} -m")
    for words, fewer in SMALLER.items():
        commands = commands.replace(words, fewer)
    env = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    done = subprocess.run(["bash", "-e", "-c", commands], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert 'training touches of hexagon, parallelogram (simulated) make a pad model of "simulated pad 0"' in done.stdout
    metrics = json.loads((tmp_path / "runs" / "recognized" / "metrics.json").read_text())
    assert metrics["source"] == "simulated"
    assert metrics["pad_model"]["pad"] == "simulated pad 0"
    assert metrics["pad_model"]["objects"] == ["hexagon", "parallelogram"]
    assert metrics["pad_model"]["other_skin"] is None
    recorded = metrics["sets"]["recorded"]
    assert recorded["episodes_of"] == {"hammer": 1, "star": 1}
    assert recorded["methods"]["fused"]["mean"]["low"] is None
    assert "too few episodes for an interval" in done.stdout
    assert len(dataset.load_dataset(tmp_path / "DATA" / "new")) == 6
    live = json.loads((tmp_path / "runs" / "live" / "result.json").read_text())
    assert live["pad_model"]["made_from"] == "runs/collected"
    assert live["true_object"] == "hammer"
