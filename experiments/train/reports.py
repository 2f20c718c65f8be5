"""Output of `experiments.train`: scores with intervals, tables and figures."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.runs import write_json
from experiments.common.tables import cell, text_table
from experiments.train.evaluation import Evaluation, choice_over_pads
from i2t import viz
from i2t.dataset import Dataset, Split, holds_simulated, source_phrase
from i2t.errors import printable
from i2t.files.writing import slug
from i2t.intervals import MIN_CLUSTERS, grouped_interval, student_interval
from i2t.models.finished import CHECKPOINTS, KEPT, ON_PRESSURE, PAD_MODEL, FinishedRun, write_training
from i2t.prediction.fit import PreparedTouches
from i2t.prediction.metrics import Score, score
from i2t.prediction.predictor import Predictor, coverage
from i2t.prediction.touch_model import Reading
from i2t.recognition.recorded import to_json
from i2t.skin_models.pad_model import KnownPad

COLUMNS = ("method", "R²", "RMSE µT", "/ sigma", "cosine")


def report(
    out: Path,
    prepared: PreparedTouches,
    evaluation: Evaluation,
    pad_model: KnownPad | str,
    *,
    about: dict[str, Any],
    started: float,
) -> None:
    """Write the predictors, the pad model, figures and, last, metrics.json. A text in place of the pad model is the
    reason why there is none.
    """
    dataset, split, choice = prepared.touches.dataset, prepared.split, evaluation.choice
    touches = dataset.touches
    truth, groups = touches.reading[split.test], split.groups[split.test]
    noise = None if touches.truth is None else (touches.reading - touches.truth.reading).std(0)
    metrics: dict[str, Any] = {
        "source": dataset.source,
        **about,
        "split": split.description,
        "counts": {part: int(getattr(split, part).sum()) for part in ("train", "validation", "test")},
        "groups": len(np.unique(groups)),
        "noise_uT": None if noise is None else noise.tolist(),
        "best": choice.best,
        "validation_r2": choice.r2,
        "choice": choice.to_json(),
        "validated_on": {
            "touches": int(prepared.selection_rows.sum()),
            "groups": len(np.unique(split.groups[prepared.selection_rows])),
            "objects": len(np.unique(touches.object[prepared.selection_rows])),
        },
        "methods": {
            name: scored(truth, mean, groups, noise, evaluation.std.get(name))
            | {"validation_coverage_90": evaluation.coverage.get(name)}
            for name, mean in evaluation.predicted.items()
        },
        "by_object": by_object(dataset, split, truth, evaluation.predicted),
        "pad_model": pad_model if isinstance(pad_model, str) else to_json(pad_model),
        "seconds": 0.0,
    }
    if not isinstance(pad_model, str):
        pad_model.save(out / PAD_MODEL)
    kept = save_predictors(out, evaluation, {"source": dataset.source, "seed": about["seed"]})
    write_training(FinishedRun(out, about["pad"], kept, pad_model if isinstance(pad_model, str) else None))
    figures(out, prepared, evaluation, metrics)
    metrics["seconds"] = round(time.perf_counter() - started, 1)
    write_json(out / "metrics.json", metrics)


def save_predictors(out: Path, evaluation: Evaluation, about: dict[str, Any]) -> dict[str, str]:
    """Write the selected predictor, the best on predicted contact pressure, and the networks, each with its origin.
    Returns their methods by folder.
    """
    best = {KEPT: evaluation.choice.best, ON_PRESSURE: evaluation.choice.best_on_pressure}
    kept = {folder: method for folder, method in best.items() if method is not None}
    kept |= {slug(name): name for name, fitted in evaluation.predictors.items() if "curve" in (fitted.metadata or {})}
    for folder, method in kept.items():
        predictor = evaluation.predictors[method]
        from_training = {name: value for name, value in (predictor.metadata or {}).items() if name != "curve"}
        kept_predictor = replace(predictor, metadata={"method": method, **about, **from_training})
        kept_predictor.save(out / CHECKPOINTS / folder)
    return kept


def curves_of(fitted: Mapping[str, Predictor]) -> dict[str, np.ndarray]:
    """Collect the errors of networks over epochs, on training and on validation touches."""
    curves = {name: np.asarray((predictor.metadata or {}).get("curve", ())) for name, predictor in fitted.items()}
    parts = ("training", "validation")
    return {f"{name}, {parts[i]}": curve[:, i] for name, curve in curves.items() if len(curve) for i in (0, 1)}


def scored(
    truth: np.ndarray, mean: np.ndarray, groups: np.ndarray, noise: np.ndarray | None, std: np.ndarray | None
) -> dict[str, Any]:
    """Compute all scores of a method.

    Args:
        truth: Measured readings of the test touches, `(n, 3 chips)`, uT.
        mean: Predicted readings, `(n, 3 chips)`, uT.
        groups: Session or spatial block of each touch, `(n,)`.
        noise: Standard deviation of the sensor's noise, `(3 chips,)`, uT, if it is known.
        std: Predicted standard deviations, `(n, 3 chips)`, uT, if the method predicts them.

    Returns:
        The scores, the 95 % interval of R2 over groups, and the share of values in the predicted 90 % range.
    """
    values: dict[str, Any] = score(truth, mean, noise)._asdict()
    values["r2_interval"] = grouped_interval(lambda rows: score(truth[rows], mean[rows]).r2, groups, most=1.0)
    if std is not None:
        values["coverage_90"] = coverage(truth, Reading(mean, std))
    return values


def by_object(dataset: Dataset, split: Split, truth: np.ndarray, predicted: dict[str, np.ndarray]) -> dict[str, Any]:
    """Compute R2 of every method on each test object."""
    kinds = dataset.touches.object[split.test]
    return {
        dataset.objects[kind]: {
            name: score(truth[kinds == kind], mean[kinds == kind]).r2 for name, mean in predicted.items()
        }
        for kind in np.unique(kinds)
        if (kinds == kind).sum() > 2
    }


def figures(out: Path, prepared: PreparedTouches, evaluation: Evaluation, metrics: dict[str, Any]) -> None:
    """Draw all figures of one run into the folder `out`."""
    dataset, split = prepared.touches.dataset, prepared.split
    simulated = holds_simulated(dataset.source)
    _touches(out, dataset, split, evaluation.predicted[evaluation.choice.best])
    if curves := curves_of(evaluation.predictors):
        figure = viz.plot_training_curves(curves, "Training", "squared error (standardised)", simulated)
        viz.save_figure(figure, out / "training.png")
    intervals = {name: (values["r2"], *values["r2_interval"]) for name, values in metrics["methods"].items()}
    xlabel = "R² (95 % interval over groups)"
    figure = viz.plot_intervals(intervals, "Explained variance on the test touches", xlabel, simulated)
    viz.save_figure(figure, out / "scores.png")


def _touches(out: Path, dataset: Dataset, split: Split, predicted: np.ndarray) -> None:
    """Draw test touches with typical, small and large errors."""
    truth, patches = dataset.touches.reading[split.test], dataset.touches.patch[split.test]
    kinds = dataset.touches.object[split.test]
    error = np.linalg.norm(predicted - truth, axis=1) / np.maximum(np.linalg.norm(truth, axis=1), 1e-9)
    order = np.argsort(error)
    middle = len(order) // 2
    shown = {
        "typical touches": order[middle - 2 : middle + 3],
        "best predicted": order[: min(5, len(order))],
        "worst predicted": order[-min(5, len(order)) :][::-1],
    }
    unseen = "objects" if split.description == "object" else "touches"
    for title, rows in shown.items():
        labels = [f"{dataset.objects[kinds[i]]}\nerror {100 * error[i]:.0f} %" for i in rows]
        figure = viz.plot_predicted_touches(
            patches[rows], {"measured": truth[rows], "predicted": predicted[rows]}, labels, dataset.board,
            f"Unseen {unseen}, {title}", holds_simulated(dataset.source),
            window=dataset.window, reach=dataset.reach,
        )  # fmt: skip
        viz.save_figure(figure, out / f"touches_{title.split()[0]}.png")


def summarise(parts: list[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Average over seeds with Student's t intervals for each pad, and over pads if there are several."""
    pads = sorted({part["pad"] or 0 for part in parts})
    of_pad = {str(pad): [part for part in parts if (part["pad"] or 0) == pad] for pad in pads}
    numbers = [field for field in Score._fields if not field.endswith("_axis")]
    summary: dict[str, Any] = {
        "source": parts[0]["source"],
        "baselines": parts[0]["baselines"],
        "seeds": sorted({part["seed"] for part in parts}),
        "pads": {pad: _estimates([part["methods"] for part in seeds], numbers) for pad, seeds in of_pad.items()},
    }
    over, which, unit = summary["pads"][str(pads[0])], f"pad {pads[0]}", "seeds"
    if len(pads) > 1:  # the mean over pads gives each pad the same weight
        means = [
            {name: {field: float(estimate.mean) for field, estimate in row.items()} for name, row in methods.items()}
            for methods in summary["pads"].values()
        ]
        summary["over_pads"] = over = _estimates(means, numbers)
        summary["by_object"] = _estimates([part["by_object"] for part in parts])
        summary["choice"] = choice_over_pads(parts)
        which, unit = f"{len(pads)} pads", "pads"
    summary["best"] = {pad: [part["best"] for part in seeds] for pad, seeds in of_pad.items()}
    write_json(out / "metrics.json", summary)
    figure = viz.plot_intervals(
        {name: tuple(row["r2"]) for name, row in over.items()},
        f"Explained variance, {which}",
        f"R² (95 % interval over {unit})",
        holds_simulated(parts[0]["source"]),
    )
    viz.save_figure(figure, out / "scores.png")
    return summary


