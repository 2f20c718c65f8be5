"""Question: how well does a model trained on two objects predict the touch of objects it has never met?

    python -m experiments.train                      the paper's set, simulated: 1630 touches, one pad, one seed
    python -m experiments.train --preset debug       a few touches, too few to mean anything
    python -m experiments.train --seeds 5            means and 95 % intervals over seeds
    python -m experiments.train --preset study       six pads, one seed: means and 95 % intervals over pads
    python -m experiments.train --preset study --executor local      its pads side by side (docs/scaling.md)
    python -m experiments.train --pad FILE           a pad fitted to a real skin in place of a random one
    python -m experiments.train --dataset DIR        any recorded or converted set (see python -m i2t.convert)

Hexagon and parallelogram train, one tool validates, all other primitives and tools test. Every method sees the same
touches: baselines that look up or regress patches, the paper's network (contact mask or depth), and two models on
predicted contact pressure. The best of all of them on the validation touches is kept as the predictor, a baseline too.
Where a model on predicted contact pressure loses to a baseline, likely causes are tested and named. A ceiling shows
what the same model would reach if the camera and the arm made no error. Results go to --out: metrics.json, config.json,
figures, the data (data.h5) and checkpoint/, which `i2t.load_predictor` reads. Of --dataset the training touches are
kept (recognition.h5, recognition.json, meshes/), so that `experiments.recognize` can make a pad model of them.

The default took 218 s on two quiet cores; `--preset debug` took 95 s of processor time the first time, when everything
is compiled, and 36 s the second.
"""

import json
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

# Factors of a few hundred rows are too small to share: waiting threads of LAPACK cost more than they give.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from experiments.common.presets import choose_preset
from experiments.common.runs import begin, slug, write_json
from experiments.common.tasks import Task, run_tasks
from experiments.train import causes, recognition_data
from experiments.train.arguments import TrainArgs
from experiments.train.choosing import Choice, choose
from experiments.train.configs import PRESETS, TrainExperiment
from experiments.train.loads import ALIKE_FORCE_N, PressLoad, press_load, several_skins, with_known_load
from experiments.train.methods import (
    adapt_network,
    ceiling,
    fit_baseline_models,
    fit_gp,
    median_conditions,
    pressure_model_of,
    touch_batch,
    train_network,
    views_of,
)
from experiments.train.recognition_data import MeshFile, mesh_files
from experiments.train.reports import by_object, figures, print_table, scored, summarise
from experiments.train.simulate import simulated_dataset
from experiments.train.splitting import Split, conditions_of, split_dataset
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.prediction import checkpoint
from i2t.prediction.gp import ContactPressure
from i2t.prediction.model import ModelConfig
from i2t.prediction.predictor import (
    BaselineModel,
    GPModel,
    PatchNetwork,
    Predictor,
    PressureNetwork,
    Reading,
    coverage,
    predict_pressures,
    save,
    std_scale,
)
from i2t.prediction.pressure import PressureModelConfig
from i2t.skin.files import load_pad, load_pad_about
from i2t.types import Pad

GP_METHOD = "Gaussian process on predicted contact pressure"
CEILING = "ceiling: GP without camera and arm errors"
ON_PRESSURE = "on_pressure"  # folder of the best predictor on predicted contact pressure, kept or not
LEAST_PRESSED_SHARE = 0.1  # of training touches that must have a predicted pressure


def run(args: TrainArgs) -> dict[str, Any]:
    """The experiment: every pad and seed, then the table over them."""
    cfg = choose_preset(PRESETS, args.preset)
    if args.epochs is not None:
        cfg = replace(cfg, training=replace(cfg.training, epochs=args.epochs))
    cfg = replace(cfg, softness=args.softness)
    seeds = range(args.seed, args.seed + (args.seeds or cfg.seeds))
    if args.pads is not None:
        cfg = replace(cfg, pads=args.pads)
    meshes = mesh_files(args.objects, args.unit)
    pads: Sequence[Pad | int | None] = (None,) if args.dataset else (load_pad(args.pad),) if args.pad else cfg.pads
    begin(args.out, args, cfg, args.resume, args.overwrite)
    several = len(seeds) * len(pads) > 1
    tasks = []
    for pad in pads:
        for seed in seeds:
            name = f"pad-{pad if isinstance(pad, int) else 0}-seed-{seed}"
            place = args.out / name if several else args.out
            work = partial(run_one, args, cfg, seed=seed, pad=pad, out=place, meshes=meshes)
            tasks.append(Task(name, place / "metrics.json", work))
    run_tasks(tasks, args.tasks)
    parts = [json.loads(task.finished.read_text()) for task in tasks]
    result = parts[0] if not several else summarise(parts, args.out)
    print_table(result)
    return result


