"""robomimic's HDF5 files: a session is a demonstration, a touch one of its steps.

`data/demo_i` holds `actions` (n, 7): the pose at which the skin touched, position (m) and quaternion with its scalar
last; `obs/` with every field of the touches, `rewards` of zero, `dones` with a one at the last step. `mask/train` and
`mask/valid` name demonstrations. What holds for all touches is JSON, the text `i2t`.
"""

import io
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from i2t import files
from i2t.convert.exchange import columns_of, dataset_of, episodes_of, in_order, note_of, pose_vectors
from i2t.dataset import Dataset
from i2t.dataset.files import inspect_file, write_hdf5
from i2t.errors import DataError

NOTE_OF_FILE, ROW = "i2t", "row"
VALID_EVERY = 10  # every tenth session is named in mask/valid, where there are as many
MAX_OBJECTS_OF_FILE = 2**20  # groups and arrays: some twenty for each session
GYM_TYPE = 2  # of an environment, as robomimic numbers them: it knows no kind for recorded touches


def write(path: Path, dataset: Dataset, *, overwrite: bool = False) -> Path:
    """Write a data set as robomimic reads it, atomically.

    Args:
        path: Of the file.
        dataset: Touches.
        overwrite: Whether an earlier file is replaced.

    Returns:
        The path.

    Raises:
        DataError: The file is there already, or cannot be written.
    """
    if path.exists() and not overwrite:
        raise DataError(f"{path}: exists already; choose another name or pass --overwrite")
    with files.replacing(path) as temporary:
        write_hdf5(temporary, lambda file: _fill(file, dataset))
    return path


def read(path: Path) -> Dataset:
    """Read a file that `write` wrote.

    Args:
        path: Of the file.

    Returns:
        The data set.

    Raises:
        DataError: It cannot be read, or holds no touches of i2t.
    """
    data = files.read_bytes(path)
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            inspect_file(file, len(data), objects=MAX_OBJECTS_OF_FILE)
            group = file["data"]
            if NOTE_OF_FILE not in file:
                raise DataError("is of another program: its demonstrations have no patches and no board of a skin")
            note = files.parse_json(file[NOTE_OF_FILE].asstr()[()], path)
            obs = [group[name]["obs"] for name in sorted(group, key=_number)]
            parts = [{name: part[name][()] for name in part if name != ROW} for part in obs]
            row = np.concatenate([part[ROW][()] for part in obs])
    except DataError as error:
        raise error if str(error).startswith(str(path)) else DataError(f"{path}: {error}") from error
    except (OSError, RuntimeError, LookupError, TypeError, ValueError, AttributeError) as error:
        reason = " ".join(str(error).split())[:100]
        raise DataError(
            f"{path}: is no file of robomimic that can be read ({reason}); restore it from a copy"
        ) from error
    return dataset_of(in_order(parts, row, path), note, path)


def _number(name: str) -> int:
    """Number of a demonstration, by which they are in order."""
    return int(name.removeprefix("demo_"))


def _fill(file: h5py.File, dataset: Dataset) -> None:
    columns = columns_of(dataset)
    actions = pose_vectors(dataset.touches.T_w_t)
    data = file.create_group("data")
    episodes = episodes_of(dataset)
    for i, (name, rows) in enumerate(episodes):
        demo = data.create_group(f"demo_{i}")
        demo.attrs["num_samples"] = len(rows)
        demo.attrs["session"] = name
        demo["actions"] = actions[rows]
        demo["rewards"] = np.zeros(len(rows), np.float32)
        demo["dones"] = (np.arange(len(rows)) == len(rows) - 1).astype(np.int64)
        obs = demo.create_group("obs")
        obs[ROW] = rows.astype(np.int64)
        for field, values in columns.items():
            packed: dict[str, Any] = {"compression": "gzip", "compression_opts": 1} if values.ndim == 3 else {}
            obs.create_dataset(field, data=values[rows], **packed)
    data.attrs["total"] = len(dataset)
    data.attrs["env_args"] = json.dumps({"env_name": "i2t", "type": GYM_TYPE, "env_kwargs": {}})
    file[NOTE_OF_FILE] = json.dumps(note_of(dataset), allow_nan=False)
    valid = [i for i in range(len(episodes)) if i % VALID_EVERY == VALID_EVERY - 1]
    for mask, numbers in (("valid", valid), ("train", [i for i in range(len(episodes)) if i not in valid])):
        if numbers:
            file[f"mask/{mask}"] = np.array([f"demo_{i}".encode() for i in numbers])
