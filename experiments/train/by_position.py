"""Predictions for a recording of one tip from the position on the skin and the load, without an image of the tip.

They are trained and tested on the same touches as the methods. They do not count as methods, because they apply to one
tip only. On that tip, a method on images should beat them.
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


class _TrainingPresses(NamedTuple):
    """Training presses in random order."""

    x: Float[np.ndarray, "n 3"]  # position (m) and load (m or N)
    y: Float[np.ndarray, "n c"]  # uT
    groups: Int[np.ndarray, " n"]


def position_readings(
    dataset: Dataset, split: Split, seed: int, *, max_calibration_presses: int = 1000
) -> dict[str, Reading]:
    """Predict readings with a tuned Gaussian process and with `i2t.calibrate`, for recordings of one tip.

    Args:
        dataset: The touches, with the corrections of `corrected_dataset`.
        split: Training, validation and test touches.
        seed: Seed of the order in which presses are drawn.
        max_calibration_presses: Maximum number of presses for `i2t.calibrate`, which is designed for no more than 1000.

    Returns:
        Mean and standard deviation `(m, 3 chips)`, uT, of the m validation and test touches, by the title of the
        predictor. The dict is empty unless these touches are presses of one object at known places of the skin.
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
    training = number[rows]
    x = np.column_stack([presses.position, presses.load])
    train = _TrainingPresses(x[training], presses.readings[training], split.groups[rows])
    at, count = x[number[held_out]], min(len(rows), max_calibration_presses)
    return {TUNED: _tuned(train, at), f"{CALIBRATED}, {count} of the presses": _calibrated(presses, train, at, count)}


def _tuned(train: _TrainingPresses, at: Float[np.ndarray, "m 3"], *, tuning_presses: int = 1000) -> Reading:
    """Predict with the scales that have the least error on held-out groups of the training presses, and return that
    error as the standard deviation. The cost of tuning grows with the cube of the number of presses.
    """
    likely = fit_scales(train.x[:, :2], train.x[:, 2], train.y)
    options = [
        PlainScales(length * likely.length, width * likely.width, noise * likely.noise)
        for length, width, noise in product((1 / 4, 1 / 3, 1 / 2, 1, 2), (1 / 2, 1, 2), (0.1, 0.3, 1, 3))
    ]
    x, y, groups = (part[:tuning_presses] for part in train)
    with limit_blas_threads(len(x)):
        best, error = best_option(_by_scales, options, x, y, assign_folds(groups))
    mean = _by_scales(train.x, train.y, at, best)
    return Reading(mean, np.broadcast_to(np.sqrt((error**2).mean(0)), mean.shape))


def _by_scales(x: np.ndarray, y: np.ndarray, at: np.ndarray, scales: PlainScales) -> np.ndarray:
    return predict_plain(scales, (x[:, :2], x[:, 2], y), (at[:, :2], at[:, 2]))


def _calibrated(presses: LoadedPresses, train: _TrainingPresses, at: Float[np.ndarray, "m 3"], count: int) -> Reading:
    x, y, _ = (part[:count] for part in train)
    calibration = calibrate(x[:, :2], x[:, 2], y, load_kind=presses.load_kind, board=presses.unnamed_board)
    return Reading(*(np.asarray(part) for part in calibration.predict(at[:, :2], at[:, 2])))
