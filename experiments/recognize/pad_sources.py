"""The pad model that recorded touches and live runs are judged by: of a finished run, a data set, or a file.

It is of one skin, which `i2t.recognition.pad_model_files.require_skin` compares with the one that touches.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments.recognize import trained_run
from experiments.recognize.config import PRESETS, Recognition
from experiments.train import recognition_data
from experiments.train.configs import Simulation
from i2t import dataset as data
from i2t import serialization
from i2t.dataset import Dataset
from i2t.hardware.rig import Rig
from i2t.objects import Mesh, catalogue
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.recognition import pad_model_files
from i2t.recognition.pad_model import PadModel, fit_pad_model
from i2t.recognition.pad_model_files import KnownPad, PadOrigin, load_pad_model
from i2t.recognition.site_pool import prepare_surfaces
from i2t.simulation import touches as simulation
from i2t.simulation.touches import SimulationErrors
from i2t.skin import files as pad_files
from i2t.types import TWIST_LEVER_M, Board

TOUCHES_OF_A_FILE, TOUCHES_OF_A_FILE_DEBUG = 900, 100  # simulated with a pad on disk, which a pad model is fitted to


class PadSource(NamedTuple):
    """A pad model and what came with it."""

    known: KnownPad
    predictor: Predictor | None  # of the run, for the paper's rules


def load_pad_source(
    key: jax.Array, *, pad: Path | None, run: Path, cfg: Recognition, meshes: Mapping[str, Mesh], rig: Rig | None
) -> PadSource:
    """The pad model that a command line names.

    Args:
        key: Of its fit.
        pad: A data set of an earlier session, a pad on disk or a pad model on disk, in place of a run.
        run: A finished run of experiments.train, or a study's folder, of which the first run is taken.
        cfg: How touches were pressed, and how far objects may be from where they are believed.
        meshes: Of objects in a data set that are not of the catalogue.
        rig: Of the lab that recorded a data set: how far its objects may be off.

    Returns:
        The pad model, and the run's predictor.

    Raises:
        ValueError: There is none, or no pad model can be made of it; the message says why.
    """
    errors = cfg.errors if rig is None else with_placement(cfg.errors, rig)
    if pad is None:
        return _of_run(key, trained_run.finished_runs(run)[0], cfg, errors)
    if not pad.exists():
        raise ValueError(f"--pad {pad}: there is no such file or folder")
    if pad.is_dir() or pad.suffix == data.files.ENDING:
        recorded = data.load_dataset(pad)
        touches = recognition_data.known_touches(recorded, np.ones(len(recorded), bool), meshes, str(pad))
        return PadSource(_fitted(key, touches, cfg, errors, str(pad)), None)
    kind = serialization.file_kind(pad)
    if kind == pad_model_files.KIND:
        return PadSource(load_pad_model(pad), None)
    if kind == pad_files.KIND:
        return PadSource(_of_pad_file(key, pad, cfg), None)
    raise ValueError(
        f"--pad {pad}: holds a {kind}; name a pad, a pad model or a data set (python -m experiments.calibrate "
        "--save-pad FILE makes a pad of presses, and of a calibration)"
    )


def with_placement(errors: SimulationErrors, rig: Rig) -> SimulationErrors:
    """Errors whose placement is as uncertain as a rig says, the mean over the axes.

    Args:
        errors: Of the world.
        rig: Of a lab.

    Returns:
        The errors.
    """
    variance = np.diag(rig.object_covariance)
    return replace(
        errors,
        placement=float(np.sqrt(variance[:3].mean())),
        placement_angle=float(np.sqrt(variance[3:].mean()) / TWIST_LEVER_M),
    )


def describe(known: KnownPad) -> str:
    """One line about a pad model.

    Args:
        known: The pad model.

    Returns:
        A sentence without its full stop.
    """
    origin = known.origin
    left_out = f", R2 {known.model.r2:.3f} on touches left out" if np.isfinite(known.model.r2) else ""
    return (
        f'pad model of "{origin.pad}" from {origin.made_from}: {origin.touches} {origin.source} touches of '
        f"{', '.join(origin.objects)}{left_out}"
    )


def to_json(known: KnownPad) -> dict[str, object]:
    """What metrics.json says of a pad model.

    Args:
        known: The pad model.

    Returns:
        Its skin, source, objects, number of touches, R2 and chips.
    """
    origin = known.origin
    return {
        "pad": origin.pad,
        "source": origin.source,
        "objects": list(origin.objects),
        "touches": origin.touches,
        "made_from": origin.made_from,
        "r2": known.model.r2,
        "chips": len(known.board.chips),
    }


def _of_run(key: jax.Array, folder: Path, cfg: Recognition, errors: SimulationErrors) -> PadSource:
    if (folder / recognition_data.ABOUT).exists():
        touches = recognition_data.read(folder)
        return PadSource(_fitted(key, touches, cfg, errors, str(folder)), load_predictor(folder))
    trained = trained_run.load_trained_run(key, folder, cfg.errors, cfg.limits)
    dataset, rows = trained.dataset, trained.rows
    origin = PadOrigin(
        pad=dataset.pads[0], source=dataset.source,
        objects=tuple(dataset.objects[i] for i in np.unique(dataset.touches.object[rows])),
        touches=int(rows.sum()), made_from=str(folder),
    )  # fmt: skip
    return PadSource(KnownPad(trained.pad_model, dataset.board, origin), trained.predictor)


def _fitted(
    key: jax.Array, touches: recognition_data.KnownTouches, cfg: Recognition, errors: SimulationErrors, made_from: str
) -> KnownPad:
    """A pad model fitted to recorded touches."""
    dataset, names = touches.dataset, list(touches.meshes)
    surfaces = dict(zip(names, prepare_surfaces(list(touches.meshes.values())), strict=True))
    rows = np.ones(len(dataset), bool)
    model = fit_pad_model(key, dataset, rows, surfaces, errors=errors, limits=cfg.limits)
    pad = dataset.pads[int(dataset.touches.pad[0])]
    return KnownPad(model, dataset.board, PadOrigin(pad, dataset.source, tuple(names), len(dataset), made_from))


def _of_pad_file(key: jax.Array, path: Path, cfg: Recognition) -> KnownPad:
    """A pad model of a pad on disk: fitted to touches that are simulated with it, as `experiments.train --pad` does.

    Where the file says how far the pad is off the presses that it was fitted to, errors of readings are larger by that.
    """
    pad, about = pad_files.load_pad(path), pad_files.load_pad_about(path)
    key_touch, key_fit = jax.random.split(key)
    names = Simulation.train
    surfaces = prepare_surfaces([catalogue.make_object(name).mesh for name in names])
    touches = TOUCHES_OF_A_FILE_DEBUG if cfg is PRESETS["debug"] else TOUCHES_OF_A_FILE
    made = jax.device_get(
        simulation.simulate_touches(
            key_touch,
            surfaces,
            pad,
            cfg.errors,
            touches // len(names),
            limits=cfg.limits,
            touches_per_session=Simulation.touches_per_session,
        )
    )
    board = Board(*(np.asarray(part) for part in pad.board))
    sessions = tuple(f"session {i}" for i in range(int(made.session.max()) + 1))
    dataset = Dataset(made, names, (about.name,), sessions, board, "simulated")
    rows = np.isfinite(dataset.touches.depth)
    known = dict(zip(names, surfaces, strict=True))
    model = fit_pad_model(key_fit, dataset, rows, known, errors=cfg.errors, limits=cfg.limits)
    origin = PadOrigin(about.name, "simulated", names, int(rows.sum()), f"{path}{about.made_from}")
    return KnownPad(with_press_errors(model, about.error_std), board, origin)


def with_press_errors(model: PadModel, error_std: float) -> PadModel:
    """A pad model whose errors of readings include those of the pad that its touches were simulated with.

    Args:
        model: Fitted to touches simulated with a pad.
        error_std: uT, root mean square of what that pad leaves of presses it was not fitted to; 0 where it is unknown.

    Returns:
        The pad model with a larger inflation of its errors.
    """
    own = float(np.mean(np.asarray(model.held_out_errors, np.float64) ** 2))
    factor = np.sqrt(1 + error_std**2 / own)
    likelihood = model.likelihood
    return model._replace(likelihood=likelihood._replace(inflation=likelihood.inflation * np.float32(factor)))
