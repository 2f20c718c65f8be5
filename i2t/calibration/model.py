"""A calibrated skin as a user holds it: presses in, readings out, on disk in one file.

from i2t import calibrate

calibration = calibrate.calibrate(place, depth, readings, "depth")  # (n, 2) m, (n,) m, (n, 15) uT
mean, std = calibration.predict(other_place, other_depth)  # (m, 15) uT each
calibration.save("skin.npz")
calibration = calibrate.load("skin.npz")

"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from i2t import serialization
from i2t.calibration.structured_gp import DEPTH, FORCE, Hyper, Presses, Process, fit, predict, widening
from i2t.types import CHIPS, Array, Board

KIND = "i2t calibration"
FURTHEST = 1.0  # m
HARDEST = {"depth": 0.1, "force": 1e3}  # m, N

Load: TypeAlias = Literal["depth", "force"]

_fit, _predict, _widening = jax.jit(fit), jax.jit(predict), jax.jit(widening)


class Kept(NamedTuple):
    """What is on disk."""

    process: Process
    widening: Array  # (channels,)


@dataclass(frozen=True)
class Calibration:
    """Predicts the readings of presses of one tip on one skin; make one with `calibrate` or `load`."""

    process: Process
    widening: Array  # (channels,) factors on the process's standard deviations
    load: Load  # what says how hard was pressed
    about: dict[str, Any] = field(default_factory=dict)

    def predict(self, place: ArrayLike, load: ArrayLike | float) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation (uT), noise included, (n, 15) or (15,) each.

        `place` (n, 2) or (2,) is the tip's place in the tool frame (m), `load` (n,) or () its depth (m) or force (N).
        Raises ValueError for anything else.
        """
        place, load = np.asarray(place, np.float64), np.asarray(load, np.float64)
        if place.shape != (*load.shape, 2) or load.ndim > 1:
            raise ValueError(f"places {place.shape} do not go with loads {load.shape}; give (n, 2) and (n,)")
        one = load.ndim == 0
        presses = checked(np.atleast_2d(place), np.atleast_1d(load), self.load)
        mean, std = (np.asarray(part) for part in _predict(self.process, presses))
        std = std * np.asarray(self.widening)
        return (mean[0], std[0]) if one else (mean, std)

    def save(self, path: Path | str) -> None:
        """Write one file (TreeError where it cannot be written)."""
        serialization.save(path, KIND, Kept(self.process, self.widening), {"load": self.load, "about": self.about})


def calibrate(
    place: ArrayLike,
    load: ArrayLike,
    readings: ArrayLike,
    kind: Load,
    board: Board | None = None,
    hyper: Hyper | None = None,
    about: dict[str, Any] | None = None,
) -> Calibration:
    """Calibrate on n presses: places (n, 2) m, loads (n,) m or N, readings (n, 15) uT.

    With a `board`, each channel's amplitude falls with the distance from its chip. Raises ValueError for input that
    cannot be.
    """
    if kind not in HARDEST:
        raise ValueError(f"{kind!r} is no load; choose one of {', '.join(HARDEST)}")
    place, load, readings = (np.asarray(part, np.float64) for part in (place, load, readings))
    n = len(load)
    if load.ndim != 1 or place.shape != (n, 2) or readings.ndim != 2 or len(readings) != n or n == 0:
        raise ValueError(
            f"places {place.shape}, loads {load.shape} and readings {readings.shape} do not belong together; give "
            "(n, 2), (n,) and (n, 15)"
        )
    if not np.isfinite(readings).all():
        raise ValueError(
            f"{np.sum(~np.isfinite(readings).all(1))} presses have readings that are not finite; drop them"
        )
    presses = checked(place, load, kind)
    hyper = (DEPTH if kind == "depth" else FORCE) if hyper is None else hyper
    chips = None if board is None else jnp.asarray(board.chips[:, :2], jnp.float32)
    y = jnp.asarray(readings, jnp.float32)
    return Calibration(_fit(hyper, presses, y, chips), _widening(hyper, presses, y, chips), kind, about or {})


def load(path: Path | str) -> Calibration:
    """A calibration from its file. Raises SerializationError where it is missing, damaged or something else."""
    kept, told = serialization.load(path, KIND, Kept)
    kept = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), kept)
    process, n = kept.process, len(kept.process.presses.load)
    whole = process.weights.shape[0] == n and process.cholesky.shape[-2:] == (n, n)
    if not whole or len(process.cholesky) not in (1, CHIPS) or told.get("load") not in HARDEST:
        raise serialization.SerializationError(f"{path}: its parts do not fit each other; calibrate again")
    return Calibration(process, kept.widening, told["load"], told["about"])


def checked(place: np.ndarray, load: np.ndarray, kind: Load) -> Presses:
    """Presses that can be, or ValueError."""
    if not (np.abs(place) < FURTHEST).all():
        raise ValueError(f"places must be finite and within {FURTHEST:g} m of the skin's centre; give metres")
    if not ((load >= 0) & (load < HARDEST[kind])).all():
        unit = "m" if kind == "depth" else "N"
        raise ValueError(f"a {kind} must lie between 0 and {HARDEST[kind]:g} {unit}; correct it or leave the press out")
    return Presses(jnp.asarray(place, jnp.float32), jnp.asarray(load, jnp.float32))


def numbers(hyper: Hyper) -> dict[str, float]:
    """Hyperparameters as plain numbers, to be written down."""
    return {name: float(value) for name, value in hyper._asdict().items()}
