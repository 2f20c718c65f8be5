"""Question: which of five stamps pressed the skin, and does the answer survive new places, depths, turns and skins?

    python -m experiments.shapes                     three skins, simulated, 1280 presses each: some 30 minutes
    python -m experiments.shapes --preset debug      the same in seconds, too small to mean anything
    python -m experiments.shapes --dataset DIR       recorded presses (python -m i2t.convert; docs/data.md)

The skin is held still; a stamp comes down at any place and turn until it bears 1 to 3 N. Every split is five-fold: a
fifth of the presses is held out, drawn at random or as squares of places, fifths of the travel or sectors of the turn,
and every press is tested once. Leave-pad-out tests on a skin that only 0, 5 or 20 presses of each shape are known of.
The paper's classifier reached 0.92 on a random fifth. Results go to --out: metrics.json, config.json, figures, and the
presses (data.h5).
"""

import json
import os
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

# Factors of a few hundred rows are too small to share: waiting threads of LAPACK cost more than they give.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np
import tyro
from tqdm import tqdm

from experiments.common.runs import begin, reported, write_json
from experiments.shapes import report
from experiments.shapes.methods import (
    IMAGINED,
    PAPER,
    SPLITS,
    Bench,
    Methods,
    Presses,
    few,
    folds,
    presses_on,
    read_again,
    shapes_of,
)
from experiments.shapes.networks import Classifier, classify
from experiments.shapes.world import SHAPES, Pressing, press_stamps
from i2t.skin.pad import numbered_pad
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.simulation.touches import SimulationErrors
from i2t.skin.elasticity import Grid
from i2t.skin.faults import Faults
from i2t.skin.noise import Noise


@dataclass(frozen=True)
class ShapeExperiment:
    """What `python -m experiments.shapes` does."""

    pads: tuple[int, ...] = (0, 1, 2)  # numbers of the simulated skins
    presses: int = 1280  # on each, the paper's
    pressing: Pressing = field(default_factory=Pressing)
    methods: Methods = field(default_factory=Methods)
    few: tuple[int, ...] = (5, 20)  # presses of each shape that are known of a new skin
    draws: int = 5  # of those presses
    noise: tuple[float, ...] = (0.5, 2.0, 4.0)  # times the real sensor's, which the splits have; none: no other sensors
    rows: int = 8  # of each press, for what a split may hide
    more: int = 4  # times as many presses, for what limits the classifier; 0: not asked


_COARSE = Grid(20, 32)
PRESETS: dict[str, ShapeExperiment] = {
    "paper": ShapeExperiment(),
    "debug": ShapeExperiment(
        pads=(0, 1),
        presses=50,
        pressing=Pressing(grid=_COARSE, friction=False, touches_per_run=25),
        methods=Methods(Classifier((16, 10), 40), Classifier((16, 10), 40), library=8, layers=1, grid=_COARSE),
        few=(2,),
        draws=1,
        noise=(),
        more=0,
    ),
}


@dataclass(frozen=True)
class Args:
    """Tell stamps apart by touch, on new places, depths, turns and skins."""

    out: Path = Path("runs/shapes")  # folder for everything that is made
    preset: Literal["paper", "debug"] = "paper"
    dataset: Path | None = None  # recorded presses in place of simulated ones; its objects are the shapes
    seed: int = 0
    resume: bool = False  # go on with an unfinished run in --out
    overwrite: bool = False


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__, prog="python -m experiments.shapes")
    return reported(partial(run, args), args.out)


def run(args: Args) -> dict[str, Any]:
    """The experiment: presses, then pad by pad the splits, new skins, and what limits them."""
    cfg = PRESETS[args.preset]
    begin(args.out, args, cfg, args.resume, args.overwrite)
    started = time.perf_counter()
    dataset = data.load(args.dataset) if args.dataset else simulated(cfg, args.seed, args.out / "data.h5")
    names = shapes_of(dataset)
    pads = [presses_on(dataset, pad) for pad in range(len(dataset.pads))]
    for pad, presses in enumerate(pads):
        if len(presses.shape) < 10 * len(names):
            raise DataError(
                f"pad {dataset.pads[pad]!r} has {len(presses.shape)} presses of {len(names)} shapes; "
                "ten of each at least are needed"
            )
    print(f"{len(dataset)} presses ({dataset.source}) of {', '.join(names)} on {len(pads)} pads")
    sensors = other_sensors(cfg) if dataset.source == "simulated" and dataset.touches.truth is not None else {}
    skins = [numbered_pad(number) for number in cfg.pads]
    again = {} if args.dataset else {name: read_again(dataset, skins, e, args.seed) for name, e in sensors.items()}

    held = [
        {split: part for split in SPLITS if (part := folds(presses, split, args.seed)) is not None} for presses in pads
    ]
    parts = []
    for pad, presses in enumerate(tqdm(pads, desc="pads", unit="pad")):
        path = args.out / f"pad-{pad}.json"
        if not path.exists():
            bench = Bench(presses, dataset.board, names, cfg.methods, args.seed)
            found = {
                "splits": splits(bench, held[pad]),
                "new": new_skin(bench, pads[:pad] + pads[pad + 1 :], cfg, args.seed),
                "sensors": {
                    name: sensor(bench, presses_on(dataset, pad, values), args.seed) for name, values in again.items()
                },
            }
            write_json(path, found)
        parts.append(json.loads(path.read_text()))
    result = {
        "source": dataset.source,
        "seed": args.seed,
        "shapes": list(names),
        "pads": list(dataset.pads),
        "presses": [len(presses.shape) for presses in pads],
        **report.summarise(parts, [presses.shape for presses in pads], held, names),
        "limits": limits(cfg, args.seed) if not args.dataset and cfg.more else {},
        "seconds": round(time.perf_counter() - started, 1),
    }
    report.figures(args.out, result)
    write_json(args.out / "metrics.json", result)
    report.report(result)
    print(f"\nresults and figures are in {args.out}")
    return result


