"""What all studies share: a pad learnt from a finished run, objects to tell apart, simulated sittings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Array

from experiments.recognize import figures as drawing
from experiments.recognize import trained_run
from experiments.recognize.config import PRESETS, Recognition
from experiments.recognize.trained_run import meshes_by_name
from i2t import viz
from i2t.dataset import Dataset
from i2t.prediction.predictor import Predictor
from i2t.recognition import metrics as scores
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import EpisodeConfig, Episodes, run_episodes
from i2t.recognition.metrics import to_json
from i2t.recognition.outcomes import LinearReadingModel, PredictedTouch
from i2t.recognition.pad_model import PadModel, fit_pad_model, fit_simulated_pad_model
from i2t.recognition.site_pool import SitePool, pose_particles, precompute_outcomes, prepare_surfaces
from i2t.simulation import touches as simulation
from i2t.simulation.press import PressLimits
from i2t.types import Pad, Surface

PLACES = 128  # of each object: with 64 to 512 accuracies are the same within 0.01
Study = Literal["policy", "open", "planar", "registered", "crossing", "sites", "pad", "sensitivity", "many"]


@dataclass(frozen=True)
class Args:
    """Study recognition by touch."""

    study: tyro.conf.Positional[Study]
    out: Path | None = None  # folder for everything that is made; runs/STUDY unless given
    run: Path = Path("runs/train")  # a finished run of experiments.train, or a study's folder of several
    preset: Literal["paper", "debug"] = "paper"
    sittings: int = 20  # of each object and setting, for each pad and seed
    meshes: Path | None = None  # a folder of STL files in metres that join the objects of `many`
    placements: tuple[float, ...] = (0.0, 0.1, 0.3, 1.0, 2.0, 4.0)  # of `crossing`: mm and degrees, one sigma
    rough: tuple[float, ...] = (0.3, 1.0)  # of `crossing`: mm of noise on every pixel of views, at 1 mm of placement
    seed: int = 0
    resume: bool = False  # go on with an unfinished study in --out
    overwrite: bool = False  # replace a finished or unfinished one


class Lab(NamedTuple):
    """One pad and seed: what was learnt, and the objects to tell apart."""

    cfg: Recognition
    pad: Pad
    learnt: PadModel
    names: tuple[str, ...]
    surfaces: list[Surface]
    sittings: int
    seed: int
    key: Array
    args: Args
    training: Callable[[Pad, Array], PadModel]  # learns another pad from the same objects
    pressed: Callable[[PressLimits, Array], PadModel]  # learns the pad as the run did, from presses with other limits
    predictor: Predictor  # of the run


def prepare_lab(args: Args, folder: Path, seed: int) -> Lab:
    """What all studies of a pad and seed share."""
    cfg = PRESETS[args.preset]
    cfg = replace(cfg, num_particles=min(cfg.num_particles, PLACES))
    key_learn, key = jax.random.split(jax.random.key(100 + seed))
    told = trained_run.load_trained_run(key_learn, folder, cfg.errors, cfg.limits)
    names = cfg.primitives + cfg.tools
    which, counts = np.unique(told.dataset.touches.object[told.rows], return_counts=True)
    kinds = tuple(told.dataset.objects[i] for i in which)
    taught_on = [told.surfaces[kind] for kind in kinds]

    def training(other: Pad, key: Array) -> PadModel:
        return fit_simulated_pad_model(
            key, other, taught_on, touches=100 if args.preset == "debug" else 900, limits=cfg.limits,
            recorded=told.pad_model,
        )  # fmt: skip

    def pressed(limits: PressLimits, key: Array) -> PadModel:
        key_press, key_learn = jax.random.split(key)
        made = simulation.simulate_touches(key_press, taught_on, told.pad, cfg.errors, counts.tolist(), limits=limits)
        touches = jax.device_get(made)
        runs = tuple(f"run {i}" for i in range(int(touches.session.max()) + 1))
        told_by = Dataset(touches, kinds, ("the pad",), runs, told.dataset.board, "simulated")
        return fit_pad_model(key_learn, told_by, np.ones(len(told_by), bool), told.surfaces, errors=cfg.errors, limits=limits)

    surfaces = prepare_surfaces(list(meshes_by_name(names).values()))
    sittings = 2 if args.preset == "debug" else args.sittings
    return Lab(
        cfg, told.pad, told.pad_model, names, surfaces, sittings, seed, key, args, training, pressed, told.predictor
    )


def placements_of(lab: Lab) -> Particles:
    """Places of an object in the lab's world."""
    return pose_particles(lab.cfg.errors, lab.cfg.num_particles, lab.seed)


def imagine(lab: Lab, sites: SitePool, places: Particles, skins: Sequence[LinearReadingModel], what: str) -> list[PredictedTouch]:
    """Outcomes on the lab's objects."""
    return precompute_outcomes(
        lab.surfaces, places.twist, sites.T_w_t, skins, overtravel=lab.cfg.limits.overtravel, label=what
    )


def sit(lab: Lab, key: Array, sites: SitePool, truth: np.ndarray, chosen: np.ndarray, what: str, **world: Any) -> Episodes:
    """Simulated sittings at sites chosen beforehand, with a bar; `world` replaces parts of the lab's."""
    setting = EpisodeConfig(lab.cfg.errors, lab.cfg.limits, chosen.shape[1])
    surfaces = world.pop("surfaces", lab.surfaces)
    pad = world.pop("pad", lab.pad)
    config = replace(setting, **world)
    return run_episodes(key, surfaces, truth, chosen, sites=sites, pad=pad, config=config, label=what)


def shown(estimate: scores.Estimate) -> str:
    """A mean with its interval."""
    return f"{float(estimate.mean):.3f} [{float(estimate.low):.3f}, {float(estimate.high):.3f}]"


def spread(name: str, unit: str, values: np.ndarray, where: str) -> dict[str, Any]:
    """Quantiles of how far something was off."""
    percentiles = np.percentile(values, [25, 50, 75, 90])
    print(f"{name} by {percentiles[1]:.2f} {unit} (median; 90 %: {percentiles[3]:.2f}) {where}")
    return {"unit": unit, "of": len(values), "percentiles_25_50_75_90": percentiles.tolist()}


def report_methods(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Accuracy of every method on the same sittings."""
    truth = np.concatenate([part["truth"] for part in parts])
    result: dict[str, Any] = {"sittings": len(truth), "methods": {}}
    settings: dict[str, dict[str, scores.Estimate]] = {}
    for name in parts[0]:
        if name == "truth":
            continue
        p = np.concatenate([part[name] for part in parts]).astype(np.float64)
        accuracy = scores.accuracy(p, truth)
        result["methods"][name] = {
            "accuracy": to_json(accuracy), "mean": to_json(scores.mean_accuracy(p, truth)),
            "log_loss": scores.log_loss(p, truth).mean(0).tolist(),
        }  # fmt: skip
        last = scores.Estimate(*(x[-1] for x in accuracy))
        evidence, _, setting = name.partition(", ")
        settings.setdefault(setting or "in any case", {})[evidence] = last
        print(f"{name:34} after {p.shape[1]}: {shown(last)}   mean: {shown(scores.mean_accuracy(p, truth))}")
    figure = drawing.sensitivity(settings, f"After {p.shape[1]} touches", "accuracy", True)
    viz.save_figure(figure, out / "accuracy.png")
    return result
