"""Depth cameras and their image files, in NumPy alone.

In the camera frame C, x points right along the image's columns, y down along its rows, and z forward. Pixel centres
have integer coordinates, and (0, 0) is the upper left pixel. Depth is z in metres, not the distance along a pixel's
ray. A pixel that was not measured is a hole, and NaN in an image from `read_depth`. Cameras and programs mark holes by
0, a negative number, NaN, infinity, the largest value of 16 bits or a distance that no camera measures;
`measured_mask` recognises all of them.
"""

import functools
import io
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from i2t import validation
from i2t.errors import DataError
from i2t.files.limits import READ_LIMITS
from i2t.files.reading import read_bytes
from i2t.files.writing import as_path

IMAGE_SUFFIXES = (".png", ".tif", ".tiff")  # file name endings of depth images that can be read
MAX_DEPTH_M = 20.0  # m, largest depth that counts as measured; larger values mark holes or an empty background
MAX_UINT16 = 2**16 - 1  # largest 16-bit value, with which some depth images mark pixels without depth
# Metres per unit of common 16-bit depth images, in which 65535 units mark a hole: millimetres, RealSense L515, TUM
# RGB-D, RealSense SR300, RealSense D405.
COMMON_UNITS_M = (1e-3, 2.5e-4, 2e-4, 1.25e-4, 1e-4)


@dataclass(frozen=True)
class PlausibleDepth:
    """Range of depth (m) that nearly all pixels of an image must be in; others show that it is not in metres."""

    nearest: float = 0.02
    farthest: float = 5.0
    outlier_fraction: float = 0.05  # fraction of the measured pixels that may lie beyond each of the two


@dataclass(frozen=True)
class PlausibleLens:
    """Bounds on a camera's lens parameters, beyond which unit, order or image size are taken to be mistaken."""

    # smallest focal length relative to the image's edge: an angle of view of 152 degrees
    min_focal_ratio: float = 1 / 8
    # largest focal length relative to the image's edge: an angle of view of 1 degree
    max_focal_ratio: float = 1 / (2 * math.tan(math.radians(0.5)))
    # largest ratio of fx to fy, of images in which every second row or column is left out
    max_pixel_aspect: float = 2.0
    # smallest distance of a swapped principal point from the image's centre, relative to each edge
    min_swapped_offset: float = 0.08
    # largest distance from the image's centre, relative to each edge, of a principal point whose swapped numbers were
    # swapped back
    max_restored_offset: float = 0.05
    max_centre_ratio: float = 1.2  # largest ratio of twice the principal point's position to an edge, or of the inverse
    # largest difference of both edges' centre ratios for a lens of another image size
    max_centre_difference: float = 0.05
    max_coefficient: float = 1e9
    # largest fraction of pixels without a line of sight, in the corners of a wide lens's image
    max_blind_fraction: float = 0.05
    blind_grid: int = 41  # number of pixels along each edge at which the line of sight is tested
    # largest error of x / z after undistorting and distorting again: some tenths of a pixel
    max_return_error: float = 1e-3


class Distortion(StrEnum):
    """Lens distortion models of RealSense cameras by librealsense's names; `i2t.depth.distortion` has the formulas."""

    NONE = "none"
    MODIFIED_BROWN_CONRADY = "modified_brown_conrady"
    INVERSE_BROWN_CONRADY = "inverse_brown_conrady"
    BROWN_CONRADY = "brown_conrady"


# Lens models by their names in ROS (plumb_bob), Kalibr (radtan), COLMAP and OpenCV. None marks a fisheye lens, which is
# refused.
LENS_MODELS: dict[str, Distortion | None] = {
    **dict.fromkeys(("", "pinhole", "perspective", "no_distortion"), Distortion.NONE),
    **dict.fromkeys(("plumb_bob", "radtan", "radial_tangential", "opencv", "brown", "rational_polynomial"),
                    Distortion.BROWN_CONRADY),
    **{str(model): model for model in Distortion},
    **dict.fromkeys(("equidistant", "fisheye", "opencv_fisheye", "kannala_brandt", "kannala_brandt4", "kb4", "ftheta")),
}  # fmt: skip


class Encoding(StrEnum):
    """Encodings of depth in the 16-bit numbers of a depth image file."""

    PLAIN = "plain"
    ROTATED = "rotated"  # rotated left by three bits, as in files of a RealSense F200


