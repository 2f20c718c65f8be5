"""Poses as six numbers, a position (m) and a rotation vector (rad), as pendants and tables hold them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from i2t.types import Array


def pose_to_vector(pose: Float[Array, "4 4"]) -> list[float]:
    """Convert a (4, 4) pose to position and rotation vector, as UR controllers write poses.

    Args:
        pose: (4, 4) rigid transform, m.

    Returns:
        x, y, z (m) and the rotation vector (rad), whose angle is in [0, pi].
    """
    return [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()]


def pose_from_vector(vector: Sequence[Any]) -> Float[Array, "4 4"]:
    """Convert position and rotation vector to a (4, 4) pose; the inverse of `pose_to_vector`.

    Args:
        vector: x, y, z (m) and a rotation vector (rad).

    Returns:
        (4, 4) rigid transform, m.
    """
    pose = np.eye(4)
    pose[:3, 3], pose[:3, :3] = vector[:3], Rotation.from_rotvec(vector[3:]).as_matrix()
    return pose


def pose_difference(first: Float[Array, "4 4"], second: Float[Array, "4 4"]) -> tuple[float, float]:
    """Measure the distance and the angle between two poses.

    Args:
        first: (4, 4) rigid transform, m.
        second: (4, 4) rigid transform, m.

    Returns:
        The distance (m) between the origins and the angle (rad, in [0, pi]) between the rotations.
    """
    rotation = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3])
    return float(np.linalg.norm(second[:3, 3] - first[:3, 3])), float(rotation.magnitude())


def translated_along_z(pose: Float[Array, "4 4"], distance: float) -> Float[Array, "4 4"]:
    """Move a pose along its own z axis.

    Args:
        pose: (4, 4) rigid transform, m; it is not changed.
        distance: Distance in m along z; negative moves backwards.

    Returns:
        (4, 4) moved transform, m.
    """
    shifted = np.array(pose, float)
    shifted[:3, 3] += distance * shifted[:3, 2]
    return shifted
