"""Pose of a camera in the tool, from views of a board from many poses of the tool.

With X = T_t_c and Y = T_b_o of the board, a corner p of the board appears in view i along the line of sight of
X^-1 T_b_t,i^-1 Y p. Two linear steps (Park and Martin, IEEE T-RO 10, 1994) estimate first the rotation of X from the
rotations between views, then its translation, from the board's pose in each view as OpenCV estimates it. Then X and Y
are refined together by least squares of the observed corners, with a loss that tolerates outlying corners. The stated
error is the jackknife's over views, because the corners of a view share the error of the arm's pose:
sqrt((n - 1) / n sum d_i^2) of the change d_i without view i.

Frames: B robot base, T tool, C camera, O board (z = 0 on it); metres, radians, lines of sight as x / z, y / z.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from i2t.depth.camera import Camera, Distortion, brown_conrady, invert_brown_conrady
from i2t.errors import MissingDriverError
from i2t.geometry import inverse, so3_exp, transform
from i2t.installation import extra_advice
from i2t.types import Array


@dataclass(frozen=True)
class HandEyeConfig:
    """Requirements on the views of a hand-eye calibration, and settings of the refinement of its fit.

    The requirements are the numbers of views and of corners in each, and the rotation (rad) about a second axis.
    """

    min_views: int = 6
    min_corners: int = 6  # smallest number of corners in each view
    # rad, smallest RMS rotation about a second axis; below it, the problem is nearly singular
    min_tilt: float = math.radians(5)
    max_steps: int = 100  # largest number of evaluations in the refinement; about ten suffice
    loss_scale: float = 1.0  # pixels, error beyond which a corner counts less than its square


class BoardView(NamedTuple):
    """A view of a calibration board: the tool's pose T_b_t (m), and the positions and lines of sight of the corners.

    Positions of the visible corners are on the board (m); lines of sight are x / z and y / z in the camera frame.
    """

    T_b_t: Array  # (4, 4) pose of the tool in the base when the view was taken, m
    corners: Array  # (k, 3) m, positions of the visible corners on the board
    rays: Array  # (k, 2) lines of sight of the corners, x / z and y / z


class HandEyeResult(NamedTuple):
    """Result of a hand-eye calibration: poses of camera in tool and board in base (m), residuals, standard errors.

    Residuals are RMS errors (pixels) of all corners and of each view's; standard errors are those of the camera's
    position (m) and orientation (rad).
    """

    T_t_c: Array  # (4, 4) pose of the camera in the tool, m
    T_b_o: Array  # (4, 4) pose of the board in the base, m
    rms: float  # pixels, RMS error of all corners
    view_rms: Array  # (n,) pixels, RMS error of each view's corners
    position_error: float  # m, standard error of the camera's position
    rotation_error: float  # rad, standard error of the camera's orientation


def pixel_rays(camera: Camera, pixels: Array) -> Array:
    """Calculate the lines of sight of pixels, without lens distortion, like `i2t.depth.distortion` but without JAX.

    Args:
        camera: Lens of the image.
        pixels: (k, 2) columns and rows in pixels.

    Returns:
        (k, 2) x / z and y / z of the lines of sight in the camera frame; NaN for pixels without a line of sight.

    Raises:
        ValueError: The lens is not of the Brown-Conrady family.
    """
    seen = (np.asarray(pixels, float) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if not any(camera.coefficients):
        return seen
    if camera.model == Distortion.INVERSE_BROWN_CONRADY:
        return np.stack(brown_conrady(camera, *seen.T), axis=1)
    if camera.model in (Distortion.BROWN_CONRADY, Distortion.MODIFIED_BROWN_CONRADY):
        return np.stack(invert_brown_conrady(camera, *seen.T), axis=1)
    raise ValueError(
        f"camera: a hand-eye calibration does not support the lens {camera.model}; give undistorted images"
    )


def fit(views: Sequence[BoardView], focal: float, *, config: HandEyeConfig = HandEyeConfig()) -> HandEyeResult:
    """Estimate the pose of the camera on the tool (hand-eye calibration) from views of one fixed board.

    Args:
        views: Views of the board from several poses of the tool.
        focal: Focal length in pixels, which converts lines of sight to pixels.
        config: Requirements on the views, and settings of the refinement.

    Returns:
        The poses of the camera on the tool and of the board in the base, with residuals and standard errors.

    Raises:
        ValueError: The views do not determine the pose.
    """
    if len(views) < config.min_views:
        raise ValueError(f"the board was found in {len(views)} views; take at least {config.min_views}, better 15")
    for number, view in enumerate(views, 1):
        if not all(np.isfinite(part).all() for part in view):
            raise ValueError(f"view {number} has a pose or corners that are not finite; omit it")
    T_c_o = np.stack([board_pose(view, config.min_corners) for view in views])
    tools = np.stack([view.T_b_t for view in views])
    X = _closed_form(tools, T_c_o, config.min_tilt)
    Y = _mean([T @ X @ board for T, board in zip(tools, T_c_o, strict=True)])
    whole = _refine(views, focal, X, Y, config)
    parts = [_refine([*views[:i], *views[i + 1 :]], focal, *whole, config)[0] for i in range(len(views))]
    shifts = np.array([np.linalg.norm(X[:3, 3] - whole[0][:3, 3]) for X in parts])
    angles = Rotation.from_matrix([X[:3, :3] @ whole[0][:3, :3].T for X in parts]).magnitude()
    squares = [(focal**2 * _residuals([view], *whole) ** 2).sum(1) for view in views]
    rms, weight = math.sqrt(np.concatenate(squares).mean()), (len(views) - 1) / len(views)
    view_rms = np.sqrt([square.mean() for square in squares])
    errors = (math.sqrt(weight * (change**2).sum()) for change in (shifts, angles))
    return HandEyeResult(*whole, rms, view_rms, *errors)


def opencv() -> Any:
    """Import and return OpenCV; raise MissingDriverError if it is missing, or too old to have ChArUco boards."""
    advice = extra_advice("hardware", "opencv-python-headless")
    try:
        import cv2
    except ImportError as error:
        raise MissingDriverError(f"finding boards needs OpenCV: {advice}") from error
    if not hasattr(getattr(cv2, "aruco", None), "CharucoDetector"):
        raise MissingDriverError(f"OpenCV {cv2.__version__} cannot find boards: {advice}")
    return cv2


def board_pose(view: BoardView, min_corners: int = HandEyeConfig.min_corners) -> Array:
    """Estimate the pose of a calibration board in the camera frame from one view.

    Args:
        view: View of the board.
        min_corners: Number of corners that the view must show.

    Returns:
        (4, 4) pose T_c_o of the board in the camera frame, m.

    Raises:
        ValueError: The view shows too few corners.
    """
    if len(view.corners) < min_corners:
        raise ValueError(f"a view shows {len(view.corners)} corners; at least {min_corners} are needed")
    _, rotvec, translation = opencv().solvePnP(view.corners, view.rays, np.eye(3), None, flags=opencv().SOLVEPNP_IPPE)
    return transform(so3_exp(rotvec.ravel()), translation.ravel())


def _closed_form(tools: Array, T_c_o: Array, min_tilt: float) -> Array:
    """Estimate the camera in the tool (4, 4) from poses (n, 4, 4) of tool and board (Park and Martin)."""
    A = inverse(tools[1:]) @ tools[0]  # t_i <- t_0
    B = T_c_o[1:] @ inverse(T_c_o[0])  # c_i <- c_0, and A X = X B
    rotvecs = Rotation.from_matrix(A[:, :3, :3]).as_rotvec()
    if np.linalg.svd(rotvecs)[1][1] / math.sqrt(len(tools)) < min_tilt:
        raise ValueError(
            "the tool turned about at most one axis between the views; tilt it by 15 degrees or more about two axes"
        )
    rotation = Rotation.align_vectors(rotvecs, Rotation.from_matrix(B[:, :3, :3]).as_rotvec())[0].as_matrix()
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ rotation.T - A[:, :3, 3]).ravel()
    return transform(rotation, np.linalg.lstsq(left, right, rcond=None)[0])


def _refine(views: Sequence[BoardView], focal: float, X: Array, Y: Array, config: HandEyeConfig) -> tuple[Array, Array]:
    """Refine X and Y by least squares of the observed corners."""

    def residuals(change: Array) -> Array:
        return (focal * _residuals(views, X @ _motion(change[:6]), Y @ _motion(change[6:]))).ravel()

    steps = config.max_steps
    solution = least_squares(
        residuals, np.zeros(12), loss="soft_l1", f_scale=config.loss_scale, x_scale="jac", max_nfev=steps
    )
    if not solution.success:
        raise ValueError(
            f"the camera's pose does not converge within {steps} steps; take more views, tilted about two axes"
        )
    return X @ _motion(solution.x[:6]), Y @ _motion(solution.x[6:])


def _residuals(views: Sequence[BoardView], X: Array, Y: Array) -> Array:
    """Errors (k, 2) of the predicted lines of sight of all corners."""
    T_c_o = inverse(np.stack([view.T_b_t for view in views]) @ X) @ Y
    parts = [view.corners @ T[:3, :3].T + T[:3, 3] for view, T in zip(views, T_c_o, strict=True)]
    points = np.concatenate(parts)
    return points[:, :2] / points[:, 2:] - np.concatenate([view.rays for view in views])


def _motion(twist: Array) -> Array:
    return transform(so3_exp(twist[3:]), twist[:3])


def _mean(poses: Sequence[Array]) -> Array:
    rotations, positions = np.stack([T[:3, :3] for T in poses]), [T[:3, 3] for T in poses]
    return transform(Rotation.from_matrix(rotations).mean().as_matrix(), np.mean(positions, 0))
