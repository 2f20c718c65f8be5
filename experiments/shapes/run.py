"""Question: how often is a stamp recognised by touch, also at new positions, travels and rotations and on new skins?

    python -m experiments.shapes                     three simulated skins, 1280 presses each, in about 15 minutes
    python -m experiments.shapes --preset debug      a few presses, too few for meaningful results
    python -m experiments.shapes --dataset DIR       recorded presses (i2t convert; docs/data.md)
    python -m experiments.shapes --readings TABLE --label COLUMN [--ignore COLUMN ...] [--samples N]
                                                     any table of labelled readings (docs/shapes.md)

The skin is fixed, and a stamp is pressed on it with 1 to 3 N at any position and rotation. Every split is five-fold: a
fifth of the presses is held out, at random or by squares of positions, fifths of the travel or sectors of the rotation,
and every press is tested once. The test on a new skin uses 0, 5 or 20 training presses of each shape on that skin. The
paper's classifier reached 0.92 on a random fifth. Results go to --out: metrics.json, config.json, figures, and the
presses (data.h5).
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


@dataclass(frozen=True)
class ShapeExperiment:
    """Settings of `python -m experiments.shapes`."""

    pads: tuple[int, ...] = (0, 1, 2)  # numbers of the simulated skins
    presses: int = 1280  # on each pad, as in the paper
    pressing: StampPressConfig = field(default_factory=StampPressConfig)
    methods: Methods = field(default_factory=Methods)
    presses_per_shape: tuple[int, ...] = (5, 20)  # training presses on a new skin
    draws: int = 5  # random choices of these presses


PRESETS: dict[str, ShapeExperiment] = {
    "paper": ShapeExperiment(),
    "debug": ShapeExperiment(
        pads=(0, 1),
        presses=50,
        pressing=StampPressConfig(grid=Grid(20, 32), friction=False, touches_per_session=25),
        methods=Methods(Classifier((16, 10), 40), Classifier((16, 10), 40), layers=1, grid=Grid(20, 32)),
        presses_per_shape=(2,),
        draws=1,
    ),
}


class ShapePresses(NamedTuple):
    """The presses on all pads, with the folds of every split."""

    dataset: Dataset
    names: tuple[str, ...]  # names of the shapes
    pads: list[StampPresses]
    held: list[dict[str, np.ndarray]]  # test fold of each press, by pad and split


def run(args: ShapesArgs) -> dict[str, Any]:
    """Run all splits and the tests on new skins, pad by pad, and report the rates."""
    cfg = choose_preset(PRESETS, args.preset)
    if args.readings:
        from experiments.shapes import readings  # the only module here that needs scikit-learn

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
    parts = [_with_new_split_names(part) for part in make_parts(makers, args.workers, bar="pads")]
    result = {
        "source": dataset.source,
        "seed": args.seed,
        "shapes": list(names),
        "pads": list(dataset.pads),
        "presses": [len(pad.shape) for pad in presses.pads],
        **report.summarise(parts, [pad.shape for pad in presses.pads], presses.held, names),
        "seconds": round(time.perf_counter() - started, 1),
    }
    report.figures(args.out, result)
    write_json(args.out / "metrics.json", result)
    report.report(result)
    return result


def _with_new_split_names(part: Part) -> Part:
    """Replace names of splits in the parts of runs that an earlier version began, which called the travel depth."""
    splits = {"travel" if split == "depth" else split: scores for split, scores in part["splits"].items()}
    return part | {"splits": splits}


def prepare(args: ShapesArgs, cfg: ShapeExperiment) -> ShapePresses:
    """Load recorded presses, or simulate them, and split them into folds (DataError: there are too few)."""
    dataset = data.load_dataset(args.dataset) if args.dataset else simulated(cfg, args.seed, args.out / "data.h5")
    names = shapes_of(dataset)
    pads = [presses_on(dataset, pad) for pad in range(len(dataset.pads))]
    for name, presses in zip(dataset.pads, pads, strict=True):
        if len(presses.shape) < 10 * len(names):
            raise DataError(
                f"pad {name!r} has {len(presses.shape)} presses of {len(names)} shapes; at least ten of each are needed"
            )
    folds = [{split: split_folds(presses, split, args.seed) for split in SPLITS} for presses in pads]
    held = [{split: fold for split, fold in of_pad.items() if fold is not None} for of_pad in folds]
    return ShapePresses(dataset, names, pads, held)


def simulated(cfg: ShapeExperiment, seed: int, path: Path) -> Dataset:
    """Load the simulated presses in `path`, or simulate them if the file does not exist."""
    if path.exists():
        return data.load_dataset(path)
    with progress(total=cfg.presses * len(cfg.pads), desc="pressing stamps", unit="presses") as bar:
        pads = [pad_from_seed(number) for number in cfg.pads]
        presses = press_stamps(jax.random.key(seed), pads, cfg.presses, cfg.pressing, bar.update)
    data.save_dataset(path, presses)
    return presses


def make_part(presses: ShapePresses, pad: int, cfg: ShapeExperiment, seed: int) -> Part:
    """Classify the presses on one pad with all methods in every split, and score them on the pad as a new skin."""
    own, others = presses.pads[pad], presses.pads[:pad] + presses.pads[pad + 1 :]
    classes = len(presses.names)
    benchmark = StampClassificationBenchmark(own, presses.dataset.board, presses.names, cfg.methods, seed)
    splits = {
        split: {method: benchmark.guesses(method, part).tolist() for method in benchmark.methods()}
        for split, part in presses.held[pad].items()
    }
    new: dict[str, Any] = {}  # by number of training presses of each shape on the skin
    if others:
        y, new["0"] = np.concatenate([o.shape for o in others]), {}
        for method in (PAPER, POSED) if own.located else (PAPER,):
            x, network = np.concatenate([o.inputs(method) for o in others]), cfg.methods.network(method)
            guess = classify(network, x, y, own.inputs(method), classes=classes, seed=seed).argmax(1)
            new["0"][f"{method}, other skins"] = [float(np.mean(guess == own.shape))]
    for count in cfg.presses_per_shape:
        new[str(count)] = {method: [] for method in benchmark.methods()}
        for draw in range(cfg.draws):
            train = rows_per_shape(own, count, seed + draw)
            test = np.setdiff1d(np.arange(len(own.shape)), train)
            for method, rates in new[str(count)].items():
                guess = benchmark.log_probability(method, train, test, seed + draw).argmax(1)
                rates.append(float(np.mean(guess == own.shape[test])))
    return {"splits": splits, "new": new}
