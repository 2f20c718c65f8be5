"""Question: does i2t.calibrate lose to a baseline on recordings that are shifted, damaged or of other skins?

    python -m experiments.shifted --dataset eflesh/spatial              30 variants, ten minutes on one core
    python -m experiments.shifted --dataset eflesh/spatial --only late  some of them
    python -m experiments.shifted --dataset eflesh/spatial --seed 11    others: what was chosen was chosen on these

1500 rows of a recording are shifted and damaged in one way at a time; skins of six kinds are simulated. From 5, 20, 50
and 100 presses all others are predicted: presses held out at random, and whole blocks of 6 mm. Baselines are the mean,
the nearest presses and two plain Gaussian processes (lengths by leaving one out, and by marginal likelihood); the best
of them is the one with the largest mean R2, known only afterwards. Results go to --out: metrics.json.
"""

import os
import time
from typing import Any

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from experiments.common.runs import begin, write_json
from experiments.fidelity.forward import BASELINE_METHODS, PressSet, explained_share
from experiments.shifted.arguments import ShiftedArgs
from experiments.shifted.variants import Variant, make_variants
from i2t.calibration import calibrate, plain_gp
from i2t.calibration.structured_gp import STDS_WITHIN_90_PERCENT
from i2t.dataset import square_blocks
from i2t.progress import progress

SHIFTED_COUNTS = (5, 20, 50, 100)
CALIBRATED, LIKELIEST = "i2t.calibrate", "plain Gaussian process, most likely"
BLOCK_M, BLOCK_SHARE = 6e-3, 0.25
RANDOM_TEST, FEW_RANDOM_TEST, MOST_TESTED, LEAST_TESTED = 300, 120, 300, 10
MANY_HELD_OUT_FROM = 1000
LOST = (0.01, 0.03, 0.1)  # of R2
SHOWN_LOSS = 0.03


def run(args: ShiftedArgs) -> dict[str, Any]:
    """The experiment: prepare, evaluate, report."""
    begin(args.out, args, args, None, args.overwrite)
    started = time.perf_counter()
    variants = {
        name: one
        for name, one in make_variants(args.dataset, args.seed).items()
        if not args.only or any(part in name for part in args.only)
    }
    if not variants:
        raise ValueError(f"--only {' '.join(args.only)}: no variant has such a name")
    cells: list[dict[str, Any]] = []
    for name, variant in progress(variants.items(), unit="variant"):
        cells += scored(name, variant, args)
    metrics = {
        "source": "mixed",
        "seed": args.seed,
        "draws": args.draws,
        "cells": cells,
        "summary": {split: summary([one for one in cells if one["held_out"] == split]) for split in WAYS_HELD_OUT},
        "seconds": round(time.perf_counter() - started, 1),
    }
    write_json(args.out / "metrics.json", metrics)
    print_table(metrics)
    return metrics


WAYS_HELD_OUT = ("random presses", "whole blocks")


def scored(name: str, variant: Variant, args: ShiftedArgs) -> list[dict[str, Any]]:
    """R2 of every method and the share of readings in the 90 % range, by what is held out and number of presses."""
    y, n = variant.readings, len(variant.readings)
    load = np.zeros(n) if variant.load is None else variant.load
    presses = PressSet(variant.position, load, variant.load_kind, y, np.zeros(n, int), np.zeros(n), np.arange(n))
    found: dict[tuple[str, int], list[dict[str, float]]] = {}
    for draw in range(args.draws):
        for split, (pool, test) in held_out(variant.position, np.random.default_rng((args.seed, draw))).items():
            for count in (count for count in SHIFTED_COUNTS if count <= len(pool) and len(test) >= LEAST_TESTED):
                found.setdefault((split, count), []).append(scores_of(presses, variant, pool[:count], test))
    cells = []
    for (split, count), draws in found.items():
        means = {key: float(np.mean([one[key] for one in draws])) for key in draws[0]}
        inside = means.pop("inside_90")
        best = max((key for key in means if key != CALIBRATED), key=lambda key: means[key])
        cells.append(
            {"variant": name, "held_out": split, "presses": count, "r2": means, "best_baseline": best,
             "gain": means[CALIBRATED] - means[best], "inside_90": inside}
        )  # fmt: skip
    return cells


def held_out(position: np.ndarray, rng: np.random.Generator) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rows to learn from, in random order, and to test on."""
    order, span = rng.permutation(len(position)), np.ptp(position, axis=0)
    edge = BLOCK_M if span.max() > 5e-3 else span.max() / 4
    block = square_blocks(position, edge)
    count = block.max() + 1
    held = np.isin(block, rng.permutation(count)[: max(round(BLOCK_SHARE * count), 1)])
    tested = RANDOM_TEST if len(order) >= MANY_HELD_OUT_FROM else FEW_RANDOM_TEST
    return {
        WAYS_HELD_OUT[0]: (order[tested:], order[:tested]),
        WAYS_HELD_OUT[1]: (order[~held[order]], order[held[order]][:MOST_TESTED]),
    }


def scores_of(presses: PressSet, variant: Variant, known: np.ndarray, test: np.ndarray) -> dict[str, float]:
    """R2 of each method from the known presses."""
    y, at, load = presses.readings, presses.position, presses.load
    predicted = {name: method(presses, known, test) for name, method in BASELINE_METHODS.items()}
    given = at[known], load[known], y[known]
    predicted[LIKELIEST] = plain_gp.predict_plain(plain_gp.fit_scales(*given), given, (at[test], load[test]))
    stated = variant.load
    calibration = calibrate(at[known], None if stated is None else stated[known], y[known], load_kind=variant.load_kind)
    mean, std = calibration.predict(at[test], None if stated is None else stated[test])
    predicted[CALIBRATED] = mean
    scores = {name: explained_share(y[test], values) for name, values in predicted.items()}
    return scores | {"inside_90": float(np.mean(np.abs(y[test] - mean) < STDS_WITHIN_90_PERCENT * std))}


def summary(cells: list[dict[str, Any]]) -> dict[str, Any]:
    """Rate and amount by which the best baseline is above."""
    gain = np.array([one["gain"] for one in cells])
    if not len(gain):
        return {"cells": 0}
    return {
        "cells": len(cells),
        "mean_r2": float(np.mean([np.clip(one["r2"][CALIBRATED], -1, 1) for one in cells])),
        "mean_loss": float(np.mean(np.clip(gain, -1, 0))),
        "lost_by_more_than": {str(limit): int(np.sum(gain < -limit)) for limit in LOST},
        "inside_90": float(np.mean([one["inside_90"] for one in cells])),
    }


def print_table(metrics: dict[str, Any]) -> None:
    """Print where the best baseline is clearly above, and the summary."""
    for one in metrics["cells"]:
        if one["gain"] < -SHOWN_LOSS:
            best = one["best_baseline"]
            print(
                f"{one['variant']}, {one['held_out']}, {one['presses']} presses: {one['r2'][CALIBRATED]:.3f}, {best} "
                f"{one['r2'][best]:.3f}"
            )
    for split, one in metrics["summary"].items():
        print(f"{split}: {one}")
