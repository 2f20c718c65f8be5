"""Folders of a depth camera's views: how they are kept and read.

DIR/camera.toml      the lens in pixels (keys of `i2t.depth.camera.Camera`), `scale` of the depth files (metres per
                     unit, or "m" or "mm"), and `encoding`, where it is not "plain"
DIR/depth/NAME.png   16 bits, or .tif; 0 or NaN where nothing was measured (see `i2t.depth.camera.read_depth`)
DIR/colour/NAME.png  8 bits RGB of the same pixels; may be missing
"""

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from i2t.depth.camera import IMAGE_SUFFIXES, Camera, Encoding, check_image, read_depth, read_image
from i2t.files import read_toml
from i2t.hardware.protocols import View

DEPTH_UNIT_M = 1e-4  # of what `save_views` writes: 6.5 m are the most that 16 bits hold
DESCRIPTION = "camera.toml"


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
    files = sorted(each for each in (Path(path) / "depth").glob("*") if each.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise ValueError(f"{Path(path) / 'depth'} holds no views; give a folder with depth/*.png or .tif")
    depth = read_depth(files[0], given["scale"], given["encoding"])
    check_image(depth, camera)
    colour = (Path(path) / "colour" / files[0].name).with_suffix(".png")
    shape = (camera.height, camera.width)
    pixels = read_image(colour, shape=shape, said_by="its depth", mode="RGB") if colour.parent.is_dir() else None
    return camera, View(math.nan, depth, pixels)


def read_lens(path: str | Path, others: dict[str, Any]) -> tuple[Camera, dict[str, Any]]:
    """Read the lens in `camera.toml` of a folder.

    Args:
        path: The folder.
        others: Further keys of the file with their defaults; None for one that must be there.

    Returns:
        The lens, and the values of the further keys.

    Raises:
        ValueError: One sentence that names the file and the field.
    """
    file, known = Path(path) / DESCRIPTION, {each.name for each in fields(Camera)}
    try:
        table = read_toml(file)
    except OSError as error:
        raise ValueError(f"{file} cannot be read ({error.strerror}); name a folder of views") from error
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
        units = np.nan_to_num(np.round(view.depth / DEPTH_UNIT_M), nan=0.0)
        Image.fromarray(np.clip(units, 0, 65535).astype(np.uint16)).save(path / "depth" / f"{number:06d}.png")
        if view.colour is not None:
            (path / "colour").mkdir(exist_ok=True)
            Image.fromarray(view.colour).save(path / "colour" / f"{number:06d}.png")
        yield view
