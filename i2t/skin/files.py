"""Pads in files: a fitted (or any other) pad as one small file, for use in place of a random one.

from i2t.skin.files import load_pad, save_pad

save_pad("pad.npz", pad)
pad = load_pad("pad.npz")

"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from i2t.errors import SerializationError
from i2t.files import serialization
from i2t.types import Pad

KIND = "i2t pad"  # kind of file in the header of a saved pad


class PadAbout(NamedTuple):
    """Description of a pad from its file: skin, source of the parameters, and error (uT) and R2 of its predictions."""

    name: str  # name of the skin in data sets
    made_from: str  # a phrase such as ", fitted to 100 real presses"; empty if unknown
    error_std: float  # uT, root mean square error on presses that it was not fitted to; 0 if unknown
    r2_places: float | None = None  # R2 at places left out; None if unknown


def save_pad(path: Path | str, pad: Pad, *, about: dict[str, Any] | None = None) -> None:
    """Write one pad, with its board, to a file.

    Args:
        path: Path of the file.
        pad: A pad on a board with any number of chips.
        about: Data to be saved with the pad, such as its skin and its fit, in types that JSON can hold.

    Raises:
        SerializationError: The file cannot be written.

    Example:
        i2t.save_pad("pad.npz", i2t.sample_pad(jax.random.key(0)))
    """
    serialization.save(path, KIND, pad, about)


def load_pad(path: Path | str) -> Pad:
    """Load a pad from a file, including files of earlier versions.

    Args:
        path: Path of the file.

    Returns:
        The pad, in float32.

    Raises:
        SerializationError: The file is missing, damaged, holds no pad, or holds impossible values.

    Example:
        pad = i2t.load_pad("pad.npz")
    """
    pad, _ = _load(path)
    with serialization.fitting(path):
        return _checked(path, pad)


def _load(path: Any) -> tuple[Pad, dict[str, Any]]:
    """Load a pad and its metadata, with the field names of earlier versions replaced."""
    return serialization.load(path, KIND, Pad, renamed={"magnetisation": "magnetization", "give": "mount_compliance"})


def _checked(path: Path | str, pad: Pad) -> Pad:
    """Convert the pad to float32; raise SerializationError if its parts are invalid."""
    side = pad.magnetization.shape[0] if pad.magnetization.ndim else 0
    chips = pad.board.chips.shape[0] if pad.board.chips.ndim else 0
    shapes = {
        "thickness": (), "young": (), "poisson": (), "magnetization": (side, side, 3), "gains": (3 * chips,),
        "board.chips": (chips, 3), "board.rotations": (chips, 3, 3), "friction": (), "mount_compliance": (),
    }  # fmt: skip
    serialization.check_arrays(path, pad, shapes, "make the pad again")
    if not (pad.thickness > 0 and pad.young > 0 and 0 <= pad.poisson < 0.5):
        raise SerializationError(f"{path}: thickness, stiffness or Poisson's ratio is impossible; make the pad again")
    return jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), pad)


def load_pad_about(path: Path | str) -> PadAbout:
    """Load the description in a pad's file.

    Args:
        path: Path of the file.

    Returns:
        The skin's name (the file's name if the file has none), the source of the pad's parameters, and the errors (uT)
        and R2 of its predicted readings.

    Raises:
        SerializationError: The file is missing, damaged or holds no pad.
    """
    _, about = _load(path)
    with serialization.fitting(path):
        presses = f", fitted to {about['presses']} {about.get('source', '')} presses" if "presses" in about else ""
        error_std = float(about.get("error_std_uT") or 0.0)
        r2 = about.get("r2_places", about.get("r2"))  # files of earlier versions have the R2 of presses left out
        name = str(about.get("pad") or f"simulated, {Path(path).stem}")
        return PadAbout(name, presses, error_std, None if r2 is None else float(r2))
