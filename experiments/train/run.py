"""Question: how well does a model that is trained on two objects predict readings on other objects?

    python -m experiments.train                      simulated touches like the paper's: 1630, one pad, one seed
    python -m experiments.train --preset debug       a few touches, too few for meaningful results
    python -m experiments.train --seeds 5            means and 95 % intervals over seeds
    python -m experiments.train --preset study       six pads, one seed: means and 95 % intervals over pads
    python -m experiments.train --preset study --workers 2        two pads at a time (docs/compiled.md)
    python -m experiments.train --pad FILE           a pad fitted to a real skin instead of a random pad
    python -m experiments.train --registered sessions    views rendered at poses estimated in each session
    python -m experiments.train --registered camera  views corrected by a camera offset estimated on training objects
    python -m experiments.train --dataset DIR        any recorded or converted set (see i2t convert)
    python -m experiments.train --methods gp ridge --method my_package.module:Mine    two methods and one of your own
    python -m experiments.train --paper.bottleneck 16 --paper.auxiliary-weight 0.1    another network and loss

Methods are trained on hexagon and parallelogram, validated on one tool and tested on six other objects. All methods use
the same touches: baselines that look up or regress patches (mean, nearest, nearest-measured, ridge, ridge-measured) or
predicted contact pressures (nearest-pressure, nearest-pressure-measured, ridge-pressure, ridge-pressure-measured), the
paper's network on contact masks or depths (paper-mask, paper-depth), in a study also with the measured force
(paper-mask-force, paper-depth-force), and two models on predicted contact pressure (pressure-network, gp). The best
method on the validation touches is selected as the predictor, even if it is a baseline. A study also uses touches of
four more objects for the selection, and reports the best method over its pads. If a model on predicted contact pressure
loses to a baseline, `experiments.fidelity` tests likely causes. For a recording of one tip, results also include a
tuned Gaussian process and `i2t.calibrate`, which use the tip's position. The row "ceiling" shows the result of the same
model without errors of camera and arm. A pad model for `experiments.recognize` is fitted to the touches of the training
objects. With --dataset it needs the objects' meshes, and --rig gives the covariance of their poses. Results go to
--out: metrics.json, config.json, figures, the data (data.h5), checkpoint/ for `i2t.load_predictor`, and pad_model.npz
for `i2t.load_pad_model` (`i2t.models.finished` lists all files).

On two quiet cores the default took 101 s the first time, when everything is compiled, and 72 s the second; `--preset
debug` 30 s and 16 s.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.common.presets import choose_preset
from experiments.common.runs import METRICS, begin
from experiments.common.tasks import Task, run_tasks
from experiments.train.arguments import TrainArgs
from experiments.train.by_position import position_readings
from experiments.train.configs import PRESETS, TrainExperiment
from experiments.train.evaluation import evaluate, position_note, pressure_note
from experiments.train.prepare import prepare
from experiments.train.registered import correct_by_camera, correct_by_sessions, reading_row, register_known_objects
from experiments.train.reports import print_table, report, summarise
from experiments.train.simulate import ceiling
from experiments.train.sources import KnownObjects, RecordedSource, SimulatedSource, TouchSource
from i2t.dataset import Dataset, source_phrase
from i2t.errors import printable
from i2t.prediction.fit import PreparedTouches
from i2t.prediction.methods import find_methods
from i2t.recognition.recorded import describe
from i2t.skin_models.pad_model import KnownPad

CEILING = "ceiling: GP without camera and arm errors"
DURATIONS = {"debug": "about half a minute", "paper": "one to two minutes"}  # by preset, on two quiet cores


def run(args: TrainArgs) -> dict[str, Any]:
    """Run every pad and seed, and print the tables."""
    cfg = configure(args)
    sources = sources_of(args, cfg)
    seeds = range(args.seed, args.seed + cfg.seeds)
    begin(args, cfg)
    if args.preset in DURATIONS and args.dataset is None and cfg == configure(TrainArgs(preset=args.preset)):
        print(f"this takes {DURATIONS[args.preset]} on two quiet cores, longest the first time", flush=True)
    tasks: list[Task] = []
    for source in sources:
        for seed in seeds:
            name = f"pad-{source.pad if isinstance(source.pad, int) else 0}-seed-{seed}"
            folder = args.out / name if len(seeds) * len(sources) > 1 else args.out
            work = partial(run_pad, source, cfg, seed=seed, pad_model_seed=args.seed + len(tasks), out=folder)
            tasks.append(Task(name, folder / METRICS, work))
    run_tasks(tasks, args.workers)
    parts = [json.loads(task.finished.read_text()) for task in tasks]
    result = parts[0] if len(parts) == 1 else summarise(parts, args.out)
    print_table(result)
    return result


def configure(args: TrainArgs) -> TrainExperiment:
    """Apply the command line to the preset, and refuse methods that do not exist (ValueError)."""
    cfg = choose_preset(
        PRESETS, args.preset, methods=args.methods, pads=args.pads, seeds=args.seeds, split=args.split,
        softness=args.softness, paper=args.paper, registered=args.registered,
    )  # fmt: skip
    methods = ("mean", *(name for name in (*cfg.methods, *args.method) if name != "mean"))
    find_methods(methods)
    epochs = cfg.training.epochs if args.epochs is None else args.epochs
    if args.registered == "camera":
        cfg = replace(cfg, simulation=replace(cfg.simulation, same_camera=True))
    return replace(cfg, methods=methods, training=replace(cfg.training, epochs=epochs))


def sources_of(args: TrainArgs, cfg: TrainExperiment) -> Sequence[TouchSource]:
    """List the sources of touches: the recording, or each simulated pad."""
    if args.dataset is not None:
        all_touches = args.pad_model_of == "all"
        return [RecordedSource(args.dataset, args.skin_name, args.objects, args.unit, args.rig, all_touches)]
    pads = cfg.pads if args.pad is None else (str(args.pad),)
    return [SimulatedSource(pad, cfg.simulation) for pad in pads]


def run_pad(source: TouchSource, cfg: TrainExperiment, *, seed: int, pad_model_seed: int, out: Path) -> None:
    """Run one pad and seed: prepare the touches, fit and evaluate every method, fit the pad model, and report."""
    started = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    objects = source.known_objects()  # first, because it is fast and may fail
    dataset = source.dataset(seed, out)
    other_views: dict[str, np.ndarray] = {}  # predictions from other views, by title
    if cfg.registered is None:
        prepared = prepare(dataset, cfg, cfg.split, seed, cfg.softness)
    else:
        prepared, objects, other_views = prepare_registered(dataset, objects, cfg, seed)
    print(describe_split(prepared), flush=True)
    touches, split = prepared.touches, prepared.split
    touches = replace(touches, paper=cfg.paper, training=cfg.training)

    methods, fitted = find_methods(cfg.methods), {}
    print(f"fitting {len(methods)} methods, {sum(method.baseline for method in methods)} of them baselines", flush=True)
    for method in methods:
        if not method.baseline:
            print(printable(f"fitting {method.title}"), flush=True)
        predictor = method.fit(jax.random.key(seed), touches, split)
        if predictor is not None:
            fitted[method.title] = predictor
    if missing := [method.title for method in methods if method.title not in fitted]:
        note = f"left out, because the touches lack data that they need: {', '.join(missing)}"
        print(printable(f"note: {note}"))
        prepared = prepared._replace(notes=(*prepared.notes, note))

    print(f"scoring the methods on {split.test.sum()} test touches", flush=True)
    by_position = {} if source.recording is None else position_readings(touches.dataset, split, seed)
    evaluation = evaluate(prepared, methods, fitted, by_position)
    if touches.dataset.touches.truth is not None and touches.pressure_model is not None:
        evaluation.predicted[CEILING] = ceiling(touches.dataset, touches.pressure_model, split, seed)
    evaluation.predicted.update(other_views)
    notes = [
        *prepared.notes,
        *pressure_note(evaluation.choice, source.recording),
        *position_note(evaluation.choice, list(by_position)),
    ]
    baselines = [method.title for method in methods if method.baseline]
    about = {"seed": seed, "pad": source.pad, "notes": notes, "baselines": baselines}
    print("fitting the pad model, for recognition", flush=True)
    pad_model = fit_or_explain(partial(source.pad_model, pad_model_seed, touches.dataset, split.train, objects))
    report(out, prepared, evaluation, pad_model, about=about, started=started)


def prepare_registered(
    dataset: Dataset, objects: KnownObjects, cfg: TrainExperiment, seed: int
) -> tuple[PreparedTouches, KnownObjects, dict[str, np.ndarray]]:
    """Prepare touches with corrected views. Returns these, their objects, and predictions from other views by title."""
    as_prepared = partial(prepare, split_by=cfg.split, seed=seed, softness=cfg.softness)
    uncorrected = as_prepared(dataset, replace(cfg, registered=None))
    registered = register_known_objects(dataset, objects)
    others = {"GP on the camera's views, not registered": uncorrected}
    if cfg.registered == "camera":
        corrected = correct_by_camera(registered, uncorrected.touches.dataset.touches.session[uncorrected.split.train])
        if registered.all_known:
            by_sessions = as_prepared(correct_by_sessions(registered).dataset, cfg)
            others["GP on views of registered sessions, all meshes known"] = by_sessions
    else:
        corrected = correct_by_sessions(registered)
    prepared = as_prepared(corrected.dataset, cfg)
    rows = {name: reading_row(other, seed) for name, other in others.items()}
    return (
        prepared._replace(notes=(*corrected.notes, *prepared.notes)),
        corrected.objects,
        {name: row for name, row in rows.items() if row is not None},
    )


def fit_or_explain(fit: Callable[[], KnownPad]) -> KnownPad | str:
    """Fit the pad model, or return the reason why the touches do not suffice for it."""
    try:
        pad_model = fit()
    except ValueError as error:
        print(printable(f"note: no pad model, so recognition cannot use this run: {error}"))
        return str(error)
    print(describe(pad_model))
    return pad_model


def describe_split(prepared: PreparedTouches) -> str:
    """State the number of touches in each part of the split, and all notes."""
    dataset, split = prepared.touches.dataset, prepared.split
    counts = f"{split.train.sum()} train, {split.validation.sum()} validate, {split.test.sum()} test"
    sizes = f"{len(dataset)} touches ({source_phrase(dataset.source)}), split by {split.description}: {counts}"
    return "\n".join([sizes, *(printable(f"note: {note}") for note in prepared.notes)])
