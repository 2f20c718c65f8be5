"""Presses of one tip on one skin as arrays."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from i2t.dataset import Dataset, square_blocks
from i2t.geometry import inverse
from i2t.recordings.sets import corrected_dataset
from i2t.skin.boards import name_of_board
from i2t.skin_models import LoadKind
from i2t.skin_models.magnetization import Presses
from i2t.types import Board, ReturnCode

MM_PER_M = 1e3
DEPTH_OF_UNKNOWN_M = 2e-3  # of every press, where neither depth nor force is known
LEAST_LOAD_RANGE = 1e-6  # of the largest load: less is one load


@dataclass(frozen=True)
class PressRecording:
    """Presses in the order of time."""

    position: np.ndarray  # (n, 2) m
    load: np.ndarray  # (n,) m of depth, or N of force
    readings: np.ndarray  # (n, c) uT
    by_force: bool
    notes: tuple[str, ...] = ()  # what is odd about the loads, a sentence each
    own_board: Board | None = None  # where it is none of a name, which `i2t.calibrate` tries by itself

    @property
    def load_kind(self) -> LoadKind:
        """Kind of the load."""
        return "force" if self.by_force else "depth"

    def presses(self, rows: np.ndarray) -> Presses:
        """Presses of some rows, to fit a pad to."""
        return Presses(jnp.float32(self.position[rows]), jnp.float32(self.load[rows]))

    def features(self, rows: np.ndarray) -> np.ndarray:
        """Position and load in their standard deviations, for neighbours."""
        both = np.column_stack([self.position, self.load])
        return (both / np.maximum(both.std(0), 1e-9))[rows]

    def blocks(self, edge_mm: float) -> np.ndarray:
        """The square block of this edge in which each press lies, counted from 0."""
        return square_blocks(MM_PER_M * self.position, edge_mm)


def read_presses(dataset: Dataset, load: str) -> PressRecording:
    """Positions of the tool's origin on the skin, and depth or force; presses that failed or met air are left out."""
    dataset, corrected = corrected_dataset(dataset)
    touches = dataset.touches
    T_t_o = inverse(touches.T_w_t.astype(np.float64)) @ touches.T_w_o
    good = ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR, ReturnCode.FREE])
    by_force = load == "force" or (load == "auto" and not np.isfinite(touches.depth[good]).all())
    amount = (touches.force if by_force else touches.depth).astype(np.float64)
    unknown = load == "auto" and not np.isfinite(amount[good]).any()
    if unknown:  # as where all presses go to one height, whose depth nothing tells
        by_force, amount = False, np.full(len(amount), DEPTH_OF_UNKNOWN_M)
    good &= np.isfinite(amount) & np.isfinite(T_t_o).all((1, 2))
    kind = "force" if by_force else "depth"
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
    return PressRecording(
        T_t_o[good, :2, 3], amount[good], readings, by_force, notes=(*corrected, *notes), own_board=own
    )


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
