"""Pose of a camera in the tool, from a board seen from many poses of the tool.

With X = T_t_c and Y = T_b_o of the board, a corner p of the board appears in view i along the line of sight of
X^-1 T_b_t,i^-1 Y p. First X's rotation from the rotations between views, then its translation, both linear (Park and
Martin, IEEE T-RO 10, 1994), from the board's pose in each view as OpenCV finds it; then X and Y together by least
squares of what was seen, with a loss that forgives single corners. The error stated is the
jackknife's over views, since corners of a view share the error of the arm's pose: sqrt((n - 1) / n sum d_i^2) of the
change d_i without view i.

Frames: B robot base, T tool, C camera, O board (z = 0 on it); metres, radians, lines of sight as x / z, y / z.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from i2t.depth.camera import Camera, Distortion, brown_conrady
from i2t.errors import DeviceError
from i2t.geometry import inverse, so3_exp, transform
from i2t.types import Array

MIN_VIEWS, MIN_CORNERS = 6, 6  # views, and corners of each
MIN_TILT_RAD = math.radians(5)  # root mean square turn about a second axis, under which the problem is nearly singular
INVERSION_STEPS = 50  # of a lens, each closer by the distortion's slope, some hundredths
MAX_FIT_STEPS = 100  # evaluations of the refinement; about ten are enough
LOSS_SCALE_PX = 1.0  # from where on a corner counts less than its square


class BoardView(NamedTuple):
    """A board seen from one pose of the tool."""

    T_b_t: Array  # (4, 4)
    corners: Array  # (k, 3) m, on the board
    rays: Array  # (k, 2) lines of sight


class HandEyeResult(NamedTuple):
    """A camera in a tool."""

    T_t_c: Array  # (4, 4)
    T_b_o: Array  # (4, 4) the board
    rms: float  # pixels, of all corners
    view_rms: Array  # (n,) pixels, of each view
    position_error: float  # m, one standard error of the camera's place
    rotation_error: float  # rad, one standard error of its turn


def pixel_rays(camera: Camera, pixels: Array) -> Array:
    """Lines of sight of pixels, as `i2t.depth.distortion` has them, without JAX.

    Args:
        camera: Its lens.
        pixels: (k, 2) columns and rows.

    Returns:
        (k, 2) x / z and y / z in the camera.

    Raises:
        ValueError: The lens is not of the Brown-Conrady family.
    """
    seen = (np.asarray(pixels, float) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if not any(camera.coefficients):
        return seen
    if camera.model == Distortion.INVERSE_BROWN_CONRADY:
        return _bent(camera, seen)
    if camera.model in (Distortion.BROWN_CONRADY, Distortion.MODIFIED_BROWN_CONRADY):
        straight = seen
        for _ in range(INVERSION_STEPS):
            straight = seen - (_bent(camera, straight) - straight)
        return straight
    raise ValueError(f"camera: a hand-eye calibration knows no {camera.model} lens; give images without distortion")


def _bent(camera: Camera, rays: Array) -> Array:
    """Lines of sight (k, 2) distorted by a lens in its direct sense."""
    return np.stack(brown_conrady(camera, *rays.T), axis=1)


def fit(views: Sequence[BoardView], focal: float) -> HandEyeResult:
    """The camera in the tool.

    Args:
        views: Of the board.
        focal: Pixels, that turns lines of sight into pixels.

    Returns:
        Where the camera and the board are, and how well that is known.

    Raises:
        ValueError: The views do not determine it.
    """
    if len(views) < MIN_VIEWS:
        raise ValueError(f"the board was found in {len(views)} views; take at least {MIN_VIEWS}, better 15")
    for number, view in enumerate(views, 1):
        if not all(np.isfinite(part).all() for part in view):
            raise ValueError(f"view {number} has a pose or corners that are not finite; leave it out")
    T_c_o = np.stack([board_pose(view) for view in views])
    tools = np.stack([view.T_b_t for view in views])
    X = _closed_form(tools, T_c_o)
    Y = _mean([T @ X @ seen for T, seen in zip(tools, T_c_o, strict=True)])
    whole = _refine(views, focal, X, Y)
    parts = [_refine([*views[:i], *views[i + 1 :]], focal, *whole)[0] for i in range(len(views))]
    moved = np.array([np.linalg.norm(X[:3, 3] - whole[0][:3, 3]) for X in parts])
    turned = Rotation.from_matrix([X[:3, :3] @ whole[0][:3, :3].T for X in parts]).magnitude()
    squares = [(focal**2 * _misses([view], *whole) ** 2).sum(1) for view in views]
    rms, spread = math.sqrt(np.concatenate(squares).mean()), (len(views) - 1) / len(views)
    view_rms = np.sqrt([each.mean() for each in squares])
    errors = (math.sqrt(spread * (each**2).sum()) for each in (moved, turned))
    return HandEyeResult(*whole, rms, view_rms, *errors)


def opencv() -> Any:
    """OpenCV, with its ChArUco boards; raises DeviceError where it is missing or too old."""
    try:
        import cv2
    except ImportError as error:
        raise DeviceError("boards are found by OpenCV: pip install 'imagine2touch[hardware]'") from error
    if not hasattr(getattr(cv2, "aruco", None), "CharucoDetector"):
        raise DeviceError(f"OpenCV {cv2.__version__} finds no boards: pip install -U 'imagine2touch[hardware]'")
    return cv2


def board_pose(view: BoardView) -> Array:
    """The board's pose from one view.

    Args:
        view: With at least `MIN_CORNERS` corners.

    Returns:
        (4, 4) T_c_o.

    Raises:
        ValueError: It shows too few corners.
    """
    if len(view.corners) < MIN_CORNERS:
        raise ValueError(f"a view shows {len(view.corners)} corners; at least {MIN_CORNERS} are needed")
    _, turn, place = opencv().solvePnP(view.corners, view.rays, np.eye(3), None, flags=opencv().SOLVEPNP_IPPE)
    return transform(so3_exp(turn.ravel()), place.ravel())


def _closed_form(tools: Array, T_c_o: Array) -> Array:
    """The camera in the tool (4, 4) from poses (n, 4, 4) of tool and board, by two linear steps (Park and Martin)."""
    A = inverse(tools[1:]) @ tools[0]  # t_i <- t_0
    B = T_c_o[1:] @ inverse(T_c_o[0])  # c_i <- c_0, and A X = X B
    turns = Rotation.from_matrix(A[:, :3, :3]).as_rotvec()
    if np.linalg.svd(turns)[1][1] / math.sqrt(len(tools)) < MIN_TILT_RAD:
        raise ValueError(
            "the tool turned about one axis at most between the views; tilt it by 15 degrees or more about two"
        )
    rotation = Rotation.align_vectors(turns, Rotation.from_matrix(B[:, :3, :3]).as_rotvec())[0].as_matrix()
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ rotation.T - A[:, :3, 3]).ravel()
    return transform(rotation, np.linalg.lstsq(left, right, rcond=None)[0])


def _refine(views: Sequence[BoardView], focal: float, X: Array, Y: Array) -> tuple[Array, Array]:
    """X and Y by least squares of the corners seen, from a guess."""

    def miss(change: Array) -> Array:
        return (focal * _misses(views, X @ _motion(change[:6]), Y @ _motion(change[6:]))).ravel()

    found = least_squares(
        miss, np.zeros(12), loss="soft_l1", f_scale=LOSS_SCALE_PX, x_scale="jac", max_nfev=MAX_FIT_STEPS
    )
    if not found.success:
        raise ValueError(
            f"the camera's pose does not settle within {MAX_FIT_STEPS} steps; take more views, tilted about two axes"
        )
    return X @ _motion(found.x[:6]), Y @ _motion(found.x[6:])


def _misses(views: Sequence[BoardView], X: Array, Y: Array) -> Array:
    """Errors (k, 2) of the predicted lines of sight of all corners."""
    T_c_o = inverse(np.stack([view.T_b_t for view in views]) @ X) @ Y
    parts = [view.corners @ T[:3, :3].T + T[:3, 3] for view, T in zip(views, T_c_o, strict=True)]
    seen = np.concatenate(parts)
    return seen[:, :2] / seen[:, 2:] - np.concatenate([view.rays for view in views])


def _motion(twist: Array) -> Array:
    return transform(so3_exp(twist[3:]), twist[:3])


def _mean(poses: Sequence[Array]) -> Array:
    rotations, places = np.stack([each[:3, :3] for each in poses]), [each[:3, 3] for each in poses]
    return transform(Rotation.from_matrix(rotations).mean().as_matrix(), np.mean(places, 0))
