"""Make the models that come with the package from the predictor and the pad model of a run.

    python -m experiments.train                    touches of a simulated pad, a predictor and a pad model
    python -m tools.ready_models                   runs/ready_models, some seconds

predictor/, pad_model.npz and metrics.json in --out are the contents of i2t/models/nominal, which
`i2t.load_predictor("nominal")` and `i2t.load_pad_model("nominal")` read. metrics.json is the model's card: its training
data, and its scores on unknown objects from the run's metrics. docs/model_card.md gives these figures.

    python -m tools.ready_models --touches --out runs/ready_touches

This simulates touches.h5 of i2t/models/nominal, the data set `i2t.load_dataset("nominal")`: few touches of the same
pad, which fit into the package because the camera has no pixel noise. Their seed differs from that of the predictor's
touches. Its card is the entry "data set" of i2t/models/nominal/metrics.json.

    python -m tools.ready_models --eflesh SESSION --out runs/ready_eflesh

This makes the calibration of a real skin, calibration.npz and its card, the contents of i2t/models/eflesh
(`i2t.load_calibration("eflesh")`). It is fitted to presses of one eFlesh session and contains none of them: a
structured Gaussian process conditioned on many presses (the teacher) predicts readings on a grid of positions and
travels, and a small one is conditioned on these predictions. The widths of its intervals are fitted to separate
presses. All scores are at positions held out from the teacher and from the widths, a fifth of all, drawn once.
"""

import json
import math
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from experiments.common.commands import command
from experiments.common.options import RunOptions
from experiments.common.runs import METRICS, begin, write_json
from i2t.cli.options import require_path
from i2t.models.finished import FORMER_NAMES, PAD_MODEL, finished_runs, require_simulated_runs

if TYPE_CHECKING:
    from i2t.skin_models import Calibration

CARD_SCORES = ("r2", "r2_interval", "rmse", "rmse_sigma", "cosine", "coverage_90")


@dataclass(frozen=True)
class DistillationSizes:
    """Sizes of the calibration of a real skin."""

    test_share: float = 0.2  # fraction of the positions
    teacher_presses: int = 1000
    interval_presses: int = 500  # to which the widths of the intervals are fitted
    grid_positions: int = 10  # along each edge of the skin
    grid_travels: int = 3  # at each position
    baseline_presses: int = 20
    baseline_neighbours: int = 3


SIZES = DistillationSizes()


@dataclass(frozen=True)
class ReadyTouches:
    """Touches of the simulated data set, and the errors of its lab."""

    objects: tuple[str, ...] = ("hexagon", "parallelogram", "star", "cylinder", "hammer", "screwdriver")
    touches_per_session: int = 10
    sessions: int = 3  # of each object
    pad: int = 0
    first_seed: int = 1000  # seed of the touches for --seed 0
    # m and degrees, standard deviations of a camera whose pose was calibrated well, and averages its frames
    hand_eye: float = 0.2e-3
    hand_eye_degrees: float = 0.1
    max_bytes: int = 400_000


READY_TOUCHES = ReadyTouches()


@dataclass(frozen=True)
class ReadyModelsArgs(RunOptions):
    """Make the models of the package for a simulated pad from a finished run, its data set, or those of a real skin."""

    FORMER_NAMES: ClassVar = FORMER_NAMES

    out: Path = Path("runs/ready_models")  # output folder
    pad_model: Path = Path("runs/train")  # folder of a run of experiments.train that simulated its touches
    touches: bool = False  # simulate the data set of the package instead
    eflesh: Path | None = None  # a session of eFlesh (states.csv ...), for the calibration of that skin instead

    def check(self) -> None:
        """Refuse a missing run or session."""
        require_path("--eflesh", self.eflesh, "folder")
        if self.touches and self.eflesh:
            raise ValueError("--touches simulates a data set, and --eflesh fits a calibration; pass one of them")
        if self.eflesh is None and not self.touches:
            require_simulated_runs(self.pad_model)


