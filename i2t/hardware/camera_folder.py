"""Folders of a depth camera's views: how they are kept and read.

DIR/camera.toml      the lens in pixels (keys of `i2t.depth.camera.Camera`, or of ROS's camera_info and OpenCV's
                     calibrations), `scale` of the depth files (metres per unit, or "m" or "mm"), and `encoding`, where
                     it is not "plain"
DIR/depth/NAME.png   16 bits, or .tif; 0, 65535 or NaN where nothing was measured (see `i2t.depth.camera.read_depth`)
DIR/colour/NAME.png  8 bits RGB of the same pixels; may be missing
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
    other_size,
    read_depth,
    read_image,
    to_units,
)
from i2t.errors import DataError
from i2t.files.reading import read_text, read_toml
from i2t.files.writing import as_path
from i2t.hardware.protocols import View

DEPTH_UNIT_M = 1e-4  # of what `save_views` writes: 6.5 m are the most that 16 bits hold
DESCRIPTION = "camera.toml"
OTHER_SUFFIXES = (".yaml", ".yml", ".json", ".xml", ".ini")  # of descriptions by other programs
YAML_REMEDY = (
    f"not TOML: write its numbers to {DESCRIPTION}, as KEY = VALUE under the same names (width, height, K, "
    "distortion_model, D), and add the depth's scale"
)
# Names of ROS's camera_info, its calibration files and librealsense, beside those of `Camera`.
OTHER_KEYS = {
    "image_width": "width", "image_height": "height", "ppx": "cx", "ppy": "cy", "distortion_model": "model",
    "D": "coefficients", "d": "coefficients", "coeffs": "coefficients", "distortion_coefficients": "coefficients",
}  # fmt: skip
MATRIX_KEYS = ("K", "k", "camera_matrix", "intrinsic_matrix")  # 3 x 3 matrix of fx, fy, cx and cy
PROJECTION_KEYS = ("P", "p", "projection_matrix")  # 3 x 4 matrix of the rectified image
ROTATION_KEYS = ("R", "r", "rectification_matrix")  # 3 x 3 rotation of the rectification
PART_KEYS = ("roi", "binning_x", "binning_y")  # keys of ROS for cropped or binned images
TEXT_KEYS = ("header", "camera_name", "frame_id")
LENS_TOLERANCE = 1e-3  # largest relative difference between two matrices of one lens


def read_view(path: str | Path) -> tuple[Camera, View]:
    """Read the first view of a folder.

    Args:
        path: The folder.

    Returns:
        The lens, and the view; its time is NaN.

    Raises:
        ValueError: The folder holds no views, or a file is damaged; the message names it.
        OSError: A file cannot be read.
    """
    camera, given = read_lens(path, {"scale": None, "encoding": str(Encoding.PLAIN), "nearest": 0.0})
    scale = metres_per_unit(given["scale"], Path(path) / DESCRIPTION)
    files = sorted(each for each in (Path(path) / "depth").glob("*") if each.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise ValueError(f"{Path(path) / 'depth'} holds no views; give a folder with depth/*.png or .tif")
    depth = read_depth(files[0], scale, given["encoding"])
    if depth.shape != (camera.height, camera.width):
        raise ValueError(f"{files[0]}: {other_size(depth.shape, camera)} ({Path(path) / DESCRIPTION})")
    colour = (Path(path) / "colour" / files[0].name).with_suffix(".png")
    shape = (camera.height, camera.width)
    pixels = read_image(colour, shape=shape, said_by="its depth", mode="RGB") if colour.parent.is_dir() else None
    return camera, View(math.nan, depth, pixels)


def read_lens(path: str | Path, others: dict[str, Any]) -> tuple[Camera, dict[str, Any]]:
    """Read the lens in `camera.toml` of a folder, by i2t's names for its numbers or by those of ROS and OpenCV.

    Args:
        path: The folder.
        others: Further keys of the file with their defaults; None for one that must be there.

    Returns:
        The lens, and the values of the further keys.

    Raises:
        ValueError: One sentence that names the file and the field.
        TypeError: The path is neither text nor a path.
    """
    file, known = as_path("path", path) / DESCRIPTION, {each.name for each in fields(Camera)}
    try:
        table = read_toml(file)
    except OSError as error:
        raise ValueError(f"{file} cannot be read ({error.strerror}); {_other_description(file)}") from error
    except DataError as error:
        if _is_yaml_or_json(file):
            raise ValueError(f"{file}: is {YAML_REMEDY}") from error
        raise
    try:
        table = _own_names(table)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{file}: {error}; see i2t.hardware.camera_folder") from error
    unknown = sorted(set(table) - known - set(others))
    needed = [*sorted(known - {"model", "coefficients"}), *(key for key, default in others.items() if default is None)]
    missing = [key for key in needed if key not in table]
    try:
        if unknown or missing:
            raise ValueError(f"it has the unknown key {unknown[0]}" if unknown else f"{missing[0]!r} is missing")
        lens: Any = {key: value for key, value in table.items() if key in known}
        lens |= {key: float(lens[key]) for key in ("fx", "fy", "cx", "cy")}
        lens["coefficients"] = tuple(float(each) for each in table.get("coefficients", ()))
        return Camera(**lens), {key: table.get(key, default) for key, default in others.items()}
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{file}: {' '.join(str(error).split())}; see i2t.hardware.camera_folder") from error


def _other_description(file: Path) -> str:
    """The remedy where a folder has no `camera.toml`: ROS and OpenCV write other files."""
    others = sorted(each.name for each in file.parent.glob("*") if each.suffix.lower() in OTHER_SUFFIXES)
    return f"{others[0]} is {YAML_REMEDY}" if others else "name a folder of views"


def _is_yaml_or_json(file: Path) -> bool:
    """Test whether a file that is no TOML begins as JSON, or has a key of YAML."""
    text = read_text(file).lstrip()
    return text.startswith(("{", "%YAML", "---")) or re.search(r"^\w+:(\s|$)", text, re.MULTILINE) is not None


def _own_names(table: dict[str, Any]) -> dict[str, Any]:
    """A lens with the keys of `Camera` in place of those of ROS and OpenCV."""
    own: dict[str, Any] = {}
    matrices = {"K": MATRIX_KEYS, "P": PROJECTION_KEYS, "R": ROTATION_KEYS}
    kind_of = {key: kind for kind, keys in matrices.items() for key in keys}
    given: dict[str, list[float]] = {}
    parts: list[tuple[str, Any]] = []
    for key, value in table.items():
        if key in kind_of:
            _add(given, kind_of[key], _numbers(key, value), key)
        elif key in PART_KEYS:
            parts.append((key, value))
        elif key not in TEXT_KEYS:
            name = OTHER_KEYS.get(key, key)
            _add(own, name, _numbers(key, value) if name == "coefficients" else value, key)
    if "K" in given:
        for name, number in zip(("fx", "fy", "cx", "cy"), _pinhole("K", given["K"]), strict=True):
            _add(own, name, number, "K")
    if any(given.get("P", ())):
        _use_projection(own, given["P"])
    if any(given.get("R", ())) and not np.allclose(given["R"], np.eye(3).ravel(), atol=LENS_TOLERANCE):
        raise ValueError("R turns a rectified image; for a raw one leave out R and P")
    for key, value in parts:
        if _is_part(value, (0, 1, own.get("width"), own.get("height"))):
            raise ValueError(f"{key} is {value}, so the image is cropped or binned; give the lens of that image")
    return own


def _add(values: dict[str, Any], name: str, value: Any, key: str) -> None:
    if name in values:
        raise ValueError(f"{key} gives {name} a second time; leave one out")
    values[name] = value


def _numbers(key: str, value: Any) -> list[float]:
    """Numbers of a list, of rows of them, or of the `data` of a matrix as OpenCV writes it."""
    if isinstance(value, dict):
        value = value.get("data", ())
    try:
        return np.asarray(value, np.float64).ravel().tolist()
    except (TypeError, ValueError) as error:
        raise ValueError(f"{key} is not a list of numbers; write it as ROS does, row after row") from error


def _pinhole(key: str, matrix: list[float]) -> tuple[float, float, float, float]:
    """fx, fy, cx and cy of a camera matrix, by rows or by columns; refuses one with skew."""
    columns = 4 if key == "P" else 3
    if len(matrix) == 3 * columns:
        rows = np.reshape(matrix, (3, columns))[:, :3]
        rows = rows.T if key == "K" and rows[2, :2].any() and not rows[:2, 2].any() else rows
        if rows[2].tolist() == [0, 0, 1] and rows[0, 1] == rows[1, 0] == 0:
            return float(rows[0, 0]), float(rows[1, 1]), float(rows[0, 2]), float(rows[1, 2])
    raise ValueError(f"{key} is {matrix}; give {3 * columns} numbers, fx 0 cx, 0 fy cy, 0 0 1, without skew")


def _is_part(value: Any, whole: tuple[Any, ...]) -> bool:
    """Test whether a region of interest or a binning leaves out or joins pixels, by the values that do not."""
    if isinstance(value, dict):
        return any(_is_part(part, whole) for part in value.values())
    return value not in whole


def _use_projection(own: dict[str, Any], matrix: list[float]) -> None:
    """Take the lens of a rectified image where it is the only one; refuse a file with another one for the raw image,
    or with a distortion, which is of that: nothing says which of both the depth is.
    """
    names, rectified = ("fx", "fy", "cx", "cy"), _pinhole("P", matrix)
    if not any(name in own for name in names):
        if any(own.get("coefficients", ())):
            raise ValueError(
                "P is of the rectified image and D of the raw one, and K is missing; for a raw image give its K and no "
                "P, for a rectified one no D"
            )
        own.update(zip(names, rectified, strict=True))
    elif not np.allclose([float(own.get(name, math.nan)) for name in names], rectified, rtol=LENS_TOLERANCE):
        raise ValueError(
            "K and P are of two lenses, of the raw and of the rectified image; for a raw image leave out P, for a "
            "rectified one give the first three columns of P as K, and no D"
        )


def lens_text(camera: Camera, **others: Any) -> str:
    """A lens as lines of TOML, which `read_lens` reads.

    Args:
        camera: The lens.
        **others: Further keys: texts, numbers and lists of them.

    Returns:
        The lines.
    """
    lens = {**asdict(camera), "model": str(camera.model), "coefficients": list(camera.coefficients), **others}
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in lens.items())


def save_views(path: str | Path, camera: Camera, views: Iterable[View]) -> Iterator[View]:
    """Write views to a new folder as they pass.

    Args:
        path: The folder.
        camera: That took them.
        views: Depth in m.

    Yields:
        Each view, once it is written.

    Raises:
        FileExistsError: There is such a folder.
        OSError: It cannot be written.
    """
    path = Path(path)
    for sub in (path, path / "depth"):
        sub.mkdir(parents=True)
    (path / DESCRIPTION).write_text(lens_text(camera, scale=DEPTH_UNIT_M), "utf-8")
    for number, view in enumerate(views):
        Image.fromarray(to_units(view.depth, DEPTH_UNIT_M)).save(path / "depth" / f"{number:06d}.png")
        if view.colour is not None:
            (path / "colour").mkdir(exist_ok=True)
            Image.fromarray(view.colour).save(path / "colour" / f"{number:06d}.png")
        yield view
