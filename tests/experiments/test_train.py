"""The whole of `python -m experiments.train` on the debug preset: its results, its predictor, its manners, killed and
resumed.
"""

import json
import os
import shutil
import subprocess
import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.baselines import bare_dataset, placed_dataset, round_tip
from helpers.debug_run import COMMAND

import i2t
from experiments.train import __main__ as command
from experiments.train import simulate
from experiments.train.configs import PRESETS
from experiments.train.evaluation import evaluate
from experiments.train.reports import print_table, summarise
from experiments.train.run import CEILING
from experiments.train.sources import simulated_touches
from i2t import dataset
from i2t.contact.pressure import ContactPressure, PressureModelConfig
from i2t.dataset import Split
from i2t.models.finished import ON_PRESSURE, read_run
from i2t.prediction.fit import PreparedTouches
from i2t.prediction.gp_method import GaussianProcess
from i2t.prediction.methods import METHODS, TrainingTouches, find_method
from i2t.prediction.metrics import Score, score
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import Reading, TouchBatch, TouchModel
from i2t.skin.boards import grid_board
from i2t.skin.files import load_pad, save_pad
from i2t.skin.pad import nominal_pad, pad_from_seed
from i2t.skin_models.pad_fit import ContactModel
from i2t.skin_models.pad_model import load_pad_model
from i2t.types import Board

BASELINES = [method.title for method in map(find_method, METHODS) if method.baseline]


def numbers(out):
    metrics = json.loads((out / "metrics.json").read_text())
    return {**metrics, "seconds": None}


@pytest.mark.full
def test_the_run_writes_the_promised_files(trained_run):
    metrics = json.loads((trained_run / "metrics.json").read_text())
    assert metrics["source"] == "simulated"
    assert metrics["counts"] == {"train": 36, "validation": 8, "test": 16}
    assert set(metrics["by_object"]) == {"star", "hammer"}
    assert metrics["groups"] == 2
    for values in metrics["methods"].values():
        assert values["r2_interval"] == [None, None]  # two sessions are too few for one
    config = json.loads((trained_run / "config.json").read_text())
    assert config["versions"]["jax"]
    assert config["experiment"]["simulation"]["touches"] == 60
    pictures = {path.name for path in trained_run.glob("*.png")}
    assert pictures >= {"scores.png", "training.png", "touches_typical.png", "touches_worst.png"}


@pytest.mark.full
def test_the_kept_predictor_is_the_best_of_all_on_validation_touches_and_scored_as_it_predicts(trained_run):
    """The table states the score of the predictor that `load_predictor` returns, on the test touches."""
    metrics = json.loads((trained_run / "metrics.json").read_text())
    methods, r2 = metrics["methods"], metrics["validation_r2"]
    # The ceiling knows the contact; a camera with noise cannot beat it by more than the scatter of 16 touches.
    assert methods[CEILING]["r2"] > max(methods[name]["r2"] for name in ("mean reading", GaussianProcess.title))
    assert set(r2) == set(methods) - {CEILING}
    assert r2[metrics["best"]] == max(r2.values())
    predictor = i2t.load_predictor(trained_run)
    assert predictor.metadata["method"] == metrics["best"]
    on_pressure = i2t.load_predictor(trained_run / "checkpoint" / ON_PRESSURE)
    assert on_pressure.metadata["method"] == metrics["choice"]["best_on_pressure"] == GaussianProcess.title
    # The range of every method was scaled on the validation touches, and what it holds of them is stated.
    assert all(0.5 < methods[name]["validation_coverage_90"] <= 1 for name in r2)
    touches = dataset.load_dataset(trained_run / "data.h5")
    rows = np.isin([touches.objects[i] for i in touches.touches.object], ["star", "hammer"])
    given = {name: getattr(touches.touches, name)[rows] for name in ("force", "nearest", "travel", "view")}
    seen = predictor.predict(touches.touches.patch[rows], **given)
    truth = touches.touches.reading[rows]
    assert methods[metrics["best"]]["r2"] == pytest.approx(score(truth, seen.mean).r2, abs=1e-4)
    assert methods[metrics["best"]]["rmse"] == pytest.approx(np.sqrt(((seen.mean - truth) ** 2).mean()), rel=1e-4)
    assert seen.std.min() > 0