class PreparedData(NamedTuple):
    """A data set, what is held out of it, and what every method shares."""

    dataset: Dataset
    split: Split
    measured: tuple[str, ...]  # of force, nearest and depth, those that were measured at every touch
    noise: np.ndarray | None  # (3 chips,) uT, the sensor's own, where it is known
    pressure_model: PressureModelConfig | None = None  # None where nothing says how hard touches were pressed
    pressure: ContactPressure | None = None  # of all touches, likewise
    notes: tuple[str, ...] = ()  # what is odd about the recording, a sentence each
    findings: tuple[causes.CauseFound, ...] = ()  # what its numbers were tested for


class FittedMethods(NamedTuple):
    """What was fitted to the training touches, each by its name."""

    predictors: dict[str, Predictor]  # baselines first; their standard deviations not yet scaled
    curves: dict[str, np.ndarray]  # (epochs,) errors of networks


class Evaluation(NamedTuple):
    """How the methods do on touches that none was fitted to."""

    predicted: dict[str, np.ndarray]  # (test touches, 3 chips) uT, by method
    std: dict[str, np.ndarray]  # likewise, of methods that have one
    choice: Choice  # on validation touches
    coverage: dict[str, float]  # share of validation values in the 90 % range, by method
    predictors: dict[str, Predictor]  # their standard deviations scaled on the validation touches

    @property
    def best(self) -> str:
        """The method that is kept."""
        return self.choice.best


def run_one(
    args: TrainArgs, cfg: TrainExperiment, seed: int, pad: Pad | int | None, out: Path, meshes: Mapping[str, MeshFile]
) -> None:
    """One pad and seed: data, methods, scores, and what is left of them on disk."""
    started = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    prepared = prepare_data(args, cfg, seed, pad, out)
    if args.dataset:
        print(recognition_data.keep(out, prepared.dataset, prepared.split.train, meshes))
    fitted = fit_methods(prepared, cfg, seed, out)
    evaluation = evaluate(prepared, fitted)
    notes = [*prepared.notes, *explain_loss(prepared, evaluation.choice)]
    if prepared.dataset.touches.truth is not None and prepared.pressure_model is not None:
        evaluation.predicted[CEILING] = ceiling(prepared.dataset, prepared.pressure_model, prepared.split, seed)
    about = {"seed": seed, "pad": str(args.pad) if args.pad else pad, "notes": notes}
    report(out, prepared, fitted, evaluation, about=about, started=started)
    keep_what_is_needed(out, cfg.networks)


def prepare_data(args: TrainArgs, cfg: TrainExperiment, seed: int, pad: Pad | int | None, out: Path) -> PreparedData:
    """Load or simulate touches, split them, and predict the contact pressure of each."""
    if args.dataset:
        dataset = data.load_dataset(args.dataset, skin=args.skin_name)
    else:
        name = load_pad_about(args.pad).name if args.pad else None
        dataset = simulated_dataset(cfg.simulation, 0 if pad is None else pad, out / "data.h5", seed=seed, name=name)
    dataset, left_out = with_known_load(dataset)
    split = split_dataset(dataset, cfg, args.split, seed)
    print(
        f"{len(dataset)} touches ({dataset.source}), split by {split.how}: {split.train.sum()} train, "
        f"{split.validation.sum()} validate, {split.test.sum()} test"
    )
    touches = dataset.touches
    load = press_load(dataset.select(split.train | split.validation | split.test).touches)
    noise = None if touches.truth is None else (touches.reading - touches.truth.reading).std(0)
    prepared = noted(
        PreparedData(dataset, split, conditions_of(touches, split), noise),
        *([left_out] if left_out else []),
        *several_skins(dataset),
        *load.notes,
    )
    pressure_model = pressure_model_of(dataset, load, cfg)
    prepared = prepared if pressure_model is None else with_pressure(prepared, pressure_model, load)
    return check_numbers(prepared) if args.dataset else prepared


