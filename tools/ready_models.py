"""The models that come with the package: the predictor and the pad model of a run.

    python -m experiments.train                    touches of a simulated pad, a predictor and a pad model
    python -m tools.ready_models                   runs/ready_models, some seconds

predictor/, pad_model.npz and metrics.json of --out are what i2t/models/nominal holds; `i2t.load_predictor("nominal")`
and `i2t.load_pad_model("nominal")` read them. metrics.json is the model's card: what it was made of, and how well it
predicts objects that it has not seen, from the run's own metrics. docs/model_card.md gives these figures.

    python -m tools.ready_models --eflesh SESSION --out runs/ready_eflesh

makes the calibration of a real skin, calibration.npz and its card, which i2t/models/eflesh holds
(`i2t.load_calibration("eflesh")`). It is fitted to presses of one eFlesh session and holds none of them: a structured
Gaussian process conditioned on many presses (the teacher) predicts readings on a grid of places and travels, and a
small one is conditioned on these predictions. The widths of its intervals are measured on presses of their own.
All is judged at places that neither the teacher nor the widths have seen: a fifth of all, drawn once.
"""

import json
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from experiments.common.commands import command
from experiments.common.options import RunOptions
from experiments.common.runs import METRICS, begin, write_json
from experiments.train.finished import FORMER_NAMES, PAD_MODEL, finished_runs, require_simulated_runs
from i2t.cli.options import require_path

if TYPE_CHECKING:
    from i2t.skin_models import Calibration

ORBAX_NOTE = "commit_success.txt"  # names the folder of the machine that wrote it; nobody reads it
CARD_SCORES = ("r2", "r2_interval", "rmse", "rmse_sigma", "cosine", "coverage_90")
TEST_SHARE = 0.2  # of the places
TEACHER_PRESSES, INTERVAL_PRESSES = 1000, 500
GRID_PLACES, GRID_TRAVELS = 10, 3  # along an edge of the skin, and at each place
PLACE_DECIMALS = 4  # m: places that differ by less are one
RANGE_STDS, RANGE_SHARE = 1.645, 0.9  # of a normal distribution
BASELINE_PRESSES, BASELINE_NEIGHBOURS = 20, 3
MM_PER_M = 1e3


@dataclass(frozen=True)
class ReadyModelsArgs(RunOptions):
    """Make the ready models of the package: of a simulated pad from a finished run, or of a real skin."""

    FORMER_NAMES: ClassVar = FORMER_NAMES

    out: Path = Path("runs/ready_models")  # folder for predictor/, pad_model.npz and metrics.json
    pad_model: Path = Path("runs/train")  # folder of a run of experiments.train that simulated its touches
    eflesh: Path | None = None  # a session of eFlesh (states.csv ...): make the calibration of that skin instead

    def check(self) -> None:
        """Refuse a run or a session that is not there."""
        require_path("--eflesh", self.eflesh, "folder")
        if self.eflesh is None:
            require_simulated_runs(self.pad_model)


def run(args: ReadyModelsArgs) -> dict[str, Any]:
    """Make the models and their card."""
    begin(args, args)
    card = _of_a_run(args) if args.eflesh is None else _of_a_session(args, args.eflesh)
    card["megabytes"] = round(sum(path.stat().st_size for path in args.out.rglob("*") if path.is_file()) / 1e6, 2)
    write_json(args.out / METRICS, card)
    print(f"models and card, {card['megabytes']} MB, are in {args.out}")
    return card


def _of_a_run(args: ReadyModelsArgs) -> dict[str, Any]:
    """Copy the run's predictor on predicted contact pressure and its pad model; their card."""
    from i2t.skin_models.pad_model import load_pad_model

    trained = finished_runs(args.pad_model)[0]
    metrics = json.loads((trained.folder / METRICS).read_text())
    shutil.copytree(trained.on_pressure, args.out / "predictor", ignore=shutil.ignore_patterns(ORBAX_NOTE))
    shutil.copyfile(trained.pad_model, args.out / PAD_MODEL)
    known = load_pad_model(args.out / PAD_MODEL)
    origin = known.origin
    return {
        "source": origin.source,
        "pad": origin.pad,
        "made from": origin.made_from,
        "trained on": list(origin.objects),
        "tested on": sorted(metrics["by_object"]),
        "touches": metrics["counts"],
        "predictor": metrics["best"],
        "methods": {
            name: {key: scores[key] for key in CARD_SCORES if key in scores}
            for name, scores in metrics["methods"].items()
        },
        "pad model": {"touches": origin.touches, "r2": known.model.r2},
    }


class _Session(NamedTuple):
    """Presses in the skin, in the order of time."""

    position: np.ndarray  # (n, 2) m
    travel: np.ndarray  # (n,) m
    reading: np.ndarray  # (n, c) uT

    def some(self, rows: np.ndarray) -> "_Session":
        """Some of the presses."""
        return _Session(*(part[rows] for part in self))


