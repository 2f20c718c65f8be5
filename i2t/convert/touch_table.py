"""Touches as a table that any program reads: a folder with touches.csv, its pictures as plain arrays, and set.json.

touches.csv has a row for each touch, with all its numbers in SI units but readings, which are in microtesla (`b0x_uT`,
`b0y_uT`, `b0z_uT`, `b1x_uT` ...), and the names of object, pad and session; a value that was not measured is empty.
patch.npy, wide.npy and truth_wide.npy are (n, pixels, pixels) float32 in metres. set.json says what holds for all.
Numbers are printed with as many digits as float32 needs to come back as it was.
"""

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from i2t import files
from i2t.convert.exchange import NAME_LISTS, columns_of, dataset_of, write_folder
from i2t.dataset import Dataset
from i2t.dataset.sets import AXIS_NAMES, INDICES
from i2t.errors import DataError
from i2t.files import file_in

TABLE, NOTE = "touches.csv", "set.json"
POSES = ("T_w_t", "T_w_o")
UNIT_OF = {
    "nearest": "m",
    "force": "N",
    "depth": "m",
    "truth_nearest": "m",
    "truth_force": "N",
    "truth_indentation": "m",
    "time": "s",
}
OPTIONAL_COLUMNS = ("truth_", "time")  # beginnings of the names that a table may lack
MAX_TABLE_BYTES = 2**30


def write(target: Path, dataset: Dataset, *, overwrite: bool = False) -> Path:
    """Write a data set as a table with its pictures.

    Args:
        target: Folder to make.
        dataset: Touches.
        overwrite: Whether an earlier export is replaced.

    Returns:
        The folder.

    Raises:
        DataError: Something is there already, or it cannot be written.
    """

    def fill(folder: Path) -> None:
        columns = columns_of(dataset)
        flat: dict[str, list[str]] = {}
        for name, values in columns.items():
            if values.ndim == 3 and name not in POSES:
                np.save(folder / f"{name}.npy", values, allow_pickle=False)
            elif name in ("object", "pad", "session"):
                names = getattr(dataset, name + "s")
                flat[name] = [names[i] for i in values]
            else:
                flat |= _flat(name, values)
        with (folder / TABLE).open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(flat)
            writer.writerows(zip(*flat.values(), strict=True))

    return write_folder(target, dataset, NOTE, fill, overwrite=overwrite)


def read(source: Path) -> Dataset:
    """Read a folder that `write` wrote.

    Args:
        source: The folder.

    Returns:
        The data set.

    Raises:
        DataError: A file is missing or damaged.
    """
    note = files.read_json(source / NOTE)
    text = files.read_text(source / TABLE, MAX_TABLE_BYTES)
    rows = list(csv.reader(io.StringIO(text)))
    header = rows[0] if rows else []
    if not header or any(len(row) != len(header) for row in rows):
        raise DataError(f"{source / TABLE}: its rows do not have the same columns; restore it from a copy")
    cells = dict(zip(header, zip(*rows[1:], strict=True) if rows[1:] else [()] * len(header), strict=True))
    columns: dict[str, np.ndarray] = {}
    try:
        for kind in NAME_LISTS:
            numbers = {name: i for i, name in enumerate(note[kind])}
            columns[kind[:-1]] = np.array([numbers[name] for name in cells[kind[:-1]]], np.int64)
        columns["code"] = np.array(cells["code"], np.int64)
        columns |= _gathered(cells, 3 * len(note["board"]["chips"]))
    except (LookupError, ValueError, TypeError, OverflowError) as error:
        reason = " ".join(str(error).split())[:100]
        raise DataError(f"{source / TABLE}: is no table of touches ({reason}); restore it from a copy") from error
    for path in sorted(source.glob("*.npy")):
        columns[path.stem] = _picture(file_in(source, path.name, source))
    return dataset_of(columns, note, source)


def _flat(name: str, values: np.ndarray) -> dict[str, list[str]]:
    """Columns of one field."""
    if name in INDICES:
        return {name: [str(value) for value in values]}
    labels = _labels(name, values.shape[1:])
    return {
        label: ["" if np.isnan(value) else str(value) for value in column]
        for label, column in zip(labels, values.reshape(len(values), -1).T, strict=True)
    }


def _labels(name: str, shape: tuple[int, ...]) -> list[str]:
    if not shape:
        return [f"{name}_{UNIT_OF[name]}"]
    if shape == (4, 4):
        return [f"{name}_{row}{column}" for row in range(4) for column in range(4)]
    prefix = "b" if name == "reading" else "truth_b"
    return [f"{prefix}{chip}{axis}_uT" for chip in range(shape[0] // 3) for axis in AXIS_NAMES]


def _gathered(cells: dict[str, Any], channels: int) -> dict[str, np.ndarray]:
    """The fields of a table's columns."""
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(UNIT_OF, ())
    shapes |= {**dict.fromkeys(POSES, (4, 4)), "reading": (channels,), "truth_reading": (channels,)}
    fields: dict[str, np.ndarray] = {}
    for name, shape in shapes.items():
        labels = _labels(name, shape)
        if name.startswith(OPTIONAL_COLUMNS) and labels[0] not in cells:
            continue
        table = np.array([[np.nan if cell == "" else float(cell) for cell in cells[label]] for label in labels])
        fields[name] = table.T.reshape(-1, *shape).astype(np.float64 if name == "time" else np.float32)
    return fields


def _picture(path: Path) -> np.ndarray:
    """An array of a file, which must be plain numbers."""
    try:
        return np.load(io.BytesIO(files.read_bytes(path)), allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{path}: is no array of numbers that can be read; restore it from a copy") from error
