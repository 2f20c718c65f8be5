"""Question: how well do a few presses at a known force tell a ReSkin, when its layer is what physics says it is?

    python -m experiments.calibrate_pads                  8 random simulated pads, 10 to 300 presses
    python -m experiments.calibrate_pads --preset short   4 pads, 5, 20 and 100 presses, no network
    python -m experiments.calibrate_pads --preset debug   1 pad, 10 and 20 presses, too few to mean anything
    python -m experiments.calibrate_pads --population     FORCE_HYPERPARAMETERS: chosen on 24 pads, tried on 32 others
    python -m experiments.calibrate_pads --prior          the prior over kernels, from simulated skins of many kinds
    python -m experiments.calibrate_pads --kinds          calibration of other simulated skins of these kinds

Everything is simulated: pads of `sample_pad`, a spherical tip of 4 mm pressed to 0.2 to 1 N at random positions, 0.02 N
of error in the force, 0.05 mm in each position, and 1.5 uT of noise. Methods: k nearest presses, a plain Gaussian
process, the structured GP for forces, a network pretrained on other random pads, a pad fitted by physics, and that with
a structured GP for what it leaves. All see the same presses. With --population no pad is fitted: the hyperparameters of
the structured GP are searched, one after the other, from a guess by geometry, on boards with the faults of one in order
(`Faults.typical`) and tried on others with and without.

--prior writes prior.npz, which becomes i2t/calibration/population_gp/prior.npz; the seeds are its own. --kinds tries
`i2t.calibrate` with it on skins of other seeds, pressed by depth, by force and by both.

Results go to --out: metrics.json, config.json, curves.png, and pad.npz, the first pad as fitted to the most presses,
which `i2t.load_pad` reads.
"""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.calibrate.data import PressRecording
from experiments.calibrate.evaluate import Curves
from experiments.calibrate.methods import NEIGHBOURS, PLAIN, Predictors, fit, neighbours, predict, select
from experiments.calibrate.report import draw_curves, summarise, table_row
from experiments.calibrate_pads import population, prior_search, skin_kinds
from experiments.calibrate_pads.arguments import CalibratePadsArgs
from experiments.calibrate_pads.simulate import BALL_TIP, board, press_pads
from experiments.common.presets import choose_preset
from experiments.common.runs import begin, write_json
from i2t.calibration import FORCE_HYPERPARAMETERS, Presses, baseline_network, physics, structured_gp
from i2t.calibration.baseline_network import PressFeatures
from i2t.calibration.physics import PadFit
from i2t.calibration.population_gp.prior import PRIOR_FILE
from i2t.prediction.metrics import score
from i2t.progress import progress, say_beside
from i2t.skin.files import save_pad
from i2t.types import Pad
from i2t.viz import style

STRUCTURED, PRETRAINED = "structured GP", "network pretrained on random pads"
NOMINAL, FITTED, RESIDUAL = "physics, median layer", "physics, fitted layer", "physics + structured GP"
STYLES: dict[str, tuple[str, str]] = {
    NEIGHBOURS: (style.GREY, "-"), PLAIN: (style.ORANGE, "-"), STRUCTURED: (style.GREEN, "-"),
    PRETRAINED: (style.PINK, "-"), NOMINAL: (style.SKY, "-"), FITTED: (style.BLUE, "-"), RESIDUAL: (style.RED, "-"),
}  # fmt: skip
OTHER_PAD_PRESSES = 60  # of each other pad
# What physics leaves is noise for the most part; the presses select how much.
PHYSICS_RESIDUAL_NOISE = (100.0, {"noise_variance": (1e-3, 1e-2, 0.1)})
PAD_LABEL_WIDTH = 40


@dataclass(frozen=True)
class PadsPreset:
    """Sizes of the experiment."""

    pads: int = 8
    counts: tuple[int, ...] = (10, 20, 50, 100, 300)
    held_out_presses: int = 200  # of each pad
    other_pads: int = 200  # random ones to pretrain on; 0: no network
    pretraining_steps: int = 3000


PRESETS: dict[str, PadsPreset] = {
    "paper": PadsPreset(),
    "short": PadsPreset(4, (5, 20, 100), 200, 0),
    "debug": PadsPreset(1, (10, 20), 40, 4, 20),
}


