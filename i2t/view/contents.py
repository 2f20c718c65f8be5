"""Contents of a session or data set for viewing.

Times are Unix time where touches were recorded with time series. Other touches are a second apart.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from i2t.dataset import Dataset, Record, Series, holds_simulated, load_dataset, read_touch
from i2t.depth.camera import Camera
from i2t.objects.catalogue import NAMES, make_object
from i2t.objects.named import read_object
from i2t.objects.solids import Mesh


@dataclass(frozen=True)
class Contents:
    """Contents of a session or data set to be shown: its touches, files and the object's mesh."""

    path: Path
    dataset: Dataset  # all touches, with NaN for chips that did not answer
    files: tuple[Path, ...]  # files of recorded touches in the order of the data set; empty for other data sets
    mesh: Mesh | None  # mesh of the object in its own frame
    skin: str | None = None  # name of the shown skin, if there are several

    @property
    def simulated(self) -> bool:
        """Whether any of the touches are simulated."""
        return holds_simulated(self.dataset.source)

    def record(self, row: int) -> Record:
        """Read the record of a touch.

        Args:
            row: Index of the touch.

        Returns:
            The record. Images and series are missing if they were not recorded.
        """
        return read_touch(self.files[row]).of_skin(self.skin) if self.files else Record(self.dataset.select([row]))

    def records(self) -> Iterator[Record]:
        """Yield the record of each touch."""
        return map(self.record, range(len(self.dataset)))


def read_contents(
    path: str | Path,
    *,
    mesh: str | None = None,
    unit: str | None = None,
    max_touches: int | None = None,
    skin: str | None = None,
) -> Contents:
    """Read the contents of a session or data set.

    Args:
        path: Folder of recorded touches, or path of a data set.
        mesh: Mesh of the object: a name in the catalogue, or a file. By default, the name that the touches give, if the
            catalogue has it.
        unit: Unit of a mesh file (m, cm, mm or inch). Objects of the catalogue need none.
        max_touches: Maximum number of touches to read, from the first on; all by default.
        skin: Name of the skin, if several were read in each touch.

    Returns:
        The contents, for `write_page` and `write_recording`.

    Raises:
        DataError: There are no touches, a file is damaged, or there are several skins and none is named.
        ValueError: The mesh cannot be read.
    """
    path = Path(path)
    dataset = load_dataset(path, missing_chips=True, skin=skin)
    files = tuple(sorted(path.glob("touch-*.h5"))) if path.is_dir() else ()
    if len(files) != len(dataset):
        files = ()  # a packed set, or touches next to other files
    if max_touches is not None:
        dataset, files = dataset.select(np.arange(min(max_touches, len(dataset)))), files[:max_touches]
    only = dataset.objects[0] if len(dataset.objects) == 1 else None
    name = only if mesh is None and only in NAMES else mesh
    return Contents(path, dataset, files, None if name is None else read_object(name, unit).mesh, skin=skin)


def mesh_of(contents: Contents, row: int) -> Mesh | None:
    """Find the mesh of the object of a touch.

    Args:
        contents: The session or data set.
        row: Index of the touch.

    Returns:
        The mesh that was given for all touches, or that of the catalogue; None if there is neither.
    """
    touched = contents.dataset.objects[contents.dataset.touches.object[row]]
    if contents.mesh is not None or touched not in NAMES:
        return contents.mesh
    return _catalogue_mesh(touched)


_catalogue_mesh = cache(lambda name: make_object(name).mesh)


def readings_of(number: int, record: Record) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n c"]]:
    """Read the readings of a touch, with the ambient subtracted.

    Args:
        number: Index of the touch.
        record: Record of the touch.

    Returns:
        `(n,)` times (s) and `(n, c)` readings (uT) of all n samples, three channels for each chip; n is 1, for the
        final reading, if no series was recorded.
    """
    if "tactile" not in record.series:
        return np.array([span(number, record)[0]]), np.asarray(record.touch.touches.reading[:1], float)
    tactile, kept = record.series["tactile"], record.series.get("ambient")
    ambient = kept.values[0] if kept is not None and len(kept.values) else 0.0
    return tactile.time, tactile.values - ambient


def span(number: int, record: Record) -> tuple[float, float]:
    """Find the times at which a touch begins and ends.

    Args:
        number: Index of the touch.
        record: Record of the touch.

    Returns:
        Unix times (s) of the beginning and the end. Both are the touch's index if no time was recorded.
    """
    recorded: list[Series] = [series for series in record.series.values() if len(series.time)]
    times = [float(series.time[i]) for series in recorded for i in (0, -1)] + [when for when, _ in record.events]
    return (min(times), max(times)) if times else (float(number),) * 2


def camera_of(dataset: Dataset) -> Camera | None:
    """Read the lens of the depth camera from a data set's metadata.

    Args:
        dataset: The data set.

    Returns:
        The camera, or None if the recording did not store it.
    """
    try:
        values = json.loads(dataset.meta["camera"])
        return Camera(**{**values, "coefficients": tuple(values["coefficients"])})
    except (LookupError, TypeError, ValueError, RecursionError):
        return None
