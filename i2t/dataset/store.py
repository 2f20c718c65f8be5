"""Files of data sets and recorded touches: `save_dataset` packs many touches into one file, `write_touch` records one
touch, and `load_dataset` reads files and folders of both.

All files contain the same groups (docs/data.md). A recorded touch adds images, time series, events and counters. If
several skins were read in a touch, the touch of the skin at the tool is stored where every file has its touches, and
the touch of each further skin in the same groups below `skins/NAME`, which earlier readers ignore. A data set holds
touches of one skin, which is selected by name (`skin=`) if there are several.
"""

import math
import secrets
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np

from i2t._version import __version__
from i2t.dataset.card import CARD
from i2t.dataset.files import ENDING, verified, write
from i2t.dataset.sets import Dataset, concatenate, missing_views, validate
from i2t.errors import DataError
from i2t.files.reading import explain_no_dataset
from i2t.files.writing import as_path
from i2t.models import ready_hint, ready_path
from i2t.types import Board, Touches, Truth

# Units that a file of touches states for its fields.
FIELD_UNITS = {
    **dict.fromkeys(("patch", "view", "nearest", "travel", "indentation"), "m"),
    "reading": "uT",
    "force": "N",
    **dict.fromkeys(("T_w_t", "T_w_o"), "1 (rotation), m (translation)"),
    **dict.fromkeys(("object", "pad", "session", "code"), "1"),
    "time": "s",
}
# Names of fields and attributes in files of earlier schema versions, by their present names.
EARLIER_NAMES = {
    "session": "run", "sessions": "runs",  # schema version 1
    "travel": "depth", "view": "wide", "view_pixels": "wide_pixels",  # schema versions 1 and 2
}  # fmt: skip

# Time series of the skin on the tool that a file holds for a touch. A further skin's have its name appended.
SKIN_SERIES = ("tactile", "temperature", "ambient", "ambient_predicted")
SKIN_NAME = "skin name"  # key, in `Dataset.meta`, of the name of the touches' skin, if there were several skins

T = TypeVar("T")


class SkinChoiceError(DataError):
    """No skin was named although a touch has several, or the named skin is unknown. The message names no file."""


class BadFileWarning(UserWarning):
    """Warning that names the files and touches that `load_dataset(..., skip_bad=True)` left out."""


@dataclass(frozen=True)
class Image:
    """A depth or colour image of one touch as the camera delivered it: integers, which times `scale` are in `unit`."""

    values: np.ndarray  # (rows, columns) or (rows, columns, channels), integers
    scale: float = 1.0
    unit: str = "1"


@dataclass(frozen=True)
class Series:
    """A recorded time series of one touch: Unix times (s) of n samples, and k columns of values in one unit."""

    time: np.ndarray  # (n,) s, Unix time
    values: np.ndarray  # (n, k) values of the columns
    columns: tuple[str, ...]  # names of the k columns
    unit: str


@dataclass(frozen=True)
class Record:
    """Everything that was recorded of one touch: its measurements, images, time series, events with Unix times (s),
    counts, and the touches of further skins.
    """

    touch: Dataset  # data set that holds one touch
    images: Mapping[str, Image] = field(default_factory=dict)
    series: Mapping[str, Series] = field(default_factory=dict)
    events: tuple[tuple[float, str], ...] = ()  # (Unix time in s, description)
    counters: Mapping[str, int] = field(default_factory=dict)  # counts, such as that of dropped frames
    skins: Mapping[str, Dataset] = field(default_factory=dict)  # the touch of each further skin, by the skin's name

    @property
    def skin_names(self) -> tuple[str, ...]:
        """Names of all skins. The first is the skin at the tool, whose name may be empty."""
        return (self.touch.meta.get(SKIN_NAME, ""), *self.skins)

    def of_skin(self, name: str | None = None) -> "Record":
        """Select the part of a touch's record that belongs to one of several skins, as if it had been the only one.

        Args:
            name: Name of the skin. It may be omitted if there is only one.

        Returns:
            The record, with the series named as those of a single skin.

        Raises:
            DataError: There are several skins and none is named, or the named one does not exist.
        """
        selected = _selected_skin(self.skin_names, name)
        others = {f"{label} {other}" for other in self.skins for label in SKIN_SERIES}
        series = {label: samples for label, samples in self.series.items() if label not in others}
        if selected in self.skins:
            own = {label: f"{label} {selected}" for label in SKIN_SERIES}
            series = {label: samples for label, samples in series.items() if label not in SKIN_SERIES}
            series |= {label: self.series[full] for label, full in own.items() if full in self.series}
        return replace(self, touch=self.skins.get(selected, self.touch), series=series, skins={})