def run(args: ReadyModelsArgs) -> dict[str, Any]:
    """Make the models and write their card."""
    begin(args, args)
    if args.touches:
        card = _simulated_touches(args)
    else:
        card = _of_a_run(args) if args.eflesh is None else _of_a_session(args, args.eflesh)
    card["megabytes"] = round(sum(path.stat().st_size for path in args.out.rglob("*") if path.is_file()) / 1e6, 2)
    write_json(args.out / METRICS, card)
    print(f"models and card, {card['megabytes']} MB, are in {args.out}")
    return card


def _of_a_run(args: ReadyModelsArgs) -> dict[str, Any]:
    """Copy the run's predictor on predicted contact pressure and its pad model; return their card."""
    from i2t.skin_models.pad_model import load_pad_model

    trained = finished_runs(args.pad_model)[0]
    metrics = json.loads((trained.folder / METRICS).read_text())
    # Orbax's commit_success.txt contains a path of the machine that wrote it, and is not needed.
    ignore = shutil.ignore_patterns("commit_success.txt")
    shutil.copytree(trained.on_pressure, args.out / "predictor", ignore=ignore)
    shutil.copyfile(trained.pad_model, args.out / PAD_MODEL)
    pad_model = load_pad_model(args.out / PAD_MODEL)
    origin = pad_model.origin
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
        "pad model": {"touches": origin.touches, "r2": pad_model.model.r2},
    }


def _simulated_touches(args: ReadyModelsArgs) -> dict[str, Any]:
    """Simulate and save the data set; return its card, with the scores of a predictor that is fitted to it."""
    import jax

    from i2t.contact.press import PressLimits
    from i2t.dataset import Dataset, save_dataset
    from i2t.objects import catalogue
    from i2t.prediction import fit_predictor
    from i2t.recognition.site_pool import prepare_surfaces
    from i2t.simulation.touches import SimulationErrors, simulate_touches
    from i2t.skin.contact import FINE_GRID
    from i2t.skin.pad import pad_from_seed

    plan, pad = READY_TOUCHES, pad_from_seed(READY_TOUCHES.pad)
    errors = SimulationErrors(
        depth_noise=0.0, depth_bleed=0.0, hand_eye=plan.hand_eye, hand_eye_angle=math.radians(plan.hand_eye_degrees)
    )
    seed = plan.first_seed + args.seed
    surfaces = prepare_surfaces([catalogue.make_object(name).mesh for name in plan.objects])
    touches = simulate_touches(
        jax.random.key(seed), surfaces, pad, errors,
        plan.sessions * plan.touches_per_session, touches_per_session=plan.touches_per_session,
        limits=PressLimits(final=FINE_GRID),
    )  # fmt: skip
    dataset = Dataset.simulated(
        touches._replace(truth=None), plan.objects, pad, pad_name=f"simulated pad {plan.pad}",
        meta={"made by": f"tools.ready_models --touches, seed {seed}"},
    )  # fmt: skip
    path = save_dataset(args.out / "touches.h5", dataset)
    size = path.stat().st_size
    if size > plan.max_bytes:
        raise ValueError(f"{path} has {size} bytes, more than {plan.max_bytes}; simulate fewer touches")
    score = fit_predictor(dataset).score(dataset)
    return {
        "source": dataset.source,
        "pad": dataset.pads[0],
        "objects": list(plan.objects),
        "touches": len(dataset),
        "sessions": len(dataset.sessions),
        "kilobytes": round(size / 1e3),
        "fit": score.to_json(),
    }


class _Session(NamedTuple):
    """Presses of a session, in the order of time."""

    position: np.ndarray  # (n, 2) m
    travel: np.ndarray  # (n,) m
    reading: np.ndarray  # (n, c) uT

    def some(self, rows: np.ndarray) -> "_Session":
        """Select presses."""
        return _Session(*(part[rows] for part in self))


