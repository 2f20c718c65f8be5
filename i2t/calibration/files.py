"""A pad on disk from presses with a known tip, or from a calibration, which holds the presses that it was fitted to.

    found = fit_pressed_pad(PressedSkin(positions, forces, readings, board, by_force=True), RoundTip("sphere", 4e-3))
    save_pressed_pad("pad.npz", found, pad="skin A", source="real")

The pad is fitted by `i2t.calibration.physics.fit_pad`; `i2t.load_pad` reads the file, and simulations and recognition
take it in place of a random pad.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from i2t.calibration.model import Calibration
from i2t.calibration.physics import PadFit, RoundTip, fit_pad
from i2t.calibration.population_gp import PopulationGP
from i2t.calibration.structured_gp import Presses
from i2t.skin.files import save_pad
from i2t.types import Board

MAX_RADIUS_MM = 50.0
MIN_PAD_PRESSES = 5  # fewer tell almost nothing of a map


class PressedSkin(NamedTuple):
    """Presses of one tip on one skin, in random order."""

    position: Float[np.ndarray, "n 2"]  # m
    load: Float[np.ndarray, " n"]  # N of force, or m of depth
    readings: Float[np.ndarray, "n c"]  # uT
    board: Board
    by_force: bool


class PressedPad(NamedTuple):
    """A pad fitted to presses, and its errors on presses left out."""

    fit: PadFit
    presses: int
    error_std: float  # uT, root mean square
    r2: float


def parse_tip(text: str) -> RoundTip:
    """A tip from its name, as `python -m i2t.convert presses --indenter` writes it.

    Args:
        text: `sphere:RADIUS` or `cylinder:RADIUS`, the radius in mm.

    Returns:
        The tip.

    Raises:
        ValueError: It is neither.
    """
    shape, _, radius = text.partition(":")
    try:
        millimetres = float(radius)
    except ValueError:
        millimetres = float("nan")
    if shape not in ("sphere", "cylinder") or not 0 < millimetres <= MAX_RADIUS_MM:
        raise ValueError(
            f'"{text}" is no tip that a pad can be fitted to; pass --tip sphere:RADIUS or --tip cylinder:RADIUS, the '
            f"radius in mm, up to {MAX_RADIUS_MM:g}"
        )
    return RoundTip("sphere" if shape == "sphere" else "cylinder", 1e-3 * millimetres)


def calibrated_presses(calibration: Calibration, board: Board) -> PressedSkin:
    """The presses that a calibration was fitted to.

    The weights of a structured Gaussian process are those of a linear system whose factor it holds, so that the
    readings are their product; one of a population holds the readings. Of two kinds of load the force is taken.

    Args:
        calibration: Of one skin.
        board: Its sensor board.

    Returns:
        The presses with the readings that were given.

    Raises:
        ValueError: The calibration is of another board, of what an earlier session left of the readings, or of presses
            of which nobody knows how hard they were.
    """
    gp = calibration.gp
    if isinstance(gp, PopulationGP):
        _check_channels(gp.readings.shape[1], board)
        if calibration.load_kind == "none":
            raise ValueError("the calibration knows no depth and no force; give one of presses with either")
        by_force = calibration.load_kind in ("force", "both")
        loads = np.asarray(gp.presses.loads)
        return PressedSkin(np.asarray(gp.presses.position), loads[:, -1], np.asarray(gp.readings), board, by_force)
    if gp.previous_session is not None:
        raise ValueError("the calibration is of what an earlier session left of the readings; give one of readings")
    channels = gp.weights.shape[1]
    _check_channels(channels, board)
    factor = np.asarray(gp.cholesky, np.float64)
    groups = len(factor)
    weights = np.asarray(gp.weights, np.float64).reshape(len(gp.weights), groups, -1).swapaxes(0, 1)
    readings = factor @ (factor.swapaxes(1, 2) @ weights)
    readings = readings.swapaxes(0, 1).reshape(len(gp.weights), channels)
    presses = gp.presses
    position, load = np.asarray(presses.position, np.float64), np.asarray(presses.load, np.float64)
    return PressedSkin(position, load, readings, board, calibration.load_kind == "force")


def _check_channels(channels: int, board: Board) -> None:
    if channels != board.num_readings:
        raise ValueError(f"the calibration has {channels} values a reading, and the board {board.num_readings}")


def fit_pressed_pad(pressed: PressedSkin, tip: RoundTip) -> PressedPad:
    """Fit a pad to presses with a known tip.

    Args:
        pressed: The presses.
        tip: What pressed.

    Returns:
        The pad, and its errors on presses left out.

    Raises:
        ValueError: Too few presses, or the fit found no pad.
    """
    count = len(pressed.load)
    if count < MIN_PAD_PRESSES:
        raise ValueError(f"{count} presses are too few to fit a pad to; give at least {MIN_PAD_PRESSES}")
    presses = Presses(jnp.float32(pressed.position), jnp.float32(pressed.load))
    readings, board = jnp.float32(pressed.readings), Board(*(jnp.float32(part) for part in pressed.board))
    fitted = fit_pad(presses, readings, tip=tip, board=board, by_force=pressed.by_force)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(fitted.pad)):
        raise ValueError(
            "no pad explains these presses; are tip, unit of the loads and board what they are said to be?"
        )
    error = pressed.readings - np.asarray(fitted.leave_one_out, np.float64)
    around = pressed.readings - pressed.readings.mean(0)
    r2 = float(1 - np.sum(error**2) / np.sum(around**2))
    return PressedPad(fitted, count, float(np.sqrt(np.mean(error**2))), r2)


def save_pressed_pad(path: Path | str, found: PressedPad, *, pad: str, source: str) -> None:
    """Write a fitted pad, and its errors, as one file.

    Args:
        path: Of the file; `.npz` by custom.
        found: The pad.
        pad: Name of the skin, as data sets call it.
        source: Of the presses: real, simulated or mixed.

    Raises:
        SerializationError: It cannot be written.
    """
    about = {
        "pad": pad, "source": source, "presses": found.presses, "error_std_uT": found.error_std, "r2": found.r2,
    }  # fmt: skip
    save_pad(path, found.fit.pad, about=about)
