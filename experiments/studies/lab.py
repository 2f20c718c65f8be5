"""What all studies share: a pad learnt from a finished run, objects to tell apart, simulated sittings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Array
from tqdm import tqdm

from experiments import plots
from experiments import recognition_figures as drawing
from experiments import recognition_scores as scores
from experiments.recognition import (
    Episodes,
    Learnt,
    Pool,
    Setting,
    Sitting,
    learn,
    learn_on_pad,
    places_about,
    surfaces_of,
    tabulate,
)
from experiments.recognition_scores import plain
from experiments.recognize import PRESETS, Recognition, taught, trained, training_rows
from i2t import objects
from i2t.belief import Particles
from i2t.outcomes import Outcome, SkinMap
from i2t.predictor import Predictor
from i2t.types import Pad, Surface

PLACES = 128  # of each object: with 64 to 512 accuracies are the same within 0.01
Study = Literal["policy", "open", "planar", "crossing", "sites", "pad", "sensitivity", "many"]


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
    overwrite: bool = False


class Lab(NamedTuple):
    """One pad and seed: what was learnt, and the objects to tell apart."""

    cfg: Recognition
    pad: Pad
    learnt: Learnt
    names: tuple[str, ...]
    surfaces: list[Surface]
    sittings: int
    seed: int
    key: Array
    args: Args
    training: Callable[[Pad, Array], Learnt]  # learns another pad from the same objects
    predictor: Predictor  # of the run


def prepare_lab(args: Args, folder: Path, seed: int) -> Lab:
    """What all studies of a pad and seed share."""
    cfg = PRESETS[args.preset]
    cfg = replace(cfg, places=min(cfg.places, PLACES))
    dataset, predictor, pad = trained(folder)
    key_learn, key = jax.random.split(jax.random.key(100 + seed))
    known = taught(dataset)
    rows = training_rows(dataset, folder)
    learnt = learn(key_learn, dataset, rows, known, cfg.errors, cfg.limits)
    names = cfg.primitives + cfg.tools
    taught_on = [known[dataset.objects[i]] for i in np.unique(dataset.touches.object[rows])]

    def training(other: Pad, key: Array) -> Learnt:
        return learn_on_pad(key, other, taught_on, 100 if args.preset == "debug" else 900, cfg.limits, learnt)

    surfaces = surfaces_of([objects.make(name).mesh for name in names])
    sittings = 2 if args.preset == "debug" else args.sittings
    return Lab(cfg, pad, learnt, names, surfaces, sittings, seed, key, args, training, predictor)


def placements_of(lab: Lab) -> Particles:
    """Places of an object in the lab's world."""
    return places_about(lab.cfg.errors, lab.cfg.places, lab.seed)


def imagine(lab: Lab, sites: Pool, places: Particles, skins: Sequence[SkinMap], what: str) -> list[Outcome]:
    """Outcomes on the lab's objects."""
    return tabulate(lab.surfaces, places.twist, sites.T_w_t, skins, lab.cfg.limits.past_goal, what)


def sit(lab: Lab, key: Array, sites: Pool, truth: np.ndarray, chosen: np.ndarray, what: str, **world: Any) -> Episodes:
    """Simulated sittings at sites chosen beforehand, with a bar; `world` replaces parts of the lab's."""
    setting = Setting(lab.cfg.errors, lab.cfg.limits, chosen.shape[1])
    surfaces = world.pop("surfaces", lab.surfaces)
    pad = world.pop("pad", lab.pad)
    sitting = Sitting(key, surfaces, truth, sites, pad, replace(setting, **world))
    with tqdm(total=chosen.size, desc=f"{what}: touching", unit="touch") as bar:
        sitting.touch(chosen, bar)
    return sitting.episodes()


def shown(estimate: scores.Estimate) -> str:
    """A mean with its interval."""
    return f"{float(estimate.mean):.3f} [{float(estimate.low):.3f}, {float(estimate.high):.3f}]"


def report_methods(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Accuracy of every method on the same sittings."""
    truth = np.concatenate([part["truth"] for part in parts])
    result: dict[str, Any] = {"sittings": len(truth), "methods": {}}
    curves = {}
    for name in parts[0]:
        if name == "truth":
            continue
        p = np.concatenate([part[name] for part in parts]).astype(np.float64)
        curves[name] = scores.accuracy(p, truth)
        result["methods"][name] = {
            "accuracy": plain(curves[name]), "mean": plain(scores.mean_accuracy(p, truth)),
            "log_loss": scores.log_loss(p, truth).mean(0).tolist(),
        }  # fmt: skip
        last = scores.Estimate(*(x[-1] for x in curves[name]))
        print(f"{name:34} after {p.shape[1]}: {shown(last)}   mean: {shown(scores.mean_accuracy(p, truth))}")
    plots.save(drawing.accuracy(curves, "Accuracy", True), out / "accuracy.png")
    return result
