"""Learning curves of all methods on the same draws of presses, scored on held-out presses."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from experiments.calibrate.held_out import PressSplit
from experiments.calibrate.methods import BASELINES, CALIBRATED, calibrated
from i2t.intervals import grouped_interval, student_interval
from i2t.leave_one_out import STDS_WITHIN_90
from i2t.recordings.presses import LoadedPresses
from i2t.runtime.progress import progress

Curves: TypeAlias = dict[str, dict[int, list[float]]]  # by method and number of presses, a value for each draw
ErrorCurves: TypeAlias = dict[str, dict[int, list[np.ndarray]]]
INTERVAL_KEYS = ("mean", "low", "high")


class Scores(NamedTuple):
    """Scores by test: R2, squared errors (uT^2) of the presses, and the share of readings in the 90 % range."""

    r2: dict[str, Curves]
    errors: dict[str, ErrorCurves]
    coverage: dict[str, Curves]


def learning_curves(
    recording: LoadedPresses, splits: Sequence[PressSplit], *, counts: Sequence[int], draws: int, seed: int
) -> Scores:
    """Score every method for every number of training presses and every draw.

    Args:
        recording: The presses.
        splits: Training and test presses. Tests of the same name in several splits count as one test.
        counts: Numbers of training presses. Numbers greater than every split's pool are left out.
        draws: Number of random choices of the training presses.
        seed: Seed of these choices.

    Returns:
        The scores by test.
    """
    names = list(dict.fromkeys(name for split in splits for name in split.tests))
    scores = Scores({name: {} for name in names}, {name: {} for name in names}, {name: {} for name in names})
    counts = [n for n in counts if n <= max(len(split.pool) for split in splits)]
    desc, unit = ("draws", "draws") if len(splits) == 1 else ("left out", "parts")
    steps = [(draw, split) for draw in range(draws) for split in splits]
    tested: dict[tuple[str, int, int], list[_TestResult]] = {}
    for draw, split in progress(steps, desc=desc, unit=unit):
        order = np.random.default_rng((seed, draw)).permutation(split.pool)
        for count in counts:
            for name, result in _tested(recording, order[:count], split.tests).items():
                tested.setdefault((name, count, draw), []).append(result)
    for (name, count, _), results in tested.items():
        readings = recording.readings[np.concatenate([result.rows for result in results])]
        for method in results[0].error:
            error = np.concatenate([result.error[method] for result in results])
            append(scores.errors[name], method, count, error)
            append(scores.r2[name], method, count, explained(readings, error))
        inside = float(np.mean(np.concatenate([result.inside for result in results])))
        append(scores.coverage[name], CALIBRATED, count, inside)
    return scores


class _TestResult(NamedTuple):
    """Errors of the predictions of a test's rows."""

    rows: np.ndarray  # (n,)
    error: dict[str, np.ndarray]  # (n,) uT^2 of each method
    inside: np.ndarray  # (n, c) whether a reading is in the 90 % range of `i2t.calibrate`


def _tested(recording: LoadedPresses, rows: np.ndarray, tests: dict[str, np.ndarray]) -> dict[str, _TestResult]:
    """Predict each test's rows with all methods trained on some rows."""
    predicted, inside = predict_all(recording, rows, np.concatenate(list(tests.values())))
    results, start = {}, 0
    for name, own in tests.items():
        part = slice(start, start + len(own))
        start += len(own)
        error = {method: ((recording.readings[own] - values[part]) ** 2).sum(1) for method, values in predicted.items()}
        results[name] = _TestResult(own, error, inside[part])
    return results


def predict_all(
    recording: LoadedPresses, rows: np.ndarray, test: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Predict the test readings with every method, and mark those (n, c) in the 90 % range of `i2t.calibrate`."""
    predicted = {name: method(recording, rows, test) for name, method in BASELINES.items()}
    predicted[CALIBRATED], std = calibrated(recording, rows, test)
    return predicted, np.abs(recording.readings[test] - predicted[CALIBRATED]) < STDS_WITHIN_90 * std


def explained(readings: np.ndarray, error: np.ndarray) -> float:
    """Compute R2 over all channels from readings (n, c) and squared errors (n,)."""
    return float(1 - error.sum() / ((readings - readings.mean(0)) ** 2).sum())


def append(curves: dict, method: str, count: int, value: float | np.ndarray) -> None:
    """Add a draw's value to curves."""
    curves.setdefault(method, {}).setdefault(count, []).append(value)


def summarise(curves: Curves) -> dict[str, Any]:
    """Average over draws with a 95 % interval (Student's t)."""
    return {
        name: {
            count: dict(zip(INTERVAL_KEYS, student_interval(values), strict=True)) for count, values in by_count.items()
        }
        for name, by_count in curves.items()
    }


def gains(curves: Curves) -> Curves:
    """Compute the lead in R2 of `i2t.calibrate` over each other method in each draw."""
    base = curves[CALIBRATED]
    return {
        f"{CALIBRATED} - {name}": {n: list(np.subtract(base[n], values)) for n, values in by_count.items()}
        for name, by_count in curves.items()
        if name != CALIBRATED
    }


def over_blocks(readings: np.ndarray, errors: ErrorCurves, block: np.ndarray) -> dict[str, Any]:
    """Compute R2 of `i2t.calibrate` and its lead over each other method, with 95 % intervals over whole blocks or
    places of the held-out presses (cluster bootstrap of the mean over draws). These intervals account for the choice of
    positions on the skin. Fewer than three blocks have no interval.
    """
    names, of = np.unique(block, return_inverse=True)
    inside = (of == np.arange(len(names))[:, None]).astype(float)  # sums over each block
    left = readings - readings.mean(0)
    presses, first, second = inside.sum(1), inside @ left, inside @ (left**2).sum(1)
    missed = {method: {n: inside @ np.mean(draws, axis=0) for n, draws in by.items()} for method, by in errors.items()}

    def share(error: np.ndarray, rows: np.ndarray) -> float:
        spread = second[rows].sum() - (first[rows].sum(0) ** 2).sum() / presses[rows].sum()
        # If a resample holds copies of one press, its spread is a rounding error.
        return float(error[rows].sum() / spread) if spread > 1e-9 * second[rows].sum() else np.nan

    def r2(error: np.ndarray, rows: np.ndarray) -> float:
        return 1 - share(error, rows)

    def interval(statistic: Callable[[np.ndarray], float], most: float = 1.0) -> dict[str, float]:
        blocks = np.arange(len(names))
        values = (statistic(blocks), *grouped_interval(statistic, blocks, most=most))
        return dict(zip(INTERVAL_KEYS, values, strict=True))

    return {
        "blocks": len(names),
        "r2": {n: interval(partial(r2, error)) for n, error in missed[CALIBRATED].items()},
        "differences": {
            f"{CALIBRATED} - {other}": {
                n: interval(partial(share, error - missed[CALIBRATED][n]), np.inf) for n, error in by.items()
            }
            for other, by in missed.items()
            if other != CALIBRATED
        },
    }
