"""Folders of a depth camera's views: reading and writing.

DIR/camera.toml      the lens in pixels (keys of `i2t.depth.camera.Camera`, or of ROS's camera_info and OpenCV's
                     calibrations), `scale` of the depth files (metres per unit, or "m" or "mm"), and `encoding`, if it
                     is not "plain"
DIR/depth/NAME.png   16 bits, or .tif; 0, 65535 or NaN for unmeasured pixels (see `i2t.depth.camera.read_depth`)
DIR/colour/NAME.png  8 bits RGB of the same pixels; optional
"""

import json
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from i2t.depth.camera import (
    IMAGE_SUFFIXES,
    Camera,
    Encoding,
    metres_per_unit,
    read_depth,
    read_image,
    to_units,
    wrong_size_message,
)
from i2t.errors import DataError
from i2t.files.reading import read_text, read_toml
from i2t.files.writing import as_path
from i2t.hardware.protocols import View

DEPTH_UNIT_M = 1e-4  # m per unit of the depth images that `save_views` writes: 16 bits hold up to 6.5 m
DESCRIPTION = "camera.toml"  # file, in a folder of depth images, that describes the camera
# Problem and remedy if the camera's description is another file than camera.toml.
NOT_TOML = (
    f"not TOML: write its numbers to {DESCRIPTION}, as KEY = VALUE under the same names (width, height, K, "
    "distortion_model, D), and add the depth's scale"
)
# Keys of ROS's camera_info, of its calibration files and of librealsense, each with the key of `Camera` or with the
# role that it has here: the camera matrix K (3 x 3), the projection P (3 x 4) of the rectified image, the rotation R
# (3 x 3) of the rectification, a "part" of a cropped or binned image, or a "text" that is ignored.
FOREIGN_KEYS = {
    "image_width": "width", "image_height": "height", "ppx": "cx", "ppy": "cy", "distortion_model": "model",
    "D": "coefficients", "d": "coefficients", "coeffs": "coefficients", "distortion_coefficients": "coefficients",
    "K": "K", "k": "K", "camera_matrix": "K", "intrinsic_matrix": "K",
    "P": "P", "p": "P", "projection_matrix": "P",
    "R": "R", "r": "R", "rectification_matrix": "R",
    "roi": "part", "binning_x": "part", "binning_y": "part",
    "header": "text", "camera_name": "text", "frame_id": "text",
}  # fmt: skip
LENS_TOLERANCE = 1e-3  # largest relative difference between two camera matrices that describe the same lens


def read_view(path: str | Path) -> tuple[Camera, View]:
    """Read the lens and the first depth view, by file name, of a folder in the form of this module.

    Args:
        path: Path of the folder.

    Returns:
        The lens and the view, whose time is NaN.

    Raises:
        ValueError: The folder holds no views, or a file is damaged; the message names the file.
        OSError: A file cannot be read.
    """
    camera, given = read_lens(path, {"scale": None, "encoding": str(Encoding.PLAIN), "nearest": 0.0})
    scale = metres_per_unit(given["scale"], Path(path) / DESCRIPTION)
    files = sorted(file for file in (Path(path) / "depth").glob("*") if file.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise ValueError(f"{Path(path) / 'depth'} holds no views; give a folder with depth/*.png or .tif")
    depth = read_depth(files[0], scale, given["encoding"])
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"{files[0]}: {wrong_size_message(depth.shape, camera)} ({Path(path) / DESCRIPTION})")
    colour = (Path(path) / "colour" / files[0].name).with_suffix(".png")
    shape = (camera.height, camera.width)
    pixels = read_image(colour, shape=shape, required_by="its depth", mode="RGB") if colour.parent.is_dir() else None
    return camera, View(math.nan, depth, pixels)


