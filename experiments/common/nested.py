"""What an experiment made of one pad and seed, on disk: nested dicts of arrays, so that it goes on if interrupted."""

from pathlib import Path
from typing import Any

import numpy as np

Part = dict[str, Any]  # of arrays, or of such dicts
BETWEEN = "/"


def save(path: Path, part: Part) -> None:
    """Write it whole or not at all; raises OSError."""
    partial = path.with_suffix(".part.npz")
    np.savez_compressed(partial, allow_pickle=False, **_flat(part))
    partial.replace(path)


def load(path: Path) -> Part:
    """What `save` wrote."""
    part: Part = {}
    with np.load(path) as file:
        for key, array in file.items():
            *above, name = key.split(BETWEEN)
            at = part
            for each in above:
                at = at.setdefault(each, {})
            at[name] = array
    return part


def _flat(part: Part, prefix: str = "") -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}
    for name, value in part.items():
        if isinstance(value, dict):
            arrays |= _flat(value, f"{prefix}{name}{BETWEEN}")
        else:
            arrays[prefix + name] = np.asarray(value)
    return arrays