@pytest.mark.full
def test_the_kept_pad_model_is_fitted_to_the_training_touches_that_were_kept(trained_run):
    run = read_run(trained_run)
    assert run.predictors["on_pressure"] == GaussianProcess.title
    known = load_pad_model(run.pad_model)
    names, plan = ("hexagon", "parallelogram"), PRESETS["debug"].simulation
    assert (known.origin.pad, known.origin.objects, known.origin.touches) == ("simulated pad 0", names, 36)
    touches = simulated_touches(dataset.load_dataset(run.touches), names, known.origin.made_from)
    anew = ContactModel(plan.errors, plan.limits).fit(jax.random.split(jax.random.key(0))[0], touches)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), known.model, anew.model)
    jax.tree.map(np.testing.assert_array_equal, load_pad(run.simulated_pad), pad_from_seed(0))
    assert json.loads((trained_run / "metrics.json").read_text())["pad_model"]["r2"] == known.model.r2


@pytest.mark.full
def test_killed_and_resumed_equals_uninterrupted(trained_run, tmp_path, capsys):
    """The run is killed before its networks are trained; it starts from the touches of an interrupted run."""
    out = tmp_path / "killed"
    out.mkdir()
    for name in ("config.json", "data.h5"):
        shutil.copy(trained_run / name, out)
    words = [*COMMAND, "--out", str(out), "--resume"]
    environment = {**os.environ, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "MPLBACKEND": "agg"}  # as of the finished run
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    time.sleep(5)
    process.kill()
    process.wait()
    assert not (out / "metrics.json").exists()

    assert command.main(["--preset", "debug", "--out", str(trained_run)]) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert command.main(["--preset", "debug", "--out", str(out)]) == 2
    assert "pass --resume" in capsys.readouterr().err
    assert command.main(["--preset", "debug", "--seed", "1", "--out", str(out), "--resume"]) == 2
    assert "other settings" in capsys.readouterr().err
    subprocess.run(words, check=True, capture_output=True, env=environment)
    assert numbers(out) == numbers(trained_run)


@dataclass(frozen=True)
class Foretold(TouchModel):
    """A model that returns given readings for any input."""

    told: Reading
    pressure: PressureModelConfig | None

    @property
    def channels(self) -> int:
        return self.told.mean.shape[-1]

    def predict_batch(self, touches: TouchBatch) -> Reading:
        return self.told


class NamedMethod(NamedTuple):
    title: str
    baseline: bool


def foretold(mean: np.ndarray, baseline: bool = False) -> Predictor:
    pressure = None if baseline else PressureModelConfig(pitch=1e-3)
    return Predictor(Foretold(Reading(mean, np.ones_like(mean)), pressure), 17e-3, 4e-3, 1.0, 3e-4)


@pytest.mark.parametrize("validated_is_baseline", [True, False])
def test_the_predictor_is_chosen_on_validation_touches_and_scaled_on_them(validated_is_baseline):
    """One of two predictors is right about the validation touches (rows 4 to 7) and the other about the test touches;
    it does not matter which of them is a baseline.
    """
    rng = np.random.default_rng(0)
    readings = rng.normal(size=(12, 6))
    blank, nothing = np.zeros((12, 4, 4)), np.zeros(12)
    dataset = bare_dataset(blank, readings, force=nothing, nearest=nothing, travel=nothing)
    part = np.repeat([0, 1, 2], 4)
    split = Split(part == 0, part == 1, part == 2, part, "object")
    pressure = ContactPressure(blank, nothing)
    prepared = PreparedTouches(TrainingTouches(dataset, pressure=pressure), split, ())
    held_out, error = readings[4:], rng.normal(size=(4, 6))
    validated, tested = held_out.copy(), held_out.copy()
    validated[:4] += 0.1 * error
    validated[4:] += 3 * error
    tested[:4] += 3 * error
    tested[4:] += 0.1 * error
    both = {
        "tested": foretold(tested, baseline=not validated_is_baseline),
        "validated": foretold(validated, baseline=validated_is_baseline),
    }
    methods = [NamedMethod(name, name == ("validated" if validated_is_baseline else "tested")) for name in both]
    evaluation = evaluate(prepared, methods, both)
    assert evaluation.choice.best == "validated"
    assert evaluation.choice.r2["validated"] == pytest.approx(score(readings[4:8], validated[:4]).r2)
    assert evaluation.choice.pressure_loses == validated_is_baseline
    inside = np.mean(np.abs(error) < 1.645 * np.sqrt(np.mean(error**2)))
    assert evaluation.coverage["validated"] == pytest.approx(inside)
    np.testing.assert_array_equal(evaluation.predicted["validated"], validated[4:])
    scale = np.sqrt(np.mean((0.1 * error) ** 2))
    assert evaluation.predictors["validated"].std_scale == pytest.approx(scale)
    np.testing.assert_allclose(evaluation.std["validated"], scale)


