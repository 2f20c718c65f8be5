"""Presses found in a continuous recording of a skin: where each begins and ends, and what it reads when steady.

A skin at rest drifts slowly and its noise is white; a press moves many channels together and comes and goes, and after
it the skin may stay displaced and recover. Rows are averaged over 20 ms. The distance of each average from a baseline,
the median of the last second at rest, is counted in standard deviations of the noise over all channels. A press begins
where it rises over a threshold. It ends where it has fallen to a tenth of the press's own peak and falls no further:
there is the next rest, with a baseline of its own. Any rate, regular or not, and any number of channels. The recording
begins at rest.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.ndimage import median_filter

MAD_TO_STD = 1.4826  # standard deviations of a normal variable in one median absolute deviation
MIN_ROWS = 8
MIN_NOISE_UT = 0.05  # of a channel that repeats one value
STEADY_SHARE = 0.5  # of a plateau's rows that the steady reading is the median of, at least
RELEASED_SHARE = 0.1  # of a press's peak, below which it is over once the skin moves no further back
REST_SCATTER = 2.0  # standard deviations between rows at rest
MIN_PEAK_SHARE = 0.03  # of the median peak: what is less is the skin recovering
NOISE_BLOCKS = 20  # of rows, whose differences are compared to find those at rest


class SegmentedPresses(NamedTuple):
    """k presses in a recording of n rows."""

    start: Int[np.ndarray, " k"]  # first row of each
    end: Int[np.ndarray, " k"]  # row after its last
    steady_start: Int[np.ndarray, " k"]  # first row of its steadiest part at full load
    steady_end: Int[np.ndarray, " k"]
    reading: Float[np.ndarray, "k c"]  # uT, steady, less the baseline before it
    baseline: Float[np.ndarray, "k c"]  # uT
    start_time: Float[np.ndarray, " k"]  # s
    end_time: Float[np.ndarray, " k"]  # s


def segment_presses(
    time: ArrayLike,
    readings: ArrayLike,
    *,
    begin_at: float = 8.0,
    end_at: float = 4.0,
    min_press_s: float = 0.1,
    min_gap_s: float = 0.1,
    smooth_s: float = 0.02,
    baseline_s: float = 1.0,
    max_press_s: float = 60.0,
    noise_std: ArrayLike | None = None,
) -> SegmentedPresses:
    """Find the presses of a recording.

    Args:
        time: (n,) when each row was read (s), increasing.
        readings: (n, c) what the board sent (uT), ambient and drift and all.
        begin_at: Distance from rest, in standard deviations of a smoothed channel, that a press exceeds.
        end_at: Distance below which the skin is at rest.
        min_press_s: Shorter presses are left out (s).
        min_gap_s: Presses closer than this are one (s).
        smooth_s: Rows are averaged over this time before they are compared (s).
        baseline_s: Time at rest that a baseline is the median of (s).
        max_press_s: What lasts longer is a new rest (s).
        noise_std: (c,) of a single row of each channel (uT); by default found from differences of rows that follow
            each other.

    Returns:
        The presses in the order of time; none where nothing presses.

    Raises:
        ValueError: Times do not increase, shapes do not belong together, or a value is not finite.

    Example:
        presses = segment_presses(time, readings)
        presses.reading, presses.start_time
    """
    time, readings = np.asarray(time, np.float64), np.asarray(readings, np.float64)
    _check(time, readings, begin_at, end_at)
    n, c = readings.shape
    step = float(np.median(np.diff(time)))

    def rows(seconds: float) -> int:
        return max(1, round(seconds / step))

    noise = _noise(readings) if noise_std is None else np.maximum(np.asarray(noise_std), MIN_NOISE_UT)
    width = min(rows(smooth_s), max(n // MIN_ROWS, 1))
    count = n // width
    blocks = readings[: count * width].reshape(count, width, c).mean(1)
    unit = noise / np.sqrt(width)
    rules = _Rules(begin_at, end_at, *(max(1, rows(s) // width) for s in (baseline_s, min_gap_s, max_press_s)))
    spans, baselines = _spans(blocks, unit, rules)
    peaks = [_distance(blocks[a:b] - base, unit).max() for (a, b), base in zip(spans, baselines, strict=True)]
    enough = MIN_PEAK_SHARE * float(np.median(peaks)) if peaks else 0.0
    kept = [
        i
        for i, (a, b) in enumerate(spans)
        if time[b * width - 1] - time[a * width] >= min_press_s - 1.5 * step and peaks[i] >= enough
    ]
    start, end = (width * np.array([spans[i][side] for i in kept], int) for side in (0, 1))
    base = np.array([baselines[i] for i in kept]).reshape(-1, c)
    steady = [_steady(blocks[spans[i][0] : spans[i][1]] - baselines[i], unit) for i in kept]
    first, last = (start + width * np.array([part[side] for part in steady], int) for side in (0, 1))
    level = np.array([np.median(readings[a:b], axis=0) for a, b in zip(first, last, strict=True)]).reshape(-1, c)
    return SegmentedPresses(
        start=start,
        end=end,
        steady_start=first,
        steady_end=last,
        reading=level - base,
        baseline=base,
        start_time=time[start],
        end_time=time[end - 1],
    )


def _check(time: np.ndarray, readings: np.ndarray, begin_at: float, end_at: float) -> None:
    if readings.ndim != 2 or time.shape != (len(readings),) or len(time) < MIN_ROWS:
        raise ValueError(
            f"times {time.shape} and readings {readings.shape} are no recording; give (n,) and (n, channels) of at "
            f"least {MIN_ROWS} rows"
        )
    if not (np.isfinite(readings).all() and np.isfinite(time).all()):
        raise ValueError("the recording has values that are not finite; drop these rows")
    if not (np.diff(time) > 0).all():
        row = int(np.flatnonzero(np.diff(time) <= 0)[0]) + 2
        raise ValueError(f"time does not increase at row {row}; sort the rows and drop repeated ones")
    if not 0 < end_at <= begin_at:
        raise ValueError(f"a press cannot begin at {begin_at:g} and end at {end_at:g}; end_at is the smaller one")


def _noise(readings: np.ndarray) -> np.ndarray:
    """Standard deviation of a row of each channel at rest, from second differences in the quietest half of blocks."""
    second = readings[2:] - 2 * readings[1:-1] + readings[:-2]  # what moves evenly takes no part
    blocks = np.array_split(second, min(NOISE_BLOCKS, max(len(second) // MIN_ROWS, 1)))
    spread = np.array([np.sqrt(np.mean(block**2, axis=0)) for block in blocks]) / np.sqrt(6)
    robust = MAD_TO_STD * np.median(np.abs(second), axis=0) / np.sqrt(6)
    return np.maximum(np.maximum(np.quantile(spread, 0.25, axis=0), 0.5 * robust), MIN_NOISE_UT)


def _spans(blocks: np.ndarray, unit: np.ndarray, rules: "_Rules") -> tuple[list[tuple[int, int]], list[np.ndarray]]:
    """First block and block after the last of each press, and the baseline before it."""
    spans: list[tuple[int, int]] = []
    baselines: list[np.ndarray] = []
    at, count = 0, len(blocks)
    rest_from, baseline = 0, np.median(blocks[: rules.rest], axis=0)
    while at < count:
        distance = _distance(blocks[at : at + rules.rest] - baseline, unit)
        over = np.flatnonzero(distance > rules.begin_at)
        if not len(over):
            at += max(1, min(rules.rest // 4, len(distance)))
            baseline = np.median(blocks[max(rest_from, at - rules.rest) : at], axis=0)
            continue
        first = at + int(over[0])
        back = _distance(blocks[rest_from:first] - baseline, unit) < rules.end_at
        start = rest_from + int(np.flatnonzero(back)[-1]) + 1 if back.any() else rest_from
        end, rests = _end(_distance(blocks[first:] - baseline, unit), rules)
        if rests:
            spans.append((start, first + end))
            baselines.append(baseline)
        at = rest_from = max(first + end, first + 1)
        if at < count:
            baseline = np.median(blocks[rest_from : rest_from + rules.gap], axis=0)
    return spans, baselines


class _Rules(NamedTuple):
    """What is a press; times in blocks, distances in standard deviations."""

    begin_at: float
    end_at: float
    rest: int
    gap: int
    longest: int


def _end(distance: np.ndarray, rules: _Rules) -> tuple[int, bool]:
    """Block at which the skin is at rest again after block 0, and False if it never is and rests where it is."""
    peak, least, least_at = 0.0, np.inf, 0
    for i, d in enumerate(distance.tolist()):
        peak = max(peak, d)
        if d < max(rules.end_at, RELEASED_SHARE * peak) and d < least:
            least, least_at = d, i
        elif least < np.inf and (
            i - least_at >= rules.gap or d > least + max(rules.begin_at, RELEASED_SHARE / 2 * peak)
        ):
            break
        if i > rules.longest and least == np.inf:
            return i, False
    if least == np.inf:
        return len(distance), True
    moving = np.flatnonzero(distance[:least_at] > least + REST_SCATTER)
    return (int(moving[-1]) + 1 if len(moving) else 0), True


def _distance(difference: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Of rows from rest: the larger of the worst channel and of what all channels show together."""
    z = np.abs(difference) / unit
    together = np.sqrt(np.maximum(np.mean(z**2, axis=1) - 1, 0)) * (z.shape[1] / 2) ** 0.25
    return np.maximum(0.8 * z.max(axis=1), together)


def _steady(pressed: np.ndarray, unit: np.ndarray) -> tuple[int, int]:
    """The rows of a press that move least among those near its full load."""
    size = np.linalg.norm(pressed / unit, axis=1)
    size = median_filter(size, 3, mode="nearest") if len(size) > 3 else size
    full = size >= 0.85 * size.max()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], full.astype(int), [0]])))
    runs = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
    first, last = max(runs, key=lambda run: run[1] - run[0])
    length = last - first
    window = max(1, int(np.ceil(STEADY_SHARE * length)))
    if length <= 2:
        return first, last
    moved = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pressed[first:last], axis=0) / unit, axis=1))])
    ahead = np.linalg.norm((pressed[first + window - 1 : last] - pressed[first : last - window + 1]) / unit, axis=1)
    best = int(np.argmin(ahead + 1e-6 * moved[: len(ahead)]))
    return first + best, first + best + window
