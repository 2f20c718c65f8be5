"""Question: does what was built in one simulated world hold in another?

    python -m experiments.second_world                         write a set, convert it, train on it, compare
    python -m experiments.second_world --preset debug          a few touches, to see it run
    python -m experiments.second_world --softness 4            predict contact pressure for a softer layer
    python -m experiments.second_world --mistake force_sign    the same with a mistake that a lab could make

The second world (`experiments.second_world.world`) has another contact law and solver, other magnets, another camera
with whole millimetres, and other errors. Its touches are written in the layout of the authors' recordings and read by
`python -m i2t.convert imagine2touch`; `python -m experiments.train --dataset` trains on them, with objects held out.
The command reports by how much the best model on predicted contact pressure leads ridge regression and nearest
neighbours, in the world as a lab has it and in one whose camera and arm make no errors: the difference says what bounds
it. Results go to --out.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from experiments.common.intervals import with_interval
from experiments.common.runs import begin, write_json
from experiments.second_world.arguments import Mistake, SecondWorldArgs
from experiments.second_world.world import (
    LOOK_M,
    WorldErrors,
    WorldTouches,
    make_objects,
    make_skin,
    simulate_session,
)
from experiments.train.__main__ import main as train
from i2t.convert.__main__ import main as convert
from i2t.progress import progress

PRESSURE = ("network on predicted contact pressure", "Gaussian process on predicted contact pressure")
BASELINES = ("k nearest patches", "k nearest patches + measured", "ridge on PCA", "ridge on PCA + measured")
TEMPERATURE_C = 27.0


@dataclass(frozen=True)
class Worlds:
    """The same world with two laboratories in it."""

    lab: WorldErrors = field(default_factory=WorldErrors)
    ideal: WorldErrors = field(default_factory=WorldErrors.none)


NAMES = {"lab": "as a lab has it", "ideal": "without errors of camera and arm"}


def run(args: SecondWorldArgs) -> dict[str, Any]:
    """Both worlds: write, convert, train, compare."""
    worlds = Worlds()
    begin(args.out, args, worlds, args.resume, args.overwrite)
    result: dict[str, Any] = {"source": "simulated, in a second world", "mistake": args.mistake, "worlds": {}}
    for world in (part.name for part in fields(worlds)):
        folder = args.out / world
        measured = _finished(folder / "train") or train_in(folder, args, getattr(worlds, world))
        result["worlds"][world] = report(NAMES[world], measured)
    write_json(args.out / "metrics.json", result)
    return result


def train_in(folder: Path, args: SecondWorldArgs, errors: WorldErrors) -> dict[str, Any]:
    """Metrics of `experiments.train` on touches of a world."""
    recordings, converted = folder / "recordings", folder / "data"
    write_recordings(recordings, args, errors)
    _must(convert, "imagine2touch", str(recordings), str(converted), "--overwrite")
    words = ["--dataset", str(converted), "--out", str(folder / "train"), "--seeds", "1", "--overwrite"]
    words += [] if args.softness == 1 else ["--softness", str(args.softness)]
    _must(train, *words, *(["--preset", "debug"] if args.preset == "debug" else []))
    found = _finished(folder / "train")
    assert found is not None
    return found


def _must(command: Callable[[list[str]], int], *words: str) -> None:
    """Run a command of i2t; raises RuntimeError if it fails."""
    if command(list(words)):
        raise RuntimeError(f"{words[0]} {words[1]} failed")


def _finished(folder: Path) -> dict[str, Any] | None:
    path = folder / "metrics.json"
    return json.loads(path.read_text()) if path.is_file() else None


def report(name: str, measured: dict[str, Any]) -> dict[str, Any]:
    """Print and return the lead of the best model on predicted pressure over the best baseline."""
    scores = {method: values for method, values in measured["methods"].items() if values.get("r2") is not None}

    def best(of: Sequence[str]) -> str:
        return max((method for method in of if method in scores), key=lambda method: scores[method]["r2"])

    model, baseline = best(PRESSURE), best(BASELINES)
    lead = scores[model]["r2"] - scores[baseline]["r2"]
    print(f"\n{name} (simulated): the lead is {lead:+.3f}; kept: {measured['best']}")
    for method in (model, baseline):
        r2 = with_interval(scores[method]["r2"], *scores[method]["r2_interval"])
        print(f"  {method:48} R2 {r2} on unseen objects")
    kept = {method: {key: values[key] for key in ("r2", "r2_interval")} for method, values in scores.items()}
    return {"lead": lead, "model": model, "baseline": baseline, "kept": measured["best"], "methods": kept}


# --- files ---


def write_recordings(folder: Path, args: SecondWorldArgs, errors: WorldErrors) -> None:
    """Sessions of all objects in the layout of the authors, with the mistake that was asked for."""
    rng = np.random.default_rng(args.seed)
    skin, objects = make_skin(rng), make_objects()
    sessions, touches_of_each = args.sizes
    with progress(total=len(objects) * sessions, desc="second world", unit="session") as bar:
        for name, mesh in objects.items():
            for session in range(sessions):
                touches = simulate_session(rng, mesh, skin, errors, touches_of_each)
                write_session(rng, folder / name, str(session + 1), touches, args.mistake)
                bar.update()


def write_session(rng: np.random.Generator, folder: Path, run: str, touches: WorldTouches, mistake: Mistake) -> None:
    """One run as the authors' code writes it."""
    name, scale = folder.name, 1e-3 if mistake == "millitesla" else 1.0
    stem = folder / f"{name}_tactile" / f"experiment_{run}_reskin"
    stem.parent.mkdir(parents=True, exist_ok=True)
    _save(stem, _samples(rng, scale * touches.samples))
    _save(stem.with_name(stem.name + "_ambient"), scale * touches.ambient)

    axis, contact = touches.T_w_t[:, :3, 2], touches.T_w_t[:, :3, 3]
    rotations = Rotation.from_matrix(touches.T_w_t[:, :3, :3])
    metre = 1e3 if mistake == "millimetres" else 1.0
    pushed = touches.force[:, None] * axis * (1.0 if mistake == "force_sign" else -1.0)
    turned = rotations.as_quat()
    poses, forces = folder / f"{name}_poses", folder / f"{name}_forces"
    for path, values in (
        (poses / f"experiment_{run}_final_contact", metre * contact),
        (poses / f"experiment_{run}_prepare_contact", metre * (contact - LOOK_M * axis)),
        (poses / f"experiment_{run}_rotations", turned),
        (forces / f"experiment_{run}_forces_torques", np.c_[pushed, np.zeros_like(pushed)]),
        (forces / f"experiment_{run}_contact_returns", np.full(len(contact), 3)),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        _save(path, values)
    images = folder / f"{name}_images" / "depth"
    images.mkdir(parents=True, exist_ok=True)
    for k, image in enumerate(touches.image):
        Image.fromarray(np.round(image * 1e3).astype(np.uint16)).save(images / f"experiment_{run}_depth_{k + 1}.tif")


def _samples(rng: np.random.Generator, field: np.ndarray) -> np.ndarray:
    """One sample of each touch: time, delay, five times temperature and field, device."""
    temperature = TEMPERATURE_C + np.linspace(-1, 1, 5) + rng.normal(0, 0.1, (len(field), 5))
    values = np.concatenate([temperature[..., None], field.reshape(len(field), 5, 3)], axis=-1).reshape(len(field), 20)
    found = np.empty((len(field), 1), object)
    found[:, 0] = [[1.6e9 + float(i), 0.01, row.tolist(), 2] for i, row in enumerate(values)]
    return found


def _save(path: Path, values: np.ndarray) -> None:
    """Save into a name without ending, as the authors do."""
    with path.open("wb") as file:
        np.save(file, values, allow_pickle=True)
