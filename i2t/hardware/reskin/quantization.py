"""The converter's steps as a checksum: a board's values are whole numbers of steps, a changed byte seldom leaves one;
and its ends, where a field that grows on begins again at the other one.

The firmware multiplies the converter's 16-bit counts by one constant for each axis (and 1/45.2 K, from 25 degrees, for
the temperature), in float32. The constants depend on gain and library, so they are learned from the first frames. At
50 uT and steps of 0.15 uT one float32 in 6000 is a whole number of steps within three units of its last place.

The counts have 16 bits: beyond 2^15 steps (7.93 mT along z at the finest) they begin again at -2^15, a jump of 15.86 mT
between two frames. Whoever knows the steps knows that jump; without them it must be one of the steps that the chip has.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

ORIGIN = np.array([25.0, 0.0, 0.0, 0.0])  # degrees, uT: where t, x, y, z count from
ROUNDING_ULPS = 3.0  # float32 units in the last place that the firmware's roundings may come to
MIN_SHARE = 0.9  # of the values must be whole numbers of steps for the steps to be believed
MIN_TEXT_SHARE = 0.97  # likewise, of values that are rounded, of which more fit by chance
MIN_VALUES = 6  # different values, each seen twice, from which a step is learned
AVERAGED_SAMPLES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 25, 32)  # that firmware may average
ZEROED_ROUNDING_UT = 5e-5  # of a value from which a baseline was subtracted, that may be larger
LEAST_STEP_IN_ROUNDINGS = 10.0  # smaller steps tell nothing
CONVERTER_COUNTS = 2**16
# uT, by gain 0 to 7 at the finest resolution, which may be made 2, 4 and 8 times coarser (MLX90393 data sheet)
MLX90393_XY_STEPS_UT = (0.751, 0.601, 0.451, 0.376, 0.300, 0.250, 0.200, 0.150)
MLX90393_Z_STEPS_UT = (1.210, 0.968, 0.726, 0.605, 0.484, 0.403, 0.323, 0.242)
MIN_WRAP_UT = CONVERTER_COUNTS * min(MLX90393_XY_STEPS_UT) / 2  # no smaller jump is one over the converter's end
KNOWN_EDGE, GUESSED_EDGE = 0.5, 0.8  # of the way to its end, that a channel must be on both sides of such a jump


class ConverterSteps(NamedTuple):
    """Steps of t, x, y and z; NaN where none was found."""

    size: Float[np.ndarray, " 4"]  # K, uT
    origin: Float[np.ndarray, "*chips 4"] = ORIGIN  # degrees, uT, from which each value counts
    rounding: float = 0.0  # degrees, uT, of the board's own, besides that of its numbers

    def fit(self, table: Float[np.ndarray, "chips 4"]) -> bool:
        """Test whether every value is a whole number of its steps.

        Args:
            table: t, x, y, z of each chip, degrees Celsius and uT.

        Returns:
            True also for values whose step is not known, and for chips that are missing.
        """
        whole = _is_whole(table, self.size, self.origin, self.rounding)
        return bool(np.all(whole | np.isnan(self.size)[None] | np.isnan(table)))


NO_STEPS = ConverterSteps(np.full(4, np.nan))


def learn_steps(tables: Float[np.ndarray, "frames chips 4"], rounding: float = 0.0) -> ConverterSteps:
    """The steps of a board.

    Firmware that zeroes or averages counts from elsewhere, and in parts of a step: such steps are looked for among
    those of the data sheet.

    Args:
        tables: t, x, y, z of each chip in some frames, some of which may be damaged; 100 are enough. NaN is missing.
        rounding: Degrees or uT, half of the last digit that the board writes; 0 where it sends numbers.

    Returns:
        Steps, NaN for a column whose values have none in common.
    """
    if not rounding:
        plain = ConverterSteps(np.array([_step(tables[:, :, column] - ORIGIN[column], column) for column in range(4)]))
        if not np.isnan(plain.size[1:]).any():
            return plain
    size, origin = np.full(4, np.nan), np.tile(ORIGIN, (tables.shape[1], 1))
    for column in (1, 2, 3):
        size[column], origin[:, column] = _lattice(tables[:, :, column], column, rounding)
    return ConverterSteps(size, origin, max(rounding, ZEROED_ROUNDING_UT))


def _lattice(
    values: Float[np.ndarray, "frames chips"], column: int, rounding: float
) -> tuple[float, Float[np.ndarray, " chips"]]:
    """The largest step of the data sheet, or part of one, that nearly all values are whole numbers of, each chip
    counting from its own origin; NaN and zeros if there is none.
    """
    known = values[np.isfinite(values).all(1)]
    table = MLX90393_Z_STEPS_UT if column == 3 else MLX90393_XY_STEPS_UT
    steps = np.unique([each * 2.0**resolution for each in table for resolution in range(4)])
    if not rounding:
        steps = np.unique(steps[:, None] / np.array(AVERAGED_SAMPLES))
    nearest = max(rounding, ZEROED_ROUNDING_UT)
    for step in steps[steps > LEAST_STEP_IN_ROUNDINGS * nearest][::-1] if len(known) else ():
        origin = np.angle(np.exp(2j * np.pi * known / step).mean(0)) * step / (2 * np.pi)
        left = known - origin
        left -= step * np.round(left / step)
        origin = origin + np.median(left, 0)
        left = known - origin
        left -= step * np.round(left / step)
        share = MIN_TEXT_SHARE if rounding else MIN_SHARE
        if np.mean(np.abs(left) <= nearest + 1e-9) >= share and np.ptp(known, 0).max() > MIN_VALUES * step:
            return float(step), origin
    return np.nan, np.zeros(values.shape[1])


def wrap_offsets(
    before: Float[np.ndarray, "chips 3"], after: Float[np.ndarray, "chips 3"], steps: ConverterSteps | None
) -> Float[np.ndarray, "chips 3"]:
    """Offsets of a frame's channels that went over the converter's end since the frame before.

    A jump is taken for one where both values lie near the two ends: half of the way at least where the steps are
    known, four fifths for steps of the chip's data sheet. Any other jump is the field's.

    Args:
        before: uT, as the converter gave it.
        after: uT, likewise.
        steps: Of the converter, where they are known.

    Returns:
        uT; 0 for all other channels.
    """
    change, offsets = after - before, np.zeros(after.shape)
    for chip, axis in np.argwhere(np.abs(change) > MIN_WRAP_UT).tolist():  # NaN is not
        step = np.nan if steps is None else steps.size[1 + axis]
        length = _wrap_length(before[chip, axis], after[chip, axis], step, axis)
        offsets[chip, axis] = -np.sign(change[chip, axis]) * length
    return offsets


def _wrap_length(before: float, after: float, step: float, axis: int) -> float:
    """uT from one end of the converter to the other, 0 if these two values are not at its ends."""
    table = MLX90393_Z_STEPS_UT if axis == 2 else MLX90393_XY_STEPS_UT
    guesses = [each * 2**resolution for each in table for resolution in range(4)]
    steps, edge = (guesses, GUESSED_EDGE) if np.isnan(step) else ([step], KNOWN_EDGE)
    low, high = sorted((abs(before), abs(after)))
    lengths = [CONVERTER_COUNTS * each for each in steps]
    fitting = [each for each in lengths if low >= edge * each / 2 and high <= each / 2 + steps[0]]
    return min(fitting, key=lambda each: abs(abs(after - before) - each), default=0.0)


def _step(offsets: Float[np.ndarray, "frames chips"], column: int) -> float:
    """The step of one column, NaN if its values have none in common.

    Values that occur twice are whole numbers of steps, for changed bytes do not repeat. Their smallest difference is
    one step, about; least squares over ever larger values, whose number of steps is known well enough by then, make it
    exact.
    """
    offsets = offsets[np.isfinite(offsets)]
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


def _is_whole(
    table: Float[np.ndarray, "*n 4"],
    step: Float[np.ndarray, " 4"],
    origin: Float[np.ndarray, "*chips 4"] = ORIGIN,
    rounding: float = 0.0,
) -> Bool[np.ndarray, "*n 4"]:
    offset = table - origin
    size = np.maximum(np.abs(table), ORIGIN).astype(np.float32)
    return np.abs(offset - np.round(offset / step) * step) <= ROUNDING_ULPS * np.spacing(size) + rounding + 1e-9
