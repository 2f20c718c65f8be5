"""Contents of a folder to look at: recorded touches with images and time series, or rows of a data set."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.dataset import Dataset, Record, load_dataset, read_touch
from i2t.depth.camera import Camera
from i2t.errors import DataError
from i2t.files import read_json
from i2t.objects.catalogue import NAMES, make_object
from i2t.objects.named import read_object
from i2t.objects.solids import Mesh

TOUCH_FILES = "touch-*.h5"


class BeliefHistory(NamedTuple):
    """Belief after each touch."""

    names: tuple[str, ...]  # of the candidates
    p: Float[np.ndarray, "touches candidates"]


@dataclass(frozen=True)
class Contents:
    """A session or a data set."""

    path: Path
    dataset: Dataset  # of all touches, chips that did not answer as NaN
    files: tuple[Path, ...]  # of recorded touches, in the order of the data set; empty for other data sets
    mesh: Mesh | None  # of the object, in its own frame
    belief: BeliefHistory | None
    skin: str | None = None  # which of several

    @property
    def simulated(self) -> bool:
        """Tell whether any of it was simulated."""
        return self.dataset.source != "real"

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
    belief: Path | None = None,
    most: int | None = None,
    skin: str | None = None,
) -> Contents:
    """Read the contents of a folder or file.

    Args:
        path: Of recorded touches, or of a data set.
        mesh: Of the object: a name of the catalogue, or a file; by default the name that the touches give, if the
            catalogue knows it.
        unit: Of a mesh file: m, cm, mm or inch; an object of the catalogue needs none.
        belief: A JSON file: `names` of candidates, and `p`, their probabilities after each touch.
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
    believed = None if belief is None else read_belief(belief, len(dataset))
    return Contents(path, dataset, files, _mesh(mesh, unit, dataset), believed, skin=skin)


def _mesh(name: str | None, unit: str | None, dataset: Dataset) -> Mesh | None:
    if name is None:
        known = [each for each in dataset.objects if each in NAMES]
        return make_object(known[0]).mesh if len(dataset.objects) == 1 and known else None
    return read_object(name, unit).mesh


def read_belief(path: Path, touches: int) -> BeliefHistory:
    """Read the belief after each touch.

    Args:
        path: A JSON file with `names` and `p`, or the `result.json` of `experiments.recognize live`, which calls them
            `objects` and `belief`.
        touches: How many there are.

    Returns:
        The belief.

    Raises:
        DataError: The file holds something else.
        OSError: It cannot be read.
    """
    found = read_json(path)
    try:
        keys = ("objects", "belief") if "belief" in found else ("names", "p")
        names, p = tuple(str(name) for name in found[keys[0]]), np.array(found[keys[1]], np.float64)
    except (LookupError, TypeError, ValueError) as error:
        raise DataError(f"{path}: holds no belief ({error}); give names, and p of each after every touch") from error
    if p.shape != (touches, len(names)) or not ((p >= 0) & (p <= 1)).all():
        raise DataError(f"{path}: p has the shape {p.shape}; give {touches} rows of {len(names)} probabilities")
    return BeliefHistory(names, p)


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
