"""Touches whose sessions are registered by their own views and contacts, with the meshes of their objects: what errors
of the camera and of placement cost a predictor, and what knowing them is worth.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from experiments.train.prepare import Prepared
from experiments.train.simulate import predicted_by_gp
from experiments.train.sources import ObjectsKnown
from i2t.dataset import Dataset
from i2t.objects import catalogue
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.recognition.recorded import named_surfaces
from i2t.recordings.sets import corrected_dataset
from i2t.registration import SessionEstimate, register_sessions, with_registered_views

MAX_VIEW_RESIDUAL = 2.0  # of a session, in standard deviations of the camera's noise: beyond it, the mesh is not there


class Registered(NamedTuple):
    """Touches of registered sessions."""

    dataset: Dataset
    objects: ObjectsKnown  # with errors of what a registration leaves open
    notes: tuple[str, ...]  # what was corrected and found, a sentence each


def registered(dataset: Dataset, objects: ObjectsKnown) -> Registered:
    """Register the sessions of all objects whose mesh is known, in the catalogue or beside it.

    Args:
        dataset: Touches with views and contacts.
        objects: Meshes that the catalogue does not have.

    Returns:
        The touches, with views rendered from where the tool really was.

    Raises:
        ValueError: No session can be registered.
    """
    print("registering sessions")
    dataset, corrected = corrected_dataset(dataset)
    names = [name for name in dataset.objects if name in objects.meshes or name in catalogue.NAMES]
    if not names:
        raise ValueError("--registered needs meshes of the objects that were touched; give them (--objects FILE ...)")
    surfaces = named_surfaces({name: objects.meshes.get(name) or catalogue.make_object(name).mesh for name in names})
    estimates = register_sessions(dataset, surfaces)
    trusted = {i: each for i, each in estimates.items() if np.median(each.view_residual) <= MAX_VIEW_RESIDUAL}
    if not trusted:
        raise ValueError(
            "--registered: no session's views and contacts agree with its mesh at any pose near the believed one; look "
            "for a wrong mesh, unit or pose of the object"
        )
    sessions = len(np.unique(dataset.touches.session))
    placement, angle = _left_open(trusted)
    errors = replace(objects.errors, placement=placement, placement_angle=angle)
    return Registered(
        with_registered_views(dataset, surfaces, trusted),
        objects._replace(errors=errors),
        (*corrected, _note(dataset, trusted, sessions)),
    )


def camera_row(prepared: Prepared, seed: int) -> np.ndarray | None:
    """Readings (n, 3 chips) uT of the test touches by the Gaussian process on the camera's views, or None where they
    have no predicted pressure: what registration is compared with.
    """
    touches = prepared.touches
    if touches.pressure is None:
        return None
    return predicted_by_gp(touches.pressure, touches.dataset.touches.reading, prepared.split, seed)


def _left_open(estimates: dict[int, SessionEstimate]) -> tuple[float, float]:
    """Errors of placement (m and rad) that registrations leave open, the root mean square over sessions and axes."""
    variance = np.mean([np.diag(each.covariance)[:6] for each in estimates.values()], axis=0)
    place, turn = np.sqrt(variance[:3].mean()), np.sqrt(variance[3:].mean())
    return float(place), float(turn / TWIST_LEVER_M)


def _note(dataset: Dataset, estimates: dict[int, SessionEstimate], sessions: int) -> str:
    believed = {i: dataset.touches.T_w_o[dataset.touches.session == i][0] for i in estimates}
    moved = [np.linalg.norm(each.T_w_o[:3, 3] - believed[i][:3, 3]) for i, each in estimates.items()]
    aside = [np.linalg.norm(each.T_t_camera[:3, 3]) for each in estimates.values()]
    return (
        f"{len(estimates)} of {sessions} sessions are registered: objects stand {1e3 * np.median(moved):.1f} mm from "
        f"where they are believed, and the camera sits {1e3 * np.median(aside):.1f} mm aside (medians)"
    )
