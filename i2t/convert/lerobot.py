"""LeRobotDataset v3.0, written with pyarrow alone: a session is an episode, and a touch is one of its frames.

Readings are `observation.tactile` (3 values for each chip, uT), patches `observation.patch` (m), `action` is the pose
at which the skin touched, position (m) and quaternion with its scalar last; every other field of a touch is
`touch.FIELD`, one of the truth `touch.truth_FIELD`, and `touch.row` is the touch's row in the data set. A task is to
touch one object. Touches have no common clock, which the format requires: its frame rate of 1/s counts touches.
Properties of the whole data set are in meta/i2t.json, which LeRobot ignores.

Format: https://huggingface.co/docs/lerobot/lerobot-dataset-v3
"""

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from i2t._version import __version__
from i2t.dataset import Dataset
from i2t.dataset.card import write_card
from i2t.dataset.sets import AXIS_NAMES, INDEX_FIELDS
from i2t.errors import DataError, require_extra
from i2t.files.writing import unwritable
from i2t.skin.boards import name_of_board

# path of the table of touches in a data set of LeRobot, as its metadata state it
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FRAME_RATE_HZ = 1  # Hz, nominal frame rate in LeRobot's metadata; each frame is a touch
# Fields of i2t's touches and their columns in LeRobot's table; the column of any other field is touch.<field>.
LEROBOT_COLUMNS = {"reading": "observation.tactile", "patch": "observation.patch", "view": "observation.view"}
# elements of a pose: position (m) and unit quaternion, scalar last
POSE_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")


def write(target: Path, dataset: Dataset) -> Path:
    """Export a data set to the LeRobotDataset format v3.0; the folder appears complete or not at all.

    Args:
        target: Folder to create; an earlier export is replaced.
        dataset: The touches to write.

    Returns:
        The path of the folder.

    Raises:
        DataError: If the folder holds other files or cannot be written, or pyarrow is missing.
    """
    require_extra("pyarrow", "LeRobot's format")
    if target.is_dir() and any(target.iterdir()) and not (target / "meta/i2t.json").is_file():
        raise DataError(f"{target}: holds files that this export did not write; give another folder")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
        try:
            part.chmod(0o755)
            _fill(part, dataset)
            write_card(part, dataset, board_name=name_of_board(dataset.board))
            if target.exists():
                shutil.rmtree(target)
            part.rename(target)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise unwritable(target, error) from error
    return target


def _fill(folder: Path, dataset: Dataset) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    for name in ("data/chunk-000", "meta/episodes/chunk-000"):
        (folder / name).mkdir(parents=True)
    order = np.argsort(dataset.touches.session, kind="stable")
    frames = {name: values[order] for name, values in _frames(dataset).items()}
    _, first, episode, lengths = np.unique(
        dataset.touches.session[order], return_index=True, return_inverse=True, return_counts=True
    )
    index = np.arange(len(dataset))
    counted = frames | {"frame_index": index - first[episode], "episode_index": episode, "index": index}
    counted["timestamp"] = counted["frame_index"].astype(np.float32) / FRAME_RATE_HZ
    parts = [slice(begin, begin + length) for begin, length in zip(first, lengths, strict=True)]
    episodes = [_episode(dataset, {name: values[rows] for name, values in counted.items()}) for rows in parts]
    pq.write_table(
        pa.table({name: _arrow(pa, values) for name, values in counted.items()}),
        folder / DATA_PATH.format(chunk_index=0, file_index=0),
    )
    pq.write_table(pa.Table.from_pylist(episodes), folder / "meta/episodes/chunk-000/file-000.parquet")
    _write_tasks(pa, pq, folder, dataset)
    texts = {"stats": {name: _stats(values) for name, values in frames.items()}, "i2t": _note(dataset)}
    for name, values in (texts | {"info": _info(dataset, frames, len(episodes))}).items():
        text = json.dumps(values, indent=1, allow_nan=False, ensure_ascii=False)
        (folder / f"meta/{name}.json").write_text(text + "\n", encoding="utf-8")


