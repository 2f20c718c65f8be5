"""Depth cameras and their files, in NumPy alone: what a camera is, and images read with an explicit scale.

Camera frame C: x right along the image's columns, y down along its rows, z forward; a pixel's centre has whole
coordinates, (0, 0) in the upper left. Depth is z in metres, not the distance along a pixel's ray. What was not measured
is a hole, NaN in an image from `read_depth`. Cameras and programs mark holes by 0, a negative number, NaN, infinity,
the largest value of 16 bits or a distance that no camera measures; `measured_mask` knows them all.
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
from i2t.files.reading import read_bytes
from i2t.files.writing import as_path

METRES_PER_DEPTH_UNIT = {"m": 1.0, "mm": 1e-3}  # m
IMAGE_SUFFIXES = (".png", ".tif", ".tiff")
MAX_IMAGE_PIXELS = 16384  # pixels, edge of an image
MAX_PIXELS_IN_ALL = 2**25  # of an image: no depth camera has so many
MAX_IMAGE_BYTES = 2**28  # of an image file
NEAREST_M, FARTHEST_M = 0.02, 5.0  # m from which a camera sees what a tool touches
FEW_SHARE = 0.05  # of an image's measured pixels
MAX_DEPTH_M = 20.0  # m; what is said to be farther marks a hole or an empty background
MAX_UINT16 = 2**16 - 1
# m per unit of 16-bit images: millimetres, RealSense L515, TUM RGB-D, RealSense SR300 and D405
COMMON_UNITS_M = (1e-3, 2.5e-4, 2e-4, 1.25e-4, 1e-4)
FULL_SCALES = tuple(2**bits - 1 for bits in range(10, 16))  # largest values of 10 to 15 bits
MAX_FULL_SCALE_SHARE = 0.01  # of an image's measured pixels, that are at the largest value by chance
FULL_SCALE_GAP = 0.98  # of the largest value; scenes have depths between this and it, marked holes have none
MIN_FOCAL_RATIO = 1 / 8  # of the image's edge: an angle of view of 152 degrees
MAX_FOCAL_RATIO = 1 / (2 * math.tan(math.radians(0.5)))  # likewise: an angle of view of 1 degree
MAX_PIXEL_ASPECT = 2.0  # of fx to fy: images of which every second row or column is left out
SWAPPED_OFF_CENTRE = 0.08  # of an edge, by which a swapped principal point is off the middle along both
SWAPPED_CENTRE = 0.05  # likewise, after it is swapped back
MAX_BLIND_SHARE = 0.05  # of an image's pixels, that a wide lens may have in its corners without a line of sight
BLIND_GRID = 41  # pixels along an edge that are looked at for it
MAX_COEFFICIENT = 1e9  # of a lens
BISECTION_STEPS, NEWTON_STEPS = 12, 6
MAX_SLOPE = 10.0  # x / z of lines of sight, 84 degrees off the camera's axis
LIMIT_RATIO = 0.999  # of the radius at which a lens folds, where lines of sight end: at the fold they are all one
RETURN_TOLERANCE = 1e-3  # of x / z: some tenths of a pixel, between a line of sight and what it returns to
SOLUTION_TOLERANCE = 1e-5  # of x / z: some thousandths of a pixel, and a hundred roundings of float32
SCALED_LENS_RATIO = 1.2  # by which a principal point may lie off the middle, along both edges alike
SCALED_LENS_AGREEMENT = 0.05  # by which these ratios of both edges differ where the lens is of another image size
MODEL_PREFIXES = ("distortion.", "rs2_distortion_")  # of librealsense's names in Python and C


class Distortion(StrEnum):
    """Lens models of RealSense's depth cameras by librealsense's names; `i2t.depth.distortion` has their formulas."""

    NONE = "none"
    MODIFIED_BROWN_CONRADY = "modified_brown_conrady"
    INVERSE_BROWN_CONRADY = "inverse_brown_conrady"
    BROWN_CONRADY = "brown_conrady"


# Names of the same models elsewhere: ROS (plumb_bob), Kalibr (radtan), COLMAP and OpenCV.
MODEL_NAMES = {
    **dict.fromkeys(("", "pinhole", "perspective", "no_distortion"), Distortion.NONE),
    **dict.fromkeys(("plumb_bob", "radtan", "radial_tangential", "opencv", "brown", "rational_polynomial"),
                    Distortion.BROWN_CONRADY),
    **{str(model): model for model in Distortion},
}  # fmt: skip
FISHEYE_NAMES = ("equidistant", "fisheye", "opencv_fisheye", "kannala_brandt", "kannala_brandt4", "kb4", "ftheta")


class Encoding(StrEnum):
    """Encodings of depth in a file's 16-bit numbers."""

    PLAIN = "plain"
    ROTATED = "rotated"  # turned left by three bits, as in files of a RealSense F200


