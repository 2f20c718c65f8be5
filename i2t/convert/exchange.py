"""Common part of others' formats: a data set as named columns and a JSON note, and back, value by value.

A column has a touch on each row, in the order of the data set. Fields keep their names and units (`i2t.types.Touches`);
those of the truth are called `truth_...`. The note holds names, board, window, reach, source and provenance, everything
that is not of a single touch. `wide` is left out where no surroundings were recorded.
"""

import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from i2t import files
from i2t._version import __version__
from i2t.dataset import Dataset, missing_context
from i2t.dataset.card import write_card
from i2t.dataset.sets import INDICES, validate
from i2t.errors import DataError
from i2t.skin.boards import name_of_board
from i2t.types import Board, Touches, Truth

EXCHANGE_FORMAT = "i2t touches"
TRUTH = "truth_"
NAME_LISTS = ("objects", "pads", "sessions")
TOUCH_FIELDS = tuple(name for name in Touches._fields if name != "truth")
POSE_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")  # m, and a unit quaternion


def columns_of(dataset: Dataset) -> dict[str, np.ndarray]:
    """The touches of a data set by field.

    Args:
        dataset: Of n touches.

    Returns:
        Arrays with n on axis 0: float32, int64 for indices, and float64 for times.
    """
    touches = dataset.touches
    columns = {name: values for name in TOUCH_FIELDS if (values := getattr(touches, name)) is not None}
    if np.isnan(columns["wide"]).all():
        del columns["wide"]
    if touches.truth is not None:
        columns |= {TRUTH + name: values for name, values in touches.truth._asdict().items()}
    return {name: values.astype(np.int64) if name in INDICES else values for name, values in columns.items()}


def note_of(dataset: Dataset) -> dict[str, Any]:
    """Note that holds for all touches of a data set, as JSON can hold it.

    Args:
        dataset: Any.

    Returns:
        Names, board, window, reach, source, provenance, and what wrote it.
    """
    return {
        "format": EXCHANGE_FORMAT,
        "software": f"i2t {__version__}",
        **{kind: list(getattr(dataset, kind)) for kind in NAME_LISTS},
        "board": {name: np.asarray(values).tolist() for name, values in dataset.board._asdict().items()},
        "window": float(dataset.window),
        "reach": float(dataset.reach),
        "source": dataset.source,
        "meta": dict(dataset.meta),
        "wide_pixels": int(dataset.touches.wide.shape[-1]),
    }


def dataset_of(columns: Mapping[str, np.ndarray], note: Any, whose: Path | str) -> Dataset:
    """The data set of columns and their note.

    Args:
        columns: As of `columns_of`.
        note: As of `note_of`.
        whose: Names the source in messages.

    Returns:
        The data set, checked.

    Raises:
        DataError: A column is missing, or they are not of a data set.
    """
    try:
        if note["format"] != EXCHANGE_FORMAT:
            raise KeyError("format")
        n = len(columns["reading"])
        values: dict[str, Any] = {name: np.asarray(columns[name]) for name in TOUCH_FIELDS if name in columns}
        values.setdefault("wide", missing_context(n, int(note["wide_pixels"])))
        if TRUTH + "reading" in columns:
            values["truth"] = Truth(**{name: np.asarray(columns[TRUTH + name]) for name in Truth._fields})
        dataset = Dataset(
            Touches(**values),
            **{kind: tuple(map(str, note[kind])) for kind in NAME_LISTS},
            board=Board(*(np.asarray(note["board"][name], np.float32) for name in Board._fields)),
            source=str(note["source"]),
            window=float(note["window"]),
            reach=float(note["reach"]),
            meta={str(key): str(text) for key, text in note["meta"].items()},
        )
        validate(dataset)
    except DataError as error:
        raise DataError(f"{whose}: {error}") from error
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        reason = " ".join(str(error).split())[:100]
        raise DataError(f"{whose}: holds no touches of i2t ({reason}); write it with python -m i2t.convert") from error
    return dataset


def pose_vectors(T: np.ndarray) -> np.ndarray:
    """Poses as most learning code wants them.

    Args:
        T: (n, 4, 4); NaN where unknown.

    Returns:
        (n, 7) float32: x, y, z (m) and a unit quaternion with its scalar last; NaN where unknown.
    """
    poses = np.full((len(T), len(POSE_NAMES)), np.nan, np.float32)
    known = np.isfinite(T).all((1, 2))
    if known.any():
        poses[known, :3] = T[known, :3, 3]
        poses[known, 3:] = Rotation.from_matrix(T[known, :3, :3]).as_quat()
    return poses


