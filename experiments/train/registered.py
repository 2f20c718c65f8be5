"""Touches corrected by registered sessions: what errors of the camera and of placement cost a predictor, and what
knowing them is worth.

Where the mesh of an object is known, a session's own views and contacts tell where the object and the camera were
(`sessions`). A camera that stays as it is mounted is known from sessions on the training objects, and corrects the
views of objects without a mesh too (`camera`).
"""

from typing import NamedTuple

import numpy as np

from experiments.train.prepare import Prepared
from experiments.train.simulate import predicted_by_gp
from experiments.train.sources import ObjectsKnown
from i2t.dataset import Dataset
from i2t.recognition.recorded import known_surfaces, with_placement
from i2t.recordings.sets import corrected_dataset
from i2t.registration import (
    HandEye,
    SessionEstimate,
    pool_hand_eye,
    register_sessions,
    with_hand_eye,
    with_registered_views,
)
from i2t.types import Surface

MAX_VIEW_RESIDUAL = 2.0  # of a session, in standard deviations of the camera's noise: beyond it, the mesh is not there
MAX_DISAGREEMENT = 4.0  # of sessions about one camera, in standard deviations: beyond it, it was not one


class RegisteredSessions(NamedTuple):
    """Touches, and where objects and camera were in the sessions that could be registered."""

    dataset: Dataset
    objects: ObjectsKnown
    surfaces: dict[str, Surface]  # of all objects whose mesh is known
    estimates: dict[int, SessionEstimate]
    notes: tuple[str, ...]  # what was corrected and found, a sentence each

    @property
    def all_known(self) -> bool:
        """Tell whether the mesh of every object is known."""
        return set(self.dataset.objects) <= set(self.surfaces)


class Corrected(NamedTuple):
    """Touches with corrected views."""

    dataset: Dataset
    objects: ObjectsKnown  # with errors of what a registration leaves open
    notes: tuple[str, ...]  # what was corrected and found, a sentence each


def register_known(dataset: Dataset, objects: ObjectsKnown) -> RegisteredSessions:
    """Register the sessions of all objects whose mesh is known, in the catalogue or beside it.

    Args:
        dataset: Touches with views and contacts.
        objects: Meshes that the catalogue does not have.

    Returns:
        The sessions whose views their meshes explain.

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
    return RegisteredSessions(dataset, objects, surfaces, trusted, corrected)


def by_sessions(found: RegisteredSessions) -> Corrected:
    """Views of registered sessions, rendered from where the tool really was.

    Args:
        found: By `register_known`.

    Returns:
        The touches; objects are known as well as registration tells on the average.
    """
    left_open = np.mean([each.covariance[:6, :6] for each in found.estimates.values()], axis=0)
    return Corrected(
        with_registered_views(found.dataset, found.surfaces, found.estimates),
        found.objects._replace(errors=with_placement(found.objects.errors, left_open)),
        (*found.notes, _note(found)),
    )


def by_camera(found: RegisteredSessions, train: np.ndarray) -> Corrected:
    """All views, corrected by the camera's offset that the training sessions show.

    Args:
        found: By `register_known`.
        train: (n,) numbers of the sessions that count, of training touches.

    Returns:
        The touches; placement stays as uncertain as it was.

    Raises:
        ValueError: No session counts, or they disagree about the camera.
    """
    counted = [each for number, each in found.estimates.items() if number in set(train.tolist())]
    if not counted:
        raise ValueError("--registered camera: no training session is registered; train on objects whose mesh is known")
    hand_eye = pool_hand_eye(counted)
    if not hand_eye.disagreement <= MAX_DISAGREEMENT:
        raise ValueError(
            f"--registered camera: {len(counted)} sessions differ about the camera by {hand_eye.disagreement:.0f} "
            "times their errors, so that it was not mounted alike in all of them; pass --registered sessions, which "
            "needs meshes of all objects"
        )
    return Corrected(
        with_hand_eye(found.dataset, hand_eye.T_t_camera), found.objects, (*found.notes, _camera_note(hand_eye))
    )


def reading_row(prepared: Prepared, seed: int) -> np.ndarray | None:
    """Readings (n, 3 chips) uT of the test touches by the Gaussian process on other views of the same touches, to be
    compared with; None where they have no predicted pressure.
    """
    touches = prepared.touches
    if touches.pressure is None:
        return None
    return predicted_by_gp(touches.pressure, touches.dataset.touches.reading, prepared.split, seed)


def _note(found: RegisteredSessions) -> str:
    touches, estimates = found.dataset.touches, found.estimates
    believed = {i: touches.T_w_o[touches.session == i][0] for i in estimates}
    moved = [np.linalg.norm(each.T_w_o[:3, 3] - believed[i][:3, 3]) for i, each in estimates.items()]
    aside = [np.linalg.norm(each.T_t_camera[:3, 3]) for each in estimates.values()]
    return (
        f"{len(estimates)} of {len(np.unique(touches.session))} sessions are registered: objects stand "
        f"{1e3 * np.median(moved):.1f} mm from where they are believed, and the camera sits "
        f"{1e3 * np.median(aside):.1f} mm aside (medians)"
    )


def _camera_note(hand_eye: HandEye) -> str:
    aside = 1e3 * np.linalg.norm(hand_eye.T_t_camera[:3, 3])
    std = 1e3 * np.sqrt(np.trace(hand_eye.covariance[:3, :3]))
    sessions = f"{hand_eye.num_sessions} training session{'s' * (hand_eye.num_sessions > 1)}"
    return (
        f"by {sessions} the camera sits {aside:.2f} mm aside "
        f"(standard deviation {std:.2f} mm); the sessions differ by {hand_eye.disagreement:.1f} times their errors"
    )
