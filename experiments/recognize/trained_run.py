"""What recognition takes from a finished run of `experiments.train`: its touches, its predictor, and its pad."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.objects import Mesh, catalogue, read_mesh
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.recognition.pad_model import PadModel, fit_pad_model
from i2t.recognition.site_pool import prepare_surfaces
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors
from i2t.skin.files import load_pad
from i2t.skin.pad import numbered_pad
from i2t.types import Pad, Surface


class TrainedRun(NamedTuple):
    """A finished run, and the pad model fitted to its training touches."""

    dataset: Dataset
    rows: np.ndarray  # (n,) bool, of the touches that it trained on
    surfaces: dict[str, Surface]  # of the catalogue's objects in the data set, by name
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
        ValueError: The run was not trained on simulated touches.
    """
    dataset, predictor, pad = _read(folder)
    rows, surfaces = _training_rows(dataset, folder), _catalogue_surfaces(dataset)
    pad_model = fit_pad_model(key, dataset, rows, surfaces, errors=errors, limits=limits)
    return TrainedRun(dataset, rows, surfaces, predictor, pad, pad_model)


def finished_runs(folder: Path) -> list[Path]:
    """The folder of a run, or those of a study's pads and seeds.

    Args:
        folder: Named by the user.

    Returns:
        Folders of finished runs.

    Raises:
        ValueError: There is none.
    """
    folders = sorted(path.parent for path in folder.glob("pad-*-seed-*/metrics.json")) or [folder]
    if not (folders[0] / "metrics.json").exists():
        raise ValueError(f"{folder} holds no finished run; make one: python -m experiments.train --out {folder}")
    return folders


def load_meshes(paths: Sequence[Path], unit: str | None) -> dict[str, Mesh]:
    """Meshes of files.

    Args:
        paths: Of the files, two at least.
        unit: Of their lengths.

    Returns:
        The meshes by the files' names.

    Raises:
        ValueError: No unit, or a single file.
    """
    if unit is None:
        raise ValueError("say in which unit the files of --objects are, for instance --unit mm")
    if len(paths) < 2:
        raise ValueError("--objects needs at least two meshes to tell apart")
    return {path.stem: read_mesh(path, unit)[0].mesh for path in paths}


def meshes_by_name(names: Sequence[str]) -> dict[str, Mesh]:
    """Meshes of the catalogue.

    Args:
        names: Of its objects.

    Returns:
        The meshes by name.
    """
    return {name: catalogue.make_object(name).mesh for name in names}


def _read(folder: Path) -> tuple[Dataset, Predictor, Pad]:
    about = json.loads((folder / "metrics.json").read_text())
    if about.get("source") != "simulated" or not (folder / "data.h5").exists():
        raise ValueError(f"{folder} was not trained on simulated touches; pass one that was, as --trained-run")
    number = about["pad"]
    pad = numbered_pad(number) if isinstance(number, int) else load_pad(Path(number))
    return data.load_dataset(folder / "data.h5"), load_predictor(folder), pad


def _training_rows(dataset: Dataset, folder: Path) -> np.ndarray:
    about = next(path for path in (folder / "config.json", folder.parent / "config.json") if path.exists())
    names = json.loads(about.read_text())["experiment"]["simulation"]["train"]
    return np.isin(dataset.touches.object, [dataset.objects.index(name) for name in names])


def _catalogue_surfaces(dataset: Dataset) -> dict[str, Surface]:
    names = [name for name in dataset.objects if name in catalogue.NAMES]
    return dict(zip(names, prepare_surfaces([catalogue.make_object(name).mesh for name in names]), strict=True))
