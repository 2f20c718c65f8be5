"""Estimate the pose of an object or of the camera from touches or from a depth image."""

from i2t.registration.contacts import contact_poses
from i2t.registration.depth import DepthRegistrationConfig, camera_covariance, register_by_depth
from i2t.registration.estimate import PoseEstimate
from i2t.registration.hand_eye import HandEye, pool_hand_eye, with_hand_eye
from i2t.registration.session import SessionEstimate, SessionRegistrationConfig, register_session
from i2t.registration.sets import register_sessions, with_registered_views
from i2t.registration.touch import TouchRegistrationConfig, register_by_touch

__all__ = [
    "DepthRegistrationConfig",
    "HandEye",
    "PoseEstimate",
    "SessionEstimate",
    "SessionRegistrationConfig",
    "TouchRegistrationConfig",
    "camera_covariance",
    "contact_poses",
    "pool_hand_eye",
    "register_by_depth",
    "register_by_touch",
    "register_session",
    "register_sessions",
    "with_hand_eye",
    "with_registered_views",
]
