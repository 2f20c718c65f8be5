"""Output of `experiments.shapes`: tables with the paper's rates, confusion matrices and figures."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.tables import cell
from experiments.shapes.methods import METHODS
from i2t import viz
from i2t.dataset import holds_simulated, source_phrase
from i2t.intervals import rate_interval, student_interval

PUBLISHED_RATES = {"T": 0.91, "circle": 0.90, "angle": 0.90, "triangle": 0.95, "cross": 0.94, "total": 0.92}


def summarise(
    parts: list[dict[str, Any]], truth: list[np.ndarray], held: list[dict[str, np.ndarray]], names: tuple[str, ...]
) -> dict[str, Any]:
    """Compute rates with intervals by Student's t over the folds of all pads (`held`), or over draws for a new skin.

    Folds of one pad share training presses, so the intervals are slightly too narrow for few pads.
    """
    new = {
        count: {
            method: list(map(float, student_interval(np.concatenate([part["new"][count][method] for part in parts]))))
            for method in methods
        }
        for count, methods in parts[0]["new"].items()
    }
    splits = {
        split: {
            method: _scored([part["splits"][split][method] for part in parts], truth, [h[split] for h in held], names)
            for method in methods
        }
        for split, methods in parts[0]["splits"].items()
        if all(split in part["splits"] for part in parts)
    }
    return {"splits": splits, "new": new}


def _scored(
    guesses: list[list[int]], truth: list[np.ndarray], held: list[np.ndarray], names: tuple[str, ...]
) -> dict[str, Any]:
    guess, true = np.concatenate(guesses).astype(int), np.concatenate(truth).astype(int)
    confusion = np.zeros((len(names), len(names)), int)
    np.add.at(confusion, (true, guess), 1)
    return {
        "total": _total(guesses, truth, held),
        "by_shape": {name: list(map(float, rate_interval(guess[true == i] == i))) for i, name in enumerate(names)},
        "confusion": confusion.tolist(),
    }


def _total(guesses: list[list[int]], truth: list[np.ndarray], held: list[np.ndarray]) -> list[float]:
    right = [np.asarray(g) == t for g, t in zip(guesses, truth, strict=True)]
    folds = [r[part == fold].mean() for r, part in zip(right, held, strict=True) for fold in np.unique(part)]
    total = student_interval(np.array(folds))
    mean = float(np.concatenate(right).mean())  # folds have nearly the same size
    return [mean, float(total.low), float(total.high)]


def report(result: dict[str, Any]) -> None:
    """Print the tables."""
    kind = "" if result["source"] == "real" else f" ({source_phrase(result['source'])})"
    over = f"{len(result['pads'])} pads" if len(result["pads"]) > 1 else "one pad"
    names = result["shapes"]
    published = all(name in PUBLISHED_RATES for name in names)
    print(
        f"\nrandom fifths held out{kind}, {over} [95 % interval]\n{'':30}"
        + "".join(f"{n:>10}" for n in (*names, "total"))
    )
    if published:
        print(f"{'paper, one real skin':30}" + "".join(f"{PUBLISHED_RATES[name]:10.2f}" for name in (*names, "total")))
    for method, scored in result["splits"]["random"].items():
        by_shape = "".join(f"{scored['by_shape'][name][0]:10.2f}" for name in names)
        print(f"{method:30}{by_shape}  {cell(scored['total'], ends=2)}")
    methods = [method for method in METHODS if method in result["splits"]["random"]]
    print(f"\nheld out{kind}{'':20}" + "".join(f"{method:>30}" for method in methods))
    for split, scored in result["splits"].items():
        print(f"{split:28}" + "".join(f"{cell(scored[method]['total'], ends=2):>30}" for method in methods))
    for count, rates in result["new"].items():
        print(f"\na new skin, {count} presses of each shape{kind}")
        for method, value in rates.items():
            print(f"  {method:40}{cell(value, ends=2)}")
    print(f"{result['seconds']:.0f} s")


def figures(out: Path, result: dict[str, Any]) -> None:
    """Draw confusion matrices of the random split, and rates of all splits."""
    simulated = holds_simulated(result["source"])
    matrices = {name: np.array(scored["confusion"]) for name, scored in result["splits"]["random"].items()}
    figure = viz.plot_confusions(matrices, result["shapes"], "Which stamp was it? A random fifth held out", simulated)
    viz.save_figure(figure, out / "confusion.png")
    rates = {
        f"{split} out": {method: scored["total"] for method, scored in methods.items()}
        for split, methods in result["splits"].items()
    } | {
        f"new skin, {count} of each": rates for count, rates in result["new"].items()
    }  # fmt: skip
    figure = viz.plot_rates(
        rates, "Which stamp was it?", "share of correct answers", 1 / len(result["shapes"]), simulated
    )
    viz.save_figure(figure, out / "rates.png")