def noted(prepared: PreparedData, *notes: str) -> PreparedData:
    """Tell a person what is odd about the recording, and remember it."""
    for note in notes:
        print(f"note: {note}")
    return prepared._replace(notes=(*prepared.notes, *notes))


def with_pressure(prepared: PreparedData, pressure_model: PressureModelConfig, load: PressLoad) -> PreparedData:
    """Predict the contact pressure of each touch; none where next to all predicted pressures are nil."""
    dataset, split, touches = prepared.dataset, prepared.split, prepared.dataset.touches
    print("predicting contact pressures")
    if load.control == "depth" and load.nil_share > causes.MIN_NIL_SHARE:
        height, said = causes.likely_height(dataset, split.train, split.groups, pressure_model)
        pressure_model = replace(pressure_model, depth_offset=height)
        prepared = noted(prepared, *([said] if said else []))
    force = np.full(len(dataset), ALIKE_FORCE_N, np.float32) if load.constant else touches.force
    pressure = predict_pressures(pressure_model, views_of(dataset), force, touches.depth)
    total = np.asarray(pressure.pressure)[split.train].sum((1, 2))
    pressed = float(np.mean(total > pressure_model.floor / 10))
    if np.isfinite(total).all() and pressed >= LEAST_PRESSED_SHARE:
        return prepared._replace(pressure_model=pressure_model, pressure=pressure)
    return noted(
        prepared,
        f"{100 * (1 - pressed):.0f} % of the predicted contact pressures are nil or not finite: methods on them are "
        "left out",
    )


def fit_methods(prepared: PreparedData, cfg: TrainExperiment, seed: int, out: Path) -> FittedMethods:
    """Fit the baselines, the networks and the Gaussian process to the training touches."""
    dataset, split, touches = prepared.dataset, prepared.split, prepared.dataset.touches
    pressure, pressure_model = prepared.pressure, prepared.pressure_model
    models = fit_baseline_models(dataset, split, prepared.measured)
    curves: dict[str, np.ndarray] = {}
    for name, network in cfg.networks.items():
        on_pressure = network.input == "image"
        if on_pressure and pressure_model is None:
            continue
        adapted, images = adapt_network(network, dataset, pressure, prepared.measured)
        training = replace(cfg.training, seed=seed)
        folder = out / "checkpoint" / slug(name)
        trained, curve = train_network(
            name, adapted, training, images=images, touches=touches, split=split, folder=folder
        )
        seen = pressure_model if on_pressure else None
        models[name] = PatchNetwork(trained) if seen is None else PressureNetwork(trained, seen)
        curves |= curve
    if pressure is not None and pressure_model is not None:
        models[GP_METHOD] = GPModel(fit_gp(pressure, touches.reading, split, seed), pressure_model)

    force, depth = median_conditions(touches, split.train)
    predictors = {name: Predictor(model, dataset.window, dataset.reach, force, depth) for name, model in models.items()}
    return FittedMethods(predictors, curves)


def evaluate(prepared: PreparedData, fitted: FittedMethods) -> Evaluation:
    """Scale the standard deviations and choose a predictor on the validation touches; predict the test touches."""
    split, readings = prepared.split, prepared.dataset.touches.reading
    held_out = split.validation | split.test
    tuning, truth = split.validation[held_out], readings[split.validation]
    touches = touch_batch(prepared.dataset, held_out, prepared.pressure)
    predicted, std, validated = {}, {}, {}
    covered: dict[str, float] = {}
    predictors: dict[str, Predictor] = {}
    for name, predictor in fitted.predictors.items():
        reading = predictor.predict_batch(touches)
        seen = Reading(reading.mean[tuning], reading.std[tuning])
        scale = std_scale(truth, seen)
        validated[name] = seen.mean
        covered[name] = coverage(truth, Reading(seen.mean, scale * seen.std))
        predicted[name], std[name] = reading.mean[~tuning], scale * reading.std[~tuning]
        predictors[name] = replace(predictor, std_scale=scale)
    choice = choose(
        truth,
        validated,
        split.groups[split.validation],
        baselines=[name for name, each in predictors.items() if isinstance(each.model, BaselineModel)],
        on_pressure=[name for name, each in predictors.items() if each.pressure is not None],
    )
    return Evaluation(predicted, std, choice, covered, predictors)