@dataclass(frozen=True)
class Camera:
    """A depth camera: its size and lens in pixels. It can be a static argument under `jit`.

    `coefficients` are in librealsense's and OpenCV's order: k1, k2, p1, p2, k3; what is left out is zero. `model` is a
    `Distortion`, or the name of the same model elsewhere, such as ROS's plumb_bob for brown_conrady.

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
        for name in ("width", "height"):
            size = getattr(self, name)
            if not isinstance(size, int | np.integer) or not 2 <= size <= MAX_IMAGE_PIXELS:
                raise ValueError(f"camera: {name} is {size!r}; give whole pixels from 2 to {MAX_IMAGE_PIXELS}")
        lens = (self.fx, self.fy, self.cx, self.cy, *self.coefficients)
        validation.numbers("camera: fx, fy, cx, cy and coefficients", lens, "pixels, and the lens's coefficients")
        if not all(math.isfinite(value) for value in lens):
            raise ValueError(f"camera: fx, fy, cx, cy and coefficients {lens} must all be finite; calibrate it again")
        if self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"camera: focal lengths fx = {self.fx}, fy = {self.fy} must be positive; give pixels")
        model, coefficients = _lens_model(self.model, tuple(float(value) for value in self.coefficients))
        _check_lens_fits_image(self)
        # One camera is one hash and so one compilation, whatever numbers described it.
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "coefficients", coefficients)
        _check_folds(self)


def _lens_model(name: Any, coefficients: tuple[float, ...]) -> tuple[Distortion, tuple[float, ...]]:
    """A lens model by anybody's name for it, and its five coefficients; refuses what is another model."""
    plain = str(name).strip().lower().replace(" ", "_").replace("-", "_")
    for prefix in MODEL_PREFIXES:
        plain = plain.removeprefix(prefix)
    if plain in FISHEYE_NAMES:
        raise ValueError(f"camera: model {name!r} is a fisheye lens, which i2t lacks; undistort to a pinhole")
    if plain not in MODEL_NAMES:
        names = ", ".join(Distortion)
        raise ValueError(f"camera: model {name!r} is not known; choose from {names} (ROS's plumb_bob is brown_conrady)")
    model = MODEL_NAMES[plain]
    if any(coefficients[5:]):
        more = ", ".join(f"{value:g}" for value in coefficients[5:])
        raise ValueError(
            f"camera: {len(coefficients)} coefficients, of which those after the fifth ({more}) are not zero, as in "
            "OpenCV's rational model, which i2t lacks; calibrate with five, or undistort the images"
        )
    if model == Distortion.NONE and any(coefficients):
        raise ValueError(
            "camera: coefficients are given without a model that has them; say which, such as 'brown_conrady' (ROS's "
            "plumb_bob, OpenCV), or leave them out"
        )
    return model, (*coefficients, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]