def _estimates(tables: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> dict[str, Any]:
    """Average tables of the same form, with an interval in each cell; all columns by default."""
    return {
        name: {column: student_interval([table[name][column] for table in tables]) for column in columns or row}
        for name, row in tables[0].items()
    }


def print_table(result: dict[str, Any]) -> None:
    """Print the tables of a run."""
    kind = "" if result["source"] == "real" else f" ({source_phrase(result['source'])})"
    if "pads" in result:
        for pad, methods in result["pads"].items() if "over_pads" not in result else ():
            _print_methods(f"pad {pad}{kind}: mean over seeds {result['seeds']} with 95 % interval", methods)
        if "over_pads" in result:
            title = f"{len(result['pads'])} pads{kind}: mean with 95 % interval over pads"
            _print_methods(title, result["over_pads"])
            _print_objects({name: {m: x[0] for m, x in row.items()} for name, row in result["by_object"].items()})
            print(f"\n{_choice_over_pads(result['choice'], len(result['pads']))}")
        return
    enough = result["groups"] >= MIN_CLUSTERS
    over = f"{'95 % interval' if enough else 'too few for an interval'}: {result['groups']} groups"
    print(f"\ntest touches{kind}; {over}; selected predictor: {result['best']}")
    rows = []
    for name, values in result["methods"].items():
        numbers = [cell(values.get(field), 2) for field in ("rmse", "rmse_sigma", "cosine")]
        axes = " / ".join(cell(value, 2) for value in values["r2_axis"])
        r2 = cell((values["r2"], *values["r2_interval"]))
        rows.append([name, r2, *numbers, axes, cell(values.get("coverage_90"), 2)])
    print(text_table((*COLUMNS, "R² x / y / z", "in 90 %"), rows))
    _print_choice(result)
    _print_objects(result["by_object"])
    print(f"{result['seconds']:.0f} s")


def _choice_over_pads(choice: dict[str, Any], pads: int) -> str:
    """State the best method on validation touches over pads, with its lead."""
    best, over = choice["best"], choice["validated_on"]
    sentence = f"best on validation touches over pads: {best} (R² {cell(choice['validation_r2'][best])})"
    if best != choice["best_baseline"]:
        sentence += f", {cell(choice['over_best_baseline'])} above {choice['best_baseline']}"
    counts = f"{over['touches']} touches of {over['objects']} objects in {over['groups']} sessions with {pads} pads"
    return f"{sentence}; {counts}"


def _print_choice(result: dict[str, Any]) -> None:
    """Print the selected method, its lead, the coverage of its 90 % range, and the notes."""
    best, choice = result["best"], result["choice"]
    lead, inside = choice["over_best_baseline"], result["methods"][best]
    sentence = f"selected: {best}, the best on validation touches (R² {cell(result['validation_r2'][best], 2)})"
    if best != choice["best_baseline"]:
        sentence += f", {_lead(lead, result['validated_on'])} above {choice['best_baseline']}"
    print(
        f"\n{sentence}; its 90 % range covers {cell(inside.get('validation_coverage_90'), 2)} of validation values and "
        f"{cell(inside.get('coverage_90'), 2)} of test values"
    )
    for note in result["notes"]:
        print(printable(f"note: {note}"))


def _lead(lead: dict[str, float | None], over: dict[str, int]) -> str:
    """Format a lead with its interval and the number of groups, or the reason why there is no interval."""
    objects = f"{over['objects']} {'object' if over['objects'] == 1 else 'objects'}"
    if lead["low"] is None or not np.isfinite(lead["low"]):
        groups = objects if over["groups"] == over["objects"] else f"{over['groups']} groups of {objects}"
        return f"{cell(lead['r2'])} ({groups}: no interval)"
    return f"{cell(lead)} (over {over['groups']} groups of {objects})"


def _print_methods(title: str, methods: dict[str, Any]) -> None:
    """Print the estimates of every method."""
    rows = []
    for name, values in methods.items():
        numbers = [cell(values[field][0], 2) for field in ("rmse", "rmse_sigma", "cosine")]
        rows.append([name, cell(values["r2"]), *numbers])
    print(f"\n{title}\n{text_table(COLUMNS, rows)}")


def _print_objects(scores: dict[str, dict[str, float]]) -> None:
    """Print R² of every method on each object, if there are several objects."""
    if len(scores) < 2:
        return
    methods = next(iter(scores.values()))
    rows = ([method, *(cell(row.get(method), 2) for row in scores.values())] for method in methods)
    print(f"\n{text_table(['R² by object', *scores], rows)}")
