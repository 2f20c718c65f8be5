"""Tactile samples of Imagine2touch: object arrays of [time, delay, values, device], whose 20 values are a temperature
and a field for each of five chips.

The binary mode of the board puts the temperature first, the ASCII mode last. The ambient field was stored as means of
15 values, or as samples again.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from i2t.convert import npy
from i2t.errors import DataError
from i2t.recordings.files import data_error
from i2t.recordings.log import ZERO_AMBIENT, ReadingLog, require_ambient
from i2t.skin.boards import AXES_OF_CHIP, mean_finite, without_silent_chips

CHIPS = 5  # number of chips on the board of the paper's skin
PAPER_READING_SIZE = AXES_OF_CHIP * CHIPS  # number of values in a sample of the paper's skin
MAX_SAMPLE_VALUE = 1e6  # uT, value of a sample from which its touch counts as damaged; chips end at 1.3e5 uT


def readings(tactile: Path, order: str, notes: ReadingLog) -> tuple[np.ndarray, np.ndarray]:
    """Compute the readings of the touches in one Imagine2touch recording: mean in contact minus mean ambient, over the
    samples in which all chips answered.

    Args:
        tactile: File of the samples in contact, with or without `.npy`; the ambient file is next to it.
        order: Order of a chip's values in a sample: "binary" (temperature t first), "ascii" (t last), or "auto", which
            looks for the steady value, the temperature.
        notes: Log that receives findings and omissions.

    Returns:
        `(n, 15)` readings (uT), NaN in a damaged touch and of a chip that did not answer; and `(n,)` times (s) of the
        last sample of each touch, NaN if samples are bare values.

    Raises:
        DataError: If a file is missing or damaged.
    """
    path = _existing(tactile)
    items = _list(path)
    touches = [_samples(path, touch) for touch in items]
    if not touches:
        raise data_error(path, "holds no touch")
    if any(len(sample) != 4 * CHIPS for touch in touches for sample in touch):
        raise data_error(path, f"holds a sample that has not {4 * CHIPS} values")
    values = np.array([sample for touch in touches for sample in touch])
    if order == "auto" and values.any():  # the order does not matter for a board that never answered
        order = _detected(path, values)
        notes.info(f"{path}: samples are in {order} order")
    means = _means(path, touches, order, notes)
    path = _existing(tactile.with_name(tactile.name + "_ambient"))
    groups = [_samples(path, group) for group in _list(path)]
    n = len(touches)
    if len(groups) not in (n, math.ceil(n / 10)):
        raise data_error(
            path, f"holds {len(groups)} groups for {n} touches, neither one for each touch nor one for every 10"
        )
    ambient = _means(path, groups, order, notes)
    ambient = ambient if len(groups) == n else ambient[np.arange(n) // 10]
    sound = ~(np.isinf(means) | np.isinf(ambient)).any(1)
    silent, silent_ambient = (
        np.isnan(mean[sound]).reshape(-1, CHIPS, AXES_OF_CHIP).any(2) for mean in (means, ambient)
    )
    if len(silent) and silent_ambient.all() and not silent.all():
        notes.doubt("ambient field", f"{path}: {ZERO_AMBIENT}")
        silent_ambient[:] = False
        ambient = np.where(np.isnan(ambient), 0, ambient)
    require_ambient(path, silent, silent_ambient, "record it again, or write zeros for all chips to subtract nothing")
    notes.select_answered(silent | silent_ambient)
    difference = np.full(means.shape, np.nan)
    difference[sound] = means[sound] - ambient[sound]
    return difference, np.array([_time(t) for t in items])


def _existing(path: Path) -> Path:
    existing = npy.find(path)
    if existing is None:
        raise data_error(path, "is missing")
    return existing


def _list(path: Path) -> list[Any]:
    values = npy.read(path)
    items = values if isinstance(values, list) else values.tolist()
    if not isinstance(items, list):
        raise data_error(path, "holds one number instead of touches")
    return items


def _means(path: Path, touches: list[list[list[float]]], order: str, notes: ReadingLog) -> np.ndarray:
    """Compute mean fields (n, 15), NaN for a chip that did not answer in any sample.

    A touch with an implausible value is infinite, and noted as damaged.
    """
    means = np.array([_mean(touch, order) for touch in touches])
    for k in np.flatnonzero(np.isinf(means).any(1)):
        notes.skip(
            data_error(
                path, f"item {k + 1} holds a value that is not a field (not finite, or above {MAX_SAMPLE_VALUE:g} uT)"
            )
        )
    return means


def _samples(path: Path, item: Any) -> list[list[float]]:
    """List all samples of one touch, of 15 or 20 values each, however they are nested: as bare values or inside [time,
    delay, values, device].
    """
    if isinstance(item, list):
        if len(item) in (PAPER_READING_SIZE, 4 * CHIPS) and all(isinstance(value, int | float) for value in item):
            return [[float(value) for value in item]]
        if len(item) == 4 and isinstance(item[2], list) and not isinstance(item[0], list):
            return _samples(path, item[2])
        if item and all(isinstance(part, list) for part in item):
            return [sample for part in item for sample in _samples(path, part)]
    kind = f"a list of {len(item)}" if isinstance(item, list) else repr(item)[:40]
    raise data_error(path, f"holds {kind} where a sample of {PAPER_READING_SIZE} or {4 * CHIPS} values should be")


def _time(item: Any) -> float:
    """Return the time in the last of nested samples [time, delay, values, device]."""
    if not isinstance(item, list):
        return math.nan
    if len(item) == 4 and isinstance(item[2], list) and not isinstance(item[0], list):
        stamped = isinstance(item[0], int | float) and math.isfinite(item[0])
        return float(item[0]) if stamped else math.nan
    return _time(item[-1]) if item else math.nan


def _mean(samples: list[list[float]], order: str) -> np.ndarray:
    """Compute the mean field (15,) of the samples in which a chip answered, chip by chip."""
    fields = without_silent_chips(np.array([_field(sample, order) for sample in samples]))
    if np.any(np.abs(fields) >= MAX_SAMPLE_VALUE):
        return np.full(PAPER_READING_SIZE, np.inf)
    return mean_finite(fields, axis=0)


def _field(sample: list[float], order: str) -> np.ndarray:
    """Return the field (15,) of one sample, infinite for a value that is not finite."""
    values = np.array(sample, np.float64).reshape(CHIPS, -1)
    field = values if values.shape[1] == 3 else values[:, 1:] if order == "binary" else values[:, :3]
    return np.where(np.isfinite(field), field, np.inf).ravel()


def _detected(path: Path, samples: np.ndarray) -> str:
    """Detect whether the first or the last of a chip's four values is the temperature.

    The temperature is within the chip's range and steady, unlike any field component on five chips at once.
    """
    spread = {}
    for order, column in (("binary", 0), ("ascii", 3)):
        chips = samples.reshape(-1, CHIPS, 4)
        # A chip that fails also sends a temperature of zero.
        answered = (chips != 0).any(2)
        values = chips[..., column][answered]
        values = values[np.abs(values) < MAX_SAMPLE_VALUE]
        plausible = (
            values.size
            and values.min() >= -40  # degrees Celsius, the range of the chips
            and values.max() <= 85
            and 5 <= values.mean() <= 60  # small numbers about zero are a field in millitesla
        )
        # Chips differ by 1 to 2.5 K.
        spread[order] = float(values.std()) if plausible and values.std() < 10 else math.inf
    best, other = sorted(spread, key=lambda order: spread[order])
    if not 3 * spread[best] < spread[other]:  # both could be a temperature, and neither is much steadier
        raise DataError(f"{path}: does not show whether temperature comes first or last; pass --order binary or ascii")
    return best
