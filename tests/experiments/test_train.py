"""The whole of `python -m experiments.train` on the debug preset: its results, its predictor, its manners, killed and
resumed.
"""

import json
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import i2t
from experiments.train import run as train
from experiments.train import simulate
from experiments.train.reports import print_table, summarise
from experiments.train.splitting import Split
from i2t import dataset
from i2t.errors import CheckpointError
from i2t.prediction.gp import ContactPressure
from i2t.prediction.metrics import Score, score
from i2t.prediction.predictor import Predictor, PressureNetwork, Reading, TouchBatch
from i2t.prediction.pressure import PressureModelConfig
from i2t.skin.boards import grid_board
from i2t.skin.files import save_pad
from i2t.skin.pad import nominal_pad, sample_pad


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
    assert metrics["groups"] == 2
    for values in metrics["methods"].values():
        # Two groups drawn with replacement are both of them every second time: R2 itself is among the draws.
        low, high = values["r2_interval"]
        assert low <= values["r2"] <= high
        assert low < high
    config = json.loads((finished / "config.json").read_text())
    assert config["versions"]["jax"]
    assert config["experiment"]["simulation"]["touches"] == 60
    pictures = {path.name for path in finished.glob("*.png")}
    assert pictures >= {"scores.png", "training.png", "error_per_axis.png", "touches_typical.png", "touches_worst.png"}


def test_readings_explained_without_errors_are_better_explained(finished):
    """The ceiling knows the contact; a camera with noise cannot beat it by more than the scatter of 16 touches."""
    methods = json.loads((finished / "metrics.json").read_text())["methods"]
    assert methods[train.CEILING]["r2"] > methods["mean reading"]["r2"]
    assert methods[train.CEILING]["r2"] > methods[train.GP_METHOD]["r2"]


def test_reported_scores_are_the_predictors_own(finished):
    """What a user gets from load_predictor on the test touches is what the table says."""
    metrics = json.loads((finished / "metrics.json").read_text())
    touches = dataset.load_dataset(finished / "data.h5")
    rows = np.isin([touches.objects[i] for i in touches.touches.object], ["star", "hammer"])
    chosen = touches.touches
    seen = i2t.load_predictor(finished).predict(chosen.patch[rows], force=chosen.force[rows], wide=chosen.wide[rows])
    truth = chosen.reading[rows]
    kept = metrics["methods"][metrics["best"]]
    sessions = chosen.session[rows]
    drawn = [np.flatnonzero(sessions == session) for session in np.unique(sessions)]
    drawn.append(np.concatenate(drawn))
    r2 = [score(truth[one], seen.mean[one]).r2 for one in drawn]
    assert kept["r2_interval"] == pytest.approx([min(r2), max(r2)], abs=1e-4)
    rmse = np.sqrt(((seen.mean - truth) ** 2).mean())
    assert rmse == pytest.approx(metrics["methods"][metrics["best"]]["rmse"], rel=1e-4)
    assert seen.std.min() > 0


def test_a_finished_run_is_not_overwritten(finished, capsys):
    before = (finished / "metrics.json").read_bytes()
    assert train.main(["--preset", "debug", "--out", str(finished)]) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert (finished / "metrics.json").read_bytes() == before


@pytest.mark.full
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


@pytest.mark.full
def test_a_data_set_trains_as_well(finished, tmp_path):
    """The set that the first run simulated, given back as --dataset, split by session this time."""
    out = tmp_path / "again"
    arguments = ["--preset", "debug", "--dataset", str(finished / "data.h5"), "--split", "session", "--out", str(out)]
    assert train.main(arguments) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["split"] == "session"
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


class Foretold(PressureNetwork):
    """A model that gives the readings it is told to, whatever it is asked."""

    def predict_batch(self, touches: TouchBatch) -> Reading:
        return self.network


def foretold(mean: np.ndarray) -> Predictor:
    std = np.ones_like(mean)
    return Predictor(Foretold(Reading(mean, std), PressureModelConfig(pitch=1e-3)), 17e-3, 4e-3, 1.0, 3e-4)