def _check_lens_fits_image(camera: Camera) -> None:
    """Refuse a lens that is of an image of another size, or not in pixels."""
    sizes, focal, middle = (camera.width, camera.height), (camera.fx, camera.fy), (camera.cx, camera.cy)
    size = f"{camera.width} x {camera.height} pixels"
    if any(length < MIN_FOCAL_RATIO * edge for length, edge in zip(focal, sizes, strict=True)):
        raise ValueError(
            f"camera: focal lengths fx = {camera.fx:g}, fy = {camera.fy:g} see more than 150 degrees on an image of "
            f"{size}; give them in pixels, neither in millimetres nor as parts of the image"
        )
    if any(length > MAX_FOCAL_RATIO * edge for length, edge in zip(focal, sizes, strict=True)):
        raise ValueError(
            f"camera: focal lengths fx = {camera.fx:g}, fy = {camera.fy:g} see less than 1 degree on an image of "
            f"{size}; give them in pixels, not in micrometres"
        )
    if max(focal) > MAX_PIXEL_ASPECT * min(focal):
        raise ValueError(
            f"camera: focal lengths fx = {camera.fx:g}, fy = {camera.fy:g} differ by more than a factor of "
            f"{MAX_PIXEL_ASPECT:g}, and pixels are nearly square; correct the wrong one"
        )
    x, y = ((2 * at + 1) / edge for at, edge in zip(middle, sizes, strict=True))
    scale = (x + y) / 2
    outside = not all(-0.5 <= at <= edge - 0.5 for at, edge in zip(middle, sizes, strict=True))
    scaled = abs(x - y) < SCALED_LENS_AGREEMENT * scale and max(scale, 1 / scale) > SCALED_LENS_RATIO
    as_given, swapped = (
        [abs((2 * at + 1) / edge - 1) / 2 for at, edge in zip(order, sizes, strict=True)]
        for order in (middle, middle[::-1])
    )
    if min(as_given) > SWAPPED_OFF_CENTRE and max(swapped) < SWAPPED_CENTRE:
        raise ValueError(
            f"camera: the principal point cx = {camera.cx:g}, cy = {camera.cy:g} lies in the middle of an image of "
            f"{size} where its two numbers are swapped; give cx along the width and cy along the height"
        )
    if outside or scaled:
        other = f"{round(scale * camera.width)} x {round(scale * camera.height)} pixels"
        of = f"; it is the lens of an image of about {other}: scale fx, fy, cx and cy with the image" if scaled else ""
        raise ValueError(
            f"camera: the principal point cx = {camera.cx:g}, cy = {camera.cy:g} does not fit an image of {size}"
            + (of or "; give the lens of this image: subtract from cx, cy what was cropped, and scale all with it")
        )


