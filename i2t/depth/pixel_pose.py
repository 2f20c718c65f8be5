"""Pose of a tool that touches what a pixel of a depth image shows.

The pixel's point is the tool's origin. The surface's normal is that of the plane of least squared distances through
the measured points around it: its normal is the direction in which they spread least (Pearson, "On lines and planes of
closest fit", 1901). Points are taken from a ball, not from a square of the image, so that what lies on another level
behind a depth edge does not tilt the plane.

Frames: W world, C camera (z forward, x along columns, y along rows), T tool; metres.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from i2t import validation
from i2t.depth.camera import Camera, check_depth, measured_mask
from i2t.depth.distortion import pixel_rays
from i2t.geometry import contact_frame
from i2t.types import Array

FITTED_RADIUS_M = 3e-3  # m: half the skin's edge is 8.5 mm, a pixel at the paper's distance 0.3 mm
MIN_FITTED_PIXELS = 8  # a plane has three; the others average noise
# Of the spread along the points' longer direction: less along the other is a line, through which any plane passes.
LEAST_WIDTH_RATIO = 0.1
MAX_FLATNESS_RATIO = 0.5  # of the spread across the plane, to the shorter one in it; more is no plane


def pose_at_pixel(
    depth: Array,
    camera: Camera,
    T_w_c: Array,
    pixel: Array | tuple[float, float],
    *,
    roll: float = 0.0,
    radius: float = FITTED_RADIUS_M,
) -> Float[np.ndarray, "4 4"]:
    """The pose of a tool whose skin lies on what a pixel shows: `T_w_t`, its origin there, its z into the surface.

    Roll means what it means to `i2t.contact_pose`, with the world in place of the object: 0 turns the tool that points
    straight down (z = -z of W, x = x of W) by the smallest rotation to the surface's normal.

    Args:
        depth: (h, w) depth (m) along the camera's axis, with holes as `i2t.depth.camera.measured_mask` knows them.
        camera: The camera.
        T_w_c: (4, 4), where it stood.
        pixel: (u, v), column and row; the upper left pixel's centre is (0, 0). The nearest pixel is taken.
        roll: Angle (rad) by which the tool is turned about its z.
        radius: Distance (m) from the pixel's point within which measured points make the plane.

    Returns:
        The pose, in W, for `i2t.patch_from_depth` or an arm.

    Raises:
        ValueError: The image is not the camera's or not in metres, the camera's pose is not rigid, the pixel is outside
            the image or not measured, or the points around it make no plane.
        TypeError: One of them holds no real numbers.

    Example:
        T_w_t = i2t.pose_at_pixel(image, camera, T_w_c, (320, 180))
        seen = i2t.patch_from_depth(image, camera, T_w_c, T_w_t)
    """
    image = validation.numbers("depth", depth, "an image of metres")
    check_depth(image, camera)
    T = validation.pose("T_w_c", T_w_c)
    validation.number("roll", roll, "radians")
    validation.number("radius", radius, f"metres above 0, such as {FITTED_RADIUS_M:g}", above=0)
    column, row = _pixel(pixel, camera)
    points = _points(image, camera)
    at = points[row, column]
    if not np.isfinite(at).all():
        measured = measured_mask(image[row, column])
        why = "has no line of sight in this lens" if measured else f"was not measured (it is {image[row, column]:g})"
        raise ValueError(f"pixel: depth at column {column}, row {row} {why}; choose another pixel, or look again")
    normal = _normal(points.reshape(-1, 3), at, radius, f"column {column}, row {row}")
    R_w_c = T[:3, :3]
    return np.asarray(contact_frame(R_w_c @ at + T[:3, 3], R_w_c @ normal, roll))


def _pixel(pixel: Any, camera: Camera) -> tuple[int, int]:
    """Column and row of the nearest pixel of the image."""
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
    """Points that pixels show, in C (m); NaN where nothing was measured."""
    x, y = np.asarray(pixel_rays(camera), np.float64)
    z = np.where(measured_mask(image), image, np.nan).astype(np.float64)
    return np.stack([x * z, y * z, z], -1)


def _normal(
    points: Float[np.ndarray, "n 3"], at: Float[np.ndarray, "3"], radius: float, where: str
) -> Float[np.ndarray, "3"]:
    """Unit normal, towards the camera, of the plane through the points around one."""
    near = points[np.linalg.norm(points - at, axis=1) <= radius]  # NaN is no comparison's
    if len(near) < MIN_FITTED_PIXELS:
        raise ValueError(
            f"pixel: only {len(near)} measured pixels lie within {1e3 * radius:g} mm of that at {where}, of at least "
            f"{MIN_FITTED_PIXELS}; choose one away from holes and edges, look from nearer, or give a larger radius"
        )
    _, spread, directions = np.linalg.svd(near - near.mean(0), full_matrices=False)
    if spread[1] < LEAST_WIDTH_RATIO * spread[0] or spread[2] > MAX_FLATNESS_RATIO * spread[1]:
        raise ValueError(
            f"pixel: the measured points within {1e3 * radius:g} mm of that at {where} make no plane, so that they "
            "have no normal; choose a pixel away from edges, or give another radius"
        )
    normal = directions[2]
    return -normal if normal @ at > 0 else normal
