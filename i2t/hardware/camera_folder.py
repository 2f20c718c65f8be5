"""A folder of recorded views as a depth camera, one after the other; and how to keep views in one.

    DIR/camera.toml      the lens in pixels (keys of `i2t.depth.camera.Camera`), `scale` of the depth files (metres per
    unit,
                         or "m" or "mm"), and, where they differ from these, `encoding` = "plain", `nearest` = 0 (m)
    DIR/depth/NAME.png   16 bits, or .tif; 0 or NaN where nothing was measured (see `i2t.depth.camera.read_depth`)
    DIR/colour/NAME.png  8 bits RGB of the same pixels; may be missing

Views come in the order of their names. Once all were given, or a file is missing or damaged, `capture` says so.
"""

import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from i2t.depth.camera import IMAGE_SUFFIXES, Camera, Encoding, check_image, read_depth, read_image
from i2t.errors import DeviceError
from i2t.files import read_toml
from i2t.hardware.base import CameraBase
from i2t.hardware.protocols import CameraFeatures, View
from i2t.types import Array

DEPTH_UNIT_M = 1e-4  # of what `save_views` writes: 6.5 m are the most that 16 bits hold
DESCRIPTION = "camera.toml"
NOMINAL_RATE_HZ = 30.0


class RecordedDepthCamera(CameraBase):
    """Recorded views as a camera (`i2t.hardware.protocols.DepthCamera`).

    Args:
        path: Folder of the views.
        loop: Begin again where they end.
    """

    def __init__(self, path: str | Path, loop: bool = False) -> None:
        super().__init__(CameraFeatures(f"the folder {path}", "folder", 0.0, NOMINAL_RATE_HZ))
        self._path, self._loop = Path(path), loop
        self._names: list[str] | None = None
        self._next = 0

    def connect(self) -> None:
        """Read what the folder holds, and begin with its first view; raises DeviceError."""
        self.close()
        try:
            self._camera, given = read_lens(
                self._path, {"scale": None, "encoding": str(Encoding.PLAIN), "nearest": 0.0}
            )
            self._features = self._features._replace(nearest=float(given["nearest"]))
        except (TypeError, ValueError) as error:
            raise DeviceError(str(error)) from error
        self._scale, self._encoding = given["scale"], given["encoding"]
        names = sorted(each.name for each in (self._path / "depth").glob("*") if each.suffix.lower() in IMAGE_SUFFIXES)
        if not names:
            raise DeviceError(f"{self._path / 'depth'} holds no views; give a folder with depth/*.png or .tif")
        self._names, self._next = names, 0

    def close(self) -> None:
        """Stop giving views."""
        self._names = None

    def capture(self, timeout: float = 2.0) -> View:
        """The next view, as in `DepthCamera.capture`, without waiting.

        Raises:
            DeviceError: There is none left, or its file is damaged.
        """
        if self._names is None:
            raise self._not_connected()
        if self._next >= len(self._names) and not self._loop:
            raise DeviceError(f"{self._name} has given all its views; connect again for the first")
        view = View(time.monotonic(), *self._read(self._names[self._next % len(self._names)]))
        self._next += 1
        return view

    def _read(self, name: str) -> tuple[Array, Array | None]:
        path = self._path / "depth" / name
        colours = self._path / "colour"
        try:
            depth = read_depth(path, self._scale, self._encoding)
            check_image(depth, self.camera)
            if not colours.is_dir():
                return depth, None
            path = (colours / name).with_suffix(".png")
            colour = read_image(path, shape=(self.camera.height, self.camera.width), said_by="its depth", mode="RGB")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error).removeprefix(f"{path}: ")
            raise DeviceError(f"{self._name} cannot give {path.name}: {reason}; restore {path}") from error
        return depth, colour


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
