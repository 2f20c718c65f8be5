"""Touches of one tip on one skin as presses by position and load."""

from typing import Literal

import numpy as np

from i2t.dataset import Dataset
from i2t.recordings.presses import LoadedPresses, LoadName, dataset_presses
from i2t.recordings.sets import corrected_dataset
from i2t.skin.boards import name_of_board
from i2t.types import ReturnCode

DEPTH_OF_UNKNOWN_M = 2e-3  # of every press, where neither depth nor force is known
LEAST_LOAD_RANGE = 1e-6  # of the largest load: less is one load


def loaded_presses(dataset: Dataset, load: Literal["auto", "depth", "force"]) -> LoadedPresses:
    """The touches of one tip on one skin by position and load; presses that failed or met air are left out.

    Args:
        dataset: Recorded or simulated touches of one object with one skin.
        load: The column that says how hard was pressed; "auto" is the depth where it was measured at every press or no
            force was, else the force.

    Returns:
        The presses whose position and load are known, with their rows in the data set and a note for each oddity.

    Raises:
        ValueError: No press has a known position and load, none of the forces pushes, or there are several skins or
            several objects.
    """
    dataset, corrected = corrected_dataset(dataset)
    touches = dataset.touches
    position = dataset_presses(dataset).position
    good = ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR, ReturnCode.FREE])
    forced = np.isfinite(touches.force[good]).any() and not np.isfinite(touches.depth[good]).all()
    by_force = load == "force" or (load == "auto" and bool(forced))
    amount = (touches.force if by_force else touches.depth).astype(np.float64)
    unknown = load == "auto" and not np.isfinite(amount[good]).any()
    if unknown:  # as where all presses go to one height, whose depth nothing tells
        by_force, amount = False, np.full(len(amount), DEPTH_OF_UNKNOWN_M)
    good &= np.isfinite(amount) & np.isfinite(position).all(1)
    kind: LoadName = "force" if by_force else "depth"
    if not good.any():
        other = "depth" if by_force else "force"
        raise ValueError(
            f"no press has a known position and {kind}, and what a press reads cannot be told without; choose --load "
            f"{other} if that was recorded"
        )
    if len(np.unique(touches.pad[good])) > 1:
        raise ValueError("the data set holds several skins; calibrate them one at a time")
    if len(np.unique(touches.object[good])) > 1:
        raise ValueError("the data set holds several objects; calibration needs presses of one tip")
    pushing, notes = _pushing_loads(amount, good, kind)
    if unknown:
        notes = ("neither depth nor force is known: all presses are taken to go to one depth",)
    good &= pushing
    readings = touches.reading[good].astype(np.float64)
    own = None if name_of_board(dataset.board) else dataset.board
    return LoadedPresses(
        position[good], amount[good], readings, kind,
        notes=(*corrected, *notes), own_board=own, row=np.flatnonzero(good),
    )  # fmt: skip


def _pushing_loads(amount: np.ndarray, good: np.ndarray, kind: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Which loads push, and what is odd about them; ValueError where none pushes."""
    notes = []
    pushing = amount >= 0
    if lost := int(np.sum(good & ~pushing)):
        notes.append(f"{lost} presses with a negative {kind} are left out")
    largest = float(amount[good & pushing].max(initial=0.0))
    if kind == "force" and largest <= 0:
        raise ValueError(
            "every force is zero, so nothing says how hard was pressed; choose --load depth if it is known"
        )
    if float(np.ptp(amount[good & pushing])) <= LEAST_LOAD_RANGE * max(largest, 1e-9):
        notes.append(f"all presses have one {kind}, so only what depends on the position is learned")
    return pushing, tuple(notes)
