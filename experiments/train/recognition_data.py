"""Data for recognition from a run on recorded touches: the touches that it trained on, of which skin they are, and the
meshes of what was touched.

A run of `experiments.train --dataset` keeps `recognition.h5`, the training touches with their surroundings left out,
`recognition.json`, and copies of mesh files. `i2t.skin_models.pad_model` makes a pad model of these.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.common.runs import write_json
from i2t import dataset as data
from i2t.dataset import Dataset, source_words
from i2t.dataset.sets import missing_context
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.objects import Mesh, catalogue, load_object
from i2t.types import ReturnCode

RECOGNITION_TOUCHES, RECOGNITION_ABOUT, RECOGNITION_MESHES = "recognition.h5", "recognition.json", "meshes"
MIN_PAD_TOUCHES, SPARE_TOUCHES = 20, 5  # that a pad model can be made of; more than a reading has values
MIN_PAD_SESSIONS = 2  # hyperparameters are chosen on sessions left out


class MeshFile(NamedTuple):
    """File of the mesh of an object."""

    path: Path
    unit: str


class KnownTouches(NamedTuple):
    """Touches of one skin on objects whose meshes are known, each seen from the object."""

    dataset: Dataset
    meshes: dict[str, Mesh]


def known_touches(dataset: Dataset, rows: np.ndarray, meshes: Mapping[str, Mesh], whose: str) -> KnownTouches:
    """The touches that a pad model can be made of.

    Args:
        dataset: Recorded touches.
        rows: (n,) bool, those that may be used.
        meshes: Of objects that the catalogue does not have, or has otherwise.
        whose: Names the data set in messages.

    Returns:
        Presses that met something, with a measured force and depth, on objects whose mesh is known; their poses are
        those of the tool seen from the object.

    Raises:
        DataError: Too few are left, of one session only, or of several skins.
    """
    touches = dataset.touches
    pressed = rows & np.isin(touches.code, [ReturnCode.SKIN, ReturnCode.WRENCH])
    if not pressed.any():
        raise DataError(f"{whose}: no press among them was ended by the skin or the force")
    measured = pressed & np.isfinite(touches.force) & np.isfinite(touches.depth)
    measured &= np.isfinite(touches.T_w_t).all((1, 2)) & np.isfinite(touches.T_w_o).all((1, 2))
    if not measured.any():
        raise DataError(f"{whose}: no press has a measured force, depth and pose")
    known = [name in meshes or name in catalogue.NAMES for name in dataset.objects]
    usable = measured & np.asarray(known)[touches.object]
    if not usable.any():
        names = sorted({dataset.objects[i] for i in touches.object[measured]})
        raise DataError(f"{whose}: there is no mesh of {', '.join(names)}; pass --objects FILE ... --unit mm")
    pads = sorted({dataset.pads[i] for i in touches.pad[usable]})
    if len(pads) > 1:
        raise DataError(f"{whose}: the touches are of several skins ({', '.join(pads)}), and a pad model is of one")
    sessions = len(np.unique(touches.session[usable]))
    least = max(MIN_PAD_TOUCHES, touches.reading.shape[-1] + SPARE_TOUCHES)
    if usable.sum() < least or sessions < MIN_PAD_SESSIONS:
        raise DataError(
            f"{whose}: {usable.sum()} usable touches in {sessions} sessions are too few for a pad model, which needs "
            f"{least} in {MIN_PAD_SESSIONS}"
        )
    chosen = _seen_from_object(dataset.select(usable))
    names = [chosen.objects[i] for i in np.unique(chosen.touches.object)]
    return KnownTouches(chosen, {name: meshes.get(name) or catalogue.make_object(name).mesh for name in names})


def keep(out: Path, dataset: Dataset, rows: np.ndarray, files: Mapping[str, MeshFile]) -> str:
    """Keep what recognition needs, or the reason why this run is of no use to it.

    Args:
        out: Folder of the run.
        dataset: That it trained on.
        rows: (n,) bool, its training touches.
        files: Mesh files by object.

    Returns:
        A sentence that says what was kept.

    Raises:
        DataError: A mesh cannot be read.
    """
    meshes = {name: load_object(file.path, file.unit).mesh for name, file in files.items()}
    try:
        known = known_touches(dataset, rows, meshes, "its training touches")
    except DataError as error:
        write_json(out / RECOGNITION_ABOUT, {"unusable": str(error)})
        return f"recognition cannot use this run: {error}"
    touches = known.dataset.touches
    narrow = touches._replace(wide=missing_context(len(known.dataset), touches.wide.shape[-1]), truth=None)
    data.save_dataset(out / RECOGNITION_TOUCHES, replace(known.dataset, touches=narrow))
    about = {
        "source": dataset.source,
        "pad": dataset.pads[int(touches.pad[0])],
        "touches": len(touches.force),
        "objects": {name: _kept_mesh(out, files.get(name)) for name in known.meshes},
    }
    write_json(out / RECOGNITION_ABOUT, about)
    return (
        f"recognition: {about['touches']} training touches of {', '.join(known.meshes)} "
        f'({source_words(dataset.source)}) make a pad model of "{about["pad"]}"'
    )


def read(folder: Path) -> KnownTouches:
    """Read what `keep` kept.

    Args:
        folder: Of the run.

    Returns:
        The touches that it trained on.

    Raises:
        DataError: It kept none, or what it kept has changed.
    """
    try:
        about: dict[str, Any] = json.loads((folder / RECOGNITION_ABOUT).read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{folder / RECOGNITION_ABOUT}: cannot be read ({error}); train the run again") from error
    if "unusable" in about:
        raise DataError(f"{folder} is of no use to recognition: {about['unusable']}")
    meshes = {name: _read_kept(folder, name, kept) for name, kept in about["objects"].items()}
    return KnownTouches(data.load_dataset(folder / RECOGNITION_TOUCHES), meshes)


def _kept_mesh(out: Path, file: MeshFile | None) -> dict[str, str] | str:
    """Copy the mesh file of an object, and return its note."""
    if file is None:
        return "catalogue"
    (out / RECOGNITION_MESHES).mkdir(exist_ok=True)
    copy = out / RECOGNITION_MESHES / file.path.name
    shutil.copyfile(file.path, copy)
    return {"file": f"{RECOGNITION_MESHES}/{file.path.name}", "unit": file.unit, "sha256": _digest(copy)}


def _read_kept(folder: Path, name: str, kept: dict[str, str] | str) -> Mesh:
    if isinstance(kept, str):
        return catalogue.make_object(name).mesh
    path = folder / kept["file"]
    if not path.is_file() or _digest(path) != kept["sha256"]:
        raise DataError(f"{path}: is not the mesh that the run kept of {name}; restore it, or train the run again")
    return load_object(path, kept["unit"]).mesh


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _seen_from_object(dataset: Dataset) -> Dataset:
    """Poses of the tool in the object's frame, for tips that move under a skin that stands."""
    touches = dataset.touches
    T_o_t = inverse(touches.T_w_o.astype(np.float64)) @ touches.T_w_t
    T_o_t[:, 3] = (0, 0, 0, 1)
    still = np.tile(np.eye(4, dtype=np.float32), (len(T_o_t), 1, 1))
    return replace(dataset, touches=touches._replace(T_w_t=T_o_t.astype(np.float32), T_w_o=still))