def episodes_of(dataset: Dataset) -> list[tuple[str, np.ndarray]]:
    """The sessions that have touches, each an episode.

    Args:
        dataset: Any.

    Returns:
        Name and rows of each, in the order of the names.
    """
    rows = ((name, np.flatnonzero(dataset.touches.session == i)) for i, name in enumerate(dataset.sessions))
    return [(name, found) for name, found in rows if len(found)]


def in_order(parts: list[dict[str, np.ndarray]], row: np.ndarray, whose: Path | str) -> dict[str, np.ndarray]:
    """Columns of episodes in the order that the data set had.

    Args:
        parts: Columns of each episode.
        row: The row that each of their touches had.
        whose: Names the source in messages.

    Returns:
        Columns of all touches.

    Raises:
        DataError: Rows are missing or repeated, or episodes have different columns.
    """
    names = set(parts[0]) if parts else set()
    if not parts or any(set(part) != names for part in parts):
        raise DataError(f"{whose}: its episodes do not have the same fields; write it again")
    if not np.array_equal(np.sort(row), np.arange(len(row))):
        raise DataError(f"{whose}: rows are missing or repeated; write it again, or restore a copy")
    order = np.argsort(row)
    return {name: np.concatenate([part[name] for part in parts])[order] for name in parts[0]}


def write_folder(
    target: Path, dataset: Dataset, note: str, fill: Callable[[Path], None], *, overwrite: bool = False
) -> Path:
    """Write a data set as a folder that appears complete or not at all, with its note and its card.

    Args:
        target: The folder.
        dataset: Touches.
        note: File in it that holds the data set's note, by which an earlier export of the same kind is known.
        fill: Writes all else into the folder that it is given.
        overwrite: Whether an earlier export of the same kind is replaced.

    Returns:
        The folder.

    Raises:
        DataError: Something is there already, or the folder cannot be written.
    """
    require_free_folder(target, note, overwrite=overwrite)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
        try:
            part.chmod(0o755)
            fill(part)
            write_json(part / note, note_of(dataset))
            write_card(part, dataset, board_name=name_of_board(dataset.board))
            _take_place(target, part)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise files.unwritable(target, error) from error
    return target


def _take_place(target: Path, part: Path) -> None:
    """Give a finished folder its name; the one that had it is gone then, and has it again if that fails."""
    before = part.with_name(part.name + ".before")
    try:
        if target.exists():
            target.rename(before)
        part.rename(target)
    except BaseException:
        if before.exists() and not target.exists():
            before.rename(target)
        raise
    shutil.rmtree(before, ignore_errors=True)


def require_free_folder(target: Path, mark: str, *, overwrite: bool) -> None:
    """Refuse a folder that holds anything but an export of the same kind that may be replaced.

    Args:
        target: The folder.
        mark: File in it by which an earlier one of the same kind is known.
        overwrite: Whether that one may be replaced.

    Raises:
        DataError: It is taken.
    """
    if target.exists() and not target.is_dir():
        raise DataError(f"{target}: is a file; give a folder to write")
    if not target.is_dir() or not any(target.iterdir()):
        return
    if not (target / mark).is_file():
        raise DataError(f"{target}: holds files that no such export wrote; give another folder")
    if not overwrite:
        raise DataError(f"{target}: holds an export already; give another folder or pass --overwrite")


def write_npz(path: Path, dataset: Dataset) -> Path:
    """Write a data set as arrays, atomically.

    The file holds every field of the touches under its name (`truth_...` for the truth), the names, board, window,
    reach, source, and provenance as `meta_keys` and `meta_values`.

    Args:
        path: Of the new file; its folder is made.
        dataset: The data set.

    Returns:
        `path`.

    Raises:
        DataError: Its folder cannot be written to; FullDiskError if the disk is full, or failed.
    """
    touches = dataset.touches._asdict()
    truth = touches.pop("truth")
    arrays: dict[str, Any] = {name: values for name, values in touches.items() if values is not None}
    if truth is not None:
        arrays |= {TRUTH + name: values for name, values in truth._asdict().items()}
    arrays |= {kind: np.array(getattr(dataset, kind), np.str_) for kind in NAME_LISTS}
    arrays |= {f"board_{name}": values for name, values in dataset.board._asdict().items()}
    arrays |= {name: np.array(getattr(dataset, name)) for name in ("window", "reach", "source")}
    arrays["meta_keys"] = np.array(list(dataset.meta), np.str_)
    arrays["meta_values"] = np.array(list(dataset.meta.values()), np.str_)
    with files.replacing(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)
    return path


def write_json(path: Path, values: Any) -> None:
    """Write JSON that any reader takes: no NaN.

    Args:
        path: Of the file; its folder is made.
        values: What JSON can hold.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")
