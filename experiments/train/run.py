"""Question: how well does a model trained on two objects predict the touch of objects it has never met?

    python -m experiments.train                      the paper's set, simulated: 1630 touches, one pad, one seed
    python -m experiments.train --preset debug       a few touches, too few to mean anything
    python -m experiments.train --seeds 5            means and 95 % intervals over seeds
    python -m experiments.train --preset study       six pads, one seed: means and 95 % intervals over pads
    python -m experiments.train --preset study --workers 2        its pads side by side (docs/compiled.md)
    python -m experiments.train --pad FILE           a pad fitted to a real skin in place of a random one
    python -m experiments.train --dataset DIR        any recorded or converted set (see python -m i2t.convert)
    python -m experiments.train --methods gp ridge --method my_package.module:Mine    these, and one of your own
    python -m experiments.train --paper.bottleneck 16 --paper.auxiliary-weight 0.1    another network, another loss

Hexagon and parallelogram train, one tool validates, six other objects test. Every method sees the same touches:
baselines that look up or regress patches (mean, nearest, nearest-measured, ridge, ridge-measured), the paper's network
on contact masks or depths (paper-mask, paper-depth), in a study also with the measured force (paper-mask-force,
paper-depth-force), and two models on predicted contact pressure (pressure-network, gp). The best of all of them on the
validation touches is kept as the predictor, a baseline too. Where a model on predicted contact pressure loses to a
baseline, `experiments.fidelity` tests likely causes. A ceiling shows what the same model would reach if the camera and
the arm made no error. Results go to --out: metrics.json, config.json, figures, the data (data.h5) and checkpoint/,
which `i2t.load_predictor` reads. Of --dataset the training touches are kept (recognition.h5, recognition.json,
meshes/), so that `experiments.recognize` can make a pad model of them.

On two quiet cores the default took 101 s the first time, when everything is compiled, and 72 s the second; `--preset
debug` 30 s and 16 s.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax

from experiments.common.presets import choose_preset
from experiments.common.runs import begin
from experiments.common.tasks import Task, tasks_here
from experiments.train import recognition_data
from experiments.train.arguments import TrainArgs
from experiments.train.configs import PRESETS, TrainExperiment
from experiments.train.evaluation import evaluate, pressure_note
from experiments.train.prepare import Prepared, prepare
from experiments.train.recognition_data import MeshFile
from experiments.train.reports import print_table, report, summarise
from experiments.train.simulate import ceiling, simulated_dataset
from i2t import dataset as data
from i2t.dataset import Dataset, source_words
from i2t.files.terminal import printable
from i2t.prediction.methods import find_methods
from i2t.skin.files import load_pad, load_pad_about
from i2t.types import Pad

CEILING = "ceiling: GP without camera and arm errors"


def run(args: TrainArgs) -> dict[str, Any]:
    """The experiment: every pad and seed, then the table over them."""
    cfg = choose_preset(PRESETS, args.preset, methods=args.methods, pads=args.pads)
    cfg = replace(cfg, methods=("mean", *(name for name in (*cfg.methods, *args.method) if name != "mean")))
    if args.epochs is not None:
        cfg = replace(cfg, training=replace(cfg.training, epochs=args.epochs))
    find_methods(cfg.methods)  # refuses names that are none, before anything is made
    seeds = range(args.seed, args.seed + (args.seeds or cfg.seeds))
    meshes = {path.stem: MeshFile(path, str(args.unit)) for path in args.objects}
    pads: Sequence[Pad | int | None] = (None,) if args.dataset else (load_pad(args.pad),) if args.pad else cfg.pads
    begin(args.out, args, cfg, args.resume, args.overwrite)
    several, tasks = len(seeds) * len(pads) > 1, []
    for pad in pads:
        for seed in seeds:
            name = f"pad-{pad if isinstance(pad, int) else 0}-seed-{seed}"
            place = args.out / name if several else args.out
            work = partial(run_one, args, cfg, seed=seed, pad=pad, out=place, meshes=meshes)
            tasks.append(Task(name, place / "metrics.json", work))
    for task in tasks_here(tasks, args.tasks):
        task.work()
    parts = [json.loads(task.finished.read_text()) for task in tasks]
    result = parts[0] if not several else summarise(parts, args.out)
    print_table(result)
    return result


def run_one(
    args: TrainArgs, cfg: TrainExperiment, seed: int, pad: Pad | int | None, out: Path, meshes: Mapping[str, MeshFile]
) -> None:
    """One pad and seed: prepare the touches, fit every method, evaluate them, report."""
    started = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    prepared = prepare(touches_of(args, cfg, seed, pad, out), cfg, args.split, seed, args.softness)
    print(summary_of(prepared))
    touches, split = prepared.touches, prepared.split
    touches = replace(touches, paper=args.paper, training=cfg.training)
    if args.dataset:
        print(recognition_data.keep(out, touches.dataset, split.train, meshes))

    methods, fitted = find_methods(cfg.methods), {}
    for method in methods:
        predictor = method.fit(jax.random.key(seed), touches, split)
        if predictor is not None:
            fitted[method.title] = predictor
    if lacking := [method.title for method in methods if method.title not in fitted]:
        prepared = noted(prepared, f"left out, as the touches lack what they need: {', '.join(lacking)}")

    evaluation = evaluate(prepared, methods, fitted)
    if touches.dataset.touches.truth is not None and touches.pressure_model is not None:
        evaluation.predicted[CEILING] = ceiling(touches.dataset, touches.pressure_model, split, seed)
    notes = [*prepared.notes, *pressure_note(evaluation.choice, args.dataset)]
    about = {"seed": seed, "pad": str(args.pad) if args.pad else pad, "notes": notes}
    report(out, prepared, evaluation, about=about, started=started)


def touches_of(args: TrainArgs, cfg: TrainExperiment, seed: int, pad: Pad | int | None, out: Path) -> Dataset:
    """Recorded touches, or simulated ones."""
    if args.dataset:
        return data.load_dataset(args.dataset, skin=args.skin_name)
    name = load_pad_about(args.pad).name if args.pad else None
    return simulated_dataset(cfg.simulation, 0 if pad is None else pad, out / "data.h5", seed=seed, name=name)


def summary_of(prepared: Prepared) -> str:
    """Touches of each part of the split, and what is odd about them."""
    dataset, split = prepared.touches.dataset, prepared.split
    counts = f"{split.train.sum()} train, {split.validation.sum()} validate, {split.test.sum()} test"
    sizes = f"{len(dataset)} touches ({source_words(dataset.source)}), split by {split.how}: {counts}"
    return "\n".join([sizes, *(printable(f"note: {note}") for note in prepared.notes)])


def noted(prepared: Prepared, note: str) -> Prepared:
    """Say one thing more of a recording, and remember it."""
    print(printable(f"note: {note}"))
    return prepared._replace(notes=(*prepared.notes, note))
