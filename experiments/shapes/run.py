"""Question: which of five stamps pressed the skin, also at new positions, travels and rotations and on new skins?

    python -m experiments.shapes                     three skins, simulated, 1280 presses each: some 15 minutes
    python -m experiments.shapes --preset debug      a few presses, too few to mean anything
    python -m experiments.shapes --dataset DIR       recorded presses (python -m i2t.convert; docs/data.md)
    python -m experiments.shapes --readings TABLE --label COLUMN [--ignore COLUMN ...] [--samples N]
                                                     any table of readings with labels (docs/shapes.md)

The skin is held still; a stamp comes down at any position and rotation until it bears 1 to 3 N. Every split is
five-fold: a fifth of the presses is held out, drawn at random or as squares of positions, fifths of the travel or
sectors of the rotation, and every press is tested once. Leave-pad-out tests on a skin that only 0, 5 or 20 presses of
each shape are known of. The paper's classifier reached 0.92 on a random fifth. Results go to --out: metrics.json,
config.json, figures, and the presses (data.h5).
"""

import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.presets import choose_preset
from experiments.common.runs import Part, begin, write_json
from experiments.common.tasks import make_parts
from experiments.shapes import report
from experiments.shapes.arguments import ShapesArgs
from experiments.shapes.methods import (
    PAPER,
    POSED,
    SPLITS,
    Methods,
    StampClassificationBenchmark,
    StampPresses,
    classify,
    presses_on,
    rows_per_shape,
    shapes_of,
    split_folds,
)
from experiments.shapes.world import StampPressConfig, press_stamps
from i2t import dataset as data
from i2t.dataset import Dataset, source_phrase
from i2t.errors import DataError, printable
from i2t.paper.classifier import Classifier
from i2t.runtime.progress import progress
from i2t.skin.elasticity import Grid
from i2t.skin.pad import pad_from_seed

MIN_PRESSES_PER_SHAPE = 10


@dataclass(frozen=True)
class ShapeExperiment:
    """Settings of `python -m experiments.shapes`."""

    pads: tuple[int, ...] = (0, 1, 2)  # numbers of the simulated skins
    presses: int = 1280  # on each, the paper's
    pressing: StampPressConfig = field(default_factory=StampPressConfig)
    methods: Methods = field(default_factory=Methods)
    presses_per_shape: tuple[int, ...] = (5, 20)  # that are known of a new skin
    draws: int = 5  # of those presses


_COARSE = Grid(20, 32)
PRESETS: dict[str, ShapeExperiment] = {
    "paper": ShapeExperiment(),
    "debug": ShapeExperiment(
        pads=(0, 1),
        presses=50,
        pressing=StampPressConfig(grid=_COARSE, friction=False, touches_per_session=25),
        methods=Methods(Classifier((16, 10), 40), Classifier((16, 10), 40), layers=1, grid=_COARSE),
        presses_per_shape=(2,),
        draws=1,
    ),
}


class ShapePresses(NamedTuple):
    """The presses of all pads, and what every method is tested on."""

    dataset: Dataset
    names: tuple[str, ...]  # of the shapes
    pads: list[StampPresses]
    held: list[dict[str, np.ndarray]]  # of each pad and split: in which fold each press is tested


def run(args: ShapesArgs) -> dict[str, Any]:
    """The experiment: presses, then pad by pad the splits and new skins."""
    cfg = choose_preset(PRESETS, args.preset)
    if args.readings:
        from experiments.shapes import readings  # needs scikit-learn, as nothing else here does

        return readings.run(args, cfg.methods)
    begin(args, cfg)
    started = time.perf_counter()
    presses = prepare(args, cfg)
    dataset, names = presses.dataset, presses.names
    print(
        f"{len(dataset)} presses ({source_phrase(dataset.source)}) of {', '.join(map(printable, names))} on "
        f"{len(presses.pads)} pads"
    )
    pads = range(len(presses.pads))
    makers = {args.out / f"pad-{pad}.json": partial(make_part, presses, pad, cfg, args.seed) for pad in pads}
    parts = make_parts(makers, args.workers, bar="pads")
    result = {
        "source": dataset.source,
        "seed": args.seed,
        "shapes": list(names),
        "pads": list(dataset.pads),
        "presses": [len(each.shape) for each in presses.pads],
        **report.summarise(parts, [each.shape for each in presses.pads], presses.held, names),
        "seconds": round(time.perf_counter() - started, 1),
    }
    report.figures(args.out, result)
    write_json(args.out / "metrics.json", result)
    report.report(result)
    return result


def prepare(args: ShapesArgs, cfg: ShapeExperiment) -> ShapePresses:
    """The presses that were recorded, or simulated ones."""
    dataset = data.load_dataset(args.dataset) if args.dataset else simulated(cfg, args.seed, args.out / "data.h5")
    names = shapes_of(dataset)
    pads = [presses_on(dataset, pad) for pad in range(len(dataset.pads))]
    for name, presses in zip(dataset.pads, pads, strict=True):
        if len(presses.shape) < MIN_PRESSES_PER_SHAPE * len(names):
            raise DataError(
                f"pad {name!r} has {len(presses.shape)} presses of {len(names)} shapes; ten of each at least are needed"
            )
    folds = [{split: split_folds(presses, split, args.seed) for split in SPLITS} for presses in pads]
    held = [{split: fold for split, fold in each.items() if fold is not None} for each in folds]
    return ShapePresses(dataset, names, pads, held)


def simulated(cfg: ShapeExperiment, seed: int, path: Path) -> Dataset:
    """The embedded default, kept in `path` for a resumed run."""
    if path.exists():
        return data.load_dataset(path)
    with progress(total=cfg.presses * len(cfg.pads), desc="pressing stamps", unit="press") as bar:
        pads = [pad_from_seed(number) for number in cfg.pads]
        made = press_stamps(jax.random.key(seed), pads, cfg.presses, cfg.pressing, bar.update)
    data.save_dataset(path, made)
    return made


def make_part(presses: ShapePresses, pad: int, cfg: ShapeExperiment, seed: int) -> Part:
    """Guesses of all methods on one pad, split by split, and their scores where it is a new skin."""
    own, others = presses.pads[pad], presses.pads[:pad] + presses.pads[pad + 1 :]
    classes = len(presses.names)
    benchmark = StampClassificationBenchmark(own, presses.dataset.board, presses.names, cfg.methods, seed)
    splits = {
        split: {method: benchmark.guesses(method, part).tolist() for method in benchmark.methods()}
        for split, part in presses.held[pad].items()
    }
    new: dict[str, Any] = {}  # by how many presses of each shape are known of the skin
    if others:
        y, new["0"] = np.concatenate([o.shape for o in others]), {}
        for method in (each for each in (PAPER, POSED) if each in benchmark.methods()):
            x, network = np.concatenate([o.inputs(method) for o in others]), cfg.methods.network(method)
            guess = classify(network, x, y, own.inputs(method), classes=classes, seed=seed).argmax(1)
            new["0"][f"{method}, other skins"] = [float(np.mean(guess == own.shape))]
    for each in cfg.presses_per_shape:
        new[str(each)] = {method: [] for method in benchmark.methods()}
        for draw in range(cfg.draws):
            train = rows_per_shape(own, each, seed + draw)
            test = np.setdiff1d(np.arange(len(own.shape)), train)
            for method, rates in new[str(each)].items():
                guess = benchmark.log_probability(method, train, test, seed + draw).argmax(1)
                rates.append(float(np.mean(guess == own.shape[test])))
    return {"splits": splits, "new": new}
