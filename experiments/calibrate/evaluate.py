"""Learning curves: every method on the same draws of presses, scored on what is held out."""

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

Curves: TypeAlias = dict[str, dict[int, list[float]]]  # method -> number of presses -> a value for each draw
ErrorCurves: TypeAlias = dict[str, dict[int, list[np.ndarray]]]
INTERVAL = ("mean", "low", "high")
LEAST_SPREAD_SHARE = 1e-9  # of the sum of squares


class Scores(NamedTuple):
    """Scores of each test: R2, squared errors (uT^2) of the presses, and the share of readings in the 90 % range."""

    r2: dict[str, Curves]
    errors: dict[str, ErrorCurves]
    coverage: dict[str, Curves]


def learning_curves(
    recording: LoadedPresses, splits: Sequence[PressSplit], *, counts: Sequence[int], draws: int, seed: int
) -> Scores:
    """Scores of every method at every number of presses, a value for each draw.

    Args:
        recording: The presses.
        splits: What methods may learn from and are tested on; of several, the tests of one name are one test.
        counts: Presses to learn from, at most: those that no split has are left out.
        draws: Of these presses.
        seed: Of the draws.

    Returns:
        The scores.
    """
    names = list(dict.fromkeys(name for split in splits for name in split.tests))
    scores = Scores({name: {} for name in names}, {name: {} for name in names}, {name: {} for name in names})
    counts = [n for n in counts if n <= max(len(split.pool) for split in splits)]
    desc, unit = ("draws", "draw") if len(splits) == 1 else ("left out", "part")
    steps = [(draw, split) for draw in range(draws) for split in splits]
    tested: dict[tuple[str, int, int], list[_Tested]] = {}
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


class _Tested(NamedTuple):
    """Rows of a test as they were predicted from others."""

    rows: np.ndarray  # (n,)
    error: dict[str, np.ndarray]  # (n,) uT^2 of each method
    inside: np.ndarray  # (n, c) readings in the 90 % range of `i2t.calibrate`


def _tested(recording: LoadedPresses, rows: np.ndarray, tests: dict[str, np.ndarray]) -> dict[str, _Tested]:
    """Each test's rows as all methods predict them from some rows."""
    predicted, inside = predict_all(recording, rows, np.concatenate(list(tests.values())))
    results, start = {}, 0
    for name, own in tests.items():
        part = slice(start, start + len(own))
        start += len(own)
        error = {method: ((recording.readings[own] - values[part]) ** 2).sum(1) for method, values in predicted.items()}
        results[name] = _Tested(own, error, inside[part])
    return results


def predict_all(
    recording: LoadedPresses, rows: np.ndarray, test: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Readings at the test by every method, and which of them (n, c) lie in the 90 % range of `i2t.calibrate`."""
    predicted = {name: method(recording, rows, test) for name, method in BASELINES.items()}
    predicted[CALIBRATED], std = calibrated(recording, rows, test)
    return predicted, np.abs(recording.readings[test] - predicted[CALIBRATED]) < STDS_WITHIN_90 * std


def explained(readings: np.ndarray, error: np.ndarray) -> float:
    """R2 over all channels from readings (n, c) and squared errors (n,)."""
    return float(1 - error.sum() / ((readings - readings.mean(0)) ** 2).sum())


def append(curves: dict, method: str, count: int, value: float | np.ndarray) -> None:
    """Add a draw's value to curves."""
    curves.setdefault(method, {}).setdefault(count, []).append(value)


def summarise(curves: Curves) -> dict[str, Any]:
    """Mean over draws with its 95 % interval (Student's t)."""
    return {
        name: {count: dict(zip(INTERVAL, student_interval(values), strict=True)) for count, values in by_count.items()}
        for name, by_count in curves.items()
    }


def gains(curves: Curves) -> Curves:
    """By how much R2 of `i2t.calibrate` is above that of each other method, draw by draw."""
    base = curves[CALIBRATED]
    return {
        f"{CALIBRATED} - {name}": {n: list(np.subtract(base[n], values)) for n, values in by_count.items()}
        for name, by_count in curves.items()
        if name != CALIBRATED
    }


def over_blocks(readings: np.ndarray, errors: ErrorCurves, block: np.ndarray) -> dict[str, Any]:
    """R2 of `i2t.calibrate`, and by how much it is above each other method, with 95 % intervals over whole blocks, or
    places, of the held-out presses (cluster bootstrap of the mean over draws): what other positions on the skin would
    have given. Fewer than three blocks have no interval.
    """
    names, of = np.unique(block, return_inverse=True)
    inside = (of == np.arange(len(names))[:, None]).astype(float)  # sums over each block
    left = readings - readings.mean(0)
    presses, first, second = inside.sum(1), inside @ left, inside @ (left**2).sum(1)
    missed = {method: {n: inside @ np.mean(draws, axis=0) for n, draws in by.items()} for method, by in errors.items()}

    def share(error: np.ndarray, rows: np.ndarray) -> float:
        spread = second[rows].sum() - (first[rows].sum(0) ** 2).sum() / presses[rows].sum()
        # A resample may hold one press several times, whose spread is that of rounding.
        return float(error[rows].sum() / spread) if spread > LEAST_SPREAD_SHARE * second[rows].sum() else np.nan

    def r2(error: np.ndarray, rows: np.ndarray) -> float:
        return 1 - share(error, rows)

    def interval(statistic: Callable[[np.ndarray], float], most: float = 1.0) -> dict[str, float]:
        every = np.arange(len(names))
        return dict(zip(INTERVAL, (statistic(every), *grouped_interval(statistic, every, most=most)), strict=True))

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