class PadScores(NamedTuple):
    """Scores over pads."""

    r2: Curves
    map_r2: Curves  # of the fitted magnetization
    coverage: Curves  # of the fitted pad's 90 % range
    layer_errors: list[dict[str, float]]  # of each pad, in the fit's standard deviations


def run(args: CalibratePadsArgs) -> dict[str, Any]:
    """Run what the options ask for: pads compared, hyperparameters, the prior over kernels, or kinds of skins."""
    others = {run_population: args.population, run_prior: args.prior, run_kinds: args.kinds}
    return next((each for each, asked in others.items() if asked), run_pads)(args)


def run_pads(args: CalibratePadsArgs) -> dict[str, Any]:
    """The experiment: prepare, evaluate, report."""
    started, cfg = time.perf_counter(), choose_preset(PRESETS, args.preset)
    begin(args.out, args, cfg, None, args.overwrite)
    key_pads, key_others, key_train = jax.random.split(jax.random.key(args.seed), 3)
    pads, presses, readings = press_pads(key_pads, cfg.pads, max(cfg.counts) + cfg.held_out_presses)
    network = None
    if cfg.other_pads:
        _, *others = press_pads(key_others, cfg.other_pads, OTHER_PAD_PRESSES)
        steps, counts = cfg.pretraining_steps, (5, 10, 20, 50)
        network = baseline_network.pretrain(key_train, *others, steps=steps, counts=counts)[0]

    scores = evaluate(cfg, pads, presses, readings, network, args.out / "pad.npz")

    gains = {
        name: {n: list(np.subtract(values, scores.r2[STRUCTURED][n])) for n, values in by_count.items()}
        for name, by_count in scores.r2.items()
        if name != STRUCTURED
    }
    metrics: dict[str, Any] = {
        "source": "simulated",
        "seed": args.seed,
        "pads": cfg.pads,
        "r2": summarise(scores.r2),
        "differences_to_structured": summarise(gains),
        "map_r2": summarise(scores.map_r2)[FITTED],
        "inside_90_of_fitted": summarise(scores.coverage)[FITTED],
        "layer_errors_in_stds": scores.layer_errors,
        "seconds": round(time.perf_counter() - started, 1),
    }
    style.save_figure(figure(metrics), args.out / "curves.png")
    write_json(args.out / "metrics.json", metrics)
    for name, by_count in metrics["r2"].items():
        print(table_row(name, by_count, PAD_LABEL_WIDTH))
    return metrics


def run_population(args: CalibratePadsArgs) -> dict[str, Any]:
    """The search for hyperparameters."""
    cfg = choose_preset(population.PRESETS, args.preset)
    begin(args.out, args, cfg, None, args.overwrite)
    metrics = population.evaluate(cfg, args.seed)
    population.report(metrics, args.out)
    return metrics


def run_prior(args: CalibratePadsArgs) -> dict[str, Any]:
    """The search for the prior over kernels."""
    cfg = choose_preset(prior_search.PRESETS, args.preset)
    begin(args.out, args, cfg, None, args.overwrite)
    metrics = prior_search.make_prior(cfg, args.out)
    write_json(args.out / "metrics.json", metrics)
    print(f"simulated; {metrics['kept']} kernels are in {args.out / PRIOR_FILE}")
    return metrics


def run_kinds(args: CalibratePadsArgs) -> dict[str, Any]:
    """Skins of many kinds, calibrated."""
    cfg = choose_preset(skin_kinds.PRESETS, args.preset)
    begin(args.out, args, cfg, None, args.overwrite)
    metrics = skin_kinds.evaluate(cfg)
    skin_kinds.report(metrics, args.out)
    return metrics


def evaluate(
    cfg: PadsPreset, pads: Pad, presses: Presses, readings: jax.Array, network: PressFeatures | None, saved: Path
) -> PadScores:
    """Every method on every pad; the first pad as fitted to the most presses is saved."""
    scores = PadScores({}, {}, {}, [])
    for i in progress(range(cfg.pads), desc="pads", unit="pad"):
        pad, at = (jax.tree.map(lambda part, i=i: part[i], tree) for tree in (pads, presses))
        position, force, y = (np.asarray(part, np.float64) for part in (at.position, at.load, readings[i]))
        predictors = Predictors(PressRecording(position, force, y, True, board().chips[:, :2]))
        if network is not None:
            predictors = predictors.with_network(network)
        test = np.arange(len(y) - cfg.held_out_presses, len(y))
        for count in cfg.counts:
            fitted = score_methods(scores, predictors, pad, np.arange(count), test)
        say_beside(
            f"pad {i}: "
            + ", ".join(f"{name} {[round(v[-1], 3) for v in by.values()]}" for name, by in scores.r2.items())
        )
        scores.layer_errors.append(layer_errors(pad, fitted))
        if i == 0:
            save_pad(saved, fitted.pad, about={"presses": max(cfg.counts), "source": "simulated"})
    return scores