def read_lens(path: str | Path, others: dict[str, Any]) -> tuple[Camera, dict[str, Any]]:
    """Read a camera's lens from `camera.toml` in a folder, with the keys of i2t or with those of ROS and OpenCV.

    Args:
        path: Path of the folder.
        others: Further keys of the file with their defaults; None for a required key.

    Returns:
        The lens and the values of the further keys.

    Raises:
        ValueError: The file is missing or invalid; the message names file and field.
        TypeError: The path is neither text nor a path.
    """
    file, own_keys = as_path("path", path) / DESCRIPTION, {field.name for field in fields(Camera)}
    try:
        table = read_toml(file)
    except OSError as error:
        raise ValueError(f"{file} cannot be read ({error.strerror}); {_other_description(file)}") from error
    except DataError as error:
        if _is_yaml_or_json(file):
            raise ValueError(f"{file}: is {NOT_TOML}") from error
        raise
    try:
        table = _with_own_keys(table)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{file}: {error}; see i2t.hardware.camera_folder") from error
    unknown = sorted(set(table) - own_keys - set(others))
    required = [*sorted(own_keys - {"model", "coefficients"})]
    required += [key for key, default in others.items() if default is None]
    missing = [key for key in required if key not in table]
    try:
        if unknown or missing:
            raise ValueError(f"it has the unknown key {unknown[0]}" if unknown else f"{missing[0]!r} is missing")
        lens: Any = {key: value for key, value in table.items() if key in own_keys}
        lens |= {key: float(lens[key]) for key in ("fx", "fy", "cx", "cy")}
        lens["coefficients"] = tuple(float(value) for value in table.get("coefficients", ()))
        return Camera(**lens), {key: table.get(key, default) for key, default in others.items()}
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{file}: {' '.join(str(error).split())}; see i2t.hardware.camera_folder") from error


def _other_description(file: Path) -> str:
    """Remedy for a folder without `camera.toml`: ROS and OpenCV write other files."""
    suffixes = (".yaml", ".yml", ".json", ".xml", ".ini")
    others = sorted(path.name for path in file.parent.glob("*") if path.suffix.lower() in suffixes)
    return f"{others[0]} is {NOT_TOML}" if others else "name a folder of views"


def _is_yaml_or_json(file: Path) -> bool:
    """Test whether a file that is not TOML begins like JSON, or has a key of YAML."""
    text = read_text(file).lstrip()
    return text.startswith(("{", "%YAML", "---")) or re.search(r"^\w+:(\s|$)", text, re.MULTILINE) is not None


def _with_own_keys(table: dict[str, Any]) -> dict[str, Any]:
    """Convert a table with keys of ROS or OpenCV to the keys of `Camera`."""
    own: dict[str, Any] = {}
    matrices: dict[str, list[float]] = {}
    parts: list[tuple[str, Any]] = []
    for key, value in table.items():
        role = FOREIGN_KEYS.get(key)
        if role in ("K", "P", "R"):
            _add(matrices, role, _numbers(key, value), key)
        elif role == "part":
            parts.append((key, value))
        elif role != "text":
            name = role or key
            _add(own, name, _numbers(key, value) if name == "coefficients" else value, key)
    if "K" in matrices:
        for name, number in zip(("fx", "fy", "cx", "cy"), _pinhole("K", matrices["K"]), strict=True):
            _add(own, name, number, "K")
    if any(matrices.get("P", ())):
        _use_projection(own, matrices["P"])
    if any(matrices.get("R", ())) and not np.allclose(matrices["R"], np.eye(3).ravel(), atol=LENS_TOLERANCE):
        raise ValueError("R rotates a rectified image; for a raw image omit R and P")
    for key, value in parts:
        if _is_part(value, (0, 1, own.get("width"), own.get("height"))):
            raise ValueError(f"{key} is {value}, so the image is cropped or binned; give the lens of that image")
    return own


def _add(values: dict[str, Any], name: str, value: Any, key: str) -> None:
    if name in values:
        raise ValueError(f"{key} gives {name} a second time; omit one of them")
    values[name] = value


