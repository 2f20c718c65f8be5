"""Question: do predictors that were built with i2t's physics also lead under other physics?

    python -m tests.second_world               five skins
    python -m tests.second_world --skins 1     the first skin only

The world is that of `tests.second_world.world`, which shares no code with i2t. Each of its objects is left out in turn:
every method is fitted to touches of the others, and its hyperparameters are chosen on them. Baselines have the same
inputs as the Gaussian process, the force and the predicted contact pressure. Pressures are predicted with i2t's own
elastic layer. Nothing in i2t is chosen on the result, which is written to --out: metrics.json and config.json.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from experiments.common.runs import METRICS, begin, write_json
from experiments.common.tables import cell, text_table
from i2t.contact.pressure import PressureModelConfig, predict_pressures
from i2t.dataset import Split
from i2t.intervals import student_interval
from i2t.prediction.methods import METHODS, Method, TrainingTouches, find_method
from i2t.prediction.metrics import score
from i2t.runtime.progress import progress
from tests.helpers.baselines import bare_dataset
from tests.second_world import world
from tests.second_world.arguments import SecondWorldArgs

GP = "gp"


def run(args: SecondWorldArgs) -> dict[str, Any]:
    """R2 of every method on each skin, and the lead of the Gaussian process over the best baseline."""
    begin(args, args)
    methods = methods_compared()
    skins = progress(range(args.skins), desc="pressing", unit="skins")
    r2 = [r2_of_skin(methods, args.seed + skin, args.touches) for skin in skins]
    metrics = summarise(methods, r2) | {"touches": args.touches, "objects": len(world.make_objects())}
    write_json(args.out / METRICS, metrics)
    rows = ([name, cell(scores["r2"], 2)] for name, scores in metrics["methods"].items())
    print(text_table(("simulated, another physics", "R² [95 % over skins]"), rows))
    print(f"lead over {metrics['best_baseline']}: {cell(metrics['lead'], 2)}")
    return metrics


def methods_compared() -> tuple[Method, ...]:
    """All baselines, then the Gaussian process on predicted contact pressure."""
    named = {name: find_method(name) for name in METHODS}
    return (*(method for method in named.values() if method.baseline), named[GP])


def r2_of_skin(methods: Sequence[Method], seed: int, count: int) -> dict[str, float]:
    """R2 by title of the methods on touches of objects that they were not fitted to.

    Args:
        methods: The methods.
        seed: Seed of the skin and its touches.
        count: Number of touches of each object.

    Returns:
        R2 over all touches, each predicted from the touches of the other objects.
    """
    rng = np.random.default_rng(seed)
    skin = world.make_skin(rng)
    patch, force, reading = (
        np.concatenate(part).astype(np.float32)
        for part in zip(*(world.touch(rng, mesh, skin, count) for mesh in world.make_objects().values()), strict=True)
    )
    touches = TrainingTouches(bare_dataset(patch, reading, source="simulated", force=force), ("force",))
    cfg = PressureModelConfig(pitch=world.EDGE_M / world.PIXELS, smooth=False, tilt=0.0)
    pressure = predict_pressures(cfg, patch, force, np.full_like(force, np.nan))
    touches = replace(touches, pressure_model=cfg, pressure=pressure)
    groups = np.arange(len(force)) // count
    predicted = {method.title: np.zeros_like(reading) for method in methods}
    for group in np.unique(groups):
        test = groups == group
        split = Split(~test, np.zeros_like(test), test, groups, "object")
        for method in methods:
            fitted = method.fit(jax.random.key(0), touches, split)
            assert fitted is not None
            predicted[method.title][test] = fitted.predict_batch(touches.batch(test)).mean
    return {name: score(reading, mean).r2 for name, mean in predicted.items()}


def summarise(methods: Sequence[Method], r2: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Means over skins with Student's t intervals, and the lead over the baseline with the largest mean."""
    of_method = {method.title: np.array([scores[method.title] for scores in r2]) for method in methods}
    baselines = [method.title for method in methods if method.baseline]
    best = max(baselines, key=lambda name: float(of_method[name].mean()))
    return {
        "source": "simulated",
        "skins": len(r2),
        "methods": {name: {"r2": student_interval(values)} for name, values in of_method.items()},
        "best_baseline": best,
        "lead": student_interval(of_method[methods[-1].title] - of_method[best]),
    }
