"""A calibrated skin as a user holds it: presses in, readings out, on disk in one file.

    import i2t

    calibration = i2t.calibrate(positions, depths, readings, load_kind="depth")  # (n, 2) m, (n,) m, (n, c) uT
    mean, std = calibration.predict(other_positions, other_depths)  # (m, c) uT each
    calibration.save("skin.npz")
    calibration = i2t.load_calibration("skin.npz")

A press's load is its depth (m) or its normal force (N), one of them throughout a calibration. The model is the
structured Gaussian process of `i2t.calibration.structured_gp`.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from i2t import serialization
from i2t.calibration import structured_gp
from i2t.calibration.structured_gp import (
    DEPTH_HYPERPARAMETERS,
    FORCE_HYPERPARAMETERS,
    Presses,
    StructuredGP,
    StructuredGPHyperparameters,
)
from i2t.types import Array, Board

FILE_KIND = "i2t calibration"
MAX_POSITION_M = 1.0
MAX_LOAD = {"depth": 0.1, "force": 1e3}  # m, N
LOAD_UNITS = {"depth": "m", "force": "N"}
AXES_PER_CHIP = 3  # of a chip

LoadKind: TypeAlias = Literal["depth", "force"]

# Names in files of the first version, and what they are called now.
_OLD_NAMES = {
    "process": "gp", "widening": "interval_scaling", "hyper": "hyperparameters", "raised": "corrected_presses",
    "chips": "chip_positions", "earlier": "previous_session", "place": "position", "unit": "unit_load",
    "offset": "load_offset", "power": "load_power", "length": "map_length", "steady": "map_variance",
    "bend": "bend_variance", "bend_width": "bend_load_width", "standing": "static_variance",
    "constant": "constant_variance", "noise": "noise_variance", "height": "height_std", "reach": "chip_reach",
    "floor": "far_amplitude", "period": "lattice_period", "height_width": "height_load_width",
    "repeating": "periodic_share",
}  # fmt: skip

_fit, _predict = jax.jit(structured_gp.fit), jax.jit(structured_gp.predict)
_interval_scaling = jax.jit(structured_gp.interval_scaling)


class CalibrationRecord(NamedTuple):
    """What is on disk."""

    gp: StructuredGP
    interval_scaling: Array  # (c,)


@dataclass(frozen=True)
class Calibration:
    """Predicts the readings of presses of one tip on one skin; make one with `calibrate` or `load_calibration`.

    Attributes:
        gp: The Gaussian process, conditioned on the presses.
        interval_scaling: (c,) factors on its standard deviations, so that nine in ten readings lie in the 90 % range.
        load_kind: Whether loads are depths (m) or forces (N).
        metadata: Whatever the caller wants to remember, as JSON can hold it.
    """

    gp: StructuredGP
    interval_scaling: Array
    load_kind: LoadKind
    metadata: dict[str, Any] = field(default_factory=dict)

    def predict(self, positions: ArrayLike, loads: ArrayLike | float) -> tuple[np.ndarray, np.ndarray]:
        """Predict readings, with uncertainty.

        Args:
            positions: (n, 2) or (2,) positions of the tip in the tool frame (m).
            loads: (n,) or () depths (m) or forces (N).

        Returns:
            Mean and standard deviation (uT), noise included, (n, c) or (c,) each.

        Raises:
            ValueError: Shapes do not belong together, or a value cannot be.
        """
        positions, loads = np.asarray(positions, np.float64), np.asarray(loads, np.float64)
        if positions.shape != (*loads.shape, 2) or loads.ndim > 1:
            raise ValueError(f"positions {positions.shape} do not go with loads {loads.shape}; give (n, 2) and (n,)")
        presses = _checked_presses(np.atleast_2d(positions), np.atleast_1d(loads), self.load_kind)
        mean, std = (np.asarray(part) for part in _predict(self.gp, presses))
        std = std * np.asarray(self.interval_scaling)
        return (mean[0], std[0]) if loads.ndim == 0 else (mean, std)

    def save(self, path: Path | str) -> None:
        """Write one file, which appears whole or not at all.

        Args:
            path: File to write; `.npz` by custom.

        Raises:
            SerializationError: It cannot be written.
        """
        record = CalibrationRecord(self.gp, self.interval_scaling)
        about = {"load": self.load_kind, "about": self.metadata}
        serialization.save(path, FILE_KIND, record, about)


def calibrate(
    positions: ArrayLike,
    loads: ArrayLike,
    readings: ArrayLike,
    *,
    load_kind: LoadKind,
    board: Board | None = None,
    hyperparameters: StructuredGPHyperparameters | None = None,
    metadata: dict[str, Any] | None = None,
) -> Calibration:
    """Calibrate one skin from n presses with one tip.

    Args:
        positions: (n, 2) positions of the tip in the tool frame (m), in random order.
        loads: (n,) depths past first contact (m) or normal forces (N).
        readings: (n, c) readings (uT), ambient subtracted.
        load_kind: Whether `loads` are depths or forces.
        board: The sensor board, c / 3 chips: each channel's amplitude then falls with the distance from its chip.
        hyperparameters: Of the Gaussian process; by default those of the kind of load.
        metadata: Whatever shall be saved with it, as JSON can hold it.

    Returns:
        The calibrated skin.

    Raises:
        ValueError: Shapes do not belong together, or a value cannot be.

    Example:
        calibration = i2t.calibrate(positions, forces, readings, load_kind="force", board=i2t.reskin_board())
    """
    if load_kind not in MAX_LOAD:
        raise ValueError(f"{load_kind!r} is no load; choose one of {', '.join(MAX_LOAD)}")
    positions, loads, readings = (np.asarray(part, np.float64) for part in (positions, loads, readings))
    n = len(loads) if loads.ndim == 1 else 0
    if n == 0 or positions.shape != (n, 2) or readings.ndim != 2 or len(readings) != n:
        raise ValueError(
            f"positions {positions.shape}, loads {loads.shape} and readings {readings.shape} do not belong together; "
            "give (n, 2), (n,) and (n, channels)"
        )
    if not np.isfinite(readings).all():
        raise ValueError(
            f"{np.sum(~np.isfinite(readings).all(1))} presses have readings that are not finite; drop them"
        )
    if board is not None and readings.shape[1] != AXES_PER_CHIP * len(board.chips):
        raise ValueError(
            f"readings of {readings.shape[1]} values are not those of a board with {len(board.chips)} chips; "
            "give the board that was pressed"
        )
    presses = _checked_presses(positions, loads, load_kind)
    if hyperparameters is None:
        hyperparameters = DEPTH_HYPERPARAMETERS if load_kind == "depth" else FORCE_HYPERPARAMETERS
    chip_positions = None if board is None else jnp.asarray(board.chips[:, :2], jnp.float32)
    fitted_to = (hyperparameters, presses, jnp.asarray(readings, jnp.float32), chip_positions)
    return Calibration(_fit(*fitted_to), _interval_scaling(*fitted_to), load_kind, metadata or {})


def load_calibration(path: Path | str) -> Calibration:
    """Load a calibration from its file.

    Args:
        path: A file that `Calibration.save` wrote, by any version so far.

    Returns:
        The calibrated skin.

    Raises:
        SerializationError: The file is missing, damaged or something else.

    Example:
        mean, std = i2t.load_calibration("skin.npz").predict(positions, depths)
    """
    record, about = serialization.load(path, FILE_KIND, CalibrationRecord, renamed=_OLD_NAMES)
    record = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), record)
    gp, n = record.gp, len(record.gp.presses.load)
    whole = gp.weights.shape[0] == n and gp.cholesky.shape[-2:] == (n, n)
    groups, channels = len(gp.cholesky), gp.weights.shape[1]
    if not whole or (groups != 1 and AXES_PER_CHIP * groups != channels) or about.get("load") not in MAX_LOAD:
        raise serialization.SerializationError(f"{path}: its parts do not fit each other; calibrate again")
    return Calibration(gp, record.interval_scaling, about["load"], about["about"])


def hyperparameters_to_json(hyperparameters: StructuredGPHyperparameters) -> dict[str, float]:
    """Hyperparameters as plain numbers, to be written down.

    Args:
        hyperparameters: Of the Gaussian process.

    Returns:
        Their values by name.
    """
    return {name: float(value) for name, value in hyperparameters._asdict().items()}


def _checked_presses(positions: np.ndarray, loads: np.ndarray, load_kind: LoadKind) -> Presses:
    """Presses that can be, or ValueError."""
    if not (np.abs(positions) < MAX_POSITION_M).all():
        raise ValueError(f"positions must be finite and within {MAX_POSITION_M:g} m of the skin's centre; give metres")
    largest = MAX_LOAD[load_kind]
    if not ((loads >= 0) & (loads < largest)).all():
        raise ValueError(
            f"a {load_kind} must lie between 0 and {largest:g} {LOAD_UNITS[load_kind]}; correct it or leave the press "
            "out"
        )
    return Presses(jnp.asarray(positions, jnp.float32), jnp.asarray(loads, jnp.float32))
