"""LeRobotDataset v3.0, written and read with pyarrow alone: a session is an episode, a touch one of its frames.

Readings are `observation.tactile` (3 values for each chip, uT), patches `observation.patch` (m), `action` is the pose
at which the skin touched, position (m) and quaternion with its scalar last; every other field of a touch is
`touch.FIELD`. A task is to touch one object. Touches have no common clock, and the format wants one: its frame rate of
1/s counts touches. What holds for all touches is in meta/i2t.json, which LeRobot leaves alone.

Format: https://huggingface.co/docs/lerobot/lerobot-dataset-v3
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from i2t import files
from i2t.convert.exchange import (
    POSE_NAMES,
    columns_of,
    dataset_of,
    episodes_of,
    in_order,
    pose_vectors,
    write_folder,
    write_json,
)
from i2t.dataset import Dataset
from i2t.dataset.sets import AXIS_NAMES
from i2t.errors import DataError, require_extra
from i2t.files import may_grow_to

LEROBOT_VERSION = "v3.0"
LEROBOT_INFO, NOTE = "meta/info.json", "meta/i2t.json"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_SIZE_MB, FILE_SIZE_MB, CHUNK_FILES = 200, 100, 1000
FPS = 1
NAMED_COLUMNS = {"reading": "observation.tactile", "patch": "observation.patch", "wide": "observation.wide"}
ROW_COLUMN = "touch.row"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
NEEDS_PYARROW = "LeRobot's format"


def write(target: Path, dataset: Dataset, *, overwrite: bool = False) -> Path:
    """Write a data set as a LeRobotDataset.

    Args:
        target: Folder to make.
        dataset: Touches.
        overwrite: Whether an earlier export is replaced.

    Returns:
        The folder.

    Raises:
        DataError: Something is there already, it cannot be written, or pyarrow is missing.
    """
    pa, pq = _pyarrow()
    frames = _frames(dataset)
    episodes = episodes_of(dataset)

    def fill(folder: Path) -> None:
        parts, rows_of_episodes, begun = [], [], 0
        for episode, (_, rows) in enumerate(episodes):
            part = {name: values[rows] for name, values in frames.items()}
            part["frame_index"] = np.arange(len(rows))
            part["timestamp"] = np.arange(len(rows), dtype=np.float32) / FPS
            part["index"] = begun + np.arange(len(rows))
            part["episode_index"] = np.full(len(rows), episode)
            rows_of_episodes.append(_episode(dataset, part, rows))
            begun += len(rows)
            parts.append(part)
        whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}
        path = folder / DATA_PATH.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table({name: _arrow(pa, values) for name, values in whole.items()}), path)
        _write_tasks(pa, pq, folder, dataset)
        path = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(rows_of_episodes), path)
        write_json(folder / "meta/stats.json", {name: _stats(values) for name, values in frames.items()})
        write_json(folder / LEROBOT_INFO, _info(dataset, frames, len(episodes)))

    return write_folder(target, dataset, NOTE, fill, overwrite=overwrite)


def read(source: Path) -> Dataset:
    """Read a folder that `write` wrote, or that LeRobot made of one.

    Args:
        source: The folder.

    Returns:
        The data set.

    Raises:
        DataError: It is of another program, or cannot be read, or pyarrow is missing.
    """
    pa, pq = _pyarrow()
    version = files.read_json(source / LEROBOT_INFO).get("codebase_version")
    if version != LEROBOT_VERSION:
        raise DataError(f"{source / LEROBOT_INFO}: is of version {version}, and {LEROBOT_VERSION} is read; convert it")
    if not (source / NOTE).is_file():
        raise DataError(
            f"{source}: has no {NOTE}, so it is of another program; touches need patches and the board of a skin"
        )
    fields = {column: field for field, column in NAMED_COLUMNS.items()}
    parts, rows = [], []
    for path in sorted((source / "data").glob("*/*.parquet")):
        try:
            table = _read_parquet(pq, path)
            names = [name for name in table.column_names if name in fields or name.startswith("touch.")]
            part = {name: _numpy(table.column(name)) for name in names}
        except (OSError, KeyError, ValueError, TypeError, NotImplementedError, pa.ArrowException) as error:
            reason = " ".join(str(error).split())[:100]
            raise DataError(f"{path}: is no table that can be read ({reason}); restore it from a copy") from error
        if ROW_COLUMN not in part:
            raise DataError(f"{path}: has no column {ROW_COLUMN}; write it with python -m i2t.convert lerobot")
        rows.append(part.pop(ROW_COLUMN))
        parts.append({fields.get(name, name.removeprefix("touch.")): values for name, values in part.items()})
    row = np.concatenate(rows) if rows else np.zeros(0, np.int64)
    return dataset_of(in_order(parts, row, source), files.read_json(source / NOTE), source)


def _pyarrow() -> tuple[Any, Any]:
    require_extra("pyarrow", NEEDS_PYARROW)
    import pyarrow
    import pyarrow.parquet

    return pyarrow, pyarrow.parquet


def _frames(dataset: Dataset) -> dict[str, np.ndarray]:
    """Columns of the touches under the names of this format, without those that count."""
    columns = {NAMED_COLUMNS.get(name, f"touch.{name}"): values for name, values in columns_of(dataset).items()}
    return {
        **columns,
        ROW_COLUMN: np.arange(len(dataset)),
        "action": pose_vectors(dataset.touches.T_w_t),
        "task_index": columns["touch.object"],
    }


def _episode(dataset: Dataset, part: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, Any]:
    """A row of the table of episodes."""
    about: dict[str, Any] = {
        "episode_index": int(part["episode_index"][0]),
        "tasks": [_task(dataset.objects[i]) for i in np.unique(part["task_index"])],
        "length": len(rows),
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": int(part["index"][0]),
        "dataset_to_index": int(part["index"][-1]) + 1,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    for name, values in part.items():
        about |= {f"stats/{name}/{key}": value for key, value in _stats(values).items()}
    return about


def _task(name: str) -> str:
    return f"touch {name}"


def _write_tasks(pa: Any, pq: Any, folder: Path, dataset: Dataset) -> None:
    """The table of tasks, whose index pandas must find."""
    table = pa.table({"task_index": np.arange(len(dataset.objects)), "task": [_task(name) for name in dataset.objects]})
    about = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
            for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        ],
        "pandas_version": "2.0.0",
    }
    path = folder / "meta" / "tasks.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), path)


def _info(dataset: Dataset, frames: dict[str, np.ndarray], episodes: int) -> dict[str, Any]:
    chips = range(dataset.board.num_chips)
    names = {"observation.tactile": [f"b{chip}{axis}" for chip in chips for axis in AXIS_NAMES], "action": POSE_NAMES}
    features: dict[str, Any] = {
        name: {"dtype": str(values.dtype), "shape": list(values.shape[1:] or (1,)), "names": names.get(name)}
        for name, values in frames.items()
    }
    features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in COUNTERS}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    return {
        "codebase_version": LEROBOT_VERSION,
        "robot_type": "i2t",
        "total_episodes": episodes,
        "total_frames": len(dataset),
        "total_tasks": len(dataset.objects),
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_SIZE_MB,
        "video_files_size_in_mb": VIDEO_SIZE_MB,
        "fps": FPS,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features,
    }


def _stats(values: np.ndarray) -> dict[str, Any]:
    """Statistics of measured values; zero where nothing was measured."""
    values = values.reshape(len(values), *(values.shape[1:] or (1,))).astype(np.float64)
    known = np.isfinite(values)
    count = np.maximum(known.sum(0), 1)
    mean = np.where(known, values, 0).sum(0) / count
    spread = np.sqrt(np.where(known, (values - mean) ** 2, 0).sum(0, where=known) / count)
    least, most = (
        np.where(known.any(0), reduce(np.where(known, values, away), axis=0), 0)
        for reduce, away in ((np.min, np.inf), (np.max, -np.inf))
    )
    found = {"min": least, "max": most, "mean": mean, "std": spread}
    return {name: array.tolist() for name, array in found.items()} | {"count": [len(values)]}


def _arrow(pa: Any, values: np.ndarray) -> Any:
    """A column: scalars, vectors of one length, or nested lists."""
    array = pa.array(np.ascontiguousarray(values).reshape(-1))
    shape = values.shape[1:]
    if len(shape) == 1:
        return pa.FixedSizeListArray.from_arrays(array, shape[0])
    for length in reversed(shape):
        array = pa.ListArray.from_arrays(np.arange(0, len(array) + 1, length, dtype=np.int32), array)
    return array


def _numpy(column: Any) -> np.ndarray:
    """The values of a column, which must all have one shape."""
    array, n = column.combine_chunks(), len(column)
    lengths = []
    while hasattr(array, "flatten") and hasattr(array.type, "value_type"):
        inner = array.flatten()
        length, rest = divmod(len(inner), max(len(array), 1))
        if rest:
            raise ValueError("lists of several lengths")
        lengths.append(length)
        array = inner
    return array.to_numpy(zero_copy_only=False).reshape(n, *lengths)


def _read_parquet(pq: Any, path: Path) -> Any:
    """A table, unless it says that it unpacks to more than its file can hold."""
    file = pq.ParquetFile(path)
    size = sum(file.metadata.row_group(i).total_byte_size for i in range(file.metadata.num_row_groups))
    if size > may_grow_to(path.stat().st_size):
        raise ValueError(f"{size} bytes in a file of {path.stat().st_size}")
    return file.read()
