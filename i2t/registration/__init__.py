"""Pose of an object or a tool, from touches or from a depth image."""

from i2t.registration.contacts import contact_poses
from i2t.registration.depth import DepthRegistrationConfig, camera_covariance, register_by_depth
from i2t.registration.estimate import PoseEstimate
from i2t.registration.touch import TouchRegistrationConfig, register_by_touch

__all__ = [
    "DepthRegistrationConfig",
    "PoseEstimate",
    "TouchRegistrationConfig",
    "camera_covariance",
    "contact_poses",
    "register_by_depth",
    "register_by_touch",
]
