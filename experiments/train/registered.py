"""Touches whose sessions are registered by their own views and contacts, with the meshes of their objects: what errors
of the camera and of placement cost a predictor, and what knowing them is worth.
"""

from typing import NamedTuple

import numpy as np

from experiments.train.prepare import Prepared
from experiments.train.simulate import predicted_by_gp
from experiments.train.sources import ObjectsKnown
from i2t.dataset import Dataset
from i2t.recognition.recorded import known_surfaces, with_placement
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
    surfaces = known_surfaces(dataset.objects, objects.meshes)
    if not surfaces:
        raise ValueError("--registered needs meshes of the objects that were touched; give them (--objects FILE ...)")
    estimates = register_sessions(dataset, surfaces)
    trusted = {i: each for i, each in estimates.items() if np.median(each.view_residual) <= MAX_VIEW_RESIDUAL}
    if not trusted:
        raise ValueError(
            "--registered: no session's views and contacts agree with its mesh at any pose near the believed one; look "
            "for a wrong mesh, unit or pose of the object"
        )
    sessions = len(np.unique(dataset.touches.session))
    left_open = np.mean([each.covariance[:6, :6] for each in trusted.values()], axis=0)
    return Registered(
        with_registered_views(dataset, surfaces, trusted),
        objects._replace(errors=with_placement(objects.errors, left_open)),
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


def _note(dataset: Dataset, estimates: dict[int, SessionEstimate], sessions: int) -> str:
    believed = {i: dataset.touches.T_w_o[dataset.touches.session == i][0] for i in estimates}
    moved = [np.linalg.norm(each.T_w_o[:3, 3] - believed[i][:3, 3]) for i, each in estimates.items()]
    aside = [np.linalg.norm(each.T_t_camera[:3, 3]) for each in estimates.values()]
    return (
        f"{len(estimates)} of {sessions} sessions are registered: objects stand {1e3 * np.median(moved):.1f} mm from "
        f"where they are believed, and the camera sits {1e3 * np.median(aside):.1f} mm aside (medians)"
    )
