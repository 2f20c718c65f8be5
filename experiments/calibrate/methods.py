"""The compared methods, which predict some presses of a recording from other presses."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from i2t.prediction.baselines import predict_with_best_option
from i2t.prediction.metrics import nearest_neighbours
from i2t.recordings.presses import LoadedPresses
from i2t.skin_models import calibrate
from i2t.skin_models.tip_gp import plain as plain_gp
from i2t.skin_models.tip_gp.leave_one_out import limit_blas_threads

MEAN, NEIGHBOURS, PLAIN = "mean of the presses", "k nearest presses", "plain Gaussian process"
CALIBRATED = "i2t.calibrate"

Predict: TypeAlias = Callable[[LoadedPresses, np.ndarray, np.ndarray], np.ndarray]
"""Function from a recording, training rows and test rows to predicted readings (n, c) uT."""


def mean(recording: LoadedPresses, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Predict the mean reading of the training rows."""
    return np.tile(recording.readings[rows].mean(0), (len(test), 1))


def neighbours(recording: LoadedPresses, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Average the k nearest presses in position and load, with k chosen by cross-validation."""
    x, at = recording.features(rows), recording.features(test)
    counts, groups = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0), np.arange(len(rows))
    return predict_with_best_option(nearest_neighbours, counts, x, recording.readings[rows], groups, at=at)


def plain(recording: LoadedPresses, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Fit a Gaussian process over position and load."""
    train = recording.position[rows], recording.load[rows], recording.readings[rows]
    at = recording.position[test], recording.load[test]
    with limit_blas_threads(len(rows)):
        return plain_gp.predict_plain(plain_gp.fit_scales(*train), train, at)


def calibrated(recording: LoadedPresses, rows: np.ndarray, test: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Predict with `i2t.calibrate`; returns means and standard deviations."""
    train = recording.position[rows], recording.load[rows], recording.readings[rows]
    calibration = calibrate(*train, load_kind=recording.load_kind, board=recording.unnamed_board)
    return calibration.predict(recording.position[test], recording.load[test])


BASELINES: dict[str, Predict] = {MEAN: mean, NEIGHBOURS: neighbours, PLAIN: plain}
