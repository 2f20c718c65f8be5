"""Classification of a table of readings: `python -m experiments.shapes --readings TABLE --label COLUMN`.

A row is a touch, or a stroke of several samples. The first 60 % of each label's rows are for training and the later
rows for the test. A second split is random, with rows on both sides that share errors. All settings and temperatures
are chosen on rolling blocks of the training rows, with each block predicted from earlier rows.

If the rows of a label were recorded together, the ambient field at that time identifies the label as well as the touch
does. Strokes are therefore compared without it (`experiments.shapes.strokes`), and one row of the table shows the
accuracy of the ambient field alone.

Two controls use only samples at rest. Without the stroke's median, they are at chance if the median is exactly the
ambient field. Without the mean of other samples at rest, they are at chance if that field is constant during a stroke.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from experiments.common.reading_tables import (
    SPLITS,
    ReadingTable,
    read_reading_table,
    refuse_counters,
    require_rows,
    training_rows,
    with_outliers,
)
from experiments.common.runs import Part, begin, write_json
from experiments.common.tables import cell, text_table
from experiments.common.tasks import make_parts
from experiments.shapes import strokes
from experiments.shapes.arguments import ShapesArgs
from experiments.shapes.methods import PAPER, Methods, classify
from experiments.shapes.strokes import StrokeKernel, StrokeSettings
from i2t import viz
from i2t.errors import DataError
from i2t.intervals import mean_interval, rate_interval
from i2t.recognition.calibrated import TemperatureScaling, calibrated_beliefs, fit_temperature
from i2t.recognition.metrics import calibration_error, confidence, confusion, hits, log_loss, to_json
from i2t.viz.style import Colour, Picture

TREES = 500  # of the ensemble "extra trees"
AMBIENT, RECORDED = "median over time only", "raw readings"
AT_REST = "control: samples at rest, median subtracted"
REST_PAIRS = "control: samples at rest, mean of others at rest subtracted"
WARPED, PATH = "time-warped strokes", "time-warped paths in a plane"
LEAD = f"lead of {WARPED}"
SATURATIONS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
PENALTIES = (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)

Rows = Int[np.ndarray, " k"]
Probabilities = Float[np.ndarray, "q classes"]
Fit = Callable[[Rows, Rows], Probabilities]  # of the test rows, from the training rows


class LabelPredictions(NamedTuple):
    """Calibrated predictions of the test rows."""

    p: Probabilities
    temperature: TemperatureScaling
    settings: StrokeSettings | None = None


class StrokeTable(NamedTuple):
    """A table whose rows have one or several samples."""

    reading: Float[np.ndarray, "n t d"]
    label: Int[np.ndarray, " n"]
    labels: tuple[str, ...]


def run(args: ShapesArgs, cfg: Methods) -> dict[str, Any]:
    """Classify the rows with all methods in both splits, and report the scores."""
    assert args.readings is not None
    assert args.label is not None
    table = read_reading_table([args.readings], label=args.label, ignore=args.ignore)
    refuse_counters(table, args.readings, may_number_touches=False)
    require_rows(table, 10, args.readings)
    data = as_strokes(table, args.samples, args.readings)
    begin(args, cfg)
    started = time.perf_counter()
    n, t, d = data.reading.shape
    print(f"{n} rows of {len(data.labels)} labels, {t} sample{'s' if t > 1 else ''} of {d} values each")
    for sentence in table.notes:
        print(sentence)
    train = training_rows(table, 0.6, args.seed)
    makers = {
        args.out / f"{name.replace(' ', '-')}.json": partial(make_part, data, training, cfg, args.seed)
        for name, training in train.items()
    }
    parts = make_parts(makers, args.workers, bar="splits")
    result = {
        "source": "table",
        "seed": args.seed,
        "rows": n,
        "samples": t,
        "values": d,
        "labels": list(data.labels),
        "train": {name: int(training.sum()) for name, training in train.items()},
        "splits": dict(zip(train, parts, strict=True)),
        "seconds": round(time.perf_counter() - started, 1),
    }
    figures(args.out, result)
    write_json(args.out / "metrics.json", result)
    report(result)
    return result


def as_strokes(table: ReadingTable, samples: int, path: Path) -> StrokeTable:
    """Reshape rows to samples and values (DataError: the number of columns is not a multiple of the samples)."""
    n, columns = table.reading.shape
    if columns % samples:
        raise DataError(
            f"{path}: the reading has {columns} columns, not a multiple of --samples {samples}; correct it, or "
            "leave out columns that are not part of the reading (--ignore)"
        )
    return StrokeTable(table.reading.reshape(n, samples, -1), table.label, table.labels)


def make_part(data: StrokeTable, training: np.ndarray, cfg: Methods, seed: int) -> Part:
    """Score all methods in one split, with a mask of the training rows."""
    train, test = np.flatnonzero(training), np.flatnonzero(~training)
    fits = baselines(data, cfg, seed)
    predictions = {name: predict_calibrated(fit, data.label, train, test) for name, fit in fits.items()}
    part: Part = {}
    if data.reading.shape[1] > 1:
        warped = WarpedStrokes(data, train)
        predictions |= {name: warped.predict(test, paths=name == PATH) for name in (WARPED, PATH)}
        settings = predictions[PATH].settings
        assert settings is not None
        drawn = warped.vectors(settings.saturation, paths=True)[0]
        part["mean_paths"] = strokes.mean_paths(drawn[train], data.label[train], len(data.labels)).tolist()
    truth = data.label[test]
    scores = {name: scored(prediction, truth) for name, prediction in predictions.items()}
    if WARPED in predictions:
        ours = right(predictions[WARPED].p, truth)
        for name, prediction in predictions.items():
            if name != WARPED:
                gain = mean_interval(ours - right(prediction.p, truth), [truth])
                scores[name][LEAD] = list(to_json(gain).values())
    return {"methods": scores, **part}


# --- methods ---


def baselines(data: StrokeTable, cfg: Methods, seed: int) -> dict[str, Fit]:
    """Make classifiers of the recorded readings and of their changes, and controls that should be at chance: the
    ambient field alone, and samples at rest without it.
    """
    around = strokes.ambient(data.reading)
    models: dict[str, Callable[[], Any]] = {
        "nearest neighbour": lambda: make_pipeline(StandardScaler(), KNeighborsClassifier(1)),
        "logistic regression": lambda: make_pipeline(StandardScaler(), LogisticRegression(C=0.01, max_iter=2000)),
        "extra trees": lambda: ExtraTreesClassifier(TREES, random_state=seed),
    }

    def of_model(model: Callable[[], Any], x: np.ndarray) -> Fit:
        return lambda train, test: model().fit(x[train], data.label[train]).predict_proba(x[test])

    def of_network(x: np.ndarray) -> Fit:
        return lambda train, test: np.exp(
            classify(cfg.paper, x[train], data.label[train], x[test], classes=len(data.labels), seed=seed)
        )

    inputs = {RECORDED: data.reading}
    fits: dict[str, Fit] = {}
    if data.reading.shape[1] > 1:
        inputs["ambient subtracted"] = strokes.less_ambient(data.reading)
        fits[AMBIENT] = of_model(models["extra trees"], around)
        quiet = strokes.quietest(data.reading)
        controls = quiet - around[:, None], quiet[:, ::2] - quiet[:, 1::2].mean(1, keepdims=True)
        for name, x in zip((AT_REST, REST_PAIRS), controls, strict=True):
            fits[name] = of_model(models["extra trees"], x.reshape(len(x), -1))
    for kind, x in inputs.items():
        flat = x.reshape(len(x), -1)
        fits |= {f"{name}, {kind}": of_model(model, flat) for name, model in models.items()}
        fits[f"{PAPER}, {kind}"] = of_network(flat)
    return fits


class WarpedStrokes:
    """The method of `experiments.shapes.strokes`, with settings chosen on rolling blocks of the training rows."""

    def __init__(self, data: StrokeTable, train: Rows) -> None:
        """Prepare the strokes of all rows, with the training rows `train`."""
        self.label, self.train = data.label, train
        self.landmarks = strokes.choose_landmarks(train)
        self.varied = strokes.varied(strokes.less_ambient(data.reading))

    def vectors(self, saturation: float, *, paths: bool) -> Float[np.ndarray, "v n t d"]:
        """Compute saturated changes, or their paths in a plane."""
        vectors = strokes.saturated(self.varied, self.train, saturation)
        return strokes.plane_paths(vectors, self.train) if paths else vectors

    def kernel(self, saturation: float, *, paths: bool) -> StrokeKernel:
        """Compute the distances to the landmarks."""
        return strokes.stroke_kernel(self.vectors(saturation, paths=paths), self.landmarks)

    def predict(self, test: Rows, *, paths: bool) -> LabelPredictions:
        """Predict the test rows with the settings that have the least log loss."""
        losses: dict[StrokeSettings, float] = {}
        for saturation in SATURATIONS:
            kernel = self.kernel(saturation, paths=paths)
            for penalty in PENALTIES:
                fit = partial(strokes.classify, kernel, self.label, penalty=penalty)
                p, truth = predict_blocks(fit, self.label, self.train)
                losses[StrokeSettings(saturation, penalty)] = float(log_loss(p[:, None], truth).mean())
        best = min(losses, key=lambda settings: losses[settings])
        kernel = self.kernel(best.saturation, paths=paths)
        fit = partial(strokes.classify, kernel, self.label, penalty=best.penalty)
        return predict_calibrated(fit, self.label, self.train, test)._replace(settings=best)


def predict_calibrated(
    fit: Callable[..., Probabilities], label: np.ndarray, train: Rows, test: Rows
) -> LabelPredictions:
    """Predict the test rows at a temperature that is fitted to rolling blocks of the training rows, with half a row of
    each label added (Jeffreys).
    """
    p, truth = predict_blocks(fit, label, train)
    temperature = fit_temperature(p[:, None], truth, smoothing=0.5 / (0.5 + len(truth)))
    calibrated = calibrated_beliefs(with_outliers(fit(train, test))[:, None], temperature)[:, 0]
    return LabelPredictions(calibrated, temperature)


def predict_blocks(
    fit: Callable[..., Probabilities], label: np.ndarray, train: Rows
) -> tuple[Probabilities, np.ndarray]:
    """Predict the rolling blocks; returns probabilities and labels."""
    blocks = [(with_outliers(fit(before, block)), label[block]) for before, block in rolling_blocks(label, train)]
    p, truth = zip(*blocks, strict=True)
    return np.concatenate(p), np.concatenate(truth)


def rolling_blocks(label: Int[np.ndarray, " n"], train: Rows) -> Iterator[tuple[Rows, Rows]]:
    """Divide each label's training rows into five blocks of time, and yield the rows before each of the last three
    blocks with the rows of that block.
    """
    block = np.empty(len(train), int)
    for value in np.unique(label[train]):
        rows = np.flatnonzero(label[train] == value)
        block[rows] = np.arange(len(rows)) * 5 // len(rows)
    for number in (2, 3, 4):
        yield train[block < number], train[block == number]


# --- scores ---


def right(p: Probabilities, truth: np.ndarray) -> Float[np.ndarray, " q"]:
    """Mark correct decisions with 1."""
    return hits(p[:, None], truth)[:, 0]


def scored(prediction: LabelPredictions, truth: np.ndarray) -> dict[str, Any]:
    """Compute rates with intervals over labels, calibration, and the confusion matrix."""
    hit = right(prediction.p, truth)
    return {
        "accuracy": list(to_json(rate_interval(hit, [truth])).values()),
        "log_loss": list(to_json(mean_interval(log_loss(prediction.p[:, None], truth)[:, 0], [truth])).values()),
        "calibration": to_json(calibration_error(confidence(prediction.p), hit)),
        "temperature": prediction.temperature.initial,
        "settings": prediction.settings._asdict() if prediction.settings else None,
        "confusion": confusion(prediction.p, truth).tolist(),
    }


def report(result: Mapping[str, Any]) -> None:
    """Print a table for each split."""
    for split, part in result["splits"].items():
        print(f"\nsplit {split}, {result['rows'] - result['train'][split]} test rows; 95 % intervals over labels")
        rows = [
            [
                name,
                cell(scores["accuracy"], ends=2),
                cell(scores["log_loss"], ends=2),
                f"{scores['calibration']['error']:.3f} ({scores['calibration']['chance']:.3f} by chance)",
                cell(scores.get(LEAD), 2, signed=True),
            ]
            for name, scores in part["methods"].items()
        ]
        print(text_table(["method", "accuracy", "log loss", "calibration error", LEAD], rows))
        for name, scores in part["methods"].items():
            if scores["settings"]:
                print(f"{name}: chosen " + ", ".join(f"{key} {value:g}" for key, value in scores["settings"].items()))
    print(f"{result['seconds']:.0f} s")


def figures(out: Path, result: Mapping[str, Any]) -> None:
    """Draw rates, confusion matrices, and the mean path of each label."""
    labels, splits = result["labels"], result["splits"]
    moving = result["samples"] > 1  # strokes have too many methods for one figure
    rates = {
        split: {
            name: scores["accuracy"]
            for name, scores in part["methods"].items()
            if not (moving and name.endswith(RECORDED))
        }
        for split, part in splits.items()
    }
    title = "Which label?"
    figure = viz.plot_rates(rates, title, "share of correct answers", 1 / len(labels), False)
    viz.save_figure(figure, out / "rates.png")
    best = {
        split: max(part["methods"], key=lambda name: (name == WARPED, part["methods"][name]["accuracy"][0]))
        for split, part in splits.items()
    }
    matrices = {
        f"{name}, {split}": np.array(splits[split]["methods"][name]["confusion"]) for split, name in best.items()
    }
    viz.save_figure(viz.plot_confusions(matrices, labels, title, False), out / "confusion.png")
    if "mean_paths" in splits[SPLITS[0]]:
        paths = np.array(splits[SPLITS[0]]["mean_paths"])
        viz.save_figure(_plot_paths(paths, labels), out / "paths.png")


def _plot_paths(paths: Float[np.ndarray, "classes k p"], labels: Sequence[str]) -> Picture:
    """Plot the mean path of each label, with dots at equal steps of its length and a large dot at the start."""
    columns = min(len(labels), 5)
    lines = -(-len(labels) // columns)
    figure = Picture(figsize=(1.6 * columns + 0.6, 1.7 * lines + 0.6), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).flat
    for axes, path, label in zip(panels, paths, labels, strict=False):
        axes.plot(path[:, 0], path[:, -1], ".-", color=Colour.BLUE, ms=3, lw=1)
        axes.plot(path[0, 0], path[0, -1], "o", color=Colour.BLUE, ms=5)
        axes.set_title(label, fontsize=9)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=6)
    figure.suptitle("Mean path of the training strokes, in the plane where readings vary most (no unit)", fontsize=10)
    return figure