def splits(bench: Bench, held: dict[str, np.ndarray]) -> dict[str, Any]:
    """What each method guesses of each press, split by split."""
    return {
        split: {method: bench.guesses(method, part).tolist() for method in bench.methods()}
        for split, part in held.items()
    }


def new_skin(bench: Bench, others: list[Presses], cfg: ShapeExperiment, seed: int) -> dict[str, Any]:
    """Shares of right answers on this skin, of what other skins and a few of its own presses taught."""
    made: dict[str, Any] = {}
    p, classes = bench.presses, len(bench.names)
    if others:
        x, y = np.concatenate([o.reading for o in others]), np.concatenate([o.shape for o in others])
        guess = classify(seed, cfg.methods.paper, x, y, p.reading, classes).argmax(1)
        made["0"] = {f"{PAPER}, other skins": [float(np.mean(guess == p.shape))]}
    for each in cfg.few:
        made[str(each)] = {method: [] for method in bench.methods()}
        for draw in range(cfg.draws):
            train = few(p, each, seed + draw)
            test = np.setdiff1d(np.arange(len(p.shape)), train)
            for method, rates in made[str(each)].items():
                guess = bench.log_p(method, train, test, seed + draw).argmax(1)
                rates.append(float(np.mean(guess == p.shape[test])))
    return made


def sensor(bench: Bench, presses: Presses, seed: int) -> dict[str, list[int]]:
    """Guesses on the random split of the same presses read by another sensor."""
    other, part = bench.with_readings(presses), folds(presses, "random", seed)
    assert part is not None
    return {method: other.guesses(method, part).tolist() for method in (PAPER, IMAGINED) if method in bench.methods()}


def other_sensors(cfg: ShapeExperiment) -> dict[str, SimulationErrors]:
    """Sensors of other noise, and without noise and faults."""
    real = cfg.pressing.errors
    if not cfg.noise:
        return {}
    return {f"{level:g} x noise": replace(real, noise=real.noise.scaled(level)) for level in cfg.noise} | {
        "no faults": replace(real, faults=Faults()),
        "no noise": replace(real, noise=Noise.none()),
        "neither": replace(real, noise=Noise.none(), faults=Faults()),
    }


def limits(cfg: ShapeExperiment, seed: int) -> dict[str, list[float]]:
    """What the paper's classifier would reach on the first skin on a random fifth of easier presses, of more, and of
    rows of which several are of one press: share of right answers and number of rows.
    """
    how = replace(cfg.pressing, friction=False)  # whose part is small
    repeated = replace(how, readings=cfg.rows)
    sets = {
        "turns within 30 degrees": (replace(how, turn=np.pi / 6), 1, False),
        "places within 0.5 mm": (replace(how, place=0.5e-3), 1, False),
        f"{cfg.more} times the presses": (how, cfg.more, False),
        f"{cfg.rows} rows of each press": (repeated, 1, False),
        f"{cfg.rows} rows of each press, whole presses held out": (repeated, 1, True),
    }
    made = {}
    for name, (plan, times, whole) in sets.items():
        n = times * cfg.presses
        with tqdm(total=n, desc=name, unit="press") as bar:
            pad = numbered_pad(cfg.pads[0])
            presses = presses_on(press_stamps(jax.random.key(seed + 1), [pad], n, plan, bar.update), 0)
        paper = cfg.methods.paper
        part = folds(presses, "random", seed)
        assert part is not None
        if whole:
            part = np.repeat(part[: n // plan.readings], plan.readings)
        paper = replace(paper, steps=times * paper.steps)  # as many epochs
        right = np.zeros(n, bool)
        for fold in np.unique(part):
            known = part != fold
            log_p = classify(seed + int(fold), paper, presses.reading[known], presses.shape[known],
                             presses.reading[~known], len(SHAPES))  # fmt: skip
            right[~known] = log_p.argmax(1) == presses.shape[~known]
        made[name] = [float(right.mean()), n]
    return made


def simulated(cfg: ShapeExperiment, seed: int, path: Path) -> Dataset:
    """The embedded default, kept in `path` for a resumed run."""
    if path.exists():
        return data.load(path)
    with tqdm(total=cfg.presses * len(cfg.pads), desc="pressing stamps", unit="press") as bar:
        pads = [numbered_pad(number) for number in cfg.pads]
        made = press_stamps(jax.random.key(seed), pads, cfg.presses, cfg.pressing, bar.update)
    data.save(path, made)
    return made