def test_touches_that_only_choose_are_neither_trained_on_nor_tested_nor_scaled_by():
    """The touches are of objects that a study touches last: they outvote the validation touches, which still determine
    the scale.
    """
    readings = np.random.default_rng(0).normal(size=(12, 6))
    blank = np.zeros((12, 4, 4))
    part = np.repeat([0, 1, 2, 3], 3)
    split = Split(part == 0, part == 1, part == 2, part, "object")
    prepared = PreparedTouches(TrainingTouches(bare_dataset(blank, readings)), split, (), selection=part == 3)
    error = np.random.default_rng(1).normal(size=(9, 6))
    wrong = {"tuned": np.repeat([0.1, 1.0, 3.0], 3), "judged": np.repeat([0.5, 1.0, 0.1], 3)}
    both = {name: foretold(readings[3:] + size[:, None] * error) for name, size in wrong.items()}
    evaluation = evaluate(prepared, [NamedMethod("tuned", True), NamedMethod("judged", False)], both)
    assert evaluation.choice.best == "judged"
    np.testing.assert_array_equal(evaluation.predicted["judged"], both["judged"].model.told.mean[3:6])
    scale = np.sqrt(np.mean((0.5 * error[:3]) ** 2))
    assert evaluation.predictors["judged"].std_scale == pytest.approx(scale)


def test_a_study_keeps_the_touches_of_the_default():
    default, study = (PRESETS[name].simulation for name in ("paper", "study"))
    assert study.objects[: len(default.objects)] == default.objects
    assert study.counts()[: len(default.objects)] == default.counts()
    assert not set(study.selection) & set(default.objects)
    assert sum(default.counts()) == default.touches


def test_a_pad_on_disk_takes_the_place_of_a_random_one(tmp_path, capsys, monkeypatch):
    kept = nominal_pad()._replace(young=jnp.asarray(123e3))
    save_pad(tmp_path / "pad.npz", kept)
    pressed = []

    def pressing(key, surfaces, pad, *others, **named):
        pressed.append(pad)
        raise ValueError("seen enough")

    monkeypatch.setattr(simulate.simulation, "simulate_touches", pressing)
    arguments = ["--preset", "debug", "--out", str(tmp_path / "run"), "--pad"]
    assert command.main([*arguments, str(tmp_path / "pad.npz")]) == 2
    jax.tree.map(np.testing.assert_allclose, pressed[0], kept)
    assert "seen enough" in capsys.readouterr().err
    assert command.main([*arguments, str(tmp_path / "none.npz"), "--overwrite"]) == 2
    assert "none.npz" in capsys.readouterr().err
    assert command.main([*arguments, str(tmp_path / "pad.npz"), "--dataset", str(tmp_path), "--overwrite"]) == 2
    assert "--pad simulates touches" in capsys.readouterr().err


