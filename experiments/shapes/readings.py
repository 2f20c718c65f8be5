"""Labels told from a table of readings: `python -m experiments.shapes --readings TABLE --label COLUMN`.

A row is a touch, or a stroke of several samples. The first 60 % of each label's rows teach and the later ones test, and
as many at random, where rows of both sides share errors. Whatever is chosen or calibrated is so on rolling blocks of
the training rows: a block is judged by what came before it.

Where the rows of a label were made in one go, the ambient field of that hour tells the label as well as the touch does.
So strokes are compared without it (`experiments.shapes.strokes`), and what it tells alone is a row of the table.

Two controls are given only samples at rest. Less the stroke's median they should be at chance if the median were the
field around the skin and nothing else; less the mean of other samples at rest, if that field stood still for a stroke.
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

SHARE, BLOCKS = 0.6, 5  # of a label's rows that teach; parts of these, of which the last ones judge in turn
JUDGED = (2, 3, 4)
MIN_ROWS = 10  # of a label
TREES = 500
PANELS = 5  # of a line of the figure of paths
AMBIENT, RECORDED, CHANGES = "median over time alone", "as recorded", "less ambient"
CONTROLS = AT_REST, REST_PAIRS = "control: at rest, less the median", "control: at rest, less others at rest"
WARPED, PATH = "time-warped strokes", "time-warped paths in a plane"
BETTER_BY = f"{WARPED} better by"
SATURATIONS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
PENALTIES = (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)

Rows = Int[np.ndarray, " k"]
Probabilities = Float[np.ndarray, "q classes"]
Fit = Callable[[Rows, Rows], Probabilities]  # of the test rows, from the training rows


class Told(NamedTuple):
    """What a method says of the test rows."""

    p: Probabilities  # calibrated
    temperature: TemperatureScaling
    settings: StrokeSettings | None = None


class StrokeTable(NamedTuple):
    """A table whose rows have several samples, or one."""

    reading: Float[np.ndarray, "n t d"]
    label: Int[np.ndarray, " n"]
    labels: tuple[str, ...]


def run(args: ShapesArgs, cfg: Methods) -> dict[str, Any]:
    """Both splits, each by all methods."""
    assert args.readings is not None
    assert args.label is not None
    table = read_reading_table([args.readings], label=args.label, ignore=args.ignore)
    refuse_counters(table, args.readings, may_number_touches=False)
    require_rows(table, MIN_ROWS, args.readings)
    data = as_strokes(table, args.samples, args.readings)
    begin(args, cfg)
    started = time.perf_counter()
    n, t, d = data.reading.shape
    print(f"{n} rows of {len(data.labels)} labels, {t} sample{'s' if t > 1 else ''} of {d} values each")
    for sentence in table.notes:
        print(sentence)
    train = training_rows(table, SHARE, args.seed)
    makers = {
        args.out / f"{name.replace(' ', '-')}.json": partial(make_part, data, taught, cfg, args.seed)
        for name, taught in train.items()
    }
    parts = make_parts(makers, args.workers, bar="splits")
    result = {
        "source": "table",
        "seed": args.seed,
        "rows": n,
        "samples": t,
        "values": d,
        "labels": list(data.labels),
        "train": {name: int(taught.sum()) for name, taught in train.items()},
        "splits": dict(zip(train, parts, strict=True)),
        "seconds": round(time.perf_counter() - started, 1),
    }
    figures(args.out, result)
    write_json(args.out / "metrics.json", result)
    report(result)
    return result


def as_strokes(table: ReadingTable, samples: int, path: Path) -> StrokeTable:
    """Rows by sample and value; DataError where the columns are no multiple of the samples."""
    n, columns = table.reading.shape
    if columns % samples:
        raise DataError(
            f"{path}: {columns} columns are left for the reading, no multiple of --samples {samples}; correct it, or "
            "leave out the columns that are no reading (--ignore)"
        )
    return StrokeTable(table.reading.reshape(n, samples, -1), table.label, table.labels)


def make_part(data: StrokeTable, taught: np.ndarray, cfg: Methods, seed: int) -> Part:
    """Scores of all methods in one split."""
    train, test = np.flatnonzero(taught), np.flatnonzero(~taught)
    told = {name: told_by(fit, data.label, train, test) for name, fit in baselines(data, cfg, seed).items()}
    part: Part = {}
    if data.reading.shape[1] > 1:
        warped = WarpedStrokes(data, train)
        told |= {name: warped.tell(test, paths=name == PATH) for name in (WARPED, PATH)}
        settings = told[PATH].settings
        assert settings is not None
        drawn = warped.vectors(settings.saturation, paths=True)[0]
        part["mean_paths"] = strokes.mean_paths(drawn[train], data.label[train], len(data.labels)).tolist()
    truth = data.label[test]
    scores = {name: scored(each, truth) for name, each in told.items()}
    if WARPED in told:
        ours = right(told[WARPED].p, truth)
        for name, each in told.items():
            if name != WARPED:
                gain = mean_interval(ours - right(each.p, truth), [truth])
                scores[name][BETTER_BY] = list(to_json(gain).values())
    return {"methods": scores, **part}


# --- methods ---


def baselines(data: StrokeTable, cfg: Methods, seed: int) -> dict[str, Fit]:
    """Classifiers of the readings as they were recorded, of their changes, and of what should tell nothing: the ambient
    field alone, and samples at rest without it.
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
    found: dict[str, Fit] = {}
    if data.reading.shape[1] > 1:
        inputs[CHANGES] = strokes.less_ambient(data.reading)
        found[AMBIENT] = of_model(models["extra trees"], around)
        quiet = strokes.quietest(data.reading)
        controls = quiet - around[:, None], quiet[:, ::2] - quiet[:, 1::2].mean(1, keepdims=True)
        for name, x in zip(CONTROLS, controls, strict=True):
            found[name] = of_model(models["extra trees"], x.reshape(len(x), -1))
    for kind, x in inputs.items():
        flat = x.reshape(len(x), -1)
        found |= {f"{name}, {kind}": of_model(model, flat) for name, model in models.items()}
        found[f"{PAPER}, {kind}"] = of_network(flat)
    return found


