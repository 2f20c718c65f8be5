"""Presses of one tip on one skin, by position and load, from a data set of touches."""

from typing import Literal

import numpy as np

from i2t.dataset import Dataset
from i2t.recordings.presses import LoadedPresses, LoadName, dataset_presses
from i2t.recordings.sets import corrected_dataset
from i2t.skin.boards import name_of_board
from i2t.types import ReturnCode

ASSUMED_TRAVEL_M = 2e-3  # m, travel assumed for every press if neither travel nor force is known


def loaded_presses(dataset: Dataset, load: Literal["auto", "travel", "force"]) -> LoadedPresses:
    """Select, from touches of one object (the tip) with one skin, the presses with a known position and load.

    Presses that failed or did not meet the skin, and those with a negative load, are left out.

    Args:
        dataset: Recorded or simulated touches of one object with one skin.
        load: Column that measures the load. "auto" is the travel if every press has one or none has a force, else the
            force.

    Returns:
        The presses with their rows in the data set, and a note on each irregularity.

    Raises:
        ValueError: No press has a known position and load, no force is above 0 N, or the data set holds several skins
            or objects.
    """
    dataset, corrected = corrected_dataset(dataset)
    touches = dataset.touches
    position = dataset_presses(dataset).position
    good = ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR, ReturnCode.FREE])
    prefer_force = np.isfinite(touches.force[good]).any() and not np.isfinite(touches.travel[good]).all()
    by_force = load == "force" or (load == "auto" and bool(prefer_force))
    amount = (touches.force if by_force else touches.travel).astype(np.float64)
    unknown = load == "auto" and not np.isfinite(amount[good]).any()
    if unknown:  # such as presses that all go to one height
        by_force, amount = False, np.full(len(amount), ASSUMED_TRAVEL_M)
    good &= np.isfinite(amount) & np.isfinite(position).all(1)
    kind: LoadName = "force" if by_force else "travel"
    if not good.any():
        other = "travel" if by_force else "force"
        raise ValueError(
            f"no press has a known position and {kind}, and readings cannot be predicted without them; choose --load "
            f"{other} if that was recorded"
        )
    if len(np.unique(touches.pad[good])) > 1:
        raise ValueError("the data set holds several skins; calibrate them one at a time")
    if len(np.unique(touches.object[good])) > 1:
        raise ValueError("the data set holds several objects; calibration needs presses of one tip")
    pushing, notes = _pushing_loads(amount, good, kind)
    if unknown:
        notes = ("neither travel nor force is known: all presses are assumed to have the same travel",)
    good &= pushing
    readings = touches.reading[good].astype(np.float64)
    own = None if name_of_board(dataset.board) else dataset.board
    return LoadedPresses(
        position[good], amount[good], readings, kind,
        notes=(*corrected, *notes), unnamed_board=own, row=np.flatnonzero(good),
    )  # fmt: skip


def presses_one_tip(dataset: Dataset, *, max_angle: float = 0.1) -> bool:
    """Test whether all touches are presses of one tip: one object, always met from the same side.

    Args:
        dataset: The touches.
        max_angle: Largest angle (rad) between the tool's axis, in the object's frame, and its mean.

    Returns:
        True for presses of one tip; False also if the poses are unknown.
    """
    touches = dataset.touches
    axes = np.einsum("nij,ni->nj", touches.T_w_o[:, :3, :3], touches.T_w_t[:, :3, 2])
    mean = axes.mean(0)
    return bool(len(np.unique(touches.object)) == 1 and (axes @ mean >= np.cos(max_angle) * np.linalg.norm(mean)).all())


def _pushing_loads(amount: np.ndarray, good: np.ndarray, kind: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the mask of loads that push, and notes on their irregularities; ValueError if no force pushes."""
    notes = []
    pushing = amount >= 0
    if count := int(np.sum(good & ~pushing)):
        notes.append(f"{count} presses with a negative {kind} are left out")
    largest = float(amount[good & pushing].max(initial=0.0))
    if kind == "force" and largest <= 0:
        raise ValueError(
            "every force is zero, so the load of the presses is unknown; choose --load travel if it is known"
        )
    if float(np.ptp(amount[good & pushing])) <= 1e-6 * max(largest, 1e-9):
        notes.append(f"all presses have the same {kind}, so only the dependence on position is learned")
    return pushing, tuple(notes)