@dataclass(frozen=True)
class Camera:
    """Image size, focal lengths, principal point (pixels) and distortion of a depth camera; hashable, static in `jit`.

    `coefficients` are in the order of librealsense and OpenCV: k1, k2, p1, p2, k3. Missing ones are zero. `model` is a
    `Distortion`, or another program's name for the same model, such as ROS's plumb_bob for brown_conrady.

    Example:
        camera = i2t.Camera(640, 360, 322.4, 322.1, 319.5, 179.5, "brown_conrady", (0.08, -0.03))
        seen = i2t.patch_from_depth(image, camera, T_w_c, T_w_t)
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = Distortion.NONE
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        max_edge = READ_LIMITS.image_edge_pixels
        for name in ("width", "height"):
            size = getattr(self, name)
            if not isinstance(size, int | np.integer) or not 2 <= size <= max_edge:
                raise ValueError(f"camera: {name} is {size!r}; give whole pixels from 2 to {max_edge}")
        lens = (self.fx, self.fy, self.cx, self.cy, *self.coefficients)
        validation.numbers("camera: fx, fy, cx, cy and coefficients", lens, "pixels, and the lens's coefficients")
        if not all(math.isfinite(value) for value in lens):
            raise ValueError(f"camera: fx, fy, cx, cy and coefficients {lens} must all be finite; calibrate it again")
        if self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"camera: focal lengths fx = {self.fx}, fy = {self.fy} must be positive; give pixels")
        model, coefficients = _lens_model(self.model, tuple(float(value) for value in self.coefficients))
        _check_lens_fits_image(self, PlausibleLens())
        # Equal cameras must have equal hashes, so that `jit` compiles once for them.
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "coefficients", coefficients)
        _check_folds(self, PlausibleLens())


def _lens_model(name: Any, coefficients: tuple[float, ...]) -> tuple[Distortion, tuple[float, ...]]:
    """Find a lens model by one of its names and complete its five coefficients, or refuse another model."""
    plain = str(name).strip().lower().replace(" ", "_").replace("-", "_")
    plain = plain.removeprefix("distortion.").removeprefix("rs2_distortion_")  # librealsense's names in Python and C
    if plain not in LENS_MODELS:
        names = ", ".join(Distortion)
        raise ValueError(f"camera: model {name!r} is not known; choose from {names} (ROS's plumb_bob is brown_conrady)")
    model = LENS_MODELS[plain]
    if model is None:
        raise ValueError(f"camera: model {name!r} is a fisheye lens, which is not supported; undistort to a pinhole")
    if any(coefficients[5:]):
        more = ", ".join(f"{value:g}" for value in coefficients[5:])
        raise ValueError(
            f"camera: {len(coefficients)} coefficients are given and those after the fifth ({more}) are not zero, as "
            "in OpenCV's rational model, which i2t does not support; calibrate with five, or undistort the images"
        )
    if model == Distortion.NONE and any(coefficients):
        raise ValueError(
            "camera: coefficients are given without a model that uses them; name the model, such as 'brown_conrady' "
            "(ROS's plumb_bob, OpenCV), or leave them out"
        )
    return model, (*coefficients, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]


def _check_lens_fits_image(camera: Camera, plausible: PlausibleLens) -> None:
    """Refuse a lens that belongs to an image of another size, or is not in pixels."""
    sizes, focal, middle = (camera.width, camera.height), (camera.fx, camera.fy), (camera.cx, camera.cy)
    size = f"{camera.width} x {camera.height} pixels"
    focal_text = f"camera: focal lengths fx = {camera.fx:g}, fy = {camera.fy:g}"
    centre_text = f"camera: the principal point cx = {camera.cx:g}, cy = {camera.cy:g}"
    if any(length < plausible.min_focal_ratio * edge for length, edge in zip(focal, sizes, strict=True)):
        raise ValueError(
            f"{focal_text} see more than 150 degrees on an image of {size}; give them in pixels, neither in "
            "millimetres nor as parts of the image"
        )
    if any(length > plausible.max_focal_ratio * edge for length, edge in zip(focal, sizes, strict=True)):
        raise ValueError(
            f"{focal_text} see less than 1 degree on an image of {size}; give them in pixels, not in micrometres"
        )
    if max(focal) > plausible.max_pixel_aspect * min(focal):
        raise ValueError(
            f"{focal_text} differ by more than a factor of {plausible.max_pixel_aspect:g}, and pixels are nearly "
            "square; correct the wrong one"
        )
    x, y = ((2 * at + 1) / edge for at, edge in zip(middle, sizes, strict=True))
    scale = (x + y) / 2
    outside = not all(-0.5 <= at <= edge - 0.5 for at, edge in zip(middle, sizes, strict=True))
    scaled = abs(x - y) < plausible.max_centre_difference * scale and max(scale, 1 / scale) > plausible.max_centre_ratio
    as_given, swapped = (
        [abs((2 * at + 1) / edge - 1) / 2 for at, edge in zip(order, sizes, strict=True)]
        for order in (middle, middle[::-1])
    )
    if min(as_given) > plausible.min_swapped_offset and max(swapped) < plausible.max_restored_offset:
        raise ValueError(
            f"{centre_text} would lie in the middle of an image of {size} if its two numbers were swapped; give cx "
            "along the width and cy along the height"
        )
    if outside or scaled:
        remedy = "give the lens of this image: subtract from cx, cy what was cropped, and scale all with it"
        if scaled:
            other = f"{round(scale * camera.width)} x {round(scale * camera.height)} pixels"
            remedy = f"it is the lens of an image of about {other}: scale fx, fy, cx and cy with the image"
        raise ValueError(f"{centre_text} does not fit an image of {size}; {remedy}")


def brown_conrady(camera: Camera, x: Any, y: Any) -> tuple[Any, Any]:
    """Apply the lens distortion of a Brown-Conrady model to lines of sight.

    The modified model applies the tangential part to the radially distorted point instead of the original one. The
    function uses arithmetic only, so that it accepts arrays of NumPy and of JAX.

    Args:
        camera: The camera, whose model and coefficients k1, k2, p1, p2, k3 are used.
        x: x / z of lines of sight; for the inverse model (u - cx) / fx of image columns u. Any shape.
        y: y / z of lines of sight; for the inverse model (v - cy) / fy of image rows v. The same shape.

    Returns:
        The distorted x and y.
    """
    k1, k2, p1, p2, k3 = camera.coefficients
    square = x * x + y * y
    scale = 1 + square * (k1 + square * (k2 + square * k3))
    u, v = x * scale, y * scale
    if camera.model == Distortion.MODIFIED_BROWN_CONRADY:
        x, y = u, v
    return (
        u + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        v + 2 * p2 * x * y + p1 * (square + 2 * y * y),
    )


def _jacobian(camera: Camera, x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
    """Compute the Jacobian du/dx, du/dy, dv/dx, dv/dy of u, v = `brown_conrady`(camera, x, y)."""
    k1, k2, p1, p2, k3 = camera.coefficients
    square = x * x + y * y
    scale = 1 + square * (k1 + square * (k2 + square * k3))
    slope = 2 * (k1 + square * (2 * k2 + 3 * square * k3))
    ux, uy, vy = scale + slope * x * x, slope * x * y, scale + slope * y * y
    a, b, ax, ay, bx, by = x, y, 1, 0, 0, 1
    if camera.model == Distortion.MODIFIED_BROWN_CONRADY:
        a, b, ax, ay, bx, by = x * scale, y * scale, ux, uy, uy, vy
    return (
        ux + 2 * p1 * (ax * b + a * bx) + p2 * (2 * x + 4 * a * ax),
        uy + 2 * p1 * (ay * b + a * by) + p2 * (2 * y + 4 * a * ay),
        uy + 2 * p2 * (ax * b + a * bx) + p1 * (2 * x + 4 * b * bx),
        vy + 2 * p2 * (ay * b + a * by) + p1 * (2 * y + 4 * b * by),
    )


def fold_radius(camera: Camera) -> float:
    """Compute the radius at which a lens model folds: `brown_conrady` moves points beyond it inwards again.

    Args:
        camera: The camera, whose coefficients are used.

    Returns:
        The radius as a ratio to z, sqrt(x^2 + y^2) / z; infinite for a lens that does not fold.
    """
    k1, k2, _, _, k3 = camera.coefficients
    squares = np.roots([7 * k3, 5 * k2, 3 * k1, 1])  # r^2 at which d/dr (r + k1 r^3 + k2 r^5 + k3 r^7) = 0
    squares = squares.real[(squares.real > 0) & (np.abs(squares.imag) <= 1e-6 * np.abs(squares.real))]
    return math.sqrt(squares.min(initial=math.inf))


def invert_brown_conrady(
    camera: Camera, x: Any, y: Any, *, xp: Any = np, repeat: Callable[[int, Callable, Any], Any] | None = None
) -> tuple[Any, Any]:
    """Remove lens distortion: invert `brown_conrady` within the radius at which the lens folds.

    Bisection of the radius finds a start for Newton's method.

    Args:
        camera: The camera, whose model and coefficients are used.
        x: Distorted x / z of lines of sight, of any shape.
        y: Distorted y / z, of the same shape.
        xp: The array namespace: NumPy, or `jax.numpy`.
        repeat: `repeat(n, step, value)` applies `step` to a value n times; None uses a Python loop.

    Returns:
        x / z and y / z before distortion; NaN where no point within the fold is mapped to the given one.
    """
    # 10 is 84 degrees off the camera's axis; at the fold itself the derivative is zero.
    limit = 0.999 * min(fold_radius(camera), 10.0)
    repeat = repeat or (lambda n, step, at: functools.reduce(lambda at, _: step(at), range(n), at))
    k1, k2, _, _, k3 = camera.coefficients
    distance = xp.hypot(x, y)

    def halve(ends: tuple[Any, Any]) -> tuple[Any, Any]:
        radius = (ends[0] + ends[1]) / 2
        square = radius * radius
        short = radius * (1 + square * (k1 + square * (k2 + square * k3))) < distance
        return xp.where(short, radius, ends[0]), xp.where(short, ends[1], radius)

    def step(at: tuple[Any, Any]) -> tuple[Any, Any]:
        p, q = brown_conrady(camera, *at)
        px, py, qx, qy = _jacobian(camera, *at)
        area = px * qy - py * qx
        area = xp.where(area == 0, 1, area)
        u, v = at[0] - ((p - x) * qy - (q - y) * py) / area, at[1] - ((q - y) * px - (p - x) * qx) / area
        shrink = xp.minimum(limit / xp.maximum(xp.hypot(u, v), limit), 1)
        return u * shrink, v * shrink

    # Up to the fold, the radial part, which dominates, grows with the radius, so bisection finds it.
    low, high = repeat(12, halve, (xp.zeros_like(distance), xp.full_like(distance, limit)))
    outward = (low + high) / 2 / xp.where(distance == 0, 1, distance)
    at = repeat(6, step, (x * outward, y * outward))
    p, q = brown_conrady(camera, *at)
    px, py, qx, qy = _jacobian(camera, *at)
    # 1e-5 is some thousandths of a pixel, and a hundred times the rounding error of float32.
    solved = xp.hypot(p - x, q - y) <= 1e-5 * (1 + xp.hypot(x, y))
    solved &= px * qy - py * qx > 0
    return xp.where(solved, at[0], xp.nan), xp.where(solved, at[1], xp.nan)


def _check_folds(camera: Camera, plausible: PlausibleLens) -> None:
    """Refuse a lens that leaves many pixels without a line of sight, as wrong coefficients do."""
    if not any(camera.coefficients):
        return
    if max(map(abs, camera.coefficients)) > plausible.max_coefficient:
        blind = 1.0
    else:
        u, v = np.meshgrid(*(np.linspace(0, edge - 1, plausible.blind_grid) for edge in (camera.width, camera.height)))
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        if camera.model == Distortion.INVERSE_BROWN_CONRADY:
            back = invert_brown_conrady(camera, *brown_conrady(camera, x, y))
        else:
            back = brown_conrady(camera, *invert_brown_conrady(camera, x, y))
        blind = np.mean(~(np.hypot(back[0] - x, back[1] - y) < plausible.max_return_error))
    if blind > plausible.max_blind_fraction:
        raise ValueError(
            f"camera: coefficients {camera.coefficients} fold the image, so that {100 * blind:.0f} % of its pixels "
            "have no line of sight; check their order (k1, k2, p1, p2, k3) and sign"
        )


def measured_mask(depth: Any) -> Any:
    """Mark the pixels of a depth image that were measured. Accepts arrays of NumPy and of JAX.

    Args:
        depth: Depth (m) along the camera's axis, floats of any shape.

    Returns:
        A mask of the same shape. It is false in holes: where depth is not positive, not finite or beyond
        `MAX_DEPTH_M`, and where it is 65535 of any of `COMMON_UNITS_M`, by which many programs mark holes in 16 bits.
    """
    return (depth > 0) & (depth < MAX_DEPTH_M) & ~_is_full_scale(depth)


def _is_full_scale(depth: Any) -> Any:
    """Mark the pixels that are 65535 of a common unit."""
    mask = depth != depth
    for unit in COMMON_UNITS_M:
        marker = MAX_UINT16 * unit
        mask = mask | (abs(depth - marker) < 1e-6 * marker)  # float32 rounds a division by 1000
    return mask


def to_units(depth: np.ndarray, unit: float) -> np.ndarray:
    """Convert a depth image to the 16-bit numbers of a file, the inverse of `read_depth`.

    Args:
        depth: Depth (m), with holes as `measured_mask` recognises them.
        unit: Metres per unit of the numbers.

    Returns:
        uint16 numbers of the same shape; 0 in holes and where depth exceeds 16 bits.
    """
    units = np.rint(np.where(measured_mask(depth), depth, 0) / unit)
    return np.where(units < MAX_UINT16, units, 0).astype(np.uint16)


def read_depth(path: str | Path, scale: float | str, encoding: str = Encoding.PLAIN) -> np.ndarray:
    """Read a depth image from a 16-bit PNG or from a TIF of integers or floats.

    Holes are 0, negative numbers, NaN, infinity and 65535, the largest value of 16 bits.

    Args:
        path: The file's path.
        scale: Metres per unit of the file's numbers, or "m" or "mm".
        encoding: An `Encoding`. With "rotated", 16-bit numbers are rotated right by three bits first.

    Returns:
        `(h, w)` depth in m as float32, NaN in holes.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file holds no depth; one sentence names the file and a remedy.
        TypeError: The path is neither text nor a path.
    """
    path = as_path("path", path)
    metres = metres_per_unit(scale, path)
    if encoding not in list(Encoding):
        raise ValueError(f"{path}: encoding {encoding!r} is not known; choose from {', '.join(Encoding)}")
    values = _stored_pixels(path)
    if values.ndim != 2:
        raise ValueError(f"{path}: is an image of shape {values.shape}; give one with a single channel of depth")
    if values.dtype not in (np.uint16, np.int32) and values.dtype.kind != "f":
        raise ValueError(f"{path}: holds {values.dtype}; give depth as 16-bit unsigned integers, or as floats in a TIF")
    if min(values.shape) < 2:
        raise ValueError(
            f"{path}: is {values.shape} pixels; an edge must have from 2 to {READ_LIMITS.image_edge_pixels}"
        )
    if encoding == Encoding.ROTATED:
        if values.dtype != np.uint16:
            raise ValueError(f"{path}: holds {values.dtype}, which cannot be rotated; give encoding='plain'")
        values = (values >> 3) | (values << 13)
    measured = stored_mask(values, path)
    return np.where(measured, values.astype(np.float64) * metres, np.nan).astype(np.float32)


def metres_per_unit(scale: Any, whose: str | Path) -> float:
    """Convert the scale of a depth file, as a user gives it, to metres per unit.

    Args:
        scale: Metres per unit, or "m" or "mm".
        whose: What messages call the file.

    Returns:
        The scale in metres per unit.

    Raises:
        ValueError: The scale is neither a positive number nor one of the two units.
    """
    metres = {"m": 1.0, "mm": 1e-3}.get(scale) if isinstance(scale, str) else scale
    if not isinstance(metres, Real) or isinstance(metres, bool) or not math.isfinite(metres) or metres <= 0:
        raise ValueError(f"{whose}: scale is {scale!r}; give metres per unit as a positive number, or 'mm' or 'm'")
    return float(metres)


def stored_mask(
    values: np.ndarray, path: str | Path, *, max_fraction: float = 0.01, max_gap: float = 0.98
) -> np.ndarray:
    """Mark the measured pixels of a depth file from the numbers that it stores, before they are scaled to metres.

    Args:
        values: `(h, w)` integers or floats, in the file's own unit.
        path: The file's path, for messages.
        max_fraction: The fraction of the measured pixels that may be at the largest value of 10 to 15 bits by chance.
        max_gap: The second largest value relative to that largest value, below which the latter marks holes: scenes
            have depths in between.

    Returns:
        `(h, w)` mask; false for 0, negative numbers, NaN, infinity, 65535, and the largest value of the type.

    Raises:
        ValueError: No pixel was measured, or many pixels are at the largest value of 10 to 15 bits and far from all
            others, so that they may be holes, or the numbers are not depth.
    """
    measured = np.isfinite(values) & (values > 0) & (values != MAX_UINT16)
    if values.dtype.kind in "iu":
        measured &= values != np.iinfo(values.dtype).max
    if not measured.any():
        reason = (
            "is negative or a hole; write depth along the camera's +z"
            if (values < 0).any()
            else f"is 0, {MAX_UINT16}, infinite or NaN; record it again, within the camera's range"
        )
        raise ValueError(f"{path}: no pixel was measured (each {reason})")
    kept = values[measured]
    largest = kept.max()
    at_largest = kept == largest
    full_scale = largest in [2**bits - 1 for bits in range(10, 16)]
    marked = full_scale and at_largest.mean() > max_fraction and not at_largest.all()
    if marked and kept[~at_largest].max() < max_gap * largest:
        raise ValueError(
            f"{path}: {100 * at_largest.mean():.0f} % of its pixels are {largest:g}, the largest value of "
            f"{int(largest).bit_length()} bits and far from all others; write 0 where nothing was measured, and depth "
            "rather than a Kinect's raw disparity"
        )
    return measured


def check_view(depth: Any, camera: Camera, T_w_c: Any, T_w_t: Any) -> None:
    """Refuse a depth image or poses that `i2t.depth.patches.patch_from_depth` cannot use, before JAX traces them.

    Args:
        depth: `(h, w)` depth (m).
        camera: The camera.
        T_w_c: `(4, 4)` pose of the camera in the world.
        T_w_t: `(4, 4)` pose of the tool in the world, from which the patch is seen.

    Raises:
        ValueError: The depth image is refused by `check_depth`, or a pose is not rigid.
    """
    check_depth(depth, camera)
    validation.pose("T_w_c", T_w_c)
    validation.pose("T_w_t", T_w_t)


def check_depth(depth: Any, camera: Camera, *, plausible: PlausibleDepth = PlausibleDepth()) -> None:
    """Refuse a depth image that has another size than its camera's, has no measured pixel, or is not in metres.

    Args:
        depth: `(h, w)` depth (m).
        camera: The camera.
        plausible: The distances between which nearly all pixels must lie.

    Raises:
        ValueError: The image is refused.
    """
    check_image(depth, camera)
    values = np.asarray(depth)
    measured = values[measured_mask(values)]
    if not measured.size:
        beyond = values[np.isfinite(values) & (values >= MAX_DEPTH_M) & ~_is_full_scale(values)]
        if beyond.size:
            raise ValueError(_too_far(float(np.quantile(beyond, plausible.outlier_fraction)), plausible.farthest))
        kind = "negative; depth is along the camera's +z" if (values < 0).any() else "a hole; record it again"
        raise ValueError(f"depth: no pixel was measured (each is {kind}, within the camera's range)")
    # Some pixels may be flying ones, and a wall may be far behind what is touched.
    near, far = np.quantile(measured, (plausible.outlier_fraction, 1 - plausible.outlier_fraction))
    if near > plausible.farthest:
        raise ValueError(_too_far(near, plausible.farthest))
    if far < plausible.nearest:
        raise ValueError(
            f"depth: nearly all of it is nearer than {far:.2g} m, where no depth camera sees "
            f"({1e3 * plausible.nearest:g} mm); it is taken for metres: check the scale of its units"
        )


def _too_far(near: float, farthest: float) -> str:
    """Word the message for an image nearly all of which is farther than `near` (m)."""
    return (
        f"depth: nearly all of it is farther than {near:.4g} m, and what is touched is seen from at most "
        f"{farthest:g} m; it is taken for metres: divide millimetres by 1000 (i2t.depth.camera.read_depth does)"
    )


def check_image(depth: Any, camera: Camera) -> None:
    """Refuse a depth image that has another shape than its camera's, or is not floats yet.

    Args:
        depth: `(h, w)` depth (m).
        camera: The camera.

    Raises:
        ValueError: The image has another shape, or does not hold floats.
        TypeError: The camera is not a `Camera`.
    """
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: is a {type(camera).__name__}; give an i2t.Camera")
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"depth: {wrong_size_message(depth.shape, camera)}")
    if depth.dtype.kind != "f":
        raise ValueError(
            f"depth: holds {depth.dtype}; give metres as floats (read_depth, or numbers times their scale)"
        )


def wrong_size_message(shape: tuple[int, ...], camera: Camera) -> str:
    """Word the message for an image of another size than its camera's.

    Args:
        shape: The shape of the image.
        camera: The camera.

    Returns:
        A sentence without its subject that states the problem and its remedy.
    """
    text = f"has the shape {tuple(shape)} where the camera's image is {(camera.height, camera.width)}; "
    if len(shape) != 2 or not all(shape):
        return text + "give one channel of depth"
    if shape == (camera.width, camera.height):
        return text + "rotate it back, or swap width and height, fx and fy, and turn cx and cy with it"
    down, across = camera.height / shape[0], camera.width / shape[1]
    if math.isclose(down, across, rel_tol=0.01):
        remedy = f"divide width, height, fx, fy, cx and cy by {down:g}"
        return text + f"give this camera's own image, or {remedy} where the image was resized"
    return text + "give this camera's own image, or subtract what was cropped from cx and cy, and give its size"


def read_image(
    path: str | Path, *, shape: tuple[int, int] | None = None, required_by: str = "the camera", mode: str = ""
) -> np.ndarray:
    """Read the pixels of a PNG, or of a TIF of one image, after checking its size.

    Args:
        path: The file's path.
        shape: The required numbers of rows and columns; None allows any.
        required_by: What requires that shape, for messages.
        mode: The mode of Pillow, such as RGB, to which pixels are converted; by default they are not.

    Returns:
        `(h, w)` pixels, or `(h, w, channels)` of a colour image, in the file's own unit.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is damaged, is neither PNG nor TIF, or has another size.
    """
    try:
        data = io.BytesIO(read_bytes(path, READ_LIMITS.image_bytes))
        with warnings.catch_warnings(action="error"), Image.open(data, formats=["PNG", "TIFF"]) as image:
            size = image.height, image.width
            if shape is not None and size != shape:
                raise DataError(
                    f"{path}: has {size[1]} x {size[0]} pixels where {required_by} says {shape[1]} x {shape[0]}; give "
                    "images of one size, aligned to each other"
                )
            max_edge = READ_LIMITS.image_edge_pixels
            if max(size) > max_edge or math.prod(size) > READ_LIMITS.image_pixels:
                raise DataError(f"{path}: is {size} pixels; an edge must have from 2 to {max_edge}")
            values = np.asarray(image.convert(mode) if mode else image)
            if _has_another(image):
                raise DataError(f"{path}: holds several images; give one with a single channel of depth")
    except UnidentifiedImageError as error:
        raise ValueError(f"{path}: cannot be read (it is not a PNG or TIF); save or copy it again") from error
    except (OSError, DataError) as error:
        if isinstance(error, DataError) or error.errno is not None:
            raise
        raise ValueError(_unreadable(path, error)) from error
    except Exception as error:  # a damaged image can make the decoder fail in any way
        raise ValueError(_unreadable(path, error)) from error
    return values.astype(values.dtype.newbyteorder("="))


def _has_another(image: Image.Image) -> bool:
    """Test whether there is a second image, without listing all of them, which may not end."""
    try:
        image.seek(1)
    except EOFError:
        return False
    return True


def _unreadable(path: str | Path, error: Exception) -> str:
    return f"{path}: cannot be read ({' '.join(str(error).split())}); save or copy it again"


def _stored_pixels(path: Path) -> np.ndarray:
    """Read the numbers of a depth file as they are stored."""
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        raise ValueError(f"{path}: is not a PNG or TIF; save depth as 16-bit PNG, or TIF")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file; check the path")
    values = read_image(path)
    # Older releases of Pillow widen the 16-bit pixels of a PNG.
    return values.astype(np.uint16) if path.suffix.lower() == ".png" and values.dtype == np.int32 else values
