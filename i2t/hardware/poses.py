"""Poses as six numbers: a position (m) and a rotation vector (rad), as pendants and lines of a table hold them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from i2t.types import Array


def pose_to_vector(pose: Float[Array, "4 4"]) -> list[float]:
    """Position and rotation vector of a transform.

    Args:
        pose: (4, 4) rigid transform, m.

    Returns:
        x, y, z (m) and the rotation vector (rad), its angle in [0, pi].
    """
    return [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()]


def pose_from_vector(vector: Sequence[Any]) -> Float[Array, "4 4"]:
    """The transform of a position and a rotation vector; the inverse of `pose_to_vector`.

    Args:
        vector: x, y, z (m) and a rotation vector (rad).

    Returns:
        (4, 4) rigid transform, m.
    """
    pose = np.eye(4)
    pose[:3, 3], pose[:3, :3] = vector[:3], Rotation.from_rotvec(vector[3:]).as_matrix()
    return pose


def apart(one: Float[Array, "4 4"], other: Float[Array, "4 4"]) -> tuple[float, float]:
    """How far two poses are from each other.

    Args:
        one: (4, 4) rigid transform, m.
        other: (4, 4) rigid transform, m.

    Returns:
        Distance (m) and angle (rad, in [0, pi]).
    """
    turn = Rotation.from_matrix(one[:3, :3].T @ other[:3, :3])
    return float(np.linalg.norm(other[:3, 3] - one[:3, 3])), float(turn.magnitude())


def shifted_along_z(pose: Float[Array, "4 4"], distance: float) -> Float[Array, "4 4"]:
    """A pose moved along its own z axis.

    Args:
        pose: (4, 4) rigid transform, m; it is not changed.
        distance: m, negative for backwards.

    Returns:
        (4, 4) the moved transform.
    """
    moved = np.array(pose, float)
    moved[:3, 3] += distance * moved[:3, 2]
    return moved