def save_dataset(path: str | Path, dataset: Dataset) -> Path:
    """Write a data set to one packed HDF5 file, completely or not at all.

    Args:
        path: Path of the file, ending in .h5. An existing file is replaced.
        dataset: Touches of one board with any number of chips.

    Returns:
        The path of the file.

    Raises:
        DataError: `validate` refuses the data set, or the file cannot be written.

    Example:
        i2t.save_dataset("touches.h5", dataset)
    """
    path = Path(path)
    if path.suffix != ENDING:
        raise DataError(f"{path}: the name of a packed data set must end in {ENDING}; rename the file")
    _check(path, dataset)
    return write(path, lambda file: _put_dataset(file, dataset))


def write_touch(folder: str | Path, record: Record, at: float | None = None) -> Path:
    """Record one touch in a new file. When this returns, the touch survives a killed process or a power cut.

    Args:
        folder: Folder for the file.
        record: Record of one touch.
        at: Unix time (s) that names the file; now by default.

    Returns:
        The path of the file, whose name holds the time in UTC.

    Raises:
        DataError: The record is invalid, or the file cannot be written.
    """
    time = datetime.now(UTC) if at is None else datetime.fromtimestamp(at, UTC)
    name = f"touch-{time:%Y%m%dT%H%M%S.%f}Z-{secrets.token_hex(3)}{ENDING}"
    path = Path(folder) / name
    if len(record.touch) != 1:
        raise DataError(f"{path}: a record holds {len(record.touch)} touches, not 1; record each touch separately")
    for touch in (record.touch, *record.skins.values()):
        _check(path, touch)
    if record.skins and (len(set(record.skin_names)) <= len(record.skins) or not all(record.skin_names)):
        names = record.skin_names
        raise DataError(f"{path}: the names of the skins, {names}, must be distinct and not empty; name each skin")
    for label, series in record.series.items():
        if series.values.ndim != 2 or series.values.shape != (len(series.time), len(series.columns)):
            raise DataError(
                f"{path}: series {label} has values of shape {series.values.shape} for {len(series.time)} times and"
                f" {len(series.columns)} columns; give one row per time and one name per column"
            )

    def fill(file: h5py.File) -> None:
        _put_dataset(file, record.touch)
        for label, image in record.images.items():
            item = _put(file, f"images/{label}", image.values, image.unit)
            item.attrs["scale"] = image.scale
        for label, series in record.series.items():
            _put(file, f"series/{label}/time", np.asarray(series.time, np.float64), "s (Unix time)")
            item = _put(file, f"series/{label}/values", series.values, series.unit)
            item.attrs["columns"] = list(series.columns)
        _put(file, "events/time", np.array([time for time, _ in record.events], np.float64), "s (Unix time)")
        _put(file, "events/text", _text([text for _, text in record.events]), "1")
        for label, count in record.counters.items():
            _put(file, f"counters/{label}", np.int64(count), "1")
        for name, touch in record.skins.items():
            _put_dataset(file.create_group(f"skins/{name}"), touch)

    return write(path, fill)


def read_touch(path: str | Path) -> Record:
    """Read everything that was recorded of one touch from the file that `write_touch` wrote.

    Args:
        path: Path of the file. A packed file of one touch is read as a record without images and series.

    Returns:
        The record of the touch.

    Raises:
        DataError: The file is missing or damaged, or does not hold exactly one touch.
    """
    path = Path(path)

    def get(file: h5py.File) -> Record:
        groups: dict[str, Any] = {name: file.get(name, {}) for name in ("images", "series", "counters")}
        times, texts = (file["events/time"][()], file["events/text"].asstr()[()]) if "events" in file else ((), ())
        return Record(
            touch=_get_dataset(file),
            images={
                k: Image(v[()], float(v.attrs["scale"]), str(v.attrs["units"])) for k, v in groups["images"].items()
            },
            series={
                k: Series(
                    v["time"][()], v["values"][()], tuple(v["values"].attrs["columns"]), str(v["values"].attrs["units"])
                )
                for k, v in groups["series"].items()
            },
            events=tuple((float(time), str(text)) for time, text in zip(times, texts, strict=True)),
            counters={k: int(v[()]) for k, v in groups["counters"].items()},
            skins={name: _get_dataset(group) for name, group in file.get("skins", {}).items()},
        )

    record = _read(path, get)
    if len(record.touch) != 1:
        raise DataError(f"{path}: holds {len(record.touch)} touches, not 1; read it with load_dataset")
    for touch in (record.touch, *record.skins.values()):
        _check(path, touch)
    return record


