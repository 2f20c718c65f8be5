"""The converter's steps as a checksum: a board's values are whole numbers of steps, a changed byte seldom leaves one.

The firmware multiplies the converter's 16-bit counts by one constant for each axis (and 1/45.2 K, from 25 degrees, for
the temperature), in float32. The constants depend on gain and library, so they are learned from the first frames. At
50 uT and steps of 0.15 uT one float32 in 6000 is a whole number of steps within three units of its last place.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

ORIGIN = np.array([25.0, 0.0, 0.0, 0.0])  # degrees, uT: where t, x, y, z count from
ROUNDING_ULPS = 3.0  # float32 units in the last place that the firmware's roundings may come to
MIN_SHARE = 0.9  # of the values must be whole numbers of steps for the steps to be believed
MIN_VALUES = 6  # different values, each seen twice, from which a step is learned


class ConverterSteps(NamedTuple):
    """Steps of t, x, y and z; NaN where none was found."""

    size: Float[np.ndarray, " 4"]  # K, uT

    def fit(self, table: Float[np.ndarray, "chips 4"]) -> bool:
        """Whether every value is a whole number of its steps.

        Args:
            table: t, x, y, z of each chip, degrees Celsius and uT.

        Returns:
            True also for values whose step is not known.
        """
        return bool(np.all(_is_whole(table, self.size) | np.isnan(self.size)[None]))


NO_STEPS = ConverterSteps(np.full(4, np.nan))


def learn_steps(tables: Float[np.ndarray, "frames chips 4"]) -> ConverterSteps:
    """The steps of a board.

    Args:
        tables: t, x, y, z of each chip in some frames, some of which may be damaged; 100 are enough.

    Returns:
        Steps, NaN for a column whose values have none in common.
    """
    return ConverterSteps(np.array([_step(tables[:, :, column] - ORIGIN[column], column) for column in range(4)]))


def _step(offsets: Float[np.ndarray, "frames chips"], column: int) -> float:
    """The step of one column, NaN if its values have none in common.

    Values that occur twice are whole numbers of steps, for changed bytes do not repeat. Their smallest difference is
    one step, about; least squares over ever larger values, whose number of steps is known well enough by then, make it
    exact.
    """
    values, count = np.unique(offsets, return_counts=True)
    values = values[(count > 1) & (values != 0)]
    if len(values) < MIN_VALUES:
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
    whole = _is_whole(table, np.full(4, step))[..., column]
    return step if whole.mean() >= MIN_SHARE else np.nan


def _is_whole(table: Float[np.ndarray, "*n 4"], step: Float[np.ndarray, " 4"]) -> Bool[np.ndarray, "*n 4"]:
    offset = table - ORIGIN
    size = np.maximum(np.abs(table), ORIGIN).astype(np.float32)
    return np.abs(offset - np.round(offset / step) * step) <= ROUNDING_ULPS * np.spacing(size)
