"""Pads on disk: a fitted (or any other) pad as one small file, to be used in place of a random one.

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

KIND = "i2t pad"
PAD_FIELDS_OF_BEFORE = {
    "magnetisation": "magnetization",
    "give": "mount_compliance",
}  # of fields in files of earlier versions


class PadAbout(NamedTuple):
    """Description in a pad's file."""

    name: str  # of the skin, as data sets call it
    made_from: str  # a phrase such as ", fitted to 100 real presses"; empty where nothing is known
    error_std: float  # uT, root mean square error on presses that it was not fitted to; 0 where unknown
    r2_places: float | None = None  # R2 at places left out; None where unknown


def save_pad(path: Path | str, pad: Pad, *, about: dict[str, Any] | None = None) -> None:
    """Write one pad.

    Args:
        path: of the file.
        pad: one pad, on a board of any number of chips.
        about: anything that JSON can hold (whose pad it is, how it was fitted).

    Raises:
        SerializationError: the file cannot be written.

    Example:
        i2t.save_pad("pad.npz", i2t.sample_pad(jax.random.key(0)))
    """
    serialization.save(path, KIND, pad, about)


def load_pad(path: Path | str) -> Pad:
    """The pad in a file, also one that an earlier version wrote.

    Args:
        path: of the file.

    Returns:
        The pad, in float32.

    Raises:
        SerializationError: the file is missing, damaged, holds no pad, or none that can be.

    Example:
        pad = i2t.load_pad("pad.npz")
    """
    pad, _ = serialization.load(path, KIND, Pad, renamed=PAD_FIELDS_OF_BEFORE)
    with serialization.fitting(path):
        return _checked(path, pad)


def _checked(path: Path | str, pad: Pad) -> Pad:
    """The pad in float32, if its parts are valid."""
    side = pad.magnetization.shape[0] if pad.magnetization.ndim else 0
    chips = pad.board.chips.shape[0] if pad.board.chips.ndim else 0
    shapes = {
        "thickness": (), "young": (), "poisson": (), "magnetization": (side, side, 3), "gains": (3 * chips,),
        "board.chips": (chips, 3), "board.rotations": (chips, 3, 3), "friction": (), "mount_compliance": (),
    }  # fmt: skip
    serialization.check_arrays(path, pad, shapes, "make the pad again")
    if not (pad.thickness > 0 and pad.young > 0 and 0 <= pad.poisson < 0.5):
        raise SerializationError(f"{path}: thickness, stiffness or Poisson's ratio cannot be; make the pad again")
    return jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), pad)


def load_pad_about(path: Path | str) -> PadAbout:
    """Description in a pad's file.

    Args:
        path: of the file.

    Returns:
        Whose pad it is and how it was made; a file that names no skin is called after itself.

    Raises:
        SerializationError: the file is missing, damaged or holds no pad.
    """
    _, about = serialization.load(path, KIND, Pad, renamed=PAD_FIELDS_OF_BEFORE)
    with serialization.fitting(path):
        presses = f", fitted to {about['presses']} {about.get('source', '')} presses" if "presses" in about else ""
        error_std = float(about.get("error_std_uT") or 0.0)
        r2 = about.get("r2_places", about.get("r2"))  # files of earlier versions have that of presses left out
        name = str(about.get("pad") or f"simulated, {Path(path).stem}")
        return PadAbout(name, presses, error_std, None if r2 is None else float(r2))