def score_methods(scores: PadScores, predictors: Predictors, pad: Pad, rows: np.ndarray, test: np.ndarray) -> PadFit:
    """Add the scores of every method that learns from the same rows; returns the fitted pad."""
    recording, count = predictors.recording, len(rows)
    truth = recording.readings[test]
    fitted, predicted = predict_all(predictors, rows, test)
    for name, mean in predicted.items():
        scores.r2.setdefault(name, {}).setdefault(count, []).append(float(score(truth, mean).r2))
    true_map = np.asarray(pad.magnetization)
    wrong = np.sum((true_map - np.asarray(fitted.pad.magnetization)) ** 2)
    scores.map_r2.setdefault(FITTED, {}).setdefault(count, []).append(float(1 - wrong / np.sum(true_map**2)))
    expected, std = physics.predict_pad(fitted, recording.presses(test), tip=BALL_TIP, by_force=True)
    inside = np.abs(truth - np.asarray(expected)) < structured_gp.STDS_WITHIN_90_PERCENT * np.asarray(std)
    scores.coverage.setdefault(FITTED, {}).setdefault(count, []).append(float(np.mean(inside)))
    return fitted


def predict_all(predictors: Predictors, rows: np.ndarray, test: np.ndarray) -> tuple[PadFit, dict[str, np.ndarray]]:
    """Readings at the test from those at rows by every method, and the pad fitted."""
    recording = predictors.recording
    at, y, prior = recording.presses(rows), jnp.float32(recording.readings[rows]), physics.layer_prior()
    predicted = {
        NEIGHBOURS: neighbours(recording, rows, test),
        PLAIN: predictors.plain(rows, test),
        STRUCTURED: predictors.structured(rows, test),
    }
    if predictors.pretrained_features is not None:
        predicted[PRETRAINED] = predictors.pretrained(rows, test)
    nominal = physics.solve_map(prior.median, prior.std, at, y, tip=BALL_TIP, board=board(), by_force=True)
    fitted = physics.fit_pad(at, y, tip=BALL_TIP, board=board(), by_force=True, prior=prior)
    for name, one in ((NOMINAL, nominal), (FITTED, fitted)):
        mean = physics.predict_pad(one, recording.presses(test), tip=BALL_TIP, by_force=True)[0]
        predicted[name] = np.asarray(mean, np.float64)
    left, (noise, factors) = y - fitted.leave_one_out, PHYSICS_RESIDUAL_NOISE
    candidates = structured_gp.hyperparameter_grid(FORCE_HYPERPARAMETERS._replace(noise_variance=noise), factors)
    rest = fit(select(candidates, recording, rows, np.asarray(left)), at, left, recording.chips)
    predicted[RESIDUAL] = predicted[FITTED] + np.asarray(predict(rest, recording.presses(test))[0], np.float64)
    return fitted, predicted


def layer_errors(pad: Pad, fitted: PadFit) -> dict[str, float]:
    """Errors of the layer's parameters, in the fit's standard deviations."""
    truth = {
        "thickness": pad.thickness,
        "gap": -pad.board.chips[0, 2] - pad.thickness,
        "young": pad.young,
        "mount_compliance": pad.mount_compliance,
    }
    return {
        name: float((getattr(fitted.layer, name) - value) / getattr(fitted.layer_std, name))
        for name, value in truth.items()
    }


def figure(metrics: dict[str, Any]) -> Figure:
    """R2 against the number of presses."""
    result = Figure(figsize=(7, 4.6), layout="constrained")
    axes = result.subplots()
    draw_curves(axes, metrics["r2"], STYLES)
    axes.set(ylabel="R² over all channels")
    axes.set_title(f"Presses at a known force on {metrics['pads']} simulated pads (95 % over pads)")
    return result
