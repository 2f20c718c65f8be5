"""Scores of the classifiers: on parts that are held out, on a new skin, with other sensors, and their limits."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from experiments.shapes.config import ShapeExperiment
from experiments.shapes.methods import (
    IMAGINED,
    PAPER,
    StampClassificationBenchmark,
    StampPresses,
    presses_on,
    rows_per_shape,
    split_folds,
)
from experiments.shapes.networks import classify
from experiments.shapes.world import SHAPES, press_stamps
from i2t.progress import progress
from i2t.simulation.touches import SimulationErrors
from i2t.skin.faults import Faults
from i2t.skin.noise import Noise
from i2t.skin.pad import numbered_pad


def splits(benchmark: StampClassificationBenchmark, held: dict[str, np.ndarray]) -> dict[str, Any]:
    """Guesses of each method for each press, split by split."""
    return {
        split: {method: benchmark.guesses(method, part).tolist() for method in benchmark.methods()}
        for split, part in held.items()
    }


def new_skin(
    benchmark: StampClassificationBenchmark, others: list[StampPresses], cfg: ShapeExperiment, seed: int
) -> dict[str, Any]:
    """Shares of right answers on this skin, of classifiers fitted to other skins and to a few of its own presses."""
    made: dict[str, Any] = {}
    p, classes = benchmark.presses, len(benchmark.names)
    if others:
        x, y = np.concatenate([o.reading for o in others]), np.concatenate([o.shape for o in others])
        guess = classify(cfg.methods.paper, x, y, p.reading, classes=classes, seed=seed).argmax(1)
        made["0"] = {f"{PAPER}, other skins": [float(np.mean(guess == p.shape))]}
    for each in cfg.presses_per_shape:
        made[str(each)] = {method: [] for method in benchmark.methods()}
        for draw in range(cfg.draws):
            train = rows_per_shape(p, each, seed + draw)
            test = np.setdiff1d(np.arange(len(p.shape)), train)
            for method, rates in made[str(each)].items():
                guess = benchmark.log_probability(method, train, test, seed + draw).argmax(1)
                rates.append(float(np.mean(guess == p.shape[test])))
    return made


def sensor(benchmark: StampClassificationBenchmark, presses: StampPresses, seed: int) -> dict[str, list[int]]:
    """Guesses on the random split of the same presses read by another sensor."""
    other, part = replace(benchmark, presses=presses), split_folds(presses, "random", seed)
    assert part is not None
    return {
        method: other.guesses(method, part).tolist() for method in (PAPER, IMAGINED) if method in benchmark.methods()
    }


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
    """Scores of the paper's classifier on the first skin on a random fifth of easier presses, of more, and of rows of
    which several are of one press: share of right answers and number of rows.
    """
    how = replace(cfg.pressing, friction=False)  # whose part is small
    repeated = replace(how, readings=cfg.rows)
    sets = {
        "rotations within 30 degrees": (replace(how, max_rotation=np.pi / 6), 1, False),
        "positions within 0.5 mm": (replace(how, max_position=0.5e-3), 1, False),
        f"{cfg.more} times the presses": (how, cfg.more, False),
        f"{cfg.rows} rows of each press": (repeated, 1, False),
        f"{cfg.rows} rows of each press, whole presses held out": (repeated, 1, True),
    }
    made = {}
    for name, (plan, times, whole) in sets.items():
        n = times * cfg.presses
        with progress(total=n, desc=name, unit="press") as bar:
            pad = numbered_pad(cfg.pads[0])
            presses = presses_on(press_stamps(jax.random.key(seed + 1), [pad], n, plan, bar.update), 0)
        paper = cfg.methods.paper
        part = split_folds(presses, "random", seed)
        assert part is not None
        if whole:
            part = np.repeat(part[: n // plan.readings], plan.readings)
        paper = replace(paper, steps=times * paper.steps)  # as many epochs
        right = np.zeros(n, bool)
        for fold in np.unique(part):
            known = part != fold
            log_p = classify(
                paper, presses.reading[known], presses.shape[known], presses.reading[~known],
                classes=len(SHAPES), seed=seed + int(fold),
            )  # fmt: skip
            right[~known] = log_p.argmax(1) == presses.shape[~known]
        made[name] = [float(right.mean()), n]
    return made