def small_recording(board: Board, **columns) -> dataset.Dataset:
    """160 presses of a round tip on a skin, ordered by position, in sessions of ten."""
    rng = np.random.default_rng(0)
    n, board_chips = 160, np.asarray(board.chips)
    place, travel = rng.uniform(-6e-3, 6e-3, (n, 2)), rng.uniform(0.3e-3, 2e-3, n)
    near = np.exp(-((place[:, None] - board_chips[:, :2]) ** 2).sum(-1) / 2 / 5e-3**2)
    noise = rng.normal(size=(n, 3 * len(board_chips)))
    made = placed_dataset(
        place, round_tip(place, 48), 4e4 * travel[:, None] * np.repeat(near, 3, axis=1) + noise, board=board,
        **({"nearest": -travel, "travel": travel, "session": np.arange(n) // 10} | columns),
    )  # fmt: skip
    return replace(made, sessions=tuple(f"run {i}" for i in range(16)))


@pytest.mark.full
def test_a_run_with_faulty_loads_ends_with_a_predictor_and_a_message(tmp_path, capsys):
    """On any board, the saved predictor is no worse than a baseline on test touches, within its group interval."""
    said = "negative in 100 %"
    pulled = small_recording(grid_board(2, 2), force=np.linspace(-3, -6, 160))
    dataset.save_dataset(tmp_path / "set.h5", pulled)
    arguments = ["--preset", "debug", "--dataset", str(tmp_path / "set.h5"), "--split", "block"]
    assert command.main([*arguments, "--out", str(tmp_path / "run")]) == 0
    assert said in capsys.readouterr().out
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (metrics["source"], metrics["split"]) == ("real", "block")
    assert any(said in note for note in metrics["notes"])
    methods, kept = metrics["methods"], metrics["methods"][metrics["best"]]
    best = max((name for name in methods if name in BASELINES), key=lambda name: methods[name]["r2"])
    assert kept["r2"] >= methods[best]["r2"] - np.ptp(methods[best]["r2_interval"])
    predictor = i2t.load_predictor(tmp_path / "run")
    assert "4 chips" in repr(predictor)
    # The recording's fingertip fills a sixth of the patch, and a flat face is unlike it.
    with pytest.warns(UserWarning, match="patch has a mean depth of 0 mm, and the model was trained on 3.3 to 3.5 mm"):
        reading = predictor.predict(np.zeros((48, 48)), nearest=0.0)
    assert reading.mean.shape == (12,)
    assert np.isfinite(reading.mean).all()
    assert (reading.std > 0).all()


def test_a_table_is_printed_where_a_score_is_missing(capsys):
    """A non-finite score is null in metrics.json and not a number in the table."""
    one = dict.fromkeys(Score._fields) | {"r2_axis": [None] * 3, "r2_interval": [None, None]}
    lead = {"r2": 0.0, "low": None, "high": None}
    print_table(
        {
            "source": "real", "groups": 3, "best": "mean reading", "seconds": 1.0, "notes": ["travels are zero"],
            "methods": {"mean reading": one | {"r2": 0.0, "validation_coverage_90": 0.91}, "GP": one},
            "validation_r2": {"mean reading": 0.0, "GP": None}, "by_object": {},
            "choice": {"best_baseline": "mean reading", "over_best_baseline": lead},
            "validated_on": {"groups": 4, "objects": 1},
        }
    )  # fmt: skip
    said = capsys.readouterr().out
    assert "selected: mean reading" in said
    assert "0.91 of validation values" in said
    assert "note: travels are zero" in said


def test_several_pads_are_summed_up_over_pads(tmp_path, capsys):
    score = {field: 0.0 for field in Score._fields if not field.endswith("_axis")}
    parts = [
        {
            "source": "simulated", "pad": pad, "seed": seed, "best": "one",
            "methods": {"one": {**score, "r2": 0.3 + 0.1 * pad + 0.01 * seed}},
            "by_object": {"star": {"one": 0.1 * pad}, "hammer": {"one": 0.5}},
            "baselines": ["mean", "ridge"],
            "validated_on": {"touches": 99, "groups": 3, "objects": 2},
            "validation_r2": {"one": 0.3 + 0.1 * pad, "ridge": 0.1 + 0.02 * seed, "mean": 0.0, "diverged": None},
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
    # Over pads as well, of which each counts once: 0.29, 0.19 and 0.09 below the best.
    choice = found["choice"]
    assert (choice["best"], choice["best_baseline"]) == ("one", "ridge")
    assert "diverged" not in choice["validation_r2"]
    lead = choice["over_best_baseline"]
    assert lead["r2"] == pytest.approx(0.29)
    assert lead["high"] - lead["r2"] == pytest.approx(4.303 * 0.1 / np.sqrt(3), rel=1e-3)
    assert "0.290 [0.042, 0.538] above ridge; 594 touches of 2 objects in 18 sessions with 3 pads" in said
