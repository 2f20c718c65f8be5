"""Presses of one tip: the columns that all readers of recordings fill, and the subset that models of skins need."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from i2t.dataset import Dataset
from i2t.geometry import inverse
from i2t.types import Board

LoadName: TypeAlias = Literal["travel", "force", "none"]


class Presses(NamedTuple):
    """n presses of a tip on a skin, in the order of time: positions and heights (m), readings (uT), forces (N), times
    (s) and names of pads and sessions. An unrecorded column is None, and a missing value NaN.
    """

    position: Float[np.ndarray, "n 2"]  # m, position of the tip's axis on the skin, along the skin's edges
    # uT, readings with three channels for each chip; NaN for a chip that did not answer
    readings: Float[np.ndarray, "n c"]
    # m, height of the tip along the skin's outward normal, from any origin
    height: Float[np.ndarray, " n"] | None = None
    force: Float[np.ndarray, " n"] | None = None  # N, force along tool z, positive if the tip presses
    time: Float[np.ndarray, " n"] | None = None  # s
    pad: np.ndarray | None = None  # (n,) names of the pads
    session: np.ndarray | None = None  # (n,) names of the sessions

    def rows(self, which: Any) -> "Presses":
        """Select some of the presses.

        Args:
            which: A mask, row numbers or a slice.

        Returns:
            The selected presses.
        """
        return self._replace(**{name: column[which] for name, column in self._asdict().items() if column is not None})


def join_presses(parts: Sequence[Presses]) -> Presses:
    """Concatenate several sets of presses.

    Args:
        parts: At least one part; all have the same columns.

    Returns:
        The presses of all parts, in their order.
    """
    columns: dict[str, Any] = {name: [getattr(part, name) for part in parts] for name in Presses._fields}
    columns = {name: None if values[0] is None else np.concatenate(values) for name, values in columns.items()}
    return Presses(**columns)


def dataset_presses(dataset: Dataset) -> Presses:
    """Convert the touches of a data set to presses of its object, the tip, on the skin.

    A height is minus the travel, and NaN if the travel is unknown. If the travel is 0, it is the distance at which the
    tip stopped before the skin, or 0 if that is unknown.

    Args:
        dataset: Touches of one object.

    Returns:
        A press for each touch; its position is that of the object's origin in the tool frame.
    """
    touches = dataset.touches
    T_t_o = inverse(touches.T_w_t.astype(np.float64)) @ touches.T_w_o
    travel, nearest = (np.asarray(column, np.float64) for column in (touches.travel, touches.nearest))
    return Presses(
        T_t_o[:, :2, 3],
        touches.reading.astype(np.float64),
        height=np.where(travel > 0, -travel, np.where(np.isnan(travel), np.nan, np.fmax(nearest, 0))),
        force=touches.force.astype(np.float64),
    )


class LoadedPresses(NamedTuple):
    """n presses with position (m), one load (travel in m or force in N) and reading (uT), as models of a tip on a skin
    take them.
    """

    position: Float[np.ndarray, "n 2"]  # m
    load: Float[np.ndarray, " n"]  # load of each press: travel in m, or force in N; constant if unknown
    readings: Float[np.ndarray, "n c"]  # uT
    load_kind: LoadName
    notes: tuple[str, ...] = ()  # irregularities of the loads, one sentence each
    unnamed_board: Board | None = None  # board without a name, which `i2t.calibrate` also tries
    session: Int[np.ndarray, " n"] | None = None
    row: Int[np.ndarray, " n"] | None = None  # row of each press in the recording

    @property
    def by_force(self) -> bool:
        """Whether the load is a force."""
        return self.load_kind == "force"

    @property
    def coordinates(self) -> Float[np.ndarray, "n 3"]:
        """`(n, 3)` position in m, and load in its standard deviations."""
        return np.column_stack([self.position, self.load / max(float(self.load.std()), 1e-9)])

    def features(self, rows: np.ndarray) -> Float[np.ndarray, "k 3"]:
        """Scale position and load for a search of nearest neighbours.

        Args:
            rows: Row numbers, or a mask.

        Returns:
            `(k, 3)` position and load of these k rows, in standard deviations over all presses.
        """
        both = np.column_stack([self.position, self.load])
        return (both / np.maximum(both.std(0), 1e-9))[rows]
