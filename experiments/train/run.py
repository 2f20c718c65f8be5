"""Question: how well does a model trained on two objects predict the touch of objects it has never met?

    python -m experiments.train                      the paper's set, simulated: 1630 touches, one pad, one seed
    python -m experiments.train --preset debug       the same in less than a minute, too small to mean anything
    python -m experiments.train --seeds 5            means and 95 % intervals over seeds
    python -m experiments.train --preset study       3 pads x 5 seeds
    python -m experiments.train --pad FILE           a pad fitted to a real skin in place of a random one
    python -m experiments.train --dataset DIR        any recorded or converted set (see python -m i2t.convert)

Hexagon and parallelogram train, one tool validates, all other primitives and tools test. Every method sees the same
touches: baselines that look up or regress patches, the paper's network (contact mask or depth), and two models on
imagined pressure, of which the better on the validation object is kept as the predictor. A ceiling shows what the same
model would reach if the camera and the arm made no error. Results go to --out: metrics.json, config.json, figures, the
data (data.h5) and checkpoint/, which `i2t.load_predictor` reads.
"""

import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

# Factors of a few hundred rows are too small to share: waiting threads of LAPACK cost more than they give.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.runs import begin, reported, slug, write_json
from experiments.train.configs import PRESETS, TrainExperiment
from experiments.train.methods import (
    ceiling,
    describe,
    adapt_network,
    fit_gp,
    pressure_model_of,
    predict,
    train_network,
    views_of,
)
from experiments.train.reports import by_object, figures, report, scored, summarise
from experiments.train.splitting import conditions_of, split_dataset
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.objects import catalogue
from i2t.prediction import predictor as predicting
from i2t.prediction.metrics import baselines, score
from i2t.prediction.predictor import Predictor, Reading
from i2t.rendering.render import prepare_surface
from i2t.simulation import touches as simulation
from i2t.skin.files import load_pad
from i2t.skin.pad import sample_pad
from i2t.types import Board, Pad

GP_METHOD = "Gaussian process on imagined pressure"
CEILING = "ceiling: process without camera and arm errors"


@dataclass(frozen=True)
class Args:
    """Train a touch predictor and report how well it does on unseen objects (or unseen places)."""

    out: Path = Path("runs/train")  # folder for everything that is made
    preset: Literal["paper", "debug", "study"] = "paper"
    dataset: Path | None = None  # a data set to train on instead of simulating one
    split: Literal["auto", "object", "run", "block", "time"] = "auto"  # what is held out of --dataset
    pad: Path | None = None  # a pad on disk (`i2t.skin.files`), say one fitted to a real skin, to simulate with
    seed: int = 0  # of everything random
    seeds: int | None = None  # how many seeds, from --seed on
    epochs: int | None = None  # of the networks
    resume: bool = False  # go on with an unfinished run in --out
    overwrite: bool = False  # replace a finished or unfinished run in --out


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__, prog="python -m experiments.train")
    return reported(partial(run, args), args.out)


def run(args: Args) -> dict[str, Any]:
    """The experiment: every pad and seed, then the table over them."""
    cfg = PRESETS[args.preset]
    if args.epochs is not None:
        cfg = replace(cfg, training=replace(cfg.training, epochs=args.epochs))
    seeds = range(args.seed, args.seed + (args.seeds or cfg.seeds))
    if args.pad and args.dataset:
        raise ValueError("--pad is for simulated touches, and --dataset brings its own; pass one of them")
    pads: Sequence[Pad | int | None] = (None,) if args.dataset else (load_pad(args.pad),) if args.pad else cfg.pads
    begin(args.out, args, cfg, args.resume, args.overwrite)
    several = len(seeds) * len(pads) > 1
    parts = []
    for pad in pads:
        for seed in seeds:
            number = pad if isinstance(pad, int) else 0
            place = args.out / f"pad-{number}-seed-{seed}" if several else args.out
            finished = place / "metrics.json"
            if not finished.exists():
                run_one(args, cfg, seed, pad, place)
            parts.append(json.loads(finished.read_text()))
    result = parts[0] if not several else summarise(parts, args.out)
    report(result)
    print(f"\nresults, figures and the predictor are in {args.out}")
    return result