def load_dataset(
    path: str | Path, *, skip_bad: bool = False, missing_chips: bool = False, skin: str | None = None
) -> Dataset:
    """Read a data set from a packed file, a file of one recorded touch, or a folder of these with its subfolders.

    Touches are in the order of the files' names, which is that of time for recorded touches. Hidden files, such as
    temporary files of an interrupted writer, index.json and the card README.md are ignored.

    Args:
        path: Path of a file or folder, or the name of a ready data set: "nominal" (`i2t.models`), of one simulated pad.
        skip_bad: Whether to leave out unusable files and touches in which a chip did not answer. A BadFileWarning names
            them.
        missing_chips: Whether to keep touches in which a chip did not answer. Its values are NaN, which the caller must
            handle.
        skin: Name of the skin whose touches are read, if several were read in each touch.

    Returns:
        One data set of all touches.

    Raises:
        DataError: Files are unusable and `skip_bad` is not set (one sentence names the first ones), no touch is left,
            chips are missing and neither switch is set, the files' boards, windows or reaches differ, or there are
            several skins and none is named.

    Example:
        touches = i2t.load_dataset("data/mug").touches
    """
    hint = ready_hint(path, "touches.h5", list_all=False)
    path = ready_path(str(as_path("path", path)), "touches.h5")
    files = _files(path, hint)
    good: list[Dataset] = []
    bad: list[str] = []
    for file in files:
        try:
            dataset = _read(file, partial(_get_skin, skin=skin))
            _check(file, dataset)
            good.append(dataset)
        except SkinChoiceError as error:
            raise SkinChoiceError(f"{file}: {error}") from None
        except DataError as error:
            bad.append(str(error))
    if bad and not (skip_bad and good):
        remedy = (
            "no file is left to read"
            if skip_bad
            else "repair these files, or leave them out (skip_bad=True, or --skip-bad where a command has it)"
        )
        named = 5  # of the unusable files
        more = [f"and {len(bad) - named} more"] if len(bad) > named else []
        raise DataError(
            f"{len(bad)} of {len(files)} files of {path} cannot be used: {' | '.join([*bad[:named], *more, remedy])}"
            if path.is_dir()
            else explain_no_dataset(path) or bad[0]
        )
    if bad:
        message = f"{len(bad)} of {len(files)} files of {path} were left out: {' | '.join(bad)}"
        warnings.warn(message, BadFileWarning, stacklevel=2)
    try:
        whole = concatenate(good)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    return whole if missing_chips else _with_all_chips(path, whole, skip_bad)


def _with_all_chips(path: Path, dataset: Dataset, skip_bad: bool) -> Dataset:
    """Select the touches in which every chip answered. Raise DataError if others exist, unless they may be left out."""
    fields = dataset.touches.reading.reshape(len(dataset), len(dataset.board.chips), 3)
    silent = np.isnan(fields).any(2)
    incomplete = silent.any(1)
    if not incomplete.any():
        return dataset
    counts = ", ".join(f"chip {chip} in {count}" for chip, count in enumerate(silent.sum(0)) if count)
    problem = f"{path}: chips did not answer in {incomplete.sum()} of {len(dataset)} touches ({counts})"
    if not skip_bad or incomplete.all():
        raise DataError(f"{problem}, but methods need all chips; i2t convert pack --skip-bad leaves such touches out")
    warnings.warn(f"{problem}; these touches were left out", BadFileWarning, stacklevel=3)
    return dataset.select(~incomplete)


def _files(path: Path, hint: str) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise DataError(f"{path}: no such file or folder{hint or '; check the path'}")
    files = [
        file
        for file in sorted(path.rglob("*"))
        if file.is_file()
        and file.name not in ("index.json", CARD)  # earlier versions wrote an index next to touches
        and not any(part.startswith(".") for part in file.relative_to(path).parts)
    ]
    if not files:
        raise DataError(f"{path}: holds no touches; record touches, or convert a data set with i2t convert")
    return files


def _check(path: Path, dataset: Dataset) -> None:
    try:
        validate(dataset)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _read(path: Path, get: Callable[[h5py.File], T]) -> T:
    """Apply `get` to a verified file. Another program may have written it with a valid digest and wrong contents."""
    with verified(path) as file:
        try:
            return get(file)
        except DataError:
            raise
        except (LookupError, AttributeError, ValueError, TypeError, OSError, RuntimeError, ArithmeticError) as error:
            reason = error.args[0] if error.args else type(error).__name__
            raise DataError(
                f"{path}: does not follow the schema ({reason}); write it with i2t.dataset.save_dataset"
            ) from error


