"""Depth cameras and their files, in NumPy alone: what a camera is, and images read with an explicit scale.

Camera frame C: x right along the image's columns, y down along its rows, z forward; a pixel's centre has whole
coordinates, (0, 0) in the upper left. Depth is z in metres, not the distance along a pixel's ray. What was not measured
is a hole, NaN in an image from `read_depth`.
"""

import io
import math
import warnings
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from i2t import files, validation
from i2t.errors import DataError
from i2t.windows import ORTHOGONALITY_TOLERANCE

METRES_PER_DEPTH_UNIT = {"m": 1.0, "mm": 1e-3}  # m
IMAGE_SUFFIXES = (".png", ".tif", ".tiff")
MAX_IMAGE_PIXELS = 16384  # pixels, edge of an image
MAX_PIXELS_IN_ALL = 2**25  # of an image: no depth camera has so many
MAX_IMAGE_BYTES = 2**28  # of an image file
NEAREST_M, FARTHEST_M = 0.02, 5.0  # m from which a camera sees what a tool touches
FEW_SHARE = 0.05  # of an image's measured pixels


class Distortion(StrEnum):
    """Lens models of RealSense's depth cameras by librealsense's names; `i2t.depth.distortion` has their formulas."""

    NONE = "none"
    MODIFIED_BROWN_CONRADY = "modified_brown_conrady"
    INVERSE_BROWN_CONRADY = "inverse_brown_conrady"
    BROWN_CONRADY = "brown_conrady"


class Encoding(StrEnum):
    """Encodings of depth in a file's 16-bit numbers."""

    PLAIN = "plain"
    ROTATED = "rotated"  # turned left by three bits, as in files of a RealSense F200


@dataclass(frozen=True)
class Camera:
    """A depth camera: its size and lens in pixels. It can be a static argument under `jit`.

    `coefficients` are in librealsense's order: k1, k2, p1, p2, k3; what is left out is zero.

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
        if self.model not in list(Distortion):
            raise ValueError(f"camera: model {self.model!r} is not known; choose from {', '.join(Distortion)}")
        if len(self.coefficients) > 5:
            raise ValueError(
                f"camera: {len(self.coefficients)} coefficients where librealsense's models have at most 5"
            )
        # One camera is one hash and so one compilation, whatever numbers described it.
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))
        padded = (*(float(value) for value in self.coefficients), 0.0, 0.0, 0.0, 0.0, 0.0)
        object.__setattr__(self, "coefficients", padded[:5])


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


def read_depth(path: str | Path, scale: float | str, encoding: str = Encoding.PLAIN) -> np.ndarray:
    """Depth (h, w) float32 m of a 16-bit PNG or a TIF (uint16 or float), NaN where nothing was measured (0, NaN).

    Args:
        path: The file.
        scale: Metres per unit, or "m" or "mm".
        encoding: An `Encoding`; with "rotated" 16-bit numbers are turned right by three bits first.

    Returns:
        The image.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds no depth; one sentence that names the file and a remedy.
    """
    path = Path(path)
    metres = METRES_PER_DEPTH_UNIT.get(scale) if isinstance(scale, str) else scale
    if metres is None or not math.isfinite(metres) or metres <= 0:
        raise ValueError(f"{path}: scale is {scale!r}; give metres per unit as a positive number, or 'mm' or 'm'")
    if encoding not in list(Encoding):
        raise ValueError(f"{path}: encoding {encoding!r} is not known; choose from {', '.join(Encoding)}")
    values = _pixels(path)
    if values.ndim != 2:
        raise ValueError(f"{path}: is an image of shape {values.shape}; give one with a single channel of depth")
    if values.dtype != np.uint16 and values.dtype.kind != "f":
        raise ValueError(f"{path}: holds {values.dtype}; give depth as 16-bit unsigned integers, or as floats in a TIF")
    if min(values.shape) < 2 or max(values.shape) > MAX_IMAGE_PIXELS:
        raise ValueError(f"{path}: is {values.shape} pixels; an edge must have from 2 to {MAX_IMAGE_PIXELS}")
    if encoding == Encoding.ROTATED:
        if values.dtype != np.uint16:
            raise ValueError(f"{path}: holds {values.dtype}, which cannot be turned; say encoding='plain'")
        values = (values >> 3) | (values << 13)
    if np.isinf(values).any() or (values < 0).any():
        raise ValueError(f"{path}: holds negative or infinite depth; write holes as 0 or NaN")
    if not (values > 0).any():
        raise ValueError(
            f"{path}: no pixel was measured (all are 0 or NaN); record it again, within the camera's range"
        )
    return np.where(values > 0, values.astype(np.float64) * metres, np.nan).astype(np.float32)


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
    check_pose("T_w_c", T_w_c)
    check_pose("T_w_t", T_w_t)


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
    if (values < 0).any():
        raise ValueError("depth: holds negative depth; write holes as 0 or NaN, and depth along the camera's +z")
    measured = values[np.isfinite(values) & (values > 0)]
    if not measured.size:
        raise ValueError("depth: no pixel was measured (none is above 0); record it again, within the camera's range")
    # Some pixels of an image may be flying ones, and a wall may be far behind what is touched.
    near, far = np.quantile(measured, (FEW_SHARE, 1 - FEW_SHARE))
    if near > FARTHEST_M:
        raise ValueError(
            f"depth: nearly all of it is farther than {near:.4g} m, and what is touched is seen from at most "
            f"{FARTHEST_M:g} m; it is metres: divide millimetres by 1000 (i2t.depth.camera.read_depth does)"
        )
    if far < NEAREST_M:
        raise ValueError(
            f"depth: nearly all of it is nearer than {far:.2g} m, where no depth camera sees ({1e3 * NEAREST_M:g} mm); "
            "it is metres: check the scale of its units"
        )


def check_pose(name: str, pose: Any) -> None:
    """Refuse what is no rigid motion.

    Args:
        name: Of the pose, for the message.
        pose: (4, 4).

    Raises:
        ValueError: Another shape, not finite, or its rotation is scaled or mirrored.
    """
    T = np.asarray(pose)
    if T.shape != (4, 4):
        raise ValueError(f"{name}: has the shape {T.shape}; give a (4, 4) transform")
    if not np.isfinite(T).all():
        raise ValueError(f"{name}: holds NaN or infinity; leave this view out")
    if np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() > ORTHOGONALITY_TOLERANCE or np.linalg.det(T[:3, :3]) < 0:
        raise ValueError(f"{name}: is not a rigid motion (its rotation is scaled, singular or mirrored); correct it")


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
        raise ValueError(
            f"depth: has the shape {depth.shape} where the camera's image is {(camera.height, camera.width)}; "
            "give this camera's own image, or the camera scaled to it"
        )
    if depth.dtype.kind != "f":
        raise ValueError(
            f"depth: holds {depth.dtype}; give metres as floats (read_depth, or numbers times their scale)"
        )


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
        data = io.BytesIO(files.read_bytes(path, MAX_IMAGE_BYTES))
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
