"""Input of recognition from a finished run of `experiments.train`: its touches, its predictor, and its pad."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments.common.checks import require_objects
from experiments.train import recognition_data
from i2t import dataset as data
from i2t.contact.press import PressLimits
from i2t.dataset import Dataset
from i2t.objects import Mesh, catalogue
from i2t.objects.named import read_object
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.recognition.site_pool import prepare_surfaces
from i2t.simulation.touches import SimulationErrors
from i2t.skin.files import load_pad
from i2t.skin.pad import numbered_pad
from i2t.skin_models.pad_fit import ContactModel, ObjectTouches
from i2t.skin_models.pad_model import PadModel
from i2t.types import Pad, Surface


class TrainedRun(NamedTuple):
    """A finished run, and the pad model fitted to its training touches."""

    dataset: Dataset
    rows: np.ndarray  # (n,) bool, of the touches that it trained on
    surfaces: dict[str, Surface]  # of the catalogue's objects that it trained on, by name
    predictor: Predictor
    pad: Pad
    pad_model: PadModel


def load_trained_run(key: jax.Array, folder: Path, errors: SimulationErrors, limits: PressLimits) -> TrainedRun:
    """Read a finished run and fit its pad model.

    Args:
        key: Of the fit.
        folder: Of the run.
        errors: Of the world in which its touches were simulated.
        limits: With which they were pressed.

    Returns:
        The run.

    Raises:
        ValueError: The run did not simulate its touches, so that there is no pad to simulate others with.
    """
    dataset, predictor, pad = read_simulated_run(folder)
    rows = _training_rows(dataset, folder)
    surfaces = _touched_surfaces(dataset, rows)
    known = ContactModel(errors, limits).fit(key, ObjectTouches(dataset, rows, surfaces, str(folder)))
    return TrainedRun(dataset, rows, surfaces, predictor, pad, known.model)


def read_simulated_run(folder: Path) -> tuple[Dataset, Predictor, Pad]:
    """Read a run that simulated its touches.

    Args:
        folder: Of the run.

    Returns:
        Its touches, its predictor and its pad.

    Raises:
        ValueError: It trained on recorded touches, or a file is missing.
    """
    about = json.loads((folder / "metrics.json").read_text())
    if not (folder / "data.h5").exists():
        if (folder / recognition_data.RECOGNITION_ABOUT).exists():
            raise ValueError(
                f"{folder} was trained on recorded touches, and simulated episodes need a pad to simulate with; "
                "recognise recorded touches with it (--dataset), or pass a run that simulated its touches as "
                "--trained-run"
            )
        raise ValueError(f"{folder} keeps no touches; train it again: python -m experiments.train")
    number = about["pad"]
    pad = numbered_pad(number) if isinstance(number, int) else load_pad(Path(number))
    # The best on predicted contact pressure, also where another was kept.
    on_pressure = folder / "checkpoint" / "on_pressure"
    predictor = load_predictor(on_pressure if on_pressure.is_dir() else folder)
    return data.load_dataset(folder / "data.h5"), predictor, pad


def load_meshes(paths: Sequence[Path], unit: str | None) -> dict[str, Mesh]:
    """Meshes of the catalogue and of files.

    Args:
        paths: Names of the catalogue or of mesh files, two at least.
        unit: Of the files' lengths.

    Returns:
        The meshes by the objects' names: the catalogue's, or the files' stems.

    Raises:
        ValueError: Neither a name nor a file, a file without a unit, two objects of one name, or a single object.
    """
    require_objects(paths, unit)
    return {path.stem: read_object(str(path), unit).mesh for path in paths}


def meshes_by_name(names: Sequence[str]) -> dict[str, Mesh]:
    """Meshes of the catalogue.

    Args:
        names: Of its objects.

    Returns:
        The meshes by name.
    """
    return {name: catalogue.make_object(name).mesh for name in names}


def _training_rows(dataset: Dataset, folder: Path) -> np.ndarray:
    about = next(path for path in (folder / "config.json", folder.parent / "config.json") if path.exists())
    names = json.loads(about.read_text())["experiment"]["simulation"]["train"]
    return np.isin(dataset.touches.object, [dataset.objects.index(name) for name in names])


def _touched_surfaces(dataset: Dataset, rows: np.ndarray) -> dict[str, Surface]:
    """Surfaces of the catalogue's objects that the rows touch; others' size class may cost many times their work."""
    touched = [dataset.objects[i] for i in np.unique(dataset.touches.object[rows])]
    names = [name for name in touched if name in catalogue.NAMES]
    return dict(zip(names, prepare_surfaces([catalogue.make_object(name).mesh for name in names]), strict=True))
