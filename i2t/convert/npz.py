"""The way back: a data set as plain NumPy arrays in one .npz file, which any program can read without pickles."""

import secrets
from pathlib import Path
from typing import Any

import numpy as np

from i2t.dataset import Dataset
from i2t.errors import DataError


def write(path: Path, dataset: Dataset) -> Path:
    """Write every field of the touches under its name (`truth_...` for the truth), the names, board, window, reach,
    source, and provenance as `meta_keys` and `meta_values`; atomically. Raises DataError.
    """
    touches = dataset.touches._asdict()
    truth = touches.pop("truth")
    arrays: dict[str, Any] = touches
    if truth is not None:
        arrays |= {f"truth_{name}": values for name, values in truth._asdict().items()}
    arrays |= {kind: np.array(getattr(dataset, kind), np.str_) for kind in ("objects", "pads", "runs")}
    arrays |= {f"board_{name}": values for name, values in dataset.board._asdict().items()}
    arrays |= {name: np.array(getattr(dataset, name)) for name in ("window", "reach", "source")}
    arrays["meta_keys"] = np.array(list(dataset.meta), np.str_)
    arrays["meta_values"] = np.array(list(dataset.meta.values()), np.str_)
    temporary = path.with_name(f".{secrets.token_hex(4)}.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            np.savez_compressed(temporary, allow_pickle=False, **arrays)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror}); choose a folder you may write to") from error
    return path
