"""Pose of a tool that touches the surface point that a pixel of a depth image shows.

The pixel's point is the tool's origin. The surface's normal is that of the plane with the least squared distances to
the measured points around it, which is the direction of their smallest spread (Pearson, "On lines and planes of closest
fit", 1901). The points are taken from a ball instead of a square of the image, so that a surface on another level
behind a depth edge does not tilt the plane.

Frames: W world, C camera (z forward, x along columns, y along rows), T tool; metres.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from i2t import validation
from i2t.depth.camera import Camera, check_depth, measured_mask
from i2t.depth.distortion import pixel_rays
from i2t.geometry import contact_frame
from i2t.types import Array


@dataclass(frozen=True)
class PlaneFit:
    """Conditions under which points around a pixel determine the plane on which a skin is laid.

    Example:
        T_w_t = i2t.pose_at_pixel(image, camera, T_w_c, (320, 200), plane=i2t.PlaneFit(min_points=20))
    """

    min_points: int = 8  # smallest number of points; three determine a plane, and the others average noise
    # smallest ratio of the points' smaller to larger spread in the plane; narrower points form a line
    min_width_ratio: float = 0.1
    max_thickness_ratio: float = 0.5  # largest ratio of the points' spread out of the plane to the smaller spread in it


def pose_at_pixel(
    depth: Array,
    camera: Camera,
    T_w_c: Array,
    pixel: Array | tuple[float, float],
    *,
    roll: float = 0.0,
    radius: float = 3e-3,
    plane: PlaneFit = PlaneFit(),
) -> Float[np.ndarray, "4 4"]:
    """Compute the pose `T_w_t` of a tool whose skin lies on the surface point that a pixel shows.

    The tool's origin is that point, and its z axis points into the surface. `roll` is defined as in
    `i2t.contact_pose`, with the world in place of the object: 0 turns a tool that points straight down (z = -z of W,
    x = x of W) by the smallest rotation to the surface's normal.

    Args:
        depth: `(h, w)` depth (m) along the camera's axis, with holes as `i2t.depth.camera.measured_mask` recognises
            them.
        camera: The camera.
        T_w_c: `(4, 4)` pose of the camera in the world W.
        pixel: (u, v), column and row. The centre of the upper left pixel is (0, 0), and the nearest pixel is taken.
        roll: Angle (rad) by which the tool is turned about its z axis.
        radius: Distance (m) from the pixel's point within which measured points determine the plane. Half the skin's
            edge is 8.5 mm, and a pixel at the paper's distance is 0.3 mm wide.
        plane: The conditions under which these points determine a plane.

    Returns:
        `(4, 4)` pose of the tool in W, for `i2t.patch_from_depth` or an arm.

    Raises:
        ValueError: The image has another size than the camera's or is not in metres, the camera's pose is not rigid,
            the pixel is outside the image or not measured, or the points around it determine no plane.
        TypeError: An argument holds no real numbers.

    Example:
        T_w_t = i2t.pose_at_pixel(image, camera, T_w_c, (320, 180))
        seen = i2t.patch_from_depth(image, camera, T_w_c, T_w_t)
    """
    image = validation.numbers("depth", depth, "an image of metres")
    check_depth(image, camera)
    T = validation.pose("T_w_c", T_w_c)
    validation.number("roll", roll, "radians")
    validation.number("radius", radius, "metres above 0, such as 0.003", above=0)
    column, row = _pixel(pixel, camera)
    points = _points(image, camera)
    at = points[row, column]
    if not np.isfinite(at).all():
        measured = measured_mask(image[row, column])
        why = "has no line of sight in this lens" if measured else f"was not measured (it is {image[row, column]:g})"
        raise ValueError(f"pixel: depth at column {column}, row {row} {why}; choose another pixel, or look again")
    normal = _plane_normal(points.reshape(-1, 3), at, radius, plane, f"column {column}, row {row}")
    R_w_c = T[:3, :3]
    return np.asarray(contact_frame(R_w_c @ at + T[:3, 3], R_w_c @ normal, roll))


def _pixel(pixel: Any, camera: Camera) -> tuple[int, int]:
    """Find the column and the row of the nearest pixel of the image."""
    at = validation.numbers("pixel", pixel, "(u, v), column and row")
    if at.shape != (2,) or not np.isfinite(at).all():
        raise ValueError(f"pixel: {pixel} is not two finite numbers; give (u, v), column and row")
    column, row = (math.floor(value + 0.5) for value in at)
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise ValueError(
            f"pixel: column {column}, row {row} is outside the image of {camera.width} x {camera.height} pixels; give "
            "(u, v), column and row, from 0"
        )
    return column, row


def _points(image: Float[np.ndarray, "height width"], camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """Compute the points (m) in C that pixels show; NaN where nothing was measured."""
    x, y = np.asarray(pixel_rays(camera), np.float64)
    z = np.where(measured_mask(image), image, np.nan).astype(np.float64)
    return np.stack([x * z, y * z, z], -1)


def _plane_normal(
    points: Float[np.ndarray, "n 3"], at: Float[np.ndarray, "3"], radius: float, plane: PlaneFit, where: str
) -> Float[np.ndarray, "3"]:
    """Fit a plane to the points around `at` and compute its unit normal towards the camera."""
    near = points[np.linalg.norm(points - at, axis=1) <= radius]  # false for NaN
    if len(near) < plane.min_points:
        raise ValueError(
            f"pixel: only {len(near)} measured pixels lie within {1e3 * radius:g} mm of that at {where}, but at least "
            f"{plane.min_points} are needed; choose a pixel away from holes and edges, look from nearer, or give a "
            "larger radius"
        )
    _, spread, directions = np.linalg.svd(near - near.mean(0), full_matrices=False)
    if spread[1] < plane.min_width_ratio * spread[0] or spread[2] > plane.max_thickness_ratio * spread[1]:
        raise ValueError(
            f"pixel: the measured points within {1e3 * radius:g} mm of that at {where} do not determine a plane, so "
            "that they have no normal; choose a pixel away from edges, or give another radius"
        )
    normal = directions[2]
    return -normal if normal @ at > 0 else normal
