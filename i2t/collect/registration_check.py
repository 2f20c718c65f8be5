"""Estimate of where the object and the camera were in a complete collection, from its own touches.

An error of a millimetre in the rig thus shows before the next object is touched.
"""

from typing import NamedTuple

import numpy as np

from i2t.dataset import Dataset
from i2t.geometry import so3_log
from i2t.hardware.rig import Rig
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.registration.contacts import contact_poses
from i2t.registration.session import SessionEstimate, SessionRegistrationConfig
from i2t.registration.sets import depth_noise, register_sessions
from i2t.rendering.render import prepare_surface


class Offset(NamedTuple):
    """Distance (m) and angle (rad) from the assumed to the estimated pose of an object or camera, with their errors."""

    distance: float  # m, distance from the assumed pose
    distance_std: float  # m, standard deviation of `distance`
    angle: float  # rad, angle from the assumed pose
    angle_std: float  # rad, standard deviation of `angle`

    @property
    def significant(self) -> bool:
        """Whether the distance or the angle exceeds three of its standard deviations."""
        return self.distance > 3 * self.distance_std or self.angle > 3 * self.angle_std

    def __str__(self) -> str:
        std = f"standard deviations {1e3 * self.distance_std:.2f} mm and {np.degrees(self.angle_std):.2f}"
        return f"{1e3 * self.distance:.1f} mm and {np.degrees(self.angle):.1f} degrees ({std})"


def describe_offsets(
    dataset: Dataset,
    mesh: Mesh,
    session: int,
    rig: Rig,
    *,
    min_touches: int = 12,
    max_view_residual: float = 3.0,
) -> str:
    """Describe how far object and camera were from their poses in the rig, as the touches of a session show it.

    Args:
        dataset: The touches that were collected.
        mesh: Mesh of the object.
        session: Index of the session in the data set.
        rig: The rig, with the assumed poses.
        min_touches: Minimum number of touches of one session that met the object; fewer hardly separate the camera from
            the object.
        max_view_residual: Maximum median residual of the views, in standard deviations of the noise, of a successful
            estimate.

    Returns:
        A sentence without its full stop.
    """
    here = dataset.select(dataset.touches.session == session)
    if (contacts := int(contact_poses(here.touches)[1].sum())) < min_touches:
        return f"{contacts} touches that met the object do not show where it and the camera were; {min_touches} would"
    names = {dataset.objects[i] for i in here.touches.object}
    T_t_c = rig.T_tool_camera
    tool_offset = -(rig.looking_distance * T_t_c[:3, 2] + T_t_c[:3, 3])
    config = SessionRegistrationConfig(
        tool_offset_at_capture=tuple(tool_offset.tolist()), depth_noise=depth_noise(here.touches.patch)
    )
    estimate = register_sessions(here, dict.fromkeys(names, prepare_surface(mesh)), config=config)[session]
    if not np.median(estimate.view_residual) <= max_view_residual:
        return "the views fit the mesh at no pose near the believed one: look for a wrong mesh, unit, pose or hand-eye"
    placed, camera = offsets(estimate, here.touches.T_w_o[0])
    advice = ""
    if placed.significant or camera.significant:
        simulated = dataset.source == "simulated"
        remedy = "calibrate the rig again (docs/hardware.md)"
        advice = f"; {'the simulation displaces both on purpose (--no-pose-error)' if simulated else remedy}"
    return f"by these touches, the object is {placed} from its pose in the rig, and the camera {camera}{advice}"


def offsets(estimate: SessionEstimate, T_w_o: np.ndarray) -> tuple[Offset, Offset]:
    """Compute how far the estimated poses of object and camera are from the assumed ones.

    Args:
        estimate: Poses estimated from the touches of a session.
        T_w_o: `(4, 4)` assumed pose of the object in W.

    Returns:
        The offset of the object and that of the camera.
    """
    variance = np.diag(np.asarray(estimate.covariance, np.float64)).reshape(4, 3).sum(1)
    moved = np.linalg.inv(T_w_o.astype(np.float64)) @ np.asarray(estimate.T_w_o, np.float64)
    return (
        _offset(moved, variance[0], variance[1]),
        _offset(np.asarray(estimate.T_t_camera, np.float64), variance[2], variance[3]),
    )


def _offset(motion: np.ndarray, along: float, about: float) -> Offset:
    angle = float(np.linalg.norm(so3_log(motion[:3, :3])))
    return Offset(float(np.linalg.norm(motion[:3, 3])), along**0.5, angle, about**0.5 / TWIST_LEVER_M)
