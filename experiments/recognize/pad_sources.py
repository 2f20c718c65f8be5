"""The pad model that recorded touches and live runs are judged by: of a finished run, a data set, or a file.

It is of one skin, which `i2t.skin_models.pad_model.require_skin` compares with the one that touches.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments.common.checks import finished_runs
from experiments.recognize import trained_run
from experiments.recognize.config import Recognition
from experiments.train import recognition_data
from experiments.train.configs import Simulation
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.dataset.files import ENDING as DATASET_SUFFIX
from i2t.files import serialization
from i2t.hardware.rig import Rig
from i2t.models import ready_path
from i2t.objects import Mesh, catalogue
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.recognition.site_pool import prepare_surfaces
from i2t.recordings.sets import corrected_dataset
from i2t.simulation import touches as simulation
from i2t.simulation.touches import SimulationErrors
from i2t.skin import files as pad_files
from i2t.skin_models.pad_fit import ContactModel, ObjectTouches
from i2t.skin_models.pad_model import (
    PAD_MODEL_KIND,
    KnownPad,
    SkinIdentity,
    load_pad_model,
    origin_of,
    with_press_errors,
)


class PadSource(NamedTuple):
    """Source of a pad model, before it is made."""

    skin: SkinIdentity
    make: Callable[[jax.Array], KnownPad]  # with a key
    predictor: Predictor | None  # of the run, for the paper's rules


def find_pad_source(
    *, pad: Path | None, run: Path, cfg: Recognition, meshes: Mapping[str, Mesh], rig: Rig | None
) -> PadSource:
    """The pad model that a command line names.

    Args:
        pad: A data set of an earlier session, a pad on disk, a pad model on disk or the name of a ready one, in place
            of a run.
        run: A finished run of experiments.train, or a study's folder, of which the first run is taken.
        cfg: How touches were pressed, and how far objects may be from where they are believed.
        meshes: Of objects in a data set that are not of the catalogue.
        rig: Of the lab that recorded a data set: how far its objects may be off.

    Returns:
        The skin and what makes its pad model, which takes a minute where it is fitted.

    Raises:
        ValueError: There is none, or no pad model can be made of it; the message says why.
    """
    errors = cfg.errors if rig is None else with_placement(cfg.errors, rig)
    if pad is None:
        return _of_run(finished_runs(run)[0], cfg, errors)
    ready = ready_path(str(pad), "pad_model.npz")
    if not ready.exists():
        raise ValueError(f"--pad {pad}: there is no such file or folder")
    if pad.is_dir() or pad.suffix == DATASET_SUFFIX:
        recorded, _ = corrected_dataset(data.load_dataset(pad))
        touches = recognition_data.known_touches(recorded, np.ones(len(recorded), bool), meshes, str(pad))
        return _of_touches(touches, cfg, errors, str(pad), None)
    kind = serialization.file_kind(ready)
    if kind == PAD_MODEL_KIND:
        known = load_pad_model(ready)
        return PadSource(known.skin, lambda key: known, None)
    if kind == pad_files.KIND:
        return _of_pad_file(pad, cfg)
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
    """Entry of metrics.json for a pad model.

    Args:
        known: The pad model.

    Returns:
        Its skin, source, objects, number of touches, R2 and chips.
    """
    return {**asdict(known.origin), "r2": known.model.r2, "chips": len(known.board.chips)}


def _of_run(folder: Path, cfg: Recognition, errors: SimulationErrors) -> PadSource:
    if (folder / recognition_data.RECOGNITION_ABOUT).exists():
        return _of_touches(recognition_data.read(folder), cfg, errors, str(folder), load_predictor(folder))
    dataset, predictor, _ = trained_run.read_simulated_run(folder)

    def make(key: jax.Array) -> KnownPad:
        trained = trained_run.load_trained_run(key, folder, cfg.errors, cfg.limits)
        return KnownPad(trained.pad_model, dataset.board, origin_of(dataset, trained.rows, str(folder)))

    return PadSource(SkinIdentity(dataset.pads[0], dataset.board, str(folder)), make, predictor)


def _of_touches(
    touches: recognition_data.KnownTouches,
    cfg: Recognition,
    errors: SimulationErrors,
    made_from: str,
    predictor: Predictor | None,
) -> PadSource:
    """A pad model fitted to recorded touches."""
    dataset, rows = touches.dataset, np.ones(len(touches.dataset), bool)

    def make(key: jax.Array) -> KnownPad:
        surfaces = dict(zip(touches.meshes, prepare_surfaces(list(touches.meshes.values())), strict=True))
        return ContactModel(errors, cfg.limits).fit(key, ObjectTouches(dataset, rows, surfaces, made_from))

    skin = SkinIdentity(dataset.pads[int(dataset.touches.pad[0])], dataset.board, made_from)
    return PadSource(skin, make, predictor)


def _of_pad_file(path: Path, cfg: Recognition) -> PadSource:
    """A pad model of a pad on disk: fitted to touches that are simulated with it, as `experiments.train --pad` does.

    Where the file says how far the pad is off the presses that it was fitted to, errors of readings are larger by that.
    """
    pad, about = pad_files.load_pad(path), pad_files.load_pad_about(path)
    names = Simulation.train
    made_from = f"{path}{about.made_from}"

    def make(key: jax.Array) -> KnownPad:
        key_touch, key_fit = jax.random.split(key)
        surfaces = prepare_surfaces([catalogue.make_object(name).mesh for name in names])
        made = simulation.simulate_touches(
            key_touch, surfaces, pad, cfg.errors, cfg.simulated_touches // len(names), limits=cfg.limits,
            touches_per_session=Simulation.touches_per_session,
        )  # fmt: skip
        dataset = Dataset.simulated(made, names, pad, pad_name=about.name)
        rows = np.isfinite(dataset.touches.depth)
        known = dict(zip(names, surfaces, strict=True))
        fitted = ContactModel(cfg.errors, cfg.limits).fit(key_fit, ObjectTouches(dataset, rows, known, made_from))
        return fitted._replace(model=with_press_errors(fitted.model, about.error_std))

    return PadSource(SkinIdentity(about.name, pad.board, made_from), make, None)