def _of_a_session(args: ReadyModelsArgs, folder: Path) -> dict[str, Any]:
    """Fit and save a small calibration of a real skin; its card."""
    from i2t.convert import eflesh
    from i2t.skin_models import calibrate

    converted = eflesh.convert(folder)
    touches = converted.dataset.touches
    rows = np.flatnonzero(touches.travel > 0)
    session = _Session(touches.T_w_o[rows, :2, 3].astype(np.float64), touches.travel[rows], touches.reading[rows])
    rng = np.random.default_rng(args.seed)
    places, place_of = np.unique(np.round(session.position, PLACE_DECIMALS), axis=0, return_inverse=True)
    chosen = rng.permutation(len(places))[: round(TEST_SHARE * len(places))]
    held_out = np.isin(place_of.ravel(), chosen)
    known = rng.permutation(np.flatnonzero(~held_out))
    fitted_to, test = session.some(known[:TEACHER_PRESSES]), session.some(np.flatnonzero(held_out))
    teacher = _fitted(*fitted_to)
    small = _distilled(teacher, session, session.some(known[TEACHER_PRESSES:][:INTERVAL_PRESSES]))
    few = session.some(known[:BASELINE_PRESSES])
    card = {
        "source": "real",
        "recording": f"eFlesh, characterization/datasets/spatial/{folder.name}",
        "licence": "MIT, Copyright (c) 2025 Venkatesh Pattabiraman",
        "presses": {"teacher": TEACHER_PRESSES, "intervals": INTERVAL_PRESSES, "test": len(test.travel)},
        "places": {"all": len(places), "test": len(chosen)},
        "grid": len(_grid(session)),
        "range_mm": {
            "x": _range(session.position[:, 0]), "y": _range(session.position[:, 1]), "travel": _range(session.travel)
        },
        "methods": {
            "small calibration": _judged(small, test),
            "its teacher, 1000 presses": _judged(teacher, test),
            f"i2t.calibrate, {BASELINE_PRESSES} presses": _judged(calibrate(*few, load_kind="travel"), test),
            f"mean of {BASELINE_NEIGHBOURS} nearest of the 1000": _scores(test, _nearest(fitted_to, test)),
            "mean reading": _scores(test, np.tile(fitted_to.reading.mean(0), (len(test.travel), 1))),
        },
    }  # fmt: skip
    about = {key: card[key] for key in ("source", "recording", "licence")} | {"notes": list(converted.notes)}
    replace(small, metadata=about).save(args.out / "calibration.npz")
    return card


def _fitted(position: np.ndarray, travel: np.ndarray, reading: np.ndarray) -> "Calibration":
    from i2t.skin_models import TRAVEL_HYPERPARAMETERS, calibrate

    return calibrate(position, travel, reading, load_kind="travel", hyperparameters=TRAVEL_HYPERPARAMETERS)


def _distilled(teacher: "Calibration", session: _Session, for_intervals: _Session) -> "Calibration":
    """A calibration of a teacher's predictions on a grid, its intervals from presses."""
    grid = _grid(session)
    small = _fitted(grid[:, :2], grid[:, 2], teacher.predict(grid[:, :2], grid[:, 2])[0])
    mean, std = small.predict(for_intervals.position, for_intervals.travel)
    away = np.quantile(np.abs(for_intervals.reading - mean) / std, RANGE_SHARE, axis=0) / RANGE_STDS
    return replace(small, interval_scaling=np.float32(np.asarray(small.interval_scaling) * away))


def _grid(session: _Session) -> np.ndarray:
    """Places and travels (n, 3) m in random order, as the Gaussian process wants its presses."""
    edges = [np.linspace(column.min(), column.max(), GRID_PLACES) for column in session.position.T]
    travels = np.quantile(session.travel, np.linspace(0, 1, GRID_TRAVELS))
    grid = np.stack(np.meshgrid(*edges, travels, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.random.default_rng(0).permutation(grid)


def _judged(calibration: "Calibration", test: _Session) -> dict[str, float]:
    mean, std = calibration.predict(test.position, test.travel)
    return _scores(test, mean) | {"coverage_90": float(np.mean(np.abs(test.reading - mean) < RANGE_STDS * std))}


def _scores(test: _Session, mean: np.ndarray) -> dict[str, float]:
    from i2t.prediction.metrics import score

    return {"r2": float(score(test.reading, mean).r2), "rmse": float(np.sqrt(np.mean((test.reading - mean) ** 2)))}


def _nearest(known: _Session, test: _Session) -> np.ndarray:
    """Mean reading of the nearest presses, places and travels in their standard deviations."""
    features = [np.column_stack([part.position, part.travel]) for part in (known, test)]
    away = np.linalg.norm((features[1][:, None] - features[0][None]) / features[0].std(0), axis=2)
    return known.reading[np.argsort(away, axis=1)[:, :BASELINE_NEIGHBOURS]].mean(1)


def _range(values: np.ndarray) -> list[float]:
    return [round(MM_PER_M * float(values.min()), 2), round(MM_PER_M * float(values.max()), 2)]


main = command(ReadyModelsArgs, "tools.ready_models")

if __name__ == "__main__":
    sys.exit(main())
