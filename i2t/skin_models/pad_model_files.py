"""Pad models with their skin: on disk, and refused for touches of another skin.

origin = PadOrigin("skin A", "real", ("hexagon", "parallelogram"), touches=300, made_from="DATA")
save_pad_model("pad_model.npz", KnownPad(pad_model, dataset.board, origin))
known = load_pad_model("pad_model.npz")
require_skin(known.skin, ["skin A"], dataset.board, "DATA/later")
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from i2t.errors import DataError, SerializationError
from i2t.files import serialization
from i2t.models import ready_hint, ready_path
from i2t.skin.boards import same_board
from i2t.skin_models.likelihood import Likelihood
from i2t.skin_models.pad_model import PadModel
from i2t.skin_models.reading_model import LinearReadingModel
from i2t.types import Board, in_one_line

PAD_MODEL_KIND = "i2t pad model"


@dataclass(frozen=True)
class PadOrigin:
    """Origin of a pad model."""

    pad: str  # name of the skin in the data set
    source: str  # of the touches: real, simulated or mixed
    objects: tuple[str, ...]  # that were touched
    touches: int
    made_from: str  # a run, a data set or a file


@in_one_line
class SkinIdentity(NamedTuple):
    """Identity of a skin."""

    pad: str  # its name in data sets
    board: Board
    made_from: str  # a run, a data set or a file


@in_one_line
class KnownPad(NamedTuple):
    """A pad model and its skin."""

    model: PadModel
    board: Board
    origin: PadOrigin

    @property
    def skin(self) -> SkinIdentity:
        """Skin of the model."""
        return SkinIdentity(self.origin.pad, self.board, self.origin.made_from)


class _Record(NamedTuple):
    """Pad model on disk."""

    reading_model: LinearReadingModel
    likelihood: Likelihood
    reading_std: np.ndarray
    r2: np.ndarray
    held_out_errors: np.ndarray
    board: Board


def save_pad_model(path: Path | str, known: KnownPad) -> None:
    """Write one file, which appears whole or not at all.

    Args:
        path: Of the file; `.npz` by custom.
        known: The pad model, its board and its origin.

    Raises:
        SerializationError: It cannot be written.
    """
    record = _Record(**known.model._asdict() | {"r2": np.asarray(known.model.r2)}, board=known.board)
    serialization.save(path, PAD_MODEL_KIND, record, asdict(known.origin))


def load_pad_model(path: Path | str) -> KnownPad:
    """The pad model in a file, or the ready one that comes with i2t.

    Args:
        path: Of a file that `save_pad_model` wrote; or the name of a ready model, "nominal" (`i2t.models`), of one
            simulated pad.

    Returns:
        The pad model, its board and its origin.

    Raises:
        SerializationError: The file is missing, damaged, holds something else, or its parts do not fit each other.

    Example:
        known = i2t.load_pad_model("nominal")
        recognizer = i2t.ObjectRecognizer(jax.random.key(0), known.model, {"mug": mug, "bowl": bowl})
    """
    hint = ready_hint(path, "pad_model.npz")
    path = ready_path(path, "pad_model.npz")
    record, about = serialization.load(path, PAD_MODEL_KIND, _Record, missing=hint)
    with serialization.fitting(path):
        return _known_pad(path, record, about)


def _known_pad(path: Path | str, record: _Record, about: dict[str, Any]) -> KnownPad:
    """A pad model from its record on disk, if its parts fit."""
    channels = 3 * len(record.board.chips)
    loads, cells = record.reading_model.mean.shape[:2]
    shapes = {
        "reading_model.mean": (loads, cells, channels),
        "reading_model.scale": (channels,),
        "reading_model.layer.poisson": (),
        "reading_model.layer.young": (),
        "likelihood.whiten": (channels, channels),
        "likelihood.loads": (loads,),
        "reading_std": (channels,),
        "board.rotations": (len(record.board.chips), 3, 3),
    }
    arrays = serialization.flatten(record)
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            raise SerializationError(f"{path}: {name} is not {shape} finite numbers; make the pad model again")
    reading_model, likelihood = jax.tree.map(
        lambda array: jnp.asarray(array, jnp.float32), (record.reading_model, record.likelihood)
    )
    model = PadModel(reading_model, likelihood, record.reading_std, float(record.r2), record.held_out_errors)
    origin = PadOrigin(**about | {"objects": tuple(about["objects"])})
    return KnownPad(model, Board(*(np.asarray(part, np.float32) for part in record.board)), origin)


def require_skin(
    skin: SkinIdentity, pads: Sequence[str], board: Board, whose: str, *, other_skin: bool = False
) -> str | None:
    """Refuse touches of another skin than a pad model's.

    Args:
        skin: That the pad model is of.
        pads: Names of the skins that touch.
        board: Of these skins.
        whose: Names the touches in messages.
        other_skin: Whether a skin of another name, on a like board, is allowed.

    Returns:
        A sentence where another skin is judged by this pad model; None where it is the same.

    Raises:
        DataError: The skin or the board is another.
    """
    if not same_board(skin.board, board):
        raise DataError(
            f"{whose}: the board has {_described(board)}, and that of the pad model of {skin.made_from} "
            f"{_described(skin.board)}; use a pad model of that very skin"
        )
    others = sorted(set(pads) - {skin.pad})
    if not others:
        return None
    told = f"{whose}: the skin is {_quoted(others)}, and the pad model of {skin.made_from} is of {_quoted([skin.pad])}"
    if not other_skin:
        raise DataError(f"{told}; every skin differs: use a pad model of that very skin")
    return f"ANOTHER SKIN: {told}"


def _described(board: Board) -> str:
    chips = np.asarray(board.chips, float)
    places = ", ".join(f"({1e3 * x:.1f} {1e3 * y:.1f})" for x, y in chips[:2, :2])
    turned = np.asarray(board.rotations, float)
    angles = np.degrees(np.arctan2(turned[:, 1, 0], turned[:, 0, 0]))
    return (
        f"{len(chips)} chips, the first at {places} mm, turned by {', '.join(f'{a:.0f}' for a in angles[:5])} degrees"
    )


def _quoted(names: Sequence[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)