def brown_conrady(camera: Camera, x: Any, y: Any) -> tuple[Any, Any]:
    """Radial and tangential distortion; the modified model moves radially first and then tangentially from there.

    Arithmetic alone, for arrays of NumPy and of JAX alike.

    Args:
        camera: Its model and coefficients k1, k2, p1, p2, k3.
        x: x / z of lines of sight, or columns of the image in the same unit for the inverse model.
        y: y / z likewise.

    Returns:
        Both after distortion.
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
    """Derivatives of both results of `brown_conrady`: of the first by x and by y, of the second by x and by y."""
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
    """Where the radial part of `brown_conrady` folds: from there on points farther out land farther in.

    Args:
        camera: Its coefficients.

    Returns:
        The radius, in the unit of x; infinite for a lens that does not fold.
    """
    k1, k2, _, _, k3 = camera.coefficients
    squares = np.roots([7 * k3, 5 * k2, 3 * k1, 1])  # of the radius r, where d/dr (r scale) = 0
    squares = squares.real[(squares.real > 0) & (np.abs(squares.imag) <= 1e-6 * np.abs(squares.real))]
    return math.sqrt(squares.min(initial=math.inf))


def invert_brown_conrady(
    camera: Camera, x: Any, y: Any, *, xp: Any = np, repeat: Callable[[int, Callable, Any], Any] | None = None
) -> tuple[Any, Any]:
    """The inverse of `brown_conrady` within the radius at which the lens folds: bisection of the radius, then Newton's
    method.

    Args:
        camera: Its model and coefficients.
        x: The first of its results, any shape.
        y: The second, of the same shape.
        xp: NumPy, or JAX's namespace like it.
        repeat: Applies a function to a value so many times; by default a loop of Python.

    Returns:
        x and y before distortion; NaN where nothing within the fold leads there.
    """
    limit = LIMIT_RATIO * min(fold_radius(camera), MAX_SLOPE)
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

    # Without its small tangential part a lens is a growing function of the radius up to its fold.
    low, high = repeat(BISECTION_STEPS, halve, (xp.zeros_like(distance), xp.full_like(distance, limit)))
    outward = (low + high) / 2 / xp.where(distance == 0, 1, distance)
    at = repeat(NEWTON_STEPS, step, (x * outward, y * outward))
    p, q = brown_conrady(camera, *at)
    px, py, qx, qy = _jacobian(camera, *at)
    solved = xp.hypot(p - x, q - y) <= SOLUTION_TOLERANCE * (1 + xp.hypot(x, y))
    solved &= px * qy - py * qx > 0
    return xp.where(solved, at[0], xp.nan), xp.where(solved, at[1], xp.nan)


def _check_folds(camera: Camera) -> None:
    """Refuse a lens that leaves many pixels without a line of sight, as wrong coefficients do."""
    if not any(camera.coefficients):
        return
    if max(map(abs, camera.coefficients)) > MAX_COEFFICIENT:
        blind = 1.0
    else:
        u, v = np.meshgrid(*(np.linspace(0, edge - 1, BLIND_GRID) for edge in (camera.width, camera.height)))
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        if camera.model == Distortion.INVERSE_BROWN_CONRADY:
            back = invert_brown_conrady(camera, *brown_conrady(camera, x, y))
        else:
            back = brown_conrady(camera, *invert_brown_conrady(camera, x, y))
        blind = np.mean(~(np.hypot(back[0] - x, back[1] - y) < RETURN_TOLERANCE))
    if blind > MAX_BLIND_SHARE:
        raise ValueError(
            f"camera: coefficients {camera.coefficients} fold the image, so that {100 * blind:.0f} % of its pixels "
            "have no line of sight; check their order (k1, k2, p1, p2, k3) and sign"
        )


def measured_mask(depth: Any) -> Any:
    """Pixels that were measured: the one rule for holes, for images of NumPy and of JAX alike.

    Args:
        depth: Depth (m) along the camera's axis, floats of any shape.

    Returns:
        Mask of the same shape: false for what is not positive and finite, for what is farther than `MAX_DEPTH_M`, and
        for 65535 units, with which many programs mark holes in 16 bits, in any of `COMMON_UNITS_M`.
    """
    return (depth > 0) & (depth < MAX_DEPTH_M) & ~_is_full_scale(depth)


def _is_full_scale(depth: Any) -> Any:
    """Mask of pixels at 65535 units of a common size."""
    mask = depth != depth
    for unit in COMMON_UNITS_M:
        marker = MAX_UINT16 * unit
        mask = mask | (abs(depth - marker) < 1e-6 * marker)  # a division by 1000 in single precision rounds
    return mask


def to_units(depth: np.ndarray, unit: float) -> np.ndarray:
    """Depth as 16-bit numbers, as files hold it: the inverse of `read_depth`.

    Args:
        depth: Depth (m), holes as `measured_mask` knows them.
        unit: Metres per unit.

    Returns:
        uint16 of the same shape; 0 in holes and where 16 bits do not suffice.
    """
    units = np.rint(np.where(measured_mask(depth), depth, 0) / unit)
    return np.where(units < MAX_UINT16, units, 0).astype(np.uint16)


def read_depth(path: str | Path, scale: float | str, encoding: str = Encoding.PLAIN) -> np.ndarray:
    """Depth (h, w) float32 m of a 16-bit PNG or a TIF (integers or floats), NaN in holes.

    Holes are 0, negative numbers, NaN, infinity and 65535, the largest value of 16 bits.

    Args:
        path: The file.
        scale: Metres per unit, or "m" or "mm".
        encoding: An `Encoding`; with "rotated" 16-bit numbers are turned right by three bits first.

    Returns:
        The image.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds no depth; one sentence that names the file and a remedy.
        TypeError: The path is neither text nor a path.
    """
    path = as_path("path", path)
    metres = metres_per_unit(scale, path)
    if encoding not in list(Encoding):
        raise ValueError(f"{path}: encoding {encoding!r} is not known; choose from {', '.join(Encoding)}")
    values = _pixels(path)
    if values.ndim != 2:
        raise ValueError(f"{path}: is an image of shape {values.shape}; give one with a single channel of depth")
    if values.dtype not in (np.uint16, np.int32) and values.dtype.kind != "f":
        raise ValueError(f"{path}: holds {values.dtype}; give depth as 16-bit unsigned integers, or as floats in a TIF")
    if min(values.shape) < 2 or max(values.shape) > MAX_IMAGE_PIXELS:
        raise ValueError(f"{path}: is {values.shape} pixels; an edge must have from 2 to {MAX_IMAGE_PIXELS}")
    if encoding == Encoding.ROTATED:
        if values.dtype != np.uint16:
            raise ValueError(f"{path}: holds {values.dtype}, which cannot be turned; say encoding='plain'")
        values = (values >> 3) | (values << 13)
    measured = stored_mask(values, path)
    return np.where(measured, values.astype(np.float64) * metres, np.nan).astype(np.float32)


def metres_per_unit(scale: Any, whose: str | Path) -> float:
    """The scale of depth files as a number.

    Args:
        scale: Metres per unit, or "m" or "mm".
        whose: Names the file in messages.

    Returns:
        Metres per unit.

    Raises:
        ValueError: It is neither.
    """
    metres = METRES_PER_DEPTH_UNIT.get(scale) if isinstance(scale, str) else scale
    if not isinstance(metres, Real) or isinstance(metres, bool) or not math.isfinite(metres) or metres <= 0:
        raise ValueError(f"{whose}: scale is {scale!r}; give metres per unit as a positive number, or 'mm' or 'm'")
    return float(metres)


def stored_mask(values: np.ndarray, path: str | Path) -> np.ndarray:
    """Pixels of a depth file that were measured, by the numbers that it stores.

    Args:
        values: (h, w) integers or floats, in the file's own unit.
        path: Of the file, for messages.

    Returns:
        (h, w) mask; false for 0, negative numbers, NaN, infinity, 65535, and the largest value of the type.

    Raises:
        ValueError: No pixel was measured; or the largest value is that of 10 to 15 bits, on many pixels and far from
            the others, so that it may mark holes or be no depth.
    """
    measured = np.isfinite(values) & (values > 0) & (values != MAX_UINT16)
    if values.dtype.kind in "iu":
        measured &= values != np.iinfo(values.dtype).max
    if not measured.any():
        held = (
            "is negative or a hole; write depth along the camera's +z"
            if (values < 0).any()
            else (f"is 0, {MAX_UINT16}, infinite or NaN; record it again, within the camera's range")
        )
        raise ValueError(f"{path}: no pixel was measured (each {held})")
    kept = values[measured]
    largest = kept.max()
    at_largest = kept == largest
    marked = largest in FULL_SCALES and at_largest.mean() > MAX_FULL_SCALE_SHARE and not at_largest.all()
    if marked and kept[~at_largest].max() < FULL_SCALE_GAP * largest:
        raise ValueError(
            f"{path}: {100 * at_largest.mean():.0f} % of its pixels are {largest:g}, the largest value of "
            f"{int(largest).bit_length()} bits and far from all others; write 0 where nothing was measured, and depth "
            "rather than a Kinect's raw disparity"
        )
    return measured


def check_view(depth: Any, camera: Camera, T_w_c: Any, T_w_t: Any) -> None:
    """Refuse, with one sentence (ValueError), what `i2t.depth.patches.patch_from_depth` cannot make sense of: for
    arrays at the border, before they are traced.

    Args:
        depth: Depth (h, w) m.
        camera: The camera.
        T_w_c: Where it stood (4, 4).
        T_w_t: Where the tool is to look from (4, 4).

    Raises:
        ValueError: One of them makes no sense.
    """
    check_depth(depth, camera)
    validation.pose("T_w_c", T_w_c)
    validation.pose("T_w_t", T_w_t)


def check_depth(depth: Any, camera: Camera) -> None:
    """Refuse a depth image of another camera, without a measured pixel, or at distances that say it is not in metres.

    Args:
        depth: Depth (h, w) m.
        camera: The camera.

    Raises:
        ValueError: The image makes no sense.
    """
    check_image(depth, camera)
    values = np.asarray(depth)
    measured = values[measured_mask(values)]
    if not measured.size:
        beyond = values[np.isfinite(values) & (values >= MAX_DEPTH_M) & ~_is_full_scale(values)]
        if beyond.size:
            raise ValueError(_too_far(float(np.quantile(beyond, FEW_SHARE))))
        kind = "negative; depth is along the camera's +z" if (values < 0).any() else "a hole; record it again"
        raise ValueError(f"depth: no pixel was measured (each is {kind}, within the camera's range)")
    # Some pixels of an image may be flying ones, and a wall may be far behind what is touched.
    near, far = np.quantile(measured, (FEW_SHARE, 1 - FEW_SHARE))
    if near > FARTHEST_M:
        raise ValueError(_too_far(near))
    if far < NEAREST_M:
        raise ValueError(
            f"depth: nearly all of it is nearer than {far:.2g} m, where no depth camera sees ({1e3 * NEAREST_M:g} mm); "
            "it is metres: check the scale of its units"
        )


def _too_far(near: float) -> str:
    """Message for an image nearly all of which is farther than a distance (m)."""
    return (
        f"depth: nearly all of it is farther than {near:.4g} m, and what is touched is seen from at most "
        f"{FARTHEST_M:g} m; it is metres: divide millimetres by 1000 (i2t.depth.camera.read_depth does)"
    )


def check_image(depth: Any, camera: Camera) -> None:
    """Refuse a depth image of another shape than its camera's, or one that is not in metres yet.

    Args:
        depth: Depth (h, w) m.
        camera: The camera.

    Raises:
        ValueError: The image is not the camera's, or holds no floats.
        TypeError: The camera is none.
    """
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: is a {type(camera).__name__}; give an i2t.Camera")
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"depth: {other_size(depth.shape, camera)}")
    if depth.dtype.kind != "f":
        raise ValueError(
            f"depth: holds {depth.dtype}; give metres as floats (read_depth, or numbers times their scale)"
        )


def other_size(shape: tuple[int, ...], camera: Camera) -> str:
    """Message for an image of another size than its camera's.

    Args:
        shape: Of the image.
        camera: The camera.

    Returns:
        What is wrong and what to do, without a subject.
    """
    text = f"has the shape {tuple(shape)} where the camera's image is {(camera.height, camera.width)}; "
    if len(shape) != 2 or not all(shape):
        return text + "give one channel of depth"
    if shape == (camera.width, camera.height):
        return text + "rotate it back, or swap width and height, fx and fy, and turn cx and cy with it"
    down, across = camera.height / shape[0], camera.width / shape[1]
    if math.isclose(down, across, rel_tol=0.01):
        how = f"divide width, height, fx, fy, cx and cy by {down:g}"
        return text + f"give this camera's own image, or {how} where the image was resized"
    return text + "give this camera's own image, or subtract what was cropped from cx and cy, and give its size"


def read_image(
    path: str | Path, *, shape: tuple[int, int] | None = None, said_by: str = "the camera", mode: str = ""
) -> np.ndarray:
    """The pixels of a PNG or of a TIF of one image, whose size is looked at before they are unpacked.

    Args:
        path: The file.
        shape: Rows and columns that it must have, if they are known.
        said_by: What says so, for the message.
        mode: Of Pillow, such as RGB, that pixels are turned into; by default they stay as they are.

    Returns:
        The pixels.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, neither PNG nor TIF, or of another size.
    """
    try:
        data = io.BytesIO(read_bytes(path, MAX_IMAGE_BYTES))
        with warnings.catch_warnings(action="error"), Image.open(data, formats=["PNG", "TIFF"]) as image:
            found = image.height, image.width
            if shape is not None and found != shape:
                raise DataError(
                    f"{path}: has {found[1]} x {found[0]} pixels where {said_by} says {shape[1]} x {shape[0]}; give "
                    "images of one size, aligned to each other"
                )
            if max(found) > MAX_IMAGE_PIXELS or math.prod(found) > MAX_PIXELS_IN_ALL:
                raise DataError(f"{path}: is {found} pixels; an edge must have from 2 to {MAX_IMAGE_PIXELS}")
            values = np.asarray(image.convert(mode) if mode else image)
            if _has_another(image):
                raise DataError(f"{path}: holds several images; give one with a single channel of depth")
    except UnidentifiedImageError as error:
        raise ValueError(f"{path}: cannot be read (it is no PNG or TIF); save or copy it again") from error
    except (OSError, DataError) as error:
        if isinstance(error, DataError) or error.errno is not None:
            raise
        raise ValueError(_unreadable(path, error)) from error
    except Exception as error:  # a damaged image can make its decoder fail in any way
        raise ValueError(_unreadable(path, error)) from error
    return values.astype(values.dtype.newbyteorder("="))


def _has_another(image: Image.Image) -> bool:
    """Test whether there is a second image; the list of all may be endless."""
    try:
        image.seek(1)
    except EOFError:
        return False
    return True


def _unreadable(path: str | Path, error: Exception) -> str:
    return f"{path}: cannot be read ({' '.join(str(error).split())}); save or copy it again"


def _pixels(path: Path) -> np.ndarray:
    """A file's numbers as they are stored."""
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        raise ValueError(f"{path}: is no PNG or TIF; save depth as 16-bit PNG, or TIF")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file; check the path")
    values = read_image(path)
    # Older releases of Pillow widen the 16-bit pixels of a PNG.
    return values.astype(np.uint16) if path.suffix.lower() == ".png" and values.dtype == np.int32 else values
