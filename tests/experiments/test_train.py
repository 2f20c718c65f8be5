"""The whole of `python -m experiments.train` on the debug preset: its results, its predictor, its manners, killed and
resumed.
"""

import json
import os
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import i2t
from experiments.train import run as train
from i2t import dataset
from i2t.errors import CheckpointError
from i2t.skin.files import save_pad
from i2t.skin.pad import nominal_pad


@pytest.fixture(scope="module")
def finished(trained_run):
    return trained_run


def numbers(out):
    metrics = json.loads((out / "metrics.json").read_text())
    return {**metrics, "seconds": None}


def test_the_run_leaves_what_it_promises(finished):
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["source"] == "simulated"
    assert metrics["counts"] == {"train": 36, "validation": 8, "test": 16}
    assert set(metrics["by_object"]) == {"star", "hammer"}
    for values in metrics["methods"].values():
        low, high = values["r2_interval"]
        assert low <= values["r2"] <= high or metrics["groups"] < 3
    config = json.loads((finished / "config.json").read_text())
    assert config["versions"]["jax"]
    assert config["experiment"]["simulation"]["touches"] == 60
    pictures = {path.name for path in finished.glob("*.png")}
    assert pictures >= {"scores.png", "training.png", "error_per_axis.png", "touches_typical.png", "touches_worst.png"}


def test_readings_explained_without_errors_are_better_explained(finished):
    """The ceiling knows the contact; a camera with noise cannot beat it by more than the scatter of 16 touches."""
    methods = json.loads((finished / "metrics.json").read_text())["methods"]
    assert methods[train.CEILING]["r2"] > methods["mean reading"]["r2"]
    assert methods[train.CEILING]["r2"] > methods[train.PROCESS]["r2"]


def test_reported_scores_are_the_predictors_own(finished):
    """What a user gets from load_predictor on the test touches is what the table says."""
    metrics = json.loads((finished / "metrics.json").read_text())
    touches = dataset.load(finished / "data.h5")
    rows = np.isin([touches.objects[i] for i in touches.touches.object], ["star", "hammer"])
    chosen = touches.touches
    seen = i2t.load_predictor(finished).predict(chosen.patch[rows], force=chosen.force[rows], wide=chosen.wide[rows])
    truth = chosen.reading[rows]
    rmse = np.sqrt(((seen.mean - truth) ** 2).mean())
    assert rmse == pytest.approx(metrics["methods"][metrics["best"]]["rmse"], rel=1e-4)
    assert seen.std.min() > 0


def test_a_finished_run_is_not_overwritten(finished, capsys):
    before = (finished / "metrics.json").read_bytes()
    assert train.main(["--preset", "debug", "--out", str(finished)]) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert (finished / "metrics.json").read_bytes() == before


def test_killed_and_resumed_equals_uninterrupted(finished, tmp_path, capsys):
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "experiments.train", "--preset", "debug", "--out", str(out)]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env={**os.environ, "MPLBACKEND": "agg"}
    )
    while process.poll() is None and not (out / "checkpoint").exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (out / "metrics.json").exists()

    assert train.main(["--preset", "debug", "--out", str(out)]) == 2
    assert "pass --resume" in capsys.readouterr().err
    assert train.main(["--preset", "debug", "--seed", "1", "--out", str(out), "--resume"]) == 2
    assert "other settings" in capsys.readouterr().err
    assert train.main(["--preset", "debug", "--out", str(out), "--resume"]) == 0
    assert numbers(out) == numbers(finished)


def test_a_data_set_trains_as_well(finished, tmp_path):
    """The set that the first run simulated, given back as --dataset, split by run this time."""
    out = tmp_path / "again"
    arguments = ["--preset", "debug", "--dataset", str(finished / "data.h5"), "--split", "run", "--out", str(out)]
    assert train.main(arguments) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["split"] == "run"
    assert metrics["source"] == "simulated"


@pytest.mark.parametrize(
    ("arguments", "words"), [(["--dataset", "/nowhere"], "nowhere"), (["--epochs", "0"], "epochs")]
)
def test_wrong_arguments_get_one_sentence(arguments, words, tmp_path, capsys):
    assert train.main(["--preset", "debug", "--out", str(tmp_path / "x"), *arguments]) == 2
    message = capsys.readouterr().err
    assert words in message
    assert len(message.strip().splitlines()) == 1


def test_there_is_no_predictor_in_an_empty_folder(tmp_path):
    with pytest.raises(CheckpointError, match="holds no predictor"):
        i2t.load_predictor(tmp_path)


def test_a_pad_on_disk_takes_the_place_of_a_random_one(tmp_path, capsys, monkeypatch):
    kept = nominal_pad()._replace(young=jnp.asarray(123e3))
    save_pad(tmp_path / "pad.npz", kept)
    pressed = []

    def simulate(key, surfaces, pad, *others, **named):
        pressed.append(pad)
        raise ValueError("seen enough")

    monkeypatch.setattr(train.world, "simulate", simulate)
    arguments = ["--preset", "debug", "--out", str(tmp_path / "run"), "--pad"]
    assert train.main([*arguments, str(tmp_path / "pad.npz")]) == 2
    jax.tree.map(np.testing.assert_allclose, pressed[0], kept)
    assert "seen enough" in capsys.readouterr().err
    assert train.main([*arguments, str(tmp_path / "none.npz"), "--overwrite"]) == 2
    assert "none.npz" in capsys.readouterr().err
    assert train.main([*arguments, str(tmp_path / "pad.npz"), "--dataset", str(tmp_path), "--overwrite"]) == 2
    assert "--pad is for simulated touches" in capsys.readouterr().err
