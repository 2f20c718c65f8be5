"""Recorded touches for recognition: touches to which a pad model is fitted, and samples of one contact as one touch.

    pad_model = i2t.fit_pad_model(dataset, {"mug": mug})
    pad_model.save("skin.npz")

Units are metres, newtons and microtesla.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Key

from i2t import validation
from i2t.contact.press import PressLimits
from i2t.dataset import Dataset
from i2t.dataset.sets import times_of
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.objects import Mesh, catalogue
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.recognition.episodes import usable_touches
from i2t.recognition.site_pool import prepare_surfaces
from i2t.recordings.samples import first_samples, mean_samples
from i2t.recordings.sets import corrected_dataset
from i2t.simulation.touches import SimulationErrors
from i2t.skin_models.pad_fit import ContactModel, ObjectTouches
from i2t.skin_models.pad_model import KnownPad
from i2t.types import ReturnCode, Surface


def recorded_touches(dataset: Dataset, rows: np.ndarray, meshes: Mapping[str, Mesh], made_from: str) -> ObjectTouches:
    """Select the recorded touches to which a pad model can be fitted.

    Args:
        dataset: Recorded touches.
        rows: (n,) mask of the touches that may be used.
        meshes: Meshes of objects that the catalogue lacks or has in another form.
        made_from: Name of the run or data set of the touches, for messages about the pad model.

    Returns:
        Presses with contact, measured force and travel, on objects with a mesh. Their poses are those of the tool in
        the object's frame.

    Raises:
        DataError: Too few touches are left, or they are of one session only, or of several skins.
    """
    touches = dataset.touches
    pressed = rows & np.isin(touches.code, [ReturnCode.SKIN, ReturnCode.WRENCH])
    if not pressed.any():
        raise DataError("no press among the training touches was ended by the skin or the force")
    measured = pressed & np.isfinite(touches.force) & np.isfinite(touches.travel)
    measured &= np.isfinite(touches.T_w_t).all((1, 2)) & np.isfinite(touches.T_w_o).all((1, 2))
    if not measured.any():
        raise DataError("no press among the training touches has a measured force, travel and pose")
    with_mesh = [_is_known(name, meshes) for name in dataset.objects]
    usable = measured & np.asarray(with_mesh)[touches.object]
    if not usable.any():
        names = sorted({dataset.objects[i] for i in touches.object[measured]})
        raise DataError(f"there is no mesh of {', '.join(names)}; give their files (--objects FILE ... --unit mm)")
    pads = sorted({dataset.pads[i] for i in touches.pad[usable]})
    if len(pads) > 1:
        raise DataError(
            f"the training touches are of several skins ({', '.join(pads)}), but a pad model describes one skin"
        )
    sessions = len(np.unique(touches.session[usable]))
    # A pad model needs more touches than a reading has values, and sessions to leave out for its hyperparameters.
    min_touches, min_sessions = max(20, touches.reading.shape[-1] + 5), 2
    if usable.sum() < min_touches or sessions < min_sessions:
        raise DataError(
            f"{usable.sum()} usable training touches in {sessions} sessions are too few for a pad model, which needs "
            f"{min_touches} in {min_sessions}"
        )
    chosen = _seen_from_object(dataset.select(usable))
    names = [chosen.objects[i] for i in np.unique(chosen.touches.object)]
    return ObjectTouches(chosen, np.ones(len(chosen), bool), known_surfaces(names, meshes), made_from)


def fit_pad_model(
    dataset: Dataset,
    meshes: Mapping[str, Any] | None = None,
    *,
    rows: Bool[np.ndarray, " n"] | None = None,
    key: Key[Array, ""] | None = None,
    errors: SimulationErrors | None = None,
    limits: PressLimits | None = None,
    made_from: str = "touches at hand",
) -> KnownPad:
    """Fit a pad model, which predicts the reading of any contact of one skin, to touches of objects with a mesh.

    Args:
        dataset: n touches with forces, travels and poses. Signs of forces and travels are corrected.
        meshes: Meshes of objects that the catalogue lacks or has in another form, by name.
        rows: `(n,)` mask of the touches that may be used; all by default.
        key: Random key of the registrations of the objects; `jax.random.key(0)` by default.
        errors: Errors of the objects' believed poses; those of a usual lab by default.
        limits: Limits at which the touches were pressed; those of a usual lab by default.
        made_from: Name of the touches, for messages about the pad model.

    Returns:
        The pad model with its skin, for `i2t.recognize` and `i2t.ObjectRecognizer`.

    Raises:
        DataError: Too few touches can be used, or they are of one session only, or of several skins.
        TypeError: `dataset` is no data set, or `key` no random key.
        ValueError: The touches do not determine how soft the pad is.

    Example:
        pad_model = i2t.fit_pad_model(dataset, {"mug": i2t.load_mesh("mug.stl", unit="mm")})
        pad_model.save("skin.npz")
    """
    if not isinstance(dataset, Dataset):
        raise TypeError(f"dataset: is a {type(dataset).__name__}; give a data set, as i2t.load_dataset reads it")
    key = jax.random.key(0) if key is None else key
    validation.random_key("key", key)
    corrected, _ = corrected_dataset(dataset)
    usable = np.ones(len(dataset), bool) if rows is None else rows
    touches = recorded_touches(corrected, usable, meshes or {}, made_from)
    return ContactModel(errors or SimulationErrors(), limits or PressLimits()).fit(key, touches)


def named_surfaces(meshes: Mapping[str, Mesh]) -> dict[str, Surface]:
    """Prepare surfaces of one size class, so that one program serves all.

    Args:
        meshes: Meshes of objects, by name.

    Returns:
        Surfaces of the objects, by name.
    """
    return dict(zip(meshes, prepare_surfaces(list(meshes.values())), strict=True))


def known_surfaces(names: Iterable[str], meshes: Mapping[str, Mesh]) -> dict[str, Surface]:
    """Prepare surfaces of the objects that have a mesh, as `named_surfaces` does.

    Args:
        names: Names of objects.
        meshes: Meshes of objects that the catalogue lacks or has in another form.

    Returns:
        Surfaces by name, without objects that have no mesh.
    """
    selected = {name: meshes.get(name) or catalogue.make_object(name).mesh for name in names if _is_known(name, meshes)}
    return named_surfaces(selected) if selected else {}


def _is_known(name: str, meshes: Mapping[str, Mesh]) -> bool:
    return name in meshes or name in catalogue.NAMES


def describe(pad: KnownPad) -> str:
    """Describe a pad model in one line: skin, source, touches, objects and accuracy.

    Args:
        pad: The pad model.

    Returns:
        Sentence without its full stop.
    """
    origin = pad.origin
    score = f", R2 {pad.model.r2:.3f} of touches left out one at a time" if np.isfinite(pad.model.r2) else ""
    return (
        f'pad model of "{origin.pad}" from {origin.made_from}: {origin.touches} {origin.source} touches of '
        f"{', '.join(origin.objects)}{score}"
    )


def to_json(pad: KnownPad) -> dict[str, object]:
    """Make the entry of metrics.json for a pad model.

    Args:
        pad: The pad model.

    Returns:
        Skin, source, objects, number of touches, R2 and number of chips.
    """
    origin = {name: value for name, value in asdict(pad.origin).items() if name != "used_touches"}
    return {**origin, "r2": pad.model.r2, "chips": len(pad.board.chips)}


def with_placement(errors: SimulationErrors, object_covariance: np.ndarray) -> SimulationErrors:
    """Set the simulated placement errors of objects to a rig's pose uncertainty, with variances averaged over the axes.

    Args:
        errors: Errors of the simulated world.
        object_covariance: (6, 6) covariance (m^2) of the pose of objects, rotations in arc lengths.

    Returns:
        Errors with this placement.
    """
    variance = np.diag(object_covariance)
    return replace(
        errors,
        placement=float(np.sqrt(variance[:3].mean())),
        placement_angle=float(np.sqrt(variance[3:].mean()) / TWIST_LEVER_M),
    )


def merge_samples(
    recorded: Dataset, *, max_distance: float = 2e-4, max_angle: float = 4e-3, max_interval: float = 1.0
) -> Dataset:
    """Merge samples of one contact into one touch.

    Samples of one contact are consecutive usable touches of a session, within a second and at the same pose: no arm
    lifts and presses again in that time. They share the errors of the contact and so are not independent touches.

    Args:
        recorded: Touches in order of time.
        max_distance: Distance (m) up to which two poses are the same.
        max_angle: Angle (rad) up to which two poses are the same.
        max_interval: Time (s) between two samples of one contact.

    Returns:
        Touches of `recorded`, in which a merged touch has the mean reading, force and travel of its samples, and all
        else from the first of them.
    """
    touches, time = recorded.touches, times_of(recorded)
    usable = np.isin(np.arange(len(recorded)), np.concatenate(list(usable_touches(touches).values())))
    moved = inverse(touches.T_w_t[:-1]) @ touches.T_w_t[1:]
    turned = np.arccos(np.clip((np.trace(moved[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    follows = (np.linalg.norm(moved[:, :3, 3], axis=1) < max_distance) & (turned < max_angle)
    follows &= usable[1:] & usable[:-1]
    for same in (touches.session, touches.code):
        follows &= same[1:] == same[:-1]
    with np.errstate(invalid="ignore"):
        follows &= (np.diff(time) >= 0) & (np.diff(time) < max_interval)  # False if a time is unknown
    starts = first_samples(follows)
    if len(starts) == len(recorded):
        return recorded
    merged = recorded.select(starts)
    means: dict[str, Any] = {
        name: mean_samples(np.asarray(getattr(touches, name), np.float64), starts).astype(np.float32)
        for name in ("reading", "force", "travel")
    }
    return replace(merged, touches=merged.touches._replace(**means))


def _seen_from_object(dataset: Dataset) -> Dataset:
    """Express poses of the tool in the object's frame, for tips that move under a stationary skin."""
    touches = dataset.touches
    T_o_t = inverse(touches.T_w_o.astype(np.float64)) @ touches.T_w_t
    T_o_t[:, 3] = (0, 0, 0, 1)
    still = np.tile(np.eye(4, dtype=np.float32), (len(T_o_t), 1, 1))
    return replace(dataset, touches=touches._replace(T_w_t=T_o_t.astype(np.float32), T_w_o=still))
