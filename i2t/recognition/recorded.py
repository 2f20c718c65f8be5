"""Recorded touches for recognition: those that a pad model is fitted to, and samples of one contact as one touch.

    touches = recorded_touches(dataset, rows, {"mug": mug}, "DATA/known")
    known = ContactModel(SimulationErrors(), PressLimits()).fit(jax.random.key(0), touches)

Metres, newtons, microtesla.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from i2t.dataset import Dataset
from i2t.dataset.sets import times_of
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.objects import Mesh, catalogue
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.recognition.episodes import usable_touches
from i2t.recognition.site_pool import prepare_surfaces
from i2t.recordings.samples import first_samples, mean_samples
from i2t.simulation.touches import SimulationErrors
from i2t.skin_models.pad_fit import ObjectTouches
from i2t.skin_models.pad_model import KnownPad
from i2t.types import ReturnCode, Surface

MIN_PAD_TOUCHES, SPARE_TOUCHES = 20, 5  # that a pad model can be made of; more than a reading has values
MIN_PAD_SESSIONS = 2  # hyperparameters are chosen on sessions left out
SAME_PLACE_M, SAME_TURN, SAME_PRESS_S = 2e-4, 4e-3, 1.0  # m, rad and s within which touches are of one contact


def recorded_touches(dataset: Dataset, rows: np.ndarray, meshes: Mapping[str, Mesh], made_from: str) -> ObjectTouches:
    """The recorded touches that a pad model can be fitted to.

    Args:
        dataset: Recorded touches.
        rows: (n,) bool, those that may be used.
        meshes: Of objects that the catalogue does not have, or has otherwise.
        made_from: The run or data set, which messages about the pad model name.

    Returns:
        Presses that met something, with a measured force and depth, on objects whose mesh is known; their poses are
        those of the tool seen from the object.

    Raises:
        DataError: Too few are left, of one session only, or of several skins.
    """
    touches = dataset.touches
    pressed = rows & np.isin(touches.code, [ReturnCode.SKIN, ReturnCode.WRENCH])
    if not pressed.any():
        raise DataError("no press among the training touches was ended by the skin or the force")
    measured = pressed & np.isfinite(touches.force) & np.isfinite(touches.depth)
    measured &= np.isfinite(touches.T_w_t).all((1, 2)) & np.isfinite(touches.T_w_o).all((1, 2))
    if not measured.any():
        raise DataError("no press among the training touches has a measured force, depth and pose")
    with_mesh = [_is_known(name, meshes) for name in dataset.objects]
    usable = measured & np.asarray(with_mesh)[touches.object]
    if not usable.any():
        names = sorted({dataset.objects[i] for i in touches.object[measured]})
        raise DataError(f"there is no mesh of {', '.join(names)}; give them (--objects FILE ... --unit mm)")
    pads = sorted({dataset.pads[i] for i in touches.pad[usable]})
    if len(pads) > 1:
        raise DataError(f"the training touches are of several skins ({', '.join(pads)}), and a pad model is of one")
    sessions = len(np.unique(touches.session[usable]))
    least = max(MIN_PAD_TOUCHES, touches.reading.shape[-1] + SPARE_TOUCHES)
    if usable.sum() < least or sessions < MIN_PAD_SESSIONS:
        raise DataError(
            f"{usable.sum()} usable training touches in {sessions} sessions are too few for a pad model, which needs "
            f"{least} in {MIN_PAD_SESSIONS}"
        )
    chosen = _seen_from_object(dataset.select(usable))
    names = [chosen.objects[i] for i in np.unique(chosen.touches.object)]
    return ObjectTouches(chosen, np.ones(len(chosen), bool), known_surfaces(names, meshes), made_from)


def named_surfaces(meshes: Mapping[str, Mesh]) -> dict[str, Surface]:
    """Surfaces of one size class, so that one program serves all.

    Args:
        meshes: Of objects, by name.

    Returns:
        Their surfaces by name.
    """
    return dict(zip(meshes, prepare_surfaces(list(meshes.values())), strict=True))


def known_surfaces(names: Iterable[str], meshes: Mapping[str, Mesh]) -> dict[str, Surface]:
    """Surfaces of the objects whose mesh is known, as of `named_surfaces`.

    Args:
        names: Of objects.
        meshes: Of objects that the catalogue does not have, or has otherwise.

    Returns:
        The surfaces by name; none of an object that neither has.
    """
    known = {name: meshes.get(name) or catalogue.make_object(name).mesh for name in names if _is_known(name, meshes)}
    return named_surfaces(known) if known else {}


def _is_known(name: str, meshes: Mapping[str, Mesh]) -> bool:
    return name in meshes or name in catalogue.NAMES


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


def with_placement(errors: SimulationErrors, object_covariance: np.ndarray) -> SimulationErrors:
    """Errors whose placement is as uncertain as a rig says, the mean over the axes.

    Args:
        errors: Of the world.
        object_covariance: (6, 6) m^2, of where objects are believed to stand, rotations in arc lengths.

    Returns:
        The errors.
    """
    variance = np.diag(object_covariance)
    return replace(
        errors,
        placement=float(np.sqrt(variance[:3].mean())),
        placement_angle=float(np.sqrt(variance[3:].mean()) / TWIST_LEVER_M),
    )


def merge_samples(recorded: Dataset) -> Dataset:
    """Make one touch of samples of one contact: usable touches of a session that follow each other within a second with
    the tool where it was, which no arm lifts and presses again in. They share the contact's errors, so that they are no
    independent touches.

    Args:
        recorded: Touches in order of time.

    Returns:
        The same touches, or fewer; readings, forces and depths of those that were merged are means.
    """
    touches, time = recorded.touches, times_of(recorded)
    usable = np.isin(np.arange(len(recorded)), np.concatenate(list(usable_touches(touches).values())))
    moved = inverse(touches.T_w_t[:-1]) @ touches.T_w_t[1:]
    turned = np.arccos(np.clip((np.trace(moved[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    follows = (np.linalg.norm(moved[:, :3, 3], axis=1) < SAME_PLACE_M) & (turned < SAME_TURN)
    follows &= usable[1:] & usable[:-1]
    for same in (touches.session, touches.code):
        follows &= same[1:] == same[:-1]
    with np.errstate(invalid="ignore"):
        follows &= (np.diff(time) >= 0) & (np.diff(time) < SAME_PRESS_S)  # false where a time is unknown
    starts = first_samples(follows)
    if len(starts) == len(recorded):
        return recorded
    merged = recorded.select(starts)
    means: dict[str, Any] = {
        name: mean_samples(np.asarray(getattr(touches, name), np.float64), starts).astype(np.float32)
        for name in ("reading", "force", "depth")
    }
    return replace(merged, touches=merged.touches._replace(**means))


def _seen_from_object(dataset: Dataset) -> Dataset:
    """Poses of the tool in the object's frame, for tips that move under a skin that stands."""
    touches = dataset.touches
    T_o_t = inverse(touches.T_w_o.astype(np.float64)) @ touches.T_w_t
    T_o_t[:, 3] = (0, 0, 0, 1)
    still = np.tile(np.eye(4, dtype=np.float32), (len(T_o_t), 1, 1))
    return replace(dataset, touches=touches._replace(T_w_t=T_o_t.astype(np.float32), T_w_o=still))
