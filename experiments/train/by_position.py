"""Rows of a recording of one tip: what predicts its readings from the position on the skin and the load, without an
image of the tip.

They learn from the training touches of the methods and predict the same held-out touches. They are no methods, as they
know one tip and say nothing of another object; on that tip a method on images has to beat them.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from i2t.dataset import Dataset, Split
from i2t.prediction.baselines import assign_folds, best_option
from i2t.prediction.touch_model import Reading
from i2t.recordings.loads import loaded_presses
from i2t.recordings.presses import LoadedPresses
from i2t.skin_models import calibrate
from i2t.skin_models.tip_gp.leave_one_out import limit_blas_threads
from i2t.skin_models.tip_gp.plain import PlainScales, fit_scales, predict_plain

TUNED, CALIBRATED = "tuned GP on position and load", "i2t.calibrate"
CALIBRATION_PRESSES = 1000  # the most that `i2t.calibrate` is made for
TUNED_PRESSES = 1000  # on which the scales of the tuned process are chosen: the cost grows with the cube
# Candidates for the scales, as multiples of the most likely ones.
LENGTHS, WIDTHS, NOISES = (1 / 4, 1 / 3, 1 / 2, 1, 2), (1 / 2, 1, 2), (0.1, 0.3, 1, 3)


class _Known(NamedTuple):
    """Presses to learn from, in random order."""

    x: Float[np.ndarray, "n 3"]  # position (m) and load (m or N)
    y: Float[np.ndarray, "n c"]  # uT
    groups: Int[np.ndarray, " n"]


def position_readings(dataset: Dataset, split: Split, seed: int) -> dict[str, Reading]:
    """Readings by a tuned Gaussian process and by `i2t.calibrate`, for recordings of one tip.

    Args:
        dataset: The touches, with the corrections of `corrected_dataset`.
        split: Those that train, and those that validate and test.
        seed: Of the order in which presses are drawn.

    Returns:
        Mean and standard deviation (m, 3 chips) uT of the m touches that validate or test, by the row's title; nothing
        where these touches are not all presses of one object at known places of the skin.
    """
    held_out = np.flatnonzero(split.validation | split.test)
    try:
        presses = loaded_presses(dataset, "auto")
    except ValueError:  # several objects or skins, or no known position or load
        return {}
    assert presses.row is not None
    number = np.full(len(dataset), -1)
    number[presses.row] = np.arange(len(presses.row))
    on_skin = (np.abs(presses.position) <= dataset.window / 2).all()
    if not on_skin or (number[held_out] < 0).any():
        return {}
    rows = np.random.default_rng(seed).permutation(np.flatnonzero(split.train & (number >= 0)))
    known = number[rows]
    x = np.column_stack([presses.position, presses.load])
    train, at = _Known(x[known], presses.readings[known], split.groups[rows]), x[number[held_out]]
    title = f"{CALIBRATED}, {min(len(rows), CALIBRATION_PRESSES)} of the presses"
    return {TUNED: _tuned(train, at), title: _calibrated(presses, train, at)}


def _tuned(train: _Known, at: Float[np.ndarray, "m 3"]) -> Reading:
    """The process whose scales have the least error on held-out groups of the training presses, and that error."""
    likely = fit_scales(train.x[:, :2], train.x[:, 2], train.y)
    options = [
        PlainScales(length * likely.length, width * likely.width, noise * likely.noise)
        for length, width, noise in product(LENGTHS, WIDTHS, NOISES)
    ]
    x, y, groups = (part[:TUNED_PRESSES] for part in train)
    with limit_blas_threads(len(x)):
        best, error = best_option(_by_scales, options, x, y, assign_folds(groups))
    mean = _by_scales(train.x, train.y, at, best)
    return Reading(mean, np.broadcast_to(np.sqrt((error**2).mean(0)), mean.shape))


def _by_scales(x: np.ndarray, y: np.ndarray, at: np.ndarray, scales: PlainScales) -> np.ndarray:
    return predict_plain(scales, (x[:, :2], x[:, 2], y), (at[:, :2], at[:, 2]))


def _calibrated(presses: LoadedPresses, train: _Known, at: Float[np.ndarray, "m 3"]) -> Reading:
    x, y, _ = (part[:CALIBRATION_PRESSES] for part in train)
    calibration = calibrate(x[:, :2], x[:, 2], y, load_kind=presses.load_kind, board=presses.unnamed_board)
    return Reading(*(np.asarray(part) for part in calibration.predict(at[:, :2], at[:, 2])))
