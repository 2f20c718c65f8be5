"""Pad models with their skin: what they predict, on disk, and refused for touches of another skin.

origin = PadOrigin("skin A", "real", ("hexagon", "parallelogram"), touches=300, made_from="DATA")
KnownPad(pad_model, dataset.board, origin).save("pad_model.npz")
known = load_pad_model("pad_model.npz")
require_skin(known, ["skin A"], dataset.board, "DATA/later")
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.contact.pressure import ContactPressure
from i2t.errors import DataError
from i2t.files import serialization
from i2t.skin.boards import same_board
from i2t.skin_models.base import load_fitted
from i2t.skin_models.likelihood import Likelihood
from i2t.skin_models.reading_model import LinearReadingModel, read_pressure
from i2t.types import Board, in_one_line

PAD_MODEL_KIND = "i2t pad model"


@in_one_line
class PadModel(NamedTuple):
    """Model of a pad from its touches of known objects."""

    reading_model: LinearReadingModel  # the reading of a contact
    likelihood: Likelihood  # of readings and positions
    reading_std: Float[np.ndarray, " c"]  # uT, of the readings
    r2: float  # of touches left out one at a time; other touches of their sessions stay
    held_out_errors: Float[np.ndarray, "n c"]  # uT, measured minus predicted


@dataclass(frozen=True)
class PadOrigin:
    """Origin of a pad model."""

    pad: str  # name of the skin in the data set
    source: str  # of the touches: real, simulated or mixed
    objects: tuple[str, ...]  # that were touched
    touches: int
    made_from: str  # a run, a data set or a file


@in_one_line
class KnownPad(NamedTuple):
    """A pad model and its skin."""

    model: PadModel
    board: Board
    origin: PadOrigin

    @property
    def left_out(self) -> Float[np.ndarray, "n c"]:
        """Errors (uT) on the touches of the fit, each predicted from all others."""
        return np.asarray(self.model.held_out_errors)

    def predict(self, contact: ContactPressure) -> tuple[Float[Array, "m c"], Float[Array, "m c"]]:
        """Predict readings of contacts.

        Args:
            contact: m contact pressures on the layer of the reading model.

        Returns:
            Mean and standard deviation (uT), with the errors on left-out touches.
        """
        return _predict(self.model.reading_model, self.model.likelihood, contact)

    def save(self, path: Path | str) -> None:
        """Write one file, which appears whole or not at all.

        Args:
            path: Of the file; `.npz` by custom.

        Raises:
            SerializationError: It cannot be written.
        """
        record = _Record(**self.model._asdict() | {"r2": np.asarray(self.model.r2)}, board=self.board)
        serialization.save(path, PAD_MODEL_KIND, record, asdict(self.origin))


@jax.jit
def _predict(
    model: LinearReadingModel, likelihood: Likelihood, contact: ContactPressure
) -> tuple[Float[Array, "m c"], Float[Array, "m c"]]:
    mean, variance = jax.vmap(partial(read_pressure, model))(
        contact.pressure.reshape(len(contact.load), -1), contact.load
    )
    errors = jnp.sum(jnp.linalg.inv(likelihood.whiten) ** 2, axis=1)  # their covariance's diagonal
    return mean, likelihood.inflation * jnp.sqrt(errors[None] + variance[:, None] * model.scale[None] ** 2)


class _Record(NamedTuple):
    """Pad model on disk."""

    reading_model: LinearReadingModel
    likelihood: Likelihood
    reading_std: np.ndarray
    r2: np.ndarray
    held_out_errors: np.ndarray
    board: Board


def load_pad_model(path: Path | str) -> KnownPad:
    """The pad model in a file, or the ready one that comes with i2t.

    Args:
        path: Of a file that `KnownPad.save` wrote; or the name of a ready model, "nominal" (`i2t.models`), of one
            simulated pad.

    Returns:
        The pad model, its board and its origin.

    Raises:
        SerializationError: The file is missing, damaged, holds something else, or its parts do not fit each other.

    Example:
        known = i2t.load_pad_model("nominal")
        recognizer = i2t.ObjectRecognizer(jax.random.key(0), known.model, {"mug": mug, "bowl": bowl})
    """
    return load_fitted(path, PAD_MODEL_KIND, _Record, _known_pad, ready="pad_model.npz")


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
    serialization.check_arrays(path, record, shapes, "make the pad model again")
    reading_model, likelihood = jax.tree.map(
        lambda array: jnp.asarray(array, jnp.float32), (record.reading_model, record.likelihood)
    )
    model = PadModel(reading_model, likelihood, record.reading_std, float(record.r2), record.held_out_errors)
    origin = PadOrigin(**about | {"objects": tuple(about["objects"])})
    return KnownPad(model, Board(*(np.asarray(part, np.float32) for part in record.board)), origin)


def with_press_errors(model: PadModel, error_std: float) -> PadModel:
    """A pad model whose errors of readings include those of the pad that its touches were simulated with.

    Args:
        model: Fitted to touches simulated with a pad.
        error_std: uT, root mean square of what that pad leaves of presses it was not fitted to; 0 where it is unknown.

    Returns:
        The pad model with a larger inflation of its errors.
    """
    own = float(np.mean(np.asarray(model.held_out_errors, np.float64) ** 2))
    return inflated(model, float(np.sqrt(1 + error_std**2 / own)))


def inflated(model: PadModel, factor: float) -> PadModel:
    """A pad model whose errors of readings are larger.

    Args:
        model: As fitted.
        factor: By which its errors' standard deviation grows.

    Returns:
        The pad model with a larger inflation.
    """
    likelihood = model.likelihood
    return model._replace(likelihood=likelihood._replace(inflation=likelihood.inflation * np.float32(factor)))


def require_skin(
    known: KnownPad, pads: Sequence[str], board: Board, whose: str, *, other_skin: bool = False
) -> str | None:
    """Refuse touches of another skin than a pad model's.

    Args:
        known: The pad model.
        pads: Names of the skins that touch.
        board: Of these skins.
        whose: Names the touches in messages.
        other_skin: Whether a skin of another name, on a like board, is allowed.

    Returns:
        A sentence where another skin is judged by this pad model; None where it is the same.

    Raises:
        DataError: The skin or the board is another.
    """
    origin = known.origin
    if not same_board(known.board, board):
        raise DataError(
            f"{whose}: the board has {_described(board)}, and that of the pad model of {origin.made_from} "
            f"{_described(known.board)}; use a pad model of that very skin"
        )
    others = sorted(set(pads) - {origin.pad})
    if not others:
        return None
    told = (
        f"{whose}: the skin is {_quoted(others)}, and the pad model of {origin.made_from} is of {_quoted([origin.pad])}"
    )
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
