"""Correction of touches by registration, which shows what errors of camera and placement cost a predictor.

If the mesh of an object is known, the poses of object and camera are estimated from a session's own views and contacts
(`sessions`). If the camera's mount did not change, its offset is estimated from sessions on the training objects, and
corrects the views of objects without a mesh too (`camera`).
"""

from typing import NamedTuple

import numpy as np

from experiments.train.simulate import predicted_by_gp
from experiments.train.sources import KnownObjects
from i2t.dataset import Dataset
from i2t.prediction.fit import PreparedTouches
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


class RegisteredSessions(NamedTuple):
    """Touches, with the poses of object and camera in the sessions that could be registered."""

    dataset: Dataset
    objects: KnownObjects
    surfaces: dict[str, Surface]  # of all objects with a mesh, by name
    estimates: dict[int, SessionEstimate]  # by number of the session
    notes: tuple[str, ...]  # sentences for the user

    @property
    def all_known(self) -> bool:
        """Whether the mesh of every object is known."""
        return set(self.dataset.objects) <= set(self.surfaces)


class Corrected(NamedTuple):
    """Touches with corrected views."""

    dataset: Dataset
    objects: KnownObjects  # with the remaining errors of their placement
    notes: tuple[str, ...]  # sentences for the user


def register_known_objects(
    dataset: Dataset, objects: KnownObjects, *, max_view_residual: float = 2.0
) -> RegisteredSessions:
    """Register the sessions of all objects whose mesh is known.

    Args:
        dataset: Touches with views and contacts.
        objects: Meshes of objects that are not in the catalogue.
        max_view_residual: Maximum median residual of a session's views, in standard deviations of the camera's noise.

    Returns:
        The sessions whose views agree with the mesh.

    Raises:
        ValueError: No session can be registered.
    """
    print("registering sessions", flush=True)
    dataset, corrected = corrected_dataset(dataset)
    surfaces = known_surfaces(dataset.objects, objects.meshes)
    if not surfaces:
        raise ValueError("--registered needs meshes of the objects; pass their files (--objects FILE ...)")
    estimates = register_sessions(dataset, surfaces)
    trusted = {i: e for i, e in estimates.items() if np.median(e.view_residual) <= max_view_residual}
    if not trusted:
        raise ValueError(
            "--registered: in no session do views and contacts agree with the mesh near the recorded pose; look for a "
            "wrong mesh, unit or pose of the object"
        )
    return RegisteredSessions(dataset, objects, surfaces, trusted, corrected)


def correct_by_sessions(registered: RegisteredSessions) -> Corrected:
    """Render the views of registered sessions from the estimated poses of the tool.

    Args:
        registered: The registered sessions.

    Returns:
        The corrected touches. The covariance of placement is the mean covariance of the registered poses.
    """
    covariance = np.mean([estimate.covariance[:6, :6] for estimate in registered.estimates.values()], axis=0)
    return Corrected(
        with_registered_views(registered.dataset, registered.surfaces, registered.estimates),
        registered.objects._replace(errors=with_placement(registered.objects.errors, covariance)),
        (*registered.notes, _session_note(registered)),
    )


def correct_by_camera(registered: RegisteredSessions, train: np.ndarray, *, max_disagreement: float = 4.0) -> Corrected:
    """Correct all views by the camera's offset, estimated from the training sessions.

    Args:
        registered: The registered sessions.
        train: Session number of each training touch, `(n,)`.
        max_disagreement: Maximum difference between the sessions' estimates of the offset, in standard deviations.

    Returns:
        The corrected touches. The uncertainty of placement stays the same.

    Raises:
        ValueError: No training session is registered, or their estimates disagree.
    """
    estimates = [estimate for number, estimate in registered.estimates.items() if number in set(train.tolist())]
    if not estimates:
        raise ValueError("--registered camera: no training session is registered; train on objects whose mesh is known")
    hand_eye = pool_hand_eye(estimates)
    if not hand_eye.disagreement <= max_disagreement:
        raise ValueError(
            f"--registered camera: camera offsets of {len(estimates)} sessions differ by {hand_eye.disagreement:.0f} "
            "times their errors, so the camera was not mounted alike in all sessions; pass --registered sessions, "
            "which needs meshes of all objects"
        )
    return Corrected(
        with_hand_eye(registered.dataset, hand_eye.T_t_camera),
        registered.objects,
        (*registered.notes, _camera_note(hand_eye)),
    )


def reading_row(prepared: PreparedTouches, seed: int) -> np.ndarray | None:
    """Predict the readings (n, 3 chips) uT of the test touches with the Gaussian process on other views of the same
    touches, for comparison; None if they have no predicted pressure.
    """
    touches = prepared.touches
    if touches.pressure is None:
        return None
    return predicted_by_gp(touches.pressure, touches.dataset.touches.reading, prepared.split, seed)


def _session_note(registered: RegisteredSessions) -> str:
    touches, estimates = registered.dataset.touches, registered.estimates
    recorded = {i: touches.T_w_o[touches.session == i][0] for i in estimates}
    moved = [np.linalg.norm(estimate.T_w_o[:3, 3] - recorded[i][:3, 3]) for i, estimate in estimates.items()]
    offset = [np.linalg.norm(estimate.T_t_camera[:3, 3]) for estimate in estimates.values()]
    return (
        f"{len(estimates)} of {len(np.unique(touches.session))} sessions are registered: objects are "
        f"{1e3 * np.median(moved):.1f} mm from their recorded poses, and the camera's offset is "
        f"{1e3 * np.median(offset):.1f} mm (medians)"
    )


def _camera_note(hand_eye: HandEye) -> str:
    offset = 1e3 * np.linalg.norm(hand_eye.T_t_camera[:3, 3])
    std = 1e3 * np.sqrt(np.trace(hand_eye.covariance[:3, :3]))
    sessions = f"{hand_eye.num_sessions} training session{'s' * (hand_eye.num_sessions > 1)}"
    return (
        f"by {sessions} the camera's offset is {offset:.2f} "
        f"mm (standard deviation {std:.2f} mm); the sessions differ by {hand_eye.disagreement:.1f} times their errors"
    )