def test_the_predictor_is_chosen_on_validation_touches_and_scaled_on_them():
    """Of two, one is right about the validation touches (rows 4 to 7) and the other about the test touches."""
    rng = np.random.default_rng(0)
    readings = rng.normal(size=(12, 6))
    blank, nothing = np.zeros((12, 4, 4)), np.zeros(12)
    touches = SimpleNamespace(
        reading=readings, patch=blank, wide=blank, force=nothing, nearest=nothing, depth=nothing, truth=None
    )
    part = np.repeat([0, 1, 2], 4)
    split = Split(part == 0, part == 1, part == 2, part, "object")
    pressure = ContactPressure(blank, nothing)
    prepared = train.PreparedData(
        SimpleNamespace(touches=touches, window=17e-3), split, (), None, PressureModelConfig(pitch=1e-3), pressure
    )
    held_out, error = readings[4:], rng.normal(size=(4, 6))
    validated, tested = held_out.copy(), held_out.copy()
    validated[:4] += 0.1 * error
    validated[4:] += 3 * error
    tested[:4] += 3 * error
    tested[4:] += 0.1 * error
    fitted = train.FittedMethods({}, {"validated": foretold(validated), "tested": foretold(tested)}, {})
    evaluation = train.evaluate(prepared, fitted)
    assert evaluation.best == "validated"
    assert evaluation.validation_r2["validated"] == pytest.approx(score(readings[4:8], validated[:4]).r2)
    np.testing.assert_array_equal(evaluation.predicted["validated"], validated[4:])
    scale = np.sqrt(np.mean((0.1 * error) ** 2))
    assert evaluation.predictors["validated"].std_scale == pytest.approx(scale)
    np.testing.assert_allclose(evaluation.std["validated"], scale)


def test_a_split_that_was_renamed_says_so(capsys, tmp_path):
    with pytest.raises(SystemExit) as end:
        train.main(["--split", "run", "--out", str(tmp_path / "x")])
    assert end.value.code == 2
    assert "--split run is called --split session now" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.full
def test_a_board_of_sixteen_chips_from_simulation_to_a_predictor_on_disk(tmp_path):
    pad = sample_pad(jax.random.key(0), board=grid_board(4, 4))
    save_pad(tmp_path / "pad.npz", pad)
    out = tmp_path / "run"
    arguments = ["--preset", "debug", "--epochs", "2", "--pad", str(tmp_path / "pad.npz"), "--out", str(out)]
    assert train.main(arguments) == 0
    touches = dataset.load_dataset(out / "data.h5")
    assert touches.touches.reading.shape == (60, 48)
    assert touches.board.chips.shape == (16, 3)
    predictor = i2t.load_predictor(out)
    assert "16 chips" in repr(predictor)
    reading = predictor.predict(touches.touches.patch[:2], force=touches.touches.force[:2])
    assert reading.mean.shape == reading.std.shape == (2, 48)
    assert np.isfinite(reading.mean).all()
    assert (reading.std > 0).all()
    assert (out / "error_per_axis.png").exists()


def test_a_pad_on_disk_takes_the_place_of_a_random_one(tmp_path, capsys, monkeypatch):
    kept = nominal_pad()._replace(young=jnp.asarray(123e3))
    save_pad(tmp_path / "pad.npz", kept)
    pressed = []

    def pressing(key, surfaces, pad, *others, **named):
        pressed.append(pad)
        raise ValueError("seen enough")

    monkeypatch.setattr(simulate.simulation, "simulate_touches", pressing)
    arguments = ["--preset", "debug", "--out", str(tmp_path / "run"), "--pad"]
    assert train.main([*arguments, str(tmp_path / "pad.npz")]) == 2
    jax.tree.map(np.testing.assert_allclose, pressed[0], kept)
    assert "seen enough" in capsys.readouterr().err
    assert train.main([*arguments, str(tmp_path / "none.npz"), "--overwrite"]) == 2
    assert "none.npz" in capsys.readouterr().err
    assert train.main([*arguments, str(tmp_path / "pad.npz"), "--dataset", str(tmp_path), "--overwrite"]) == 2
    assert "--pad is for simulated touches" in capsys.readouterr().err


def test_several_pads_are_summed_up_over_pads(tmp_path, capsys):
    score = {field: 0.0 for field in Score._fields if not field.endswith("_axis")}
    parts = [
        {
            "source": "simulated", "pad": pad, "seed": seed, "best": "one",
            "methods": {"one": {**score, "r2": 0.3 + 0.1 * pad + 0.01 * seed}},
            "by_object": {"star": {"one": 0.1 * pad}, "hammer": {"one": 0.5}},
        }
        for pad in (0, 1, 2)
        for seed in (0, 1)
    ]  # fmt: skip
    found = summarise(parts, tmp_path)
    mean, low, high = found["over_pads"]["one"]["r2"]
    assert mean == pytest.approx(0.405)
    assert high - mean == pytest.approx(4.303 * 0.1 / np.sqrt(3), rel=1e-3)  # over pads, not runs
    assert mean - low == pytest.approx(high - mean)
    print_table(found)
    said = capsys.readouterr().out
    assert "3 pads (simulated): mean with 95 % interval over pads" in said
    assert "R² by object" in said
