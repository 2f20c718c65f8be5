"""The converter's steps as a checksum: a board's values are whole numbers of steps, a changed byte seldom leaves one.

The firmware multiplies the converter's 16-bit counts by one constant for each axis (and 1/45.2 K, from 25 degrees, for
the temperature), in float32. The constants depend on gain and library, so they are learned from the first frames. At
50 uT and steps of 0.15 uT one float32 in 6000 is a whole number of steps within three units of its last place.
"""

from typing import NamedTuple

import numpy as np

ORIGIN = np.array([25.0, 0.0, 0.0, 0.0])  # degrees, uT: where t, x, y, z count from
SLACK = 3.0  # float32 units in the last place that the firmware's roundings may come to
SHARE = 0.9  # of the values must lie on a grid for it to be believed
FEWEST = 6  # different values, each seen twice, from which a step is learned


class Grid(NamedTuple):
    """Steps of t, x, y and z; NaN where none was found."""

    step: np.ndarray  # (4,) K, uT

    def holds(self, table: np.ndarray) -> bool:
        """Whether every value (5, 4) is a whole number of its steps."""
        return bool(np.all(_on(table, self.step) | np.isnan(self.step)[None]))


NO_GRID = Grid(np.full(4, np.nan))


def learn(tables: np.ndarray) -> Grid:
    """The grid of frames (n, 5, 4), some of which may be damaged; 100 are enough."""
    return Grid(np.array([_step(tables[:, :, column] - ORIGIN[column], column) for column in range(4)]))


def _step(offsets: np.ndarray, column: int) -> float:
    """The step of one column, NaN if its values have none in common.

    Values that occur twice are whole numbers of steps, for changed bytes do not repeat. Their smallest difference is
    one step, about; least squares over ever larger values, whose number of steps is known well enough by then, make it
    exact.
    """
    values, count = np.unique(offsets, return_counts=True)
    values = values[(count > 1) & (values != 0)]
    if len(values) < FEWEST:
        return np.nan
    gaps = np.diff(values)
    gaps = gaps[gaps < 1.5 * gaps.min()]
    step = float(gaps.mean())
    values = values[np.argsort(np.abs(values))]
    for known in range(2, len(values) + 1):
        some = values[:known]
        number = np.round(some / step)
        if not number.any():
            return np.nan
        step = float(some @ number / (number @ number))
    table = np.zeros((*offsets.shape, 4))
    table[..., column] = offsets + ORIGIN[column]
    on = _on(table, np.full(4, step))[..., column]
    return step if on.mean() >= SHARE else np.nan


def _on(table: np.ndarray, step: np.ndarray) -> np.ndarray:
    offset = table - ORIGIN
    size = np.maximum(np.abs(table), ORIGIN).astype(np.float32)
    return np.abs(offset - np.round(offset / step) * step) <= SLACK * np.spacing(size)