class WarpedStrokes:
    """The method of `experiments.shapes.strokes`, its settings chosen on rolling blocks of the training rows."""

    def __init__(self, data: StrokeTable, train: Rows) -> None:
        """Strokes of all rows, of which those of `train` teach."""
        self.label, self.train = data.label, train
        self.landmarks = strokes.choose_landmarks(train)
        self.varied = strokes.varied(strokes.less_ambient(data.reading))

    def vectors(self, saturation: float, *, paths: bool) -> Float[np.ndarray, "v n t d"]:
        """Saturated changes, or their paths in a plane."""
        found = strokes.saturated(self.varied, self.train, saturation)
        return strokes.plane_paths(found, self.train) if paths else found

    def kernel(self, saturation: float, *, paths: bool) -> StrokeKernel:
        """Distances to the landmarks."""
        return strokes.stroke_kernel(self.vectors(saturation, paths=paths), self.landmarks)

    def tell(self, test: Rows, *, paths: bool) -> Told:
        """Probabilities of the test rows under the settings with the least log loss."""
        losses: dict[StrokeSettings, float] = {}
        for saturation in SATURATIONS:
            kernel = self.kernel(saturation, paths=paths)
            for penalty in PENALTIES:
                judged = judge(partial(strokes.classify, kernel, self.label, penalty=penalty), self.label, self.train)
                losses[StrokeSettings(saturation, penalty)] = float(log_loss(judged[0][:, None], judged[1]).mean())
        best = min(losses, key=lambda each: losses[each])
        kernel = self.kernel(best.saturation, paths=paths)
        fit = partial(strokes.classify, kernel, self.label, penalty=best.penalty)
        return told_by(fit, self.label, self.train, test)._replace(settings=best)