def _numbers(key: str, value: Any) -> list[float]:
    """Flatten a list, a list of rows, or the `data` of a matrix as OpenCV writes it."""
    if isinstance(value, dict):
        value = value.get("data", ())
    try:
        return np.asarray(value, np.float64).ravel().tolist()
    except (TypeError, ValueError) as error:
        raise ValueError(f"{key} is not a list of numbers; write it like ROS, row after row") from error


def _pinhole(key: str, matrix: list[float]) -> tuple[float, float, float, float]:
    """Extract fx, fy, cx and cy from a camera matrix, by rows or by columns; refuse a matrix with skew."""
    columns = 4 if key == "P" else 3
    if len(matrix) == 3 * columns:
        rows = np.reshape(matrix, (3, columns))[:, :3]
        rows = rows.T if key == "K" and rows[2, :2].any() and not rows[:2, 2].any() else rows
        if rows[2].tolist() == [0, 0, 1] and rows[0, 1] == rows[1, 0] == 0:
            return float(rows[0, 0]), float(rows[1, 1]), float(rows[0, 2]), float(rows[1, 2])
    raise ValueError(f"{key} is {matrix}; give {3 * columns} numbers, fx 0 cx, 0 fy cy, 0 0 1, without skew")


def _is_part(value: Any, whole: tuple[Any, ...]) -> bool:
    """Test whether a region of interest or a binning crops or joins pixels; the values in `whole` do not."""
    if isinstance(value, dict):
        return any(_is_part(part, whole) for part in value.values())
    return value not in whole


def _use_projection(own: dict[str, Any], matrix: list[float]) -> None:
    """Take the lens of a rectified image if the file has no other.

    Refuse a file with a different lens or a distortion for the raw image, because it does not show which of the two
    images the depth belongs to.
    """
    names, rectified = ("fx", "fy", "cx", "cy"), _pinhole("P", matrix)
    if not any(name in own for name in names):
        if any(own.get("coefficients", ())):
            raise ValueError(
                "P is of the rectified image and D of the raw image, and K is missing; for a raw image give K and "
                "no P, for a rectified image no D"
            )
        own.update(zip(names, rectified, strict=True))
    elif not np.allclose([float(own.get(name, math.nan)) for name in names], rectified, rtol=LENS_TOLERANCE):
        raise ValueError(
            "K and P are of two lenses, those of the raw and the rectified image; for a raw image omit P, for a "
            "rectified image give the first three columns of P as K, and no D"
        )


def lens_text(camera: Camera, **others: Any) -> str:
    """Format a camera's lens as TOML that `read_lens` can read.

    Args:
        camera: Lens to format.
        **others: Values of further keys: texts, numbers and lists of them.

    Returns:
        The lines of the file.
    """
    lens = {**asdict(camera), "model": str(camera.model), "coefficients": list(camera.coefficients), **others}
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in lens.items())


def save_views(path: str | Path, camera: Camera, views: Iterable[View]) -> Iterator[View]:
    """Write depth views and their lens to a new folder, as the caller iterates over them.

    Args:
        path: Path of the new folder.
        camera: Lens of the views.
        views: Views with depth in m, which is written in steps of 0.1 mm; above 6.5 m it becomes unmeasured.

    Yields:
        Each view after it has been written.

    Raises:
        FileExistsError: The folder exists already.
        OSError: The folder cannot be written.
    """
    path = Path(path)
    for folder in (path, path / "depth"):
        folder.mkdir(parents=True)
    (path / DESCRIPTION).write_text(lens_text(camera, scale=DEPTH_UNIT_M), "utf-8")
    for number, view in enumerate(views):
        Image.fromarray(to_units(view.depth, DEPTH_UNIT_M)).save(path / "depth" / f"{number:06d}.png")
        if view.colour is not None:
            (path / "colour").mkdir(exist_ok=True)
            Image.fromarray(view.colour).save(path / "colour" / f"{number:06d}.png")
        yield view
