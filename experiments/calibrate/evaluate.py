"""Learning curves: every method on the same draws of presses, scored on what is held out."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from experiments.calibrate.data import SECOND_HALF, PressRecording, PressSplit
from experiments.calibrate.methods import (
    HEIGHT,
    NEIGHBOURS,
    PREVIOUS_ALONE,
    PREVIOUS_MEAN,
    RESIDUAL_NOISE,
    Predictors,
    interval_scaling,
    neighbours,
    predict,
    select,
)
from i2t.calibration.structured_gp import STDS_WITHIN_90_PERCENT, hyperparameter_grid
from i2t.progress import progress

Curves: TypeAlias = dict[str, dict[int, list[float]]]  # method -> number of presses -> a value for each draw
ErrorCurves: TypeAlias = dict[str, dict[int, list[np.ndarray]]]


class PredictionTask(NamedTuple):
    """Presses to learn from, in the order of one draw, and what is predicted from them."""

    rows: np.ndarray
    tests: dict[str, np.ndarray]
    previous_mean: np.ndarray | None = None  # (n, c) uT, of all rows of the recording as a previous session predicts


class Scores(NamedTuple):
    """Scores of each test: R2, squared errors (uT^2) of the presses, and the share of readings in the 90 % range."""

    r2: dict[str, Curves]
    errors: dict[str, ErrorCurves]
    coverage: dict[str, Curves]


def learning_curves(
    predictors: Predictors, split: PressSplit, *, counts: Sequence[int], draws: int, seed: int
) -> Scores:
    """Scores of every method at every number of presses, a value for each draw."""
    tasks = (
        _draw_tasks(predictors, split, counts, (seed, draw))
        for draw in progress(range(draws), desc="draws", unit="draw")
    )
    return _score(predictors, tasks, counts, [*split.tests, SECOND_HALF])


def explained(readings: np.ndarray, error: np.ndarray) -> float:
    """R2 over all channels from readings (n, c) and squared errors (n,)."""
    return float(1 - error.sum() / ((readings - readings.mean(0)) ** 2).sum())


def _draw_tasks(
    predictors: Predictors, split: PressSplit, counts: Sequence[int], seed: tuple[int, int]
) -> list[PredictionTask]:
    rng = np.random.default_rng(seed)
    order, later, past = (rng.permutation(rows) for rows in (split.pool, split.later_pool, split.earlier_pool))
    mean = _previous_mean(predictors, predictors.recording, past[: max(counts)])
    return [PredictionTask(order, split.tests), PredictionTask(later, {SECOND_HALF: split.later_test}, mean)]


def _previous_mean(predictors: Predictors, previous: PressRecording, rows: np.ndarray) -> np.ndarray:
    """(n, c) uT: every press of the recording as predicted from rows of a previous one."""
    gp = Predictors(previous).gp(predictors.hyperparameters, rows, previous.readings[rows])
    every = np.arange(len(predictors.recording.load))
    return np.asarray(predict(gp, predictors.recording.presses(every))[0], np.float64)


def _score(
    predictors: Predictors, draws: Iterator[list[PredictionTask]], counts: Sequence[int], tests: Sequence[str]
) -> Scores:
    readings = predictors.recording.readings
    scores = Scores({name: {} for name in tests}, {name: {} for name in tests}, {name: {} for name in tests})
    fits = ((task, count) for tasks in draws for task in tasks for count in counts if count <= len(task.rows))
    for task, count in fits:
        rows, test = task.rows[:count], np.concatenate(list(task.tests.values()))
        if task.previous_mean is None:
            predicted = {name: method(rows, test) for name, method in predictors.by_name().items()}
            inside = _coverage(predictors, rows, test)
        else:
            predicted, inside = _predictions_from_mean(predictors, rows, test, task.previous_mean), {}
        ends = np.cumsum([len(part) for part in task.tests.values()])
        for (name, own), end in zip(task.tests.items(), ends, strict=True):
            part = slice(end - len(own), end)
            for method, values in predicted.items():
                error = ((readings[own] - values[part]) ** 2).sum(1)
                _append(scores.errors[name], method, count, error)
                _append(scores.r2[name], method, count, explained(readings[own], error))
            for method, covered in inside.items():
                _append(scores.coverage[name], method, count, float(np.mean(covered[part])))
    return scores


def _append(curves: dict, method: str, count: int, value: float | np.ndarray) -> None:
    curves.setdefault(method, {}).setdefault(count, []).append(value)


def _predictions_from_mean(
    predictors: Predictors, rows: np.ndarray, test: np.ndarray, mean: np.ndarray
) -> dict[str, np.ndarray]:
    """Readings at the test with a previous session's predictions (n, c) as the mean, and without."""
    recording = predictors.recording
    left = recording.readings[rows] - mean[rows]
    # Heights were found by the previous session; the presses select how much of what it leaves is noise.
    candidates = hyperparameter_grid(predictors.hyperparameters._replace(height_std=0.0), RESIDUAL_NOISE)
    selected = select(candidates, recording, rows, left)
    return {
        NEIGHBOURS: neighbours(recording, rows, test),
        HEIGHT: predictors.structured(rows, test),
        PREVIOUS_ALONE: mean[test],
        PREVIOUS_MEAN: mean[test] + predictors.gp_mean(selected, rows, left, test),
    }


def _coverage(predictors: Predictors, rows: np.ndarray, test: np.ndarray) -> dict[str, np.ndarray]:
    """Masks of the readings (n, c) in the 90 % range, as the GP predicts it and with the interval scaling."""
    recording, hyperparameters = predictors.recording, predictors.hyperparameters
    known = recording.readings[rows]
    mean, std = predict(predictors.gp(hyperparameters, rows, known), recording.presses(test))
    scaling = interval_scaling(hyperparameters, recording.presses(rows), np.float32(known), recording.chips)
    error = np.abs(recording.readings[test] - mean)
    return {
        f"{HEIGHT}, as predicted": error < STDS_WITHIN_90_PERCENT * std,
        f"{HEIGHT}, interval scaling": error < STDS_WITHIN_90_PERCENT * np.asarray(std * scaling[None]),
    }