def _frames(dataset: Dataset) -> dict[str, np.ndarray]:
    """Make the columns of the touches under the names of this format, without counters.

    `view` is left out if no surroundings were recorded.
    """
    fields = {name: values for name, values in dataset.touches._asdict().items() if name != "truth"}
    if dataset.touches.truth is not None:
        fields |= {f"truth_{name}": values for name, values in dataset.touches.truth._asdict().items()}
    columns = {
        LEROBOT_COLUMNS.get(name, f"touch.{name}"): values.astype(np.int64) if name in INDEX_FIELDS else values
        for name, values in fields.items()
        if values is not None and not (name == "view" and np.isnan(values).all())
    }
    return {
        **columns,
        "touch.row": np.arange(len(dataset)),
        "action": _pose_vectors(dataset.touches.T_w_t),
        "task_index": columns["touch.object"],
    }


def _pose_vectors(T: np.ndarray) -> np.ndarray:
    """Convert poses to (n, 7) float32 vectors, which most learning code expects; NaN if unknown."""
    poses = np.full((len(T), len(POSE_NAMES)), np.nan, np.float32)
    finite = np.isfinite(T).all((1, 2))
    if finite.any():
        poses[finite, :3] = T[finite, :3, 3]
        poses[finite, 3:] = Rotation.from_matrix(T[finite, :3, :3]).as_quat()
    return poses


def _note(dataset: Dataset) -> dict[str, Any]:
    """Collect the properties of the whole data set, as values for JSON."""
    return {
        "software": f"i2t {__version__}",
        **{kind: list(getattr(dataset, kind)) for kind in ("objects", "pads", "sessions")},
        "board": {name: np.asarray(values).tolist() for name, values in dataset.board._asdict().items()},
        "window": float(dataset.window),
        "reach": float(dataset.reach),
        "source": dataset.source,
        "meta": dict(dataset.meta),
    }


def _episode(dataset: Dataset, part: dict[str, np.ndarray]) -> dict[str, Any]:
    """Make a row of the table of episodes."""
    about: dict[str, Any] = {
        "episode_index": int(part["episode_index"][0]),
        "tasks": [_task(dataset.objects[i]) for i in np.unique(part["task_index"])],
        "length": len(part["index"]),
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
    """Write the table of tasks, with the metadata by which pandas finds its index."""
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
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), folder / "meta/tasks.parquet")


def _info(dataset: Dataset, frames: dict[str, np.ndarray], episodes: int) -> dict[str, Any]:
    chips = range(dataset.board.num_chips)
    names = {"observation.tactile": [f"b{chip}{axis}" for chip in chips for axis in AXIS_NAMES], "action": POSE_NAMES}
    features: dict[str, Any] = {
        name: {"dtype": str(values.dtype), "shape": list(values.shape[1:] or (1,)), "names": names.get(name)}
        for name, values in frames.items()
    }
    counters = ("frame_index", "episode_index", "index", "task_index")
    features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in counters}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    return {
        "codebase_version": "v3.0",
        "robot_type": "i2t",
        "total_episodes": episodes,
        "total_frames": len(dataset),
        "total_tasks": len(dataset.objects),
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FRAME_RATE_HZ,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features,
    }


def _stats(values: np.ndarray) -> dict[str, Any]:
    """Compute statistics of measured values; zero if nothing was measured."""
    values = values.reshape(len(values), *(values.shape[1:] or (1,))).astype(np.float64)
    finite = np.isfinite(values)
    count = np.maximum(finite.sum(0), 1)
    mean = np.where(finite, values, 0).sum(0) / count
    spread = np.sqrt(np.where(finite, (values - mean) ** 2, 0).sum(0, where=finite) / count)
    smallest, largest = (
        np.where(finite.any(0), reduce(np.where(finite, values, fill), axis=0), 0)
        for reduce, fill in ((np.min, np.inf), (np.max, -np.inf))
    )
    statistics = {"min": smallest, "max": largest, "mean": mean, "std": spread}
    return {name: array.tolist() for name, array in statistics.items()} | {"count": [len(values)]}


def _arrow(pa: Any, values: np.ndarray) -> Any:
    """Make a column of scalars, vectors of one length, or nested lists."""
    array = pa.array(np.ascontiguousarray(values).reshape(-1))
    shape = values.shape[1:]
    if len(shape) == 1:
        return pa.FixedSizeListArray.from_arrays(array, shape[0])
    for length in reversed(shape):
        array = pa.ListArray.from_arrays(np.arange(0, len(array) + 1, length, dtype=np.int32), array)
    return array
