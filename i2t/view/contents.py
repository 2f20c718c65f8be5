"""Contents of a folder to look at, as one list that every writer shows: recorded touches, or rows of a data set.

Times are Unix time where touches were recorded with their series; other touches are a second apart.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from i2t.dataset import Dataset, Record, Series, holds_simulated, load_dataset, read_touch
from i2t.depth.camera import Camera
from i2t.objects.catalogue import NAMES, make_object
from i2t.objects.named import read_object
from i2t.objects.solids import Mesh

TOUCH_FILES = "touch-*.h5"
SHOWN_HZ = 30.0  # of poses and field vectors; numbers have every sample
SECONDS_A_TOUCH = 1.0  # of touches without times of their own
AXES = ("x", "y", "z")

Times: TypeAlias = Float[np.ndarray, " n"]  # s


class Poses(NamedTuple):
    """Where a frame is in the world."""

    frame: str  # object, tool or camera
    time: Times
    T: Float[np.ndarray, "n 4 4"]  # m


class Numbers(NamedTuple):
    """Numbers that change with time; NaN where one is not known."""

    place: str  # readings (uT less the ambient), temperature (degrees Celsius), force (N) or torque (Nm)
    names: tuple[str, ...]
    time: Times
    values: Float[np.ndarray, "n names"]


class Field(NamedTuple):
    """Readings as vectors at the chips."""

    time: Times
    vectors: Float[np.ndarray, "n chips 3"]  # uT, tool axes


class Picture(NamedTuple):
    """A depth image or a patch."""

    place: str  # depth or patch
    frame: str  # in which it was taken
    time: float  # s
    metres: Float[np.ndarray, "rows columns"]


class Events(NamedTuple):
    """What happened."""

    time: Times
    texts: tuple[str, ...]


Item: TypeAlias = Poses | Numbers | Field | Picture | Events


@dataclass(frozen=True)
class Contents:
    """A session or a data set."""

    path: Path
    dataset: Dataset  # of all touches, chips that did not answer as NaN
    files: tuple[Path, ...]  # of recorded touches, in the order of the data set; empty for other data sets
    mesh: Mesh | None  # of the object, in its own frame
    skin: str | None = None  # which of several

    @property
    def simulated(self) -> bool:
        """Tell whether any of it was simulated."""
        return holds_simulated(self.dataset.source)

    def records(self) -> Iterator[Record]:
        """The touches one after the other; without images and series where these were not recorded."""
        if self.files:
            for file in self.files:
                yield read_touch(file).of_skin(self.skin)
        else:
            for row in range(len(self.dataset)):
                yield Record(self.dataset.select([row]))


def read_contents(
    path: str | Path,
    *,
    mesh: str | None = None,
    unit: str | None = None,
    most: int | None = None,
    skin: str | None = None,
) -> Contents:
    """Read the contents of a folder or file.

    Args:
        path: Of recorded touches, or of a data set.
        mesh: Of the object: a name of the catalogue, or a file; by default the name that the touches give, if the
            catalogue knows it.
        unit: Of a mesh file: m, cm, mm or inch; an object of the catalogue needs none.
        most: Touches that are looked at, the first ones; by default all.
        skin: Name of the skin, where several were read in each touch.

    Returns:
        The contents.

    Raises:
        DataError: There are no touches, a file is damaged, or there are several skins and none is named.
        ValueError: The mesh cannot be read.
    """
    path = Path(path)
    dataset = load_dataset(path, missing_chips=True, skin=skin)
    files = tuple(sorted(path.glob(TOUCH_FILES))) if path.is_dir() else ()
    if len(files) != len(dataset):
        files = ()  # a packed set, or one with others next to it
    if most is not None:
        dataset, files = dataset.select(np.arange(min(most, len(dataset)))), files[:most]
    return Contents(path, dataset, files, _mesh(mesh, unit, dataset), skin=skin)


def _mesh(name: str | None, unit: str | None, dataset: Dataset) -> Mesh | None:
    if name is None:
        known = [each for each in dataset.objects if each in NAMES]
        return make_object(known[0]).mesh if len(dataset.objects) == 1 and known else None
    return read_object(name, unit).mesh


def items(contents: Contents, number: int, record: Record) -> Iterator[Item]:
    """All that there is to show of a touch.

    Args:
        contents: Of which it is one.
        number: Of the touch.
        record: Of the touch.

    Yields:
        Each thing that was recorded or kept of it.
    """
    touches, series, board = record.touch.touches, record.series, contents.dataset.board
    start, end = span(number, record)
    known, at = np.array([start]), np.array([end])
    yield Poses("object", known, np.asarray(touches.T_w_o[:1], float))
    if "pose" in series:
        rows = _thinned(series["pose"].time)
        yield Poses("tool", series["pose"].time[rows], series["pose"].values[rows].reshape(-1, 4, 4))
    yield Poses("tool", at, np.asarray(touches.T_w_t[:1], float))
    yield Picture("patch", "tool", start, np.asarray(touches.patch[0], np.float32))
    if "camera" in series and len(series["camera"].values):
        yield Poses("camera", known, series["camera"].values[:1].reshape(1, 4, 4))
    if "depth" in record.images:
        image = record.images["depth"]
        yield Picture("depth", "camera", start, (image.values * image.scale).astype(np.float32))
    time, readings = readings_of(number, record)
    names = tuple(f"chip{chip}/{axis}" for chip in range(board.num_chips) for axis in AXES)
    yield Numbers("readings", names, time, readings)
    rows = _thinned(time)
    times, shown = np.append(time[rows], end), np.concatenate([readings[rows], np.asarray(touches.reading[:1], float)])
    yield Field(times, np.nan_to_num(np.stack([board.to_tool(reading) for reading in shown])))
    if "temperature" in series:
        chips = tuple(f"chip{chip}" for chip in range(board.num_chips))
        yield Numbers("temperature", chips, series["temperature"].time, series["temperature"].values)
    if "wrench" in series:
        yield Numbers("force", AXES, series["wrench"].time, series["wrench"].values[:, :3])
        yield Numbers("torque", AXES, series["wrench"].time, series["wrench"].values[:, 3:])
    else:
        yield Numbers("force", ("normal",), known, np.asarray(touches.force[:1, None], float))
    if record.events:
        yield Events(np.array([when for when, _ in record.events]), tuple(text for _, text in record.events))


def readings_of(number: int, record: Record) -> tuple[Times, Float[np.ndarray, "n c"]]:
    """Readings of a touch, less its ambient.

    Args:
        number: Of the touch.
        record: Of the touch.

    Returns:
        Times and every sample (uT); the touch's one reading where nobody kept them.
    """
    if "tactile" not in record.series:
        return np.array([span(number, record)[0]]), np.asarray(record.touch.touches.reading[:1], float)
    tactile, kept = record.series["tactile"], record.series.get("ambient")
    ambient = kept.values[0] if kept is not None and len(kept.values) else 0.0
    return tactile.time, tactile.values - ambient


def span(number: int, record: Record) -> tuple[float, float]:
    """Times at which a touch begins and ends.

    Args:
        number: Of the touch.
        record: Of the touch.

    Returns:
        Unix time in s; from its number where nobody kept the time.
    """
    recorded: list[Series] = [series for series in record.series.values() if len(series.time)]
    times = [float(series.time[i]) for series in recorded for i in (0, -1)] + [when for when, _ in record.events]
    return (min(times), max(times)) if times else (SECONDS_A_TOUCH * number,) * 2


def _thinned(time: np.ndarray) -> np.ndarray:
    """Rows of a series at about `SHOWN_HZ`."""
    if not len(time):
        return np.zeros(0, np.int64)
    slots = np.floor((time - time[0]) * SHOWN_HZ).astype(np.int64)
    return np.unique(slots, return_index=True)[1]


def camera_of(dataset: Dataset) -> Camera | None:
    """The depth camera's lens, which recorded touches keep.

    Args:
        dataset: Of touches.

    Returns:
        The camera; None where it was not kept.
    """
    try:
        said = json.loads(dataset.meta["camera"])
        return Camera(**{**said, "coefficients": tuple(said["coefficients"])})
    except (LookupError, TypeError, ValueError, RecursionError):
        return None