def check_numbers(prepared: PreparedData) -> PreparedData:
    """Tell a person what is wrong with the recording's own numbers."""
    found = causes.seen_in_numbers(prepared.dataset, prepared.split.train, prepared.pressure_model, prepared.pressure)
    return noted(prepared._replace(findings=tuple(found)), *(each.evidence for each in found if each.found))


def explain_loss(prepared: PreparedData, choice: Choice) -> Sequence[str]:
    """Where a method on predicted pressure loses to a baseline: a sentence with the likely causes that were tested."""
    method, baseline, cfg = choice.best_on_pressure, choice.best_baseline, prepared.pressure_model
    if method is None or not choice.pressure_loses or cfg is None:
        return []
    if prepared.dataset.touches.truth is not None:  # the simulation makes none of the mistakes that are looked for
        return [f"{method} loses to {baseline} on validation touches"]
    if not np.isfinite(getattr(prepared.dataset.touches, cfg.control)[prepared.split.train]).all():
        return [f"{method} loses to {baseline}: how hard was pressed is not known"]
    print(f"{method} loses to {baseline}: testing likely causes")
    split = prepared.split
    found = [*prepared.findings, *causes.tried_changes(prepared.dataset, split.train, split.groups, cfg)]
    return [causes.loss_sentence(method, choice.r2[method], baseline, choice.r2[baseline], found)]


def report(
    out: Path, prepared: PreparedData, fitted: FittedMethods, evaluation: Evaluation, *,
    about: dict[str, Any], started: float,
) -> None:  # fmt: skip
    """Write the predictor, the figures and, last of all, metrics.json."""
    dataset, split, noise = prepared.dataset, prepared.split, prepared.noise
    truth, groups = dataset.touches.reading[split.test], split.groups[split.test]
    metrics: dict[str, Any] = {
        "source": dataset.source,
        **about,
        "split": split.how,
        "counts": {part: int(getattr(split, part).sum()) for part in ("train", "validation", "test")},
        "groups": len(np.unique(groups)),
        "noise_uT": None if noise is None else noise.tolist(),
        "best": evaluation.best,
        "validation_r2": evaluation.choice.r2,
        "choice": evaluation.choice.to_json(),
        "validated_on": {
            "groups": len(np.unique(split.groups[split.validation])),
            "objects": len(np.unique(dataset.touches.object[split.validation])),
        },
        "methods": {
            name: scored(truth, mean, groups, noise, evaluation.std.get(name))
            | {"validation_coverage_90": evaluation.coverage.get(name)}
            for name, mean in evaluation.predicted.items()
        },
        "by_object": by_object(dataset, split, truth, evaluation.predicted),
        "seconds": 0.0,
    }
    kept = {"predictor": evaluation.best, ON_PRESSURE: evaluation.choice.best_on_pressure}
    for folder, method in kept.items():
        if method is not None:
            metadata = {"method": method, "source": dataset.source, "seed": about["seed"]}
            save(out / "checkpoint" / folder, replace(evaluation.predictors[method], metadata=metadata))
    figures(
        out, dataset, split,
        predicted=evaluation.predicted, best=evaluation.best, curves=fitted.curves, noise=noise, metrics=metrics,
    )  # fmt: skip
    metrics["seconds"] = round(time.perf_counter() - started, 1)
    write_json(out / "metrics.json", metrics)


def keep_what_is_needed(out: Path, networks: Mapping[str, ModelConfig]) -> None:
    """Of the networks of a finished run: the parameters of those that see patches, which `experiments.recognize` asks
    for the paper's rules. The others are kept as a predictor, if they are kept.
    """
    for name, network in networks.items():
        folder = out / "checkpoint" / slug(name)
        if network.input == "image":
            shutil.rmtree(folder, ignore_errors=True)
        elif checkpoint.exists(folder):
            checkpoint.drop_state(folder)
