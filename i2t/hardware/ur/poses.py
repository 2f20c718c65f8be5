"""Poses as a UR controller has them: three metres and a rotation vector, in the robot's base."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def to_ur(T_b_t: Float[np.ndarray, "4 4"]) -> list[float]:
    """Position and rotation vector of a transform.

    Args:
        T_b_t: (4, 4) pose of the tool in the base, m.

    Returns:
        x, y, z in m and the rotation vector in rad.
    """
    return [*T_b_t[:3, 3].tolist(), *Rotation.from_matrix(T_b_t[:3, :3]).as_rotvec().tolist()]


def from_ur(vector: Sequence[float]) -> Float[np.ndarray, "4 4"]:
    """Transform of a UR pose, the inverse of `to_ur`.

    Args:
        vector: x, y, z in m and the rotation vector in rad.

    Returns:
        (4, 4) pose of the tool in the base, m.
    """
    T_b_t = np.eye(4)
    T_b_t[:3, 3], T_b_t[:3, :3] = vector[:3], Rotation.from_rotvec(np.asarray(vector[3:], float)).as_matrix()
    return T_b_t
