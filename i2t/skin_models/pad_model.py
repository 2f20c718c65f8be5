"""Pad models with their skin: predictions, files, and the refusal of touches of another skin.

origin = PadOrigin("skin A", "real", ("hexagon", "parallelogram"), touches=300, made_from="DATA")
KnownPad(pad_model, dataset.board, origin).save("pad_model.npz")
skin = load_pad_model("pad_model.npz")
require_skin(skin, ["skin A"], dataset.board, "DATA/later")
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
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

PAD_MODEL_KIND = "i2t pad model"  # kind of file in the header of a saved pad model


@in_one_line
class PadModel(NamedTuple):
    """Model of one pad's readings and their errors at any contact, with its R2 and errors (uT) on left-out touches.

    It is fitted to touches of known objects.

    Example:
        pad_model = i2t.load_pad_model("nominal").model
        print(f"R2 {pad_model.r2:.2f} of touches left out one at a time")
    """

    reading_model: LinearReadingModel  # model that predicts the reading of a contact
    likelihood: Likelihood  # likelihood of readings and positions
    reading_std: Float[np.ndarray, " c"]  # uT, standard deviation of the readings
    r2: float  # R2 on touches left out one at a time; the other touches of their sessions stay
    held_out_errors: Float[np.ndarray, "n c"]  # uT, measured minus predicted from all other touches


@dataclass(frozen=True)
class PadOrigin:
    """Provenance of a pad model: the skin, and the touches and objects to which the model was fitted."""

    pad: str  # name of the skin in the data set
    source: str  # source of the touches: real, simulated or mixed
    objects: tuple[str, ...]  # names of the touched objects
    touches: int  # number of touches
    made_from: str  # name of the run, data set or file from which the model was made
    # digests of the touches (`i2t.dataset.digests`); None in files without this record
    used_touches: tuple[str, ...] | None = field(default=None, repr=False)


@in_one_line
class KnownPad(NamedTuple):
    """Pad model with the board and provenance of its skin.

    Example:
        known = i2t.load_pad_model("nominal")
        recognizer = i2t.ObjectRecognizer(jax.random.key(0), known.model, {"mug": mug, "bowl": bowl})
    """

    model: PadModel
    board: Board
    origin: PadOrigin

    def __str__(self) -> str:
        """Describe the skin, the touches of the fit and the accuracy."""
        origin = self.origin
        r2 = f", R2 {self.model.r2:.2f} of touches left out one at a time" if np.isfinite(self.model.r2) else ""
        return (
            f'Pad model of "{origin.pad}" with {len(self.board.chips)} chips ({origin.source})\n'
            f"  fitted to {origin.touches} touches of {', '.join(origin.objects)}{r2}\n"
            f"  made from {origin.made_from}"
        )

    @property
    def leave_one_out(self) -> Float[np.ndarray, "n c"]:
        """Measured minus predicted readings (uT) of the touches of the fit, each predicted from all others."""
        return np.asarray(self.model.held_out_errors)

    def predict(self, contact: ContactPressure) -> tuple[Float[Array, "m c"], Float[Array, "m c"]]:
        """Predict the readings of contacts from their pressures.

        Args:
            contact: m contact pressures on the layer of the reading model.

        Returns:
            `(m, c)` means and standard deviations (uT); the latter include the leave-one-out errors.
        """
        return _predict(self.model.reading_model, self.model.likelihood, contact)

    def save(self, path: Path | str) -> None:
        """Write the pad model to one file, which appears whole or not at all.

        Args:
            path: Path of the file; `.npz` by convention.

        Raises:
            SerializationError: The file cannot be written.
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
    errors = jnp.sum(jnp.linalg.inv(likelihood.whiten) ** 2, axis=1)  # diagonal of the errors' covariance
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
    """Load a pad model from a file, or the ready one that comes with i2t.

    Args:
        path: Path of a file that `KnownPad.save` wrote, or the name of a ready model: "nominal" (`i2t.models`), of one
            simulated pad.

    Returns:
        The pad model, its board and its origin.

    Raises:
        SerializationError: The file is missing, damaged or not a pad model, or its parts do not fit each other.

    Example:
        skin = i2t.load_pad_model("nominal")
        recognizer = i2t.ObjectRecognizer(jax.random.key(0), skin.model, {"mug": mug, "bowl": bowl})
    """
    return load_fitted(path, PAD_MODEL_KIND, _Record, _known_pad, ready="pad_model.npz")


def _known_pad(path: Path | str, record: _Record, about: dict[str, Any]) -> KnownPad:
    """Build a pad model from its record on disk."""
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
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in about.items()}
    origin = PadOrigin(**values)
    return KnownPad(model, Board(*(np.asarray(part, np.float32) for part in record.board)), origin)


def add_press_errors(model: PadModel, error_std: float) -> PadModel:
    """Enlarge a pad model's errors by those of the fitted pad with which its training touches were simulated.

    Args:
        model: Pad model fitted to touches that were simulated with a pad.
        error_std: Root mean square (uT) of that pad's errors on presses it was not fitted to; 0 if it is unknown.

    Returns:
        The pad model with a larger inflation of its errors.
    """
    own = float(np.mean(np.asarray(model.held_out_errors, np.float64) ** 2))
    return inflate_errors(model, float(np.sqrt(1 + error_std**2 / own)))


def inflate_errors(model: PadModel, factor: float) -> PadModel:
    """Enlarge the errors of readings that a pad model assumes.

    Args:
        model: A pad model.
        factor: Factor on the standard deviation of its errors.

    Returns:
        The pad model with a larger inflation.
    """
    likelihood = model.likelihood
    return model._replace(likelihood=likelihood._replace(inflation=likelihood.inflation * np.float32(factor)))


def require_skin(
    model: KnownPad, pads: Sequence[str], board: Board, whose: str, *, other_skin: bool = False
) -> str | None:
    """Refuse touches that were made with another skin than that of a pad model.

    Args:
        model: The pad model.
        pads: Names of the skins with which the touches are made.
        board: Board of these skins.
        whose: Name of the touches in messages.
        other_skin: Whether a skin of another name, on a board of the same kind, is allowed.

    Returns:
        A sentence if the pad model is used for another skin; None if the skin is the same.

    Raises:
        DataError: The board differs, or the skin does and `other_skin` is not set.
    """
    origin = model.origin
    if not same_board(model.board, board):
        raise DataError(
            f"{whose}: the board has {_described(board)}, and that of the pad model of {origin.made_from} "
            f"{_described(model.board)}; use a pad model of that very skin"
        )
    others = sorted(set(pads) - {origin.pad})
    if not others:
        return None
    mismatch = (
        f"{whose}: the skin is {_quoted(others)}, and the pad model of {origin.made_from} is of {_quoted([origin.pad])}"
    )
    if not other_skin:
        raise DataError(f"{mismatch}; every skin differs: use a pad model of that very skin")
    return f"ANOTHER SKIN: {mismatch}"


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