def told_by(fit: Callable[..., Probabilities], label: np.ndarray, train: Rows, test: Rows) -> Told:
    """Probabilities of the test rows at the temperature that suits rolling blocks of the training rows, as if half a
    row more had been of any label (Jeffreys).
    """
    p, truth = judge(fit, label, train)
    temperature = fit_temperature(p[:, None], truth, smoothing=0.5 / (0.5 + len(truth)))
    return Told(calibrated_beliefs(with_outliers(fit(train, test))[:, None], temperature)[:, 0], temperature)


def judge(fit: Callable[..., Probabilities], label: np.ndarray, train: Rows) -> tuple[Probabilities, np.ndarray]:
    """Probabilities of the judged blocks, and their labels."""
    found = [(with_outliers(fit(before, block)), label[block]) for before, block in rolling_blocks(label, train)]
    p, truth = zip(*found, strict=True)
    return np.concatenate(p), np.concatenate(truth)


def rolling_blocks(label: Int[np.ndarray, " n"], train: Rows) -> Iterator[tuple[Rows, Rows]]:
    """Rows before a block of time, and its rows, label by label, for each of the last blocks."""
    block = np.empty(len(train), int)
    for each in np.unique(label[train]):
        rows = np.flatnonzero(label[train] == each)
        block[rows] = np.arange(len(rows)) * BLOCKS // len(rows)
    for judged in JUDGED:
        yield train[block < judged], train[block == judged]


# --- scores ---


def right(p: Probabilities, truth: np.ndarray) -> Float[np.ndarray, " q"]:
    """Correctness of each decision."""
    return hits(p[:, None], truth)[:, 0]


def scored(told: Told, truth: np.ndarray) -> dict[str, Any]:
    """Rates with intervals over labels, calibration, and the confusion matrix."""
    hit = right(told.p, truth)
    return {
        "accuracy": list(to_json(rate_interval(hit, [truth])).values()),
        "log_loss": list(to_json(mean_interval(log_loss(told.p[:, None], truth)[:, 0], [truth])).values()),
        "calibration": to_json(calibration_error(confidence(told.p), hit)),
        "temperature": told.temperature.initial,
        "settings": told.settings._asdict() if told.settings else None,
        "confusion": confusion(told.p, truth).tolist(),
    }


def report(result: Mapping[str, Any]) -> None:
    """A table for each split."""
    for split, part in result["splits"].items():
        print(f"\ntested {split}, {result['rows'] - result['train'][split]} rows; 95 % intervals over labels")
        rows = [
            [
                name,
                cell(each["accuracy"], ends=2),
                cell(each["log_loss"], ends=2),
                f"{each['calibration']['error']:.3f} ({each['calibration']['chance']:.3f} by chance)",
                cell(each.get(BETTER_BY), 2, signed=True),
            ]
            for name, each in part["methods"].items()
        ]
        print(text_table(["method", "accuracy", "log loss", "calibration error", BETTER_BY], rows))
        for name, each in part["methods"].items():
            if each["settings"]:
                print(f"{name}: chosen " + ", ".join(f"{key} {value:g}" for key, value in each["settings"].items()))
    print(f"{result['seconds']:.0f} s")


def figures(out: Path, result: Mapping[str, Any]) -> None:
    """Rates, confusion matrices, and the mean path of each label."""
    labels, splits = result["labels"], result["splits"]
    moving = result["samples"] > 1  # and too many rows for one picture
    rates = {
        split: {
            name: each["accuracy"] for name, each in part["methods"].items() if not (moving and name.endswith(RECORDED))
        }
        for split, part in splits.items()
    }
    title = "Which label?"
    figure = viz.plot_rates(rates, title, "share of right answers", 1 / len(labels), False)
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
    """The mean path of each label; dots are at equal steps of its length, the first one is large."""
    columns = min(len(labels), PANELS)
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