def run_one(args: Args, cfg: TrainExperiment, seed: int, pad: Pad | int | None, out: Path) -> None:
    """One pad and seed: data, split, methods, scores, figures, predictor."""
    started = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    dataset = (
        data.load(args.dataset) if args.dataset else simulate(cfg, seed, 0 if pad is None else pad, out / "data.h5")
    )
    split = split_dataset(dataset, cfg, args.split, seed)
    touches, readings = dataset.touches, dataset.touches.reading
    simulated = dataset.source != "real"
    noise = None if touches.truth is None else (readings - touches.truth.reading).std(0)
    print(
        f"{len(dataset)} touches ({dataset.source}), split by {split.how}: {split.train.sum()} train, "
        f"{split.validation.sum()} validate, {split.test.sum()} test"
    )

    measured = conditions_of(touches, split)
    values = np.stack([getattr(touches, name) for name in measured], -1) if measured else np.zeros((len(dataset), 0))
    predicted = baselines(
        touches.patch[split.train], values[split.train], readings[split.train], split.groups[split.train],
        touches.patch[split.test], values[split.test],
    )  # fmt: skip
    spreads: dict[str, np.ndarray] = {}

    print("imagining pressures")
    imagination = pressure_model_of(dataset, measured, cfg)
    views = views_of(dataset)
    imagined = predicting.predict_pressures(imagination, views, touches.force, touches.depth)
    candidates: dict[str, Predictor] = {}
    curves: dict[str, np.ndarray] = {}
    for name, network in cfg.networks.items():
        network, images = adapt_network(network, dataset, imagined, measured)
        trained, curve = train_network(
            name, network, replace(cfg.training, seed=seed), images, touches, split, out / "checkpoint" / slug(name)
        )
        on_pressure = network.input == "image"
        candidates[name] = describe(
            Predictor(None, trained, imagination if on_pressure else None, dataset.window, dataset.reach, 1.0, 0.3e-3),
            dataset,
            split,
        )
        curves |= curve
    process = fit_gp(imagined, readings, split, seed)
    candidates[GP_METHOD] = describe(
        Predictor(process, None, imagination, dataset.window, dataset.reach, 1.0, 0.3e-3), dataset, split
    )

    validation: dict[str, float] = {}
    held = split.validation | split.test
    tuning = split.validation[held]
    for name, candidate in candidates.items():
        reading = predict(candidate, dataset, held, imagined)
        seen = Reading(reading.mean[tuning], reading.std[tuning])
        spread = predicting.std_scale(readings[split.validation], seen)
        validation[name] = score(readings[split.validation], seen.mean).r2
        predicted[name], spreads[name] = reading.mean[~tuning], spread * reading.std[~tuning]
        candidates[name] = replace(candidate, spread=spread)
    best = max(
        (name for name in candidates if candidates[name].imagination is not None), key=lambda name: validation[name]
    )
    if touches.truth is not None:
        predicted[CEILING] = ceiling(dataset, imagination, split, seed)

    truth = readings[split.test]
    groups = split.groups[split.test]
    metrics: dict[str, Any] = {
        "source": dataset.source,
        "seed": seed,
        "pad": str(args.pad) if args.pad else pad,
        "split": split.how,
        "counts": {part: int(getattr(split, part).sum()) for part in ("train", "validation", "test")},
        "groups": len(np.unique(groups)),
        "noise_uT": None if noise is None else noise.tolist(),
        "best": best,
        "validation_r2": validation,
        "methods": {name: scored(truth, mean, groups, noise, spreads.get(name)) for name, mean in predicted.items()},
        "by_object": by_object(dataset, split, truth, predicted),
        "seconds": 0.0,
    }
    predicting.save(
        out / "checkpoint" / "predictor",
        replace(candidates[best], about={"method": best, "source": dataset.source, "seed": seed}),
    )
    figures(out, dataset, split, predicted, best, curves, noise, metrics, simulated)
    metrics["seconds"] = round(time.perf_counter() - started, 1)
    write_json(out / "metrics.json", metrics)


def numbered_pad(number: int) -> Pad:
    """The random pad of a number, which a run's metrics name."""
    return sample_pad(jax.random.key(1000 + number))


def simulate(cfg: TrainExperiment, seed: int, which: Pad | int, path: Path) -> Dataset:
    """The embedded default: simulated touches of the preset with one pad, random by its number or given, kept in `path`
    for a resumed run.
    """
    if path.exists():
        return data.load(path)
    plan = cfg.simulation
    surfaces = [prepare_surface(catalogue.make_object(name).mesh) for name in plan.objects]
    pad = numbered_pad(which) if isinstance(which, int) else which
    with tqdm(total=plan.touches, desc="simulating touches", unit="touch") as bar:
        touches = simulation.simulate(
            jax.random.key(seed), surfaces, pad, plan.errors, plan.counts(),
            limits=plan.limits, touches_per_run=plan.touches_per_run, progress=bar.update,
        )  # fmt: skip
    runs = tuple(f"run {i:03d}" for i in range(int(touches.run.max()) + 1))
    board = Board(*(np.asarray(field) for field in pad.board))
    made = Dataset(
        touches,
        plan.objects,
        (f"simulated pad {which}" if isinstance(which, int) else "pad on disk",),
        runs,
        board,
        "simulated",
        meta={"made by": f"experiments.train, seed {seed}"},
    )
    data.save(path, made)
    return made