def _of_a_session(args: ReadyModelsArgs, folder: Path) -> dict[str, Any]:
    """Fit and save a small calibration of a real skin; return its card."""
    from i2t.convert import eflesh
    from i2t.skin_models import calibrate

    converted = eflesh.convert(folder)
    touches = converted.dataset.touches
    rows = np.flatnonzero(touches.travel > 0)
    session = _Session(touches.T_w_o[rows, :2, 3].astype(np.float64), touches.travel[rows], touches.reading[rows])
    rng = np.random.default_rng(args.seed)
    places, place_of = np.unique(np.round(session.position, 4), axis=0, return_inverse=True)  # to 0.1 mm
    test_places = rng.permutation(len(places))[: round(SIZES.test_share * len(places))]
    held_out = np.isin(place_of.ravel(), test_places)
    training_rows = rng.permutation(np.flatnonzero(~held_out))
    fitted_to, test = session.some(training_rows[: SIZES.teacher_presses]), session.some(np.flatnonzero(held_out))
    teacher = _fitted(*fitted_to)
    small = _distilled(teacher, session, session.some(training_rows[SIZES.teacher_presses :][: SIZES.interval_presses]))
    baseline = session.some(training_rows[: SIZES.baseline_presses])
    card = {
        "source": "real",
        "recording": f"eFlesh, characterization/datasets/spatial/{folder.name}",
        "licence": "MIT, Copyright (c) 2025 Venkatesh Pattabiraman",
        "presses": {"teacher": SIZES.teacher_presses, "intervals": SIZES.interval_presses, "test": len(test.travel)},
        "places": {"all": len(places), "test": len(test_places)},
        "grid": len(_grid(session)),
        "range_mm": {
            "x": _range(session.position[:, 0]), "y": _range(session.position[:, 1]), "travel": _range(session.travel)
        },
        "methods": {
            "small calibration": _judged(small, test),
            "its teacher, 1000 presses": _judged(teacher, test),
            f"i2t.calibrate, {SIZES.baseline_presses} presses": _judged(calibrate(*baseline, load_kind="travel"), test),
            f"mean of {SIZES.baseline_neighbours} nearest of the 1000": _scores(test, _nearest(fitted_to, test)),
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
    """Fit a calibration to a teacher's predictions on a grid, and the widths of its intervals to presses."""
    grid = _grid(session)
    small = _fitted(grid[:, :2], grid[:, 2], teacher.predict(grid[:, :2], grid[:, 2])[0])
    mean, std = small.predict(for_intervals.position, for_intervals.travel)
    widening = np.quantile(np.abs(for_intervals.reading - mean) / std, 0.9, axis=0) / 1.645
    return replace(small, interval_scaling=np.float32(np.asarray(small.interval_scaling) * widening))


def _grid(session: _Session) -> np.ndarray:
    """Grid (n, 3) of positions and travels in metres, in random order as the Gaussian process requires."""
    edges = [np.linspace(column.min(), column.max(), SIZES.grid_positions) for column in session.position.T]
    travels = np.quantile(session.travel, np.linspace(0, 1, SIZES.grid_travels))
    grid = np.stack(np.meshgrid(*edges, travels, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.random.default_rng(0).permutation(grid)


def _judged(calibration: "Calibration", test: _Session) -> dict[str, float]:
    mean, std = calibration.predict(test.position, test.travel)
    return _scores(test, mean) | {"coverage_90": float(np.mean(np.abs(test.reading - mean) < 1.645 * std))}


def _scores(test: _Session, mean: np.ndarray) -> dict[str, float]:
    from i2t.prediction.metrics import score

    return {"r2": float(score(test.reading, mean).r2), "rmse": float(np.sqrt(np.mean((test.reading - mean) ** 2)))}


def _nearest(training: _Session, test: _Session) -> np.ndarray:
    """Mean reading of the nearest presses, with positions and travels scaled by their standard deviations."""
    features = [np.column_stack([part.position, part.travel]) for part in (training, test)]
    distance = np.linalg.norm((features[1][:, None] - features[0][None]) / features[0].std(0), axis=2)
    return training.reading[np.argsort(distance, axis=1)[:, : SIZES.baseline_neighbours]].mean(1)


def _range(values: np.ndarray) -> list[float]:
    return [round(1e3 * float(values.min()), 2), round(1e3 * float(values.max()), 2)]


main = command(ReadyModelsArgs, "tools.ready_models")

if __name__ == "__main__":
    sys.exit(main())
