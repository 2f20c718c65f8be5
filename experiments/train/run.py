"""Question: how well does a model trained on two objects predict the touch of objects it has never met?

    python -m experiments.train                      the paper's set, simulated: 1630 touches, one pad, one seed
    python -m experiments.train --preset debug       a few touches, too few to mean anything
    python -m experiments.train --seeds 5            means and 95 % intervals over seeds
    python -m experiments.train --preset study       six pads, one seed: means and 95 % intervals over pads
    python -m experiments.train --preset study --workers 2        its pads side by side (docs/compiled.md)
    python -m experiments.train --pad FILE           a pad fitted to a real skin in place of a random one
    python -m experiments.train --registered sessions    views from where each session's touches put object and camera
    python -m experiments.train --registered camera  views of a camera whose offset the training objects' sessions show
    python -m experiments.train --dataset DIR        any recorded or converted set (see python -m i2t.convert)
    python -m experiments.train --methods gp ridge --method my_package.module:Mine    these, and one of your own
    python -m experiments.train --paper.bottleneck 16 --paper.auxiliary-weight 0.1    another network, another loss

Hexagon and parallelogram train, one tool validates, six other objects test. Every method sees the same touches:
baselines that look up or regress patches (mean, nearest, nearest-measured, ridge, ridge-measured) or predicted contact
pressures (nearest-pressure, nearest-pressure-measured, ridge-pressure, ridge-pressure-measured), the paper's network on
contact masks or depths (paper-mask, paper-depth), in a study also with the measured force (paper-mask-force,
paper-depth-force), and two models on predicted contact pressure (pressure-network, gp). The best of all of them on the
validation touches is kept as the predictor, a baseline too. A study chooses by touches of four more objects, and says
which method is best there over its pads. Where a model on predicted contact pressure loses to a baseline,
`experiments.fidelity` tests likely causes. On a recording of one tip, a tuned Gaussian process and `i2t.calibrate`,
which are given the tip's position, stand next to the methods. A ceiling shows what the same model would reach if the
camera and the arm made no error. A pad model is fitted to the touches of the training objects, for
`experiments.recognize`; of --dataset it needs the objects' meshes, and --rig tells how far they may be off. Results go
to --out: metrics.json, config.json, figures, the data (data.h5), checkpoint/, which `i2t.load_predictor` reads, and
pad_model.npz, which `i2t.load_pad_model` reads (`experiments.train.finished` has the whole list).

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
from experiments.train.prepare import Prepared, prepare
from experiments.train.registered import by_camera, by_sessions, reading_row, register_known
from experiments.train.reports import print_table, report, summarise
from experiments.train.simulate import ceiling
from experiments.train.sources import ObjectsKnown, RecordedSource, SimulatedSource, TouchSource
from i2t.dataset import Dataset, source_phrase
from i2t.errors import printable
from i2t.prediction.methods import find_methods
from i2t.recognition.recorded import describe
from i2t.skin_models.pad_model import KnownPad

CEILING = "ceiling: GP without camera and arm errors"
ON_CAMERA = "GP on the camera's views, not registered"
BY_SESSIONS = "GP on views of registered sessions, all meshes known"


def run(args: TrainArgs) -> dict[str, Any]:
    """The experiment: every pad and seed, then the table over them."""
    cfg = configure(args)
    sources = sources_of(args, cfg)
    seeds = range(args.seed, args.seed + cfg.seeds)
    begin(args, cfg)
    tasks: list[Task] = []
    for source in sources:
        for seed in seeds:
            name = f"pad-{source.pad if isinstance(source.pad, int) else 0}-seed-{seed}"
            place = args.out / name if len(seeds) * len(sources) > 1 else args.out
            work = partial(run_one, source, cfg, seed=seed, pad_model_seed=args.seed + len(tasks), out=place)
            tasks.append(Task(name, place / METRICS, work))
    run_tasks(tasks, args.workers)
    parts = [json.loads(task.finished.read_text()) for task in tasks]
    result = parts[0] if len(parts) == 1 else summarise(parts, args.out)
    print_table(result)
    return result


def configure(args: TrainArgs) -> TrainExperiment:
    """The preset with what the command line changes of it; refuses methods that there are not."""
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
    """The recording, or the pads with which touches are simulated."""
    if args.dataset is not None:
        every = args.pad_model_of == "all"
        return [RecordedSource(args.dataset, args.skin_name, args.objects, args.unit, args.rig, every)]
    pads = cfg.pads if args.pad is None else (str(args.pad),)
    return [SimulatedSource(pad, cfg.simulation) for pad in pads]


def run_one(source: TouchSource, cfg: TrainExperiment, *, seed: int, pad_model_seed: int, out: Path) -> None:
    """One pad and seed: prepare the touches, fit every method, evaluate them, fit the pad model, report."""
    started = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    objects = source.objects_known()  # before all that takes long
    dataset = source.dataset(seed, out)
    beside: dict[str, np.ndarray] = {}  # rows of predictions by other views
    if cfg.registered is None:
        prepared = prepare(dataset, cfg, cfg.split, seed, cfg.softness)
    else:
        prepared, objects, beside = prepare_registered(dataset, objects, cfg, seed)
    print(summary_of(prepared))
    touches, split = prepared.touches, prepared.split
    touches = replace(touches, paper=cfg.paper, training=cfg.training)

    methods, fitted = find_methods(cfg.methods), {}
    for method in methods:
        predictor = method.fit(jax.random.key(seed), touches, split)
        if predictor is not None:
            fitted[method.title] = predictor
    if lacking := [method.title for method in methods if method.title not in fitted]:
        prepared = noted(prepared, f"left out, as the touches lack what they need: {', '.join(lacking)}")

    by_position = {} if source.recording is None else position_readings(touches.dataset, split, seed)
    evaluation = evaluate(prepared, methods, fitted, by_position)
    if touches.dataset.touches.truth is not None and touches.pressure_model is not None:
        evaluation.predicted[CEILING] = ceiling(touches.dataset, touches.pressure_model, split, seed)
    evaluation.predicted.update(beside)
    notes = [
        *prepared.notes,
        *pressure_note(evaluation.choice, source.recording),
        *position_note(evaluation.choice, list(by_position)),
    ]
    baselines = [method.title for method in methods if method.baseline]
    about = {"seed": seed, "pad": source.pad, "notes": notes, "baselines": baselines}
    pad_model = fit_or_explain(partial(source.pad_model, pad_model_seed, touches.dataset, split.train, objects))
    report(out, prepared, evaluation, pad_model, about=about, started=started)


def prepare_registered(
    dataset: Dataset, objects: ObjectsKnown, cfg: TrainExperiment, seed: int
) -> tuple[Prepared, ObjectsKnown, dict[str, np.ndarray]]:
    """Touches with corrected views, what is known of their objects then, and rows of predictions by other views."""
    as_prepared = partial(prepare, how=cfg.split, seed=seed, softness=cfg.softness)
    as_seen = as_prepared(dataset, replace(cfg, registered=None))
    found = register_known(dataset, objects)
    others = {ON_CAMERA: as_seen}
    if cfg.registered == "camera":
        corrected = by_camera(found, as_seen.touches.dataset.touches.session[as_seen.split.train])
        if found.all_known:
            others[BY_SESSIONS] = as_prepared(by_sessions(found).dataset, cfg)
    else:
        corrected = by_sessions(found)
    prepared = as_prepared(corrected.dataset, cfg)
    rows = {name: reading_row(each, seed) for name, each in others.items()}
    return (
        prepared._replace(notes=(*corrected.notes, *prepared.notes)),
        corrected.objects,
        {name: row for name, row in rows.items() if row is not None},
    )


def fit_or_explain(fit: Callable[[], KnownPad]) -> KnownPad | str:
    """The pad model, or why the touches make none: many that a predictor is content with do not."""
    try:
        known = fit()
    except ValueError as error:
        print(printable(f"note: no pad model, so that recognition cannot use this run: {error}"))
        return str(error)
    print(describe(known))
    return known


def summary_of(prepared: Prepared) -> str:
    """Touches of each part of the split, and what is odd about them."""
    dataset, split = prepared.touches.dataset, prepared.split
    counts = f"{split.train.sum()} train, {split.validation.sum()} validate, {split.test.sum()} test"
    sizes = f"{len(dataset)} touches ({source_phrase(dataset.source)}), split by {split.description}: {counts}"
    return "\n".join([sizes, *(printable(f"note: {note}") for note in prepared.notes)])


def noted(prepared: Prepared, note: str) -> Prepared:
    """Say one thing more of a recording, and remember it."""
    print(printable(f"note: {note}"))
    return prepared._replace(notes=(*prepared.notes, note))
