"""Question: which of five stamps pressed the skin, also at new positions, depths and rotations and on new skins?

    python -m experiments.shapes                     three skins, simulated, 1280 presses each: some 30 minutes
    python -m experiments.shapes --preset debug      a few presses, too few to mean anything
    python -m experiments.shapes --dataset DIR       recorded presses (python -m i2t.convert; docs/data.md)

The skin is held still; a stamp comes down at any position and rotation until it bears 1 to 3 N. Every split is
five-fold: a fifth of the presses is held out, drawn at random or as squares of positions, fifths of the depth or
sectors of the rotation, and every press is tested once. Leave-pad-out tests on a skin that only 0, 5 or 20 presses of
each shape are known of. The paper's classifier reached 0.92 on a random fifth. Results go to --out: metrics.json,
config.json, figures, and the presses (data.h5).
"""

import json
import os
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

# Factors of a few hundred rows are too small to share: waiting threads of LAPACK cost more than they give.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np

from experiments.common.presets import choose_preset
from experiments.common.runs import begin, write_json
from experiments.common.tasks import Task, run_tasks
from experiments.shapes import report
from experiments.shapes.arguments import ShapesArgs
from experiments.shapes.config import PRESETS, ShapeExperiment
from experiments.shapes.evaluate import limits, new_skin, other_sensors, sensor, splits
from experiments.shapes.methods import (
    SPLITS,
    StampPresses,
    make_benchmark,
    presses_on,
    read_again,
    shapes_of,
    split_folds,
)
from experiments.shapes.world import press_stamps
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.progress import progress
from i2t.skin.pad import numbered_pad

MIN_PRESSES_PER_SHAPE = 10


class ShapePresses(NamedTuple):
    """The presses of all pads, and what every method is tested on."""

    dataset: Dataset
    names: tuple[str, ...]  # of the shapes
    pads: list[StampPresses]
    held: list[dict[str, np.ndarray]]  # of each pad and split: in which fold each press is tested
    other_readings: dict[str, np.ndarray]  # by sensor: what it reads of the same presses


def run(args: ShapesArgs) -> dict[str, Any]:
    """The experiment: presses, then pad by pad the splits, new skins, and what limits them."""
    cfg = choose_preset(PRESETS, args.preset)
    begin(args.out, args, cfg, args.resume, args.overwrite)
    started = time.perf_counter()
    presses = prepare(args, cfg)
    dataset, names = presses.dataset, presses.names
    print(f"{len(dataset)} presses ({dataset.source}) of {', '.join(names)} on {len(presses.pads)} pads")
    tasks = []
    for pad in range(len(presses.pads)):
        path = args.out / f"pad-{pad}.json"
        tasks.append(Task(path.stem, path, partial(make_part, presses, pad, cfg, args.seed, path)))
    run_tasks(tasks, args.tasks, bar="pads")
    parts = [json.loads(task.finished.read_text()) for task in tasks]
    result = {
        "source": dataset.source,
        "seed": args.seed,
        "shapes": list(names),
        "pads": list(dataset.pads),
        "presses": [len(each.shape) for each in presses.pads],
        **report.summarise(parts, [each.shape for each in presses.pads], presses.held, names),
        "limits": limits(cfg, args.seed) if not args.dataset and cfg.more else {},
        "seconds": round(time.perf_counter() - started, 1),
    }
    report.figures(args.out, result)
    write_json(args.out / "metrics.json", result)
    report.report(result)
    return result


def prepare(args: ShapesArgs, cfg: ShapeExperiment) -> ShapePresses:
    """The presses that were recorded, or simulated ones and what other sensors would have read of them."""
    dataset = data.load_dataset(args.dataset) if args.dataset else simulated(cfg, args.seed, args.out / "data.h5")
    names = shapes_of(dataset)
    pads = [presses_on(dataset, pad) for pad in range(len(dataset.pads))]
    for name, presses in zip(dataset.pads, pads, strict=True):
        if len(presses.shape) < MIN_PRESSES_PER_SHAPE * len(names):
            raise DataError(
                f"pad {name!r} has {len(presses.shape)} presses of {len(names)} shapes; ten of each at least are needed"
            )
    other_readings = {}
    if not args.dataset and dataset.touches.truth is not None:
        skins = [numbered_pad(number) for number in cfg.pads]
        sensors = other_sensors(cfg)
        other_readings = {name: read_again(dataset, skins, errors, args.seed) for name, errors in sensors.items()}
    return ShapePresses(dataset, names, pads, [folds_of(presses, args.seed) for presses in pads], other_readings)


def folds_of(presses: StampPresses, seed: int) -> dict[str, np.ndarray]:
    """Each split that the presses of a pad allow."""
    folds = {split: split_folds(presses, split, seed) for split in SPLITS}
    return {split: fold for split, fold in folds.items() if fold is not None}


def make_part(presses: ShapePresses, pad: int, cfg: ShapeExperiment, seed: int, path: Path) -> None:
    """Scores of all methods on one pad, kept in `path`."""
    write_json(path, evaluate_pad(presses, pad, cfg, seed))


def evaluate_pad(presses: ShapePresses, pad: int, cfg: ShapeExperiment, seed: int) -> dict[str, Any]:
    """Scores of all methods on one pad: on each split, as a new skin after the others, and with other sensors."""
    own, others = presses.pads[pad], presses.pads[:pad] + presses.pads[pad + 1 :]
    benchmark = make_benchmark(own, presses.dataset.board, presses.names, cfg=cfg.methods, seed=seed)
    return {
        "splits": splits(benchmark, presses.held[pad]),
        "new": new_skin(benchmark, others, cfg, seed),
        "sensors": {
            name: sensor(benchmark, presses_on(presses.dataset, pad, readings), seed)
            for name, readings in presses.other_readings.items()
        },
    }


def simulated(cfg: ShapeExperiment, seed: int, path: Path) -> Dataset:
    """The embedded default, kept in `path` for a resumed run."""
    if path.exists():
        return data.load_dataset(path)
    with progress(total=cfg.presses * len(cfg.pads), desc="pressing stamps", unit="press") as bar:
        pads = [numbered_pad(number) for number in cfg.pads]
        made = press_stamps(jax.random.key(seed), pads, cfg.presses, cfg.pressing, bar.update)
    data.save_dataset(path, made)
    return made
