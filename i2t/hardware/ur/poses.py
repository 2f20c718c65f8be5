"""Poses as a UR controller has them: three metres and a rotation vector, in the robot's base."""

from i2t.hardware.poses import pose_from_vector as from_ur
from i2t.hardware.poses import pose_to_vector as to_ur

__all__ = ["from_ur", "to_ur"]