def _put_dataset(file: h5py.Group, dataset: Dataset) -> None:
    touches = dataset.touches
    file.attrs["source"] = dataset.source
    file.attrs["software"] = f"i2t {__version__}"
    file.attrs["created"] = datetime.now(UTC).isoformat(timespec="microseconds")
    _put(file, "window", np.float64(dataset.window), "m")
    _put(file, "reach", np.float64(dataset.reach), "m")
    for key, text in dataset.meta.items():
        _put(file, f"meta/{key}", text, "1")
    for kind in ("objects", "pads", "sessions"):
        _put(file, f"names/{kind}", _text(getattr(dataset, kind)), "1")
    _put(file, "board/chips", dataset.board.chips, "m")
    _put(file, "board/rotations", dataset.board.rotations, "1")
    for name, values in touches._asdict().items():
        if name != "truth" and values is not None and not (name == "view" and np.isnan(values).all()):
            _put(file, f"touches/{name}", values, FIELD_UNITS[name])
    for name, values in touches.truth._asdict().items() if touches.truth is not None else ():
        _put(file, f"truth/{name}", values, FIELD_UNITS[name])
    file["touches"].attrs["view_pixels"] = touches.view.shape[-1]


def _get_skin(file: h5py.File, skin: str | None) -> Dataset:
    """Read the touches of one skin. Raise SkinChoiceError if the choice is unclear."""
    own = str(file["meta"][SKIN_NAME].asstr()[()]) if SKIN_NAME in file.get("meta", {}) else ""
    selected = _selected_skin((own, *file.get("skins", {})), skin)
    return _get_dataset(file if selected == own else file["skins"][selected])


def _selected_skin(names: tuple[str, ...], requested: str | None) -> str:
    """Find the name of the selected skin. Raise SkinChoiceError if the choice is unclear."""
    if requested is None and len(names) == 1:
        return names[0]
    listed = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
    if requested is None:
        raise SkinChoiceError(
            f"holds touches of {len(names)} skins, {listed}; name one with --skin-name (skin= of load_dataset; "
            "i2t convert pack --skin-name makes a set of one skin)"
        )
    if requested not in names or not requested:
        has = f"the skin {listed}" if names != ("",) else "one skin without a name"
        remedy = "name one of these" if names != ("",) else "leave out --skin-name"
        raise SkinChoiceError(f"has no skin {requested!r} but {has}; {remedy}")
    return requested


def _get_dataset(file: h5py.Group) -> Dataset:
    group = file["touches"]
    columns = {name: group[_stored(group, name)][()] for name in Touches._fields if _stored(group, name) in group}
    if "view" not in columns:
        pixels = group.attrs[_stored(group.attrs, "view_pixels")]
        columns["view"] = missing_views(len(columns["reading"]), int(pixels))
    if "truth" in file:
        truth = file["truth"]
        columns["truth"] = Truth(**{name: truth[_stored(truth, name)][()] for name in Truth._fields})
    return Dataset(
        touches=Touches(**columns),
        **{
            kind: tuple(file["names"][_stored(file["names"], kind)].asstr()[()])
            for kind in ("objects", "pads", "sessions")
        },
        board=Board(file["board/chips"][()], file["board/rotations"][()]),
        source=str(file.attrs["source"]),
        window=float(file["window"][()]),
        reach=float(file["reach"][()]),
        meta={key: str(item.asstr()[()]) for key, item in file.get("meta", {}).items()},
    )


def _stored(group: Mapping[str, Any], name: str) -> str:
    """Find the name that a file has for a field, a list of names or an attribute, which may be `EARLIER_NAMES`'s."""
    return name if name in group else EARLIER_NAMES.get(name, name)


def _put(file: h5py.Group, name: str, values: Any, unit: str) -> h5py.Dataset:
    """Store an array with its unit. A large one is compressed (gzip 1) in chunks of rows."""
    options: dict[str, Any] = {}
    if isinstance(values, np.ndarray) and values.nbytes > 4096 and values.dtype != object:
        rows = 64 if values.ndim == 3 else math.ceil(2**18 / max(values[:1].nbytes, 1))
        options = {"compression": "gzip", "compression_opts": 1, "chunks": (min(len(values), rows), *values.shape[1:])}
    item = file.create_dataset(name, data=values, **options)
    item.attrs["units"] = unit
    return item


def _text(texts: Any) -> np.ndarray:
    return np.array(list(texts), h5py.string_dtype())
