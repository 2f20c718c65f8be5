"""The models that come with the package: the predictor that a run kept, and the pad model fitted to its touches.

    python -m experiments.train                    touches of a simulated pad, and a predictor
    python -m experiments.ready_models             runs/ready_models, some minutes

predictor/, pad_model.npz and metrics.json of --out are what i2t/models/nominal holds; `i2t.load_predictor("nominal")`
and `i2t.load_pad_model("nominal")` read them. metrics.json is the model's card: what it was made of, and how well it
predicts objects that it has not seen, from the run's own metrics. docs/model_card.md gives these figures.

    python -m experiments.ready_models --eflesh SESSION --out runs/ready_eflesh

makes the calibration of a real skin, calibration.npz and its card, which i2t/models/eflesh holds
(`i2t.load_calibration("eflesh")`); `experiments.ready_models.eflesh` says how.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.checks import finished_runs
from experiments.common.runs import METRICS, begin, write_json
from experiments.ready_models.arguments import ReadyModelsArgs
from experiments.ready_models.eflesh import fit_small, read_session
from experiments.recognize.config import Recognition
from experiments.recognize.trained_run import load_trained_run
from i2t.prediction import predictor as predictors
from i2t.recognition.pad_model_files import KnownPad, PadOrigin, save_pad_model

ORBAX_NOTE = "commit_success.txt"  # names the folder of the machine that wrote it; nobody reads it


class CardFigures(NamedTuple):
    """Figures of the predictor for a card, from the metrics of its run."""

    kept: str
    methods: dict[str, dict[str, Any]]


def run(args: ReadyModelsArgs) -> dict[str, Any]:
    """Make the models and their card."""
    card = _of_a_run(args) if args.eflesh is None else _of_a_session(args, args.eflesh)
    write_json(args.out / METRICS, card)
    print(f"models and card, {card['megabytes']} MB, are in {args.out}")
    return card


def _of_a_session(args: ReadyModelsArgs, folder: Path) -> dict[str, Any]:
    """Fit and save a small calibration of a real skin."""
    session = read_session(folder)
    begin(args.out, args, Recognition(), None, args.overwrite)
    calibration, card = fit_small(session, args.seed)
    calibration.save(args.out / "calibration.npz")
    return card | {"megabytes": round(_bytes(args.out) / 1e6, 2)}


def _of_a_run(args: ReadyModelsArgs) -> dict[str, Any]:
    """Save the kept predictor, fit and save the pad model."""
    folder, cfg = finished_runs(args.trained_run)[0], Recognition()
    begin(args.out, args, cfg, None, args.overwrite)
    trained = load_trained_run(jax.random.key(args.seed), folder, cfg.errors, cfg.limits)
    metrics = json.loads((folder / METRICS).read_text())
    predictors.save(args.out / "predictor", trained.predictor)
    (args.out / "predictor" / ORBAX_NOTE).unlink(missing_ok=True)
    dataset, rows = trained.dataset, trained.rows
    names = tuple(dataset.objects[i] for i in np.unique(dataset.touches.object[rows]))
    made_from = f"experiments.train, pad {metrics['pad']}, seed {metrics['seed']}"
    origin = PadOrigin(dataset.pads[0], dataset.source, names, int(rows.sum()), made_from)
    save_pad_model(args.out / "pad_model.npz", KnownPad(trained.pad_model, dataset.board, origin))
    figures = card_figures(metrics)
    return {
        "source": dataset.source,
        "pad": dataset.pads[0],
        "made from": made_from,
        "trained on": list(names),
        "tested on": sorted(metrics["by_object"]),
        "touches": metrics["counts"],
        "predictor": figures.kept,
        "methods": figures.methods,
        "pad model": {"touches": origin.touches, "r2": trained.pad_model.r2},
        "megabytes": round(_bytes(args.out) / 1e6, 2),
    }


def card_figures(metrics: dict[str, Any]) -> CardFigures:
    """Figures of the kept predictor, the baselines and the ceiling on unseen objects.

    Args:
        metrics: Of a run of experiments.train.

    Returns:
        The kept method and R2 with its interval, RMSE and coverage of each method.
    """
    wanted = ("r2", "r2_interval", "rmse", "rmse_sigma", "cosine", "coverage_90")
    methods = {
        name: {key: scores[key] for key in wanted if key in scores} for name, scores in metrics["methods"].items()
    }
    return CardFigures(metrics["best"], methods)


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
