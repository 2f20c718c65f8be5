"""Presses of one tip: the columns that every reader of recordings fills, and views of them for who needs less."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from i2t.dataset import Dataset
from i2t.geometry import inverse
from i2t.types import Board

LoadName: TypeAlias = Literal["depth", "force", "none"]
MM_PER_M = 1e3


class Presses(NamedTuple):
    """Presses, a row each, in the order of time; None for a column that was not recorded, NaN for a value."""

    position: Float[np.ndarray, "n 2"]  # m, of the tip's axis on the skin, along the skin's edges
    readings: Float[np.ndarray, "n c"]  # uT, three channels for each chip; NaN of a chip that did not answer
    height: Float[np.ndarray, " n"] | None = None  # m, of the tip along the skin's outward normal, from anywhere
    force: Float[np.ndarray, " n"] | None = None  # N, along tool z: positive where the tip presses
    time: Float[np.ndarray, " n"] | None = None  # s
    pad: np.ndarray | None = None  # (n,) names
    session: np.ndarray | None = None  # (n,) names

    def rows(self, which: Any) -> "Presses":
        """Some of the presses.

        Args:
            which: A mask, row numbers or a slice.

        Returns:
            The presses of these rows.
        """
        return self._replace(**{name: column[which] for name, column in self._asdict().items() if column is not None})


def join_presses(parts: Sequence[Presses]) -> Presses:
    """Presses one after the other.

    Args:
        parts: Presses with the same columns, at least one part.

    Returns:
        The presses of all parts.
    """
    columns: dict[str, Any] = {name: [getattr(part, name) for part in parts] for name in Presses._fields}
    joined: dict[str, Any] = {
        name: None if parts[0] is None else np.concatenate(parts) for name, parts in columns.items()
    }
    return Presses(**joined)


def dataset_presses(dataset: Dataset) -> Presses:
    """The touches of a data set as presses.

    A height is minus the depth; of a press without depth it is the distance at which the tip stood before the skin,
    where that is known.

    Args:
        dataset: Touches of one object.

    Returns:
        A row for each touch; positions are those of the object's origin in the tool frame.
    """
    touches = dataset.touches
    T_t_o = inverse(touches.T_w_t.astype(np.float64)) @ touches.T_w_o
    depth, nearest = (np.asarray(column, np.float64) for column in (touches.depth, touches.nearest))
    return Presses(
        T_t_o[:, :2, 3],
        touches.reading.astype(np.float64),
        height=np.where(depth > 0, -depth, np.where(np.isnan(depth), np.nan, np.fmax(nearest, 0))),
        force=touches.force.astype(np.float64),
    )


class LoadedPresses(NamedTuple):
    """Presses by their place and by one load, as what predicts a reading is given them."""

    position: Float[np.ndarray, "n 2"]  # m
    load: Float[np.ndarray, " n"]  # m of depth, or N of force; of one value where none is known
    readings: Float[np.ndarray, "n c"]  # uT
    load_kind: LoadName
    notes: tuple[str, ...] = ()  # what is odd about the loads, a sentence each
    own_board: Board | None = None  # where it is none of a name, which `i2t.calibrate` tries by itself
    session: Int[np.ndarray, " n"] | None = None
    row: Int[np.ndarray, " n"] | None = None  # of the recording

    @property
    def by_force(self) -> bool:
        """Whether the load is a force."""
        return self.load_kind == "force"

    @property
    def coordinates(self) -> Float[np.ndarray, "n 3"]:
        """Position (m), and load in its standard deviations."""
        return np.column_stack([self.position, self.load / max(float(self.load.std()), 1e-9)])

    def features(self, rows: np.ndarray) -> Float[np.ndarray, "k 3"]:
        """Position and load in their standard deviations, for neighbours.

        Args:
            rows: Row numbers, or a mask.

        Returns:
            Of these rows.
        """
        both = np.column_stack([self.position, self.load])
        return (both / np.maximum(both.std(0), 1e-9))[rows]
