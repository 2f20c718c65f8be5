"""Question: which of five stamps pressed the skin, also at new positions, depths and rotations and on new skins?

    python -m experiments.shapes                     three skins, simulated, 1280 presses each: some 30 minutes
    python -m experiments.shapes --preset debug      the same in seconds, too small to mean anything
    python -m experiments.shapes --dataset DIR       recorded presses (python -m i2t.convert; docs/data.md)

The skin is held still; a stamp comes down at any position and rotation until it bears 1 to 3 N. Every split is
five-fold: a fifth of the presses is held out, drawn at random or as squares of positions, fifths of the travel or
sectors of the rotation, and every press is tested once. Leave-pad-out tests on a skin that only 0, 5 or 20 presses of
each shape are known of. The paper's classifier reached 0.92 on a random fifth. Results go to --out: metrics.json,
config.json, figures, and the presses (data.h5).
"""

import json
import os
import time
from functools import partial
from pathlib import Path
from typing import Any

# Factors of a few hundred rows are too small to share: waiting threads of LAPACK cost more than they give.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import tyro
from tqdm import tqdm

from experiments.common.presets import RENAMED, answer_renamed_value, choose_preset
from experiments.common.runs import begin, reported, write_json
from experiments.shapes import report
from experiments.shapes.config import PRESETS, ShapeExperiment, ShapesArgs
from experiments.shapes.evaluate import limits, new_skin, other_sensors, sensor, splits
from experiments.shapes.methods import SPLITS, make_benchmark, presses_on, read_again, shapes_of, split_folds
from experiments.shapes.world import press_stamps
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.skin.pad import numbered_pad


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    answer_renamed_value(argv, "--preset", RENAMED)
    args = tyro.cli(ShapesArgs, args=argv, description=__doc__, prog="python -m experiments.shapes")
    return reported(partial(run, args), args.out)


def run(args: ShapesArgs) -> dict[str, Any]:
    """The experiment: presses, then pad by pad the splits, new skins, and what limits them."""
    cfg = choose_preset(PRESETS, args.preset)
    begin(args.out, args, cfg, args.resume, args.overwrite)
    started = time.perf_counter()
    dataset = data.load_dataset(args.dataset) if args.dataset else simulated(cfg, args.seed, args.out / "data.h5")
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
        {split: part for split in SPLITS if (part := split_folds(presses, split, args.seed)) is not None}
        for presses in pads
    ]
    parts = []
    for pad, presses in enumerate(tqdm(pads, desc="pads", unit="pad")):
        path = args.out / f"pad-{pad}.json"
        if not path.exists():
            benchmark = make_benchmark(presses, dataset.board, names, cfg=cfg.methods, seed=args.seed)
            found = {
                "splits": splits(benchmark, held[pad]),
                "new": new_skin(benchmark, pads[:pad] + pads[pad + 1 :], cfg, args.seed),
                "sensors": {
                    name: sensor(benchmark, presses_on(dataset, pad, values), args.seed)
                    for name, values in again.items()
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


def simulated(cfg: ShapeExperiment, seed: int, path: Path) -> Dataset:
    """The embedded default, kept in `path` for a resumed run."""
    if path.exists():
        return data.load_dataset(path)
    with tqdm(total=cfg.presses * len(cfg.pads), desc="pressing stamps", unit="press") as bar:
        pads = [numbered_pad(number) for number in cfg.pads]
        made = press_stamps(jax.random.key(seed), pads, cfg.presses, cfg.pressing, bar.update)
    data.save_dataset(path, made)
    return made
