"""Segmentation of a continuous recording into presses: where each begins and ends, and its steady reading.

A skin at rest drifts slowly and has white noise. A press moves many channels together and comes and goes; after it the
skin may stay displaced and recover slowly. Rows are averaged over 20 ms. The distance of each average from a baseline,
the median of the last second at rest, is measured in standard deviations of the noise over all channels. A press begins
where the distance exceeds a threshold. It ends where the distance has fallen to a tenth of the press's own peak and
falls no further; the next rest begins there, with its own baseline. The rate may be any, regular or not, and so may the
number of channels.

The first level at which the skin stays still is taken as its rest until the skin leaves it. If the skin then goes to
the rest of an earlier recording, or does not come back, it was pressed or has moved, and the next still level becomes
its rest.

A row that stands out from two rows on either side is a spike, and is replaced by their median. Rows that repeat the row
before them, as from a sensor that is read faster than it measures, do not count towards the noise.

`segment_presses` takes a whole recording. A recording that does not fit into memory is passed piece by piece to
`extend_recording`, which keeps no more rows than the longest press has.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.ndimage import median_filter

MAD_TO_STD = 1.4826  # standard deviations of a normal variable in one median absolute deviation


@dataclass(frozen=True)
class SegmentationConfig:
    """Thresholds by which a continuous recording is divided into presses.

    Attributes:
        begin_distance: Distance from rest, in standard deviations, above which a press begins.
        end_distance: Distance from rest, in standard deviations, below which the skin is at rest.
        released_share: Share of a press's peak below which the press is over once the skin moves no further back.
        rest_scatter: Standard deviations between rows at rest.
        min_peak_share: Share of the median peak below which a press is only the skin recovering.
        smooth_s: Time over which rows are averaged before they are compared.
        baseline_s: Time at rest that the baseline is the median of.
        min_press_s: Duration below which a press is ignored.
        max_press_s: Duration above which a displaced skin has a new rest.
        min_gap_s: Time at rest below which two presses are one.
        min_rows: Number of rows in a recording, at least.
        min_noise_ut: Noise that a channel has at least, even if it repeats one value.
        noise_blocks: Number of blocks of rows, the quietest of which determine the noise.
        min_spike_stds: Standard deviations by which a spike stands out, at least.
        min_spike_spread: Spreads of the neighbouring rows by which a spike stands out, at least.
        min_steady_share: Share of a plateau's rows over which the steady reading is the median.
        still_blocks: Number of blocks that a still level lasts, at least.
        min_move_share: Share of the way to a level that presses from that level exceed: a held press that wavers moves
            less.
        min_held_rows: Mean length of runs of one value above which a sensor is read faster than it measures.
        max_held_spread: Ratio of long to short runs up to which this holds.
    """

    begin_distance: float = 8.0
    end_distance: float = 4.0
    released_share: float = 0.1
    rest_scatter: float = 2.0
    min_peak_share: float = 0.03
    smooth_s: float = 0.02
    baseline_s: float = 1.0
    min_press_s: float = 0.1
    max_press_s: float = 60.0
    min_gap_s: float = 0.1
    min_rows: int = 8
    min_noise_ut: float = 0.05
    noise_blocks: int = 20
    min_spike_stds: float = 10.0
    min_spike_spread: float = 4.0
    min_steady_share: float = 0.5
    still_blocks: int = 3
    min_move_share: float = 0.3
    min_held_rows: float = 1.3
    max_held_spread: float = 2.0


class SegmentedPresses(NamedTuple):
    """The k presses of a continuous recording of n rows: first rows, ends, steady parts, steady readings minus baseline
    (uT), baselines (uT) and times (s).
    """

    start: Int[np.ndarray, " k"]  # first row of each press
    end: Int[np.ndarray, " k"]  # row after the last row of each press
    steady_start: Int[np.ndarray, " k"]  # first row of each press's steadiest part at full load
    steady_end: Int[np.ndarray, " k"]  # row after the last row of each press's steadiest part
    reading: Float[np.ndarray, "k c"]  # uT, steady reading of each press minus the baseline before it
    baseline: Float[np.ndarray, "k c"]  # uT, reading at rest before each press
    start_time: Float[np.ndarray, " k"]  # s, time of each press's first row
    end_time: Float[np.ndarray, " k"]  # s, time of each press's end


class SegmentedPress(NamedTuple):
    """One press in a continuous recording: its rows (counted from the recording's first) and times (s), its steady
    reading minus the baseline (uT), and the other columns at its start and while steady.
    """

    start: int  # first row of the press
    end: int  # row after the last row of the press
    steady_start: int  # first row of the press's steadiest part at full load
    steady_end: int  # row after the last row of the press's steadiest part
    reading: Float[np.ndarray, " c"]  # uT, steady reading minus the baseline before the press
    baseline: Float[np.ndarray, " c"]  # uT, reading at rest before the press
    at_start: Float[np.ndarray, " e"]  # values of the other columns in the press's first row
    across: Float[np.ndarray, "2 e"]  # values of the other columns before and after the longest time step at the start
    steady: Float[np.ndarray, " e"]  # medians of the other columns over the steady part
    start_time: float  # s, time of the press's first row
    end_time: float  # s, time of the press's end
    gap: float  # s, the longest time step at the start
    over: bool  # whether the press ended before the recording did
    peak: float  # largest distance from rest, in standard deviations of a smoothed channel


class SegmentationRules(NamedTuple):
    """Rules for finding presses in one recording, from its rate and noise: noise and smallest spike (uT) of each
    channel, time (s) between rows, and durations in blocks, which are groups of averaged rows.
    """

    noise_std: Float[np.ndarray, " c"]  # uT, standard deviation of a row's noise
    step: float  # s, time between rows
    width: int  # number of rows in a block
    rest: int  # number of blocks in a baseline
    gap: int  # smallest number of blocks between presses
    longest: int  # largest number of blocks in a press
    # uT, smallest deviation of a spike from its neighbours; inf if one row may be a press
    spike: Float[np.ndarray, " c"]
    fresh: float  # share of rows that do not repeat the row before
    config: SegmentationConfig

    @property
    def unit(self) -> Float[np.ndarray, " c"]:
        """`(c,)` standard deviation (uT) of the noise of a block's mean, a unit of deviations from rest."""
        return self.noise_std / np.sqrt(max(self.width * self.fresh, 1.0))


class OpenRecording(NamedTuple):
    """State of the search for presses in a recording to which more rows may be added: the rules, the kept rows, the
    block up to which they were searched, and the reading at rest (uT).
    """

    rules: SegmentationRules
    first: int  # row of the recording that is the first of the kept rows
    time: Float[np.ndarray, " n"]  # s, times of the kept rows
    readings: Float[np.ndarray, "n c"]  # uT, readings of the kept rows
    others: Float[np.ndarray, "n e"]  # other columns of the kept rows
    at: int  # block, among the kept ones, up to which presses have been searched for
    rest_from: int  # block from which the skin has been at rest; negative if that block was dropped
    baseline: Float[np.ndarray, " c"] | None  # uT, reading at rest; None before the first rest
    earlier: Float[np.ndarray, " c"] | None = None  # uT, previous reading at rest, in this recording or in another
    sure: bool = False  # whether the skin has returned to its reading at rest
    moved: tuple[np.ndarray, ...] = ()  # other columns in the rows at which the skin left a level for good
    spikes: int = 0  # number of rows with a spike


def segment_presses(
    time: ArrayLike, readings: ArrayLike, *, config: SegmentationConfig = SegmentationConfig()
) -> SegmentedPresses:
    """Find the presses in a continuous recording of a skin, with the steady reading of each.

    Args:
        time: `(n,)` increasing times of the rows, in s.
        readings: `(n, c)` values as the board sends them, in uT, with ambient field and drift.
        config: Definition of a press.

    Returns:
        The k presses in the order of time; k is 0 if nothing presses the skin.

    Raises:
        ValueError: The times do not increase, the shapes do not match, or a value is not finite.

    Example:
        presses = segment_presses(time, readings)
        presses.reading, presses.start_time
    """
    time, readings = np.asarray(time, np.float64), np.asarray(readings, np.float64)
    rules = segmentation_rules(time, readings, config=config)
    recording, ended = extend_recording(open_recording(rules), time, readings)
    presses = filter_presses([*ended, *finish_recording(recording)[1]], rules)
    columns = {name: np.array([getattr(press, name) for press in presses]) for name in SegmentedPresses._fields}
    columns |= {name: columns[name].reshape(-1, readings.shape[1]) for name in ("reading", "baseline")}
    return SegmentedPresses(**columns)


def segmentation_rules(
    time: ArrayLike, readings: ArrayLike, *, config: SegmentationConfig = SegmentationConfig()
) -> SegmentationRules:
    """Measure the rate and the noise in some rows of a recording.

    Args:
        time: `(n,)` increasing times of the rows, in s.
        readings: `(n, c)` values of the rows, in uT.
        config: Definition of a press.

    Returns:
        The definition of a press in rows of this recording.

    Raises:
        ValueError: The times do not increase, the shapes do not match, or a value is not finite.
    """
    time, readings = np.asarray(time, np.float64), np.asarray(readings, np.float64)
    _check(time, readings, config.min_rows)
    step = float(np.median(np.diff(time)))
    width = min(max(1, round(config.smooth_s / step)), max(len(time) // config.min_rows, 1))
    durations = (config.baseline_s, config.min_gap_s, config.max_press_s)
    rest, gap, longest = (max(1, max(1, round(duration / step)) // width) for duration in durations)
    fresh = _fresh_share(readings, config)
    new = readings[np.append(True, np.diff(readings, axis=0).any(1))] if fresh < 1 else readings
    has_spikes = 2 * step < config.min_press_s and fresh == 1
    spike = _spike_size(new, config) if has_spikes else np.full(readings.shape[1], np.inf)
    noise = _noise(_mend_spikes(new, spike, config.min_spike_spread)[0], config)
    return SegmentationRules(noise, step, width, rest, gap, longest, spike, fresh, config)


def open_recording(
    rules: SegmentationRules, columns: int = 0, earlier: Float[np.ndarray, " c"] | None = None
) -> OpenRecording:
    """Create the state of a recording without rows.

    Args:
        rules: Definition of a press in rows of the recording.
        columns: Number of other columns that come with the readings.
        earlier: `(c,)` baseline of the recording before this one in uT, or None if there is none.

    Returns:
        The state before the first row.
    """
    channels = len(rules.noise_std)
    nothing = (np.zeros(0), np.zeros((0, channels)), np.zeros((0, columns)))
    return OpenRecording(rules, 0, *nothing, at=0, rest_from=0, baseline=None, earlier=earlier)


def extend_recording(
    recording: OpenRecording, time: ArrayLike, readings: ArrayLike, others: ArrayLike | None = None
) -> tuple[OpenRecording, list[SegmentedPress]]:
    """Add rows to a recording, and find the presses that have ended.

    Args:
        recording: State after the rows before.
        time: `(n,)` times of the new rows, in s.
        readings: `(n, c)` finite values of the new rows, in uT.
        others: `(n, e)` values of e other columns, such as the tip's position; may hold NaN.

    Returns:
        The new state, and the presses that have ended. Short and weak ones are included; `filter_presses` removes them.
    """
    rows = np.asarray(readings, np.float64)
    other_rows = np.zeros((len(rows), 0)) if others is None else np.asarray(others, np.float64)
    extended = recording._replace(
        time=np.concatenate([recording.time, np.asarray(time, np.float64)]),
        readings=np.concatenate([recording.readings, rows]),
        others=np.concatenate([recording.others, other_rows]),
    )
    return _advance(extended, last=False)


def finish_recording(recording: OpenRecording) -> tuple[OpenRecording, list[SegmentedPress]]:
    """Find the presses in the last rows of a recording.

    Args:
        recording: State after all rows.

    Returns:
        The final state, and the presses that `extend_recording` has not returned. A press that is not over ends with
        the recording.
    """
    return _advance(recording, last=True)


def filter_presses(presses: Sequence[SegmentedPress], rules: SegmentationRules) -> list[SegmentedPress]:
    """Remove presses shorter than `min_press_s`, and those with a peak below `min_peak_share` of the median peak, which
    are only a skin recovering from a press.

    Args:
        presses: All presses of a recording.
        rules: Definition of a press in rows of the recording.

    Returns:
        The remaining presses in the same order.
    """
    min_peak = rules.config.min_peak_share * float(np.median([press.peak for press in presses])) if presses else 0.0
    min_duration = rules.config.min_press_s - 1.5 * rules.step
    return [press for press in presses if press.end_time - press.start_time >= min_duration and press.peak >= min_peak]


def _check(time: np.ndarray, readings: np.ndarray, min_rows: int) -> None:
    if readings.ndim != 2 or time.shape != (len(readings),) or len(time) < min_rows:
        raise ValueError(
            f"times {time.shape} and readings {readings.shape} do not form a recording; give (n,) and (n, channels) "
            f"with at least {min_rows} rows"
        )
    if not (np.isfinite(readings).all() and np.isfinite(time).all()):
        raise ValueError("the recording has non-finite values; drop these rows")
    if not (np.diff(time) > 0).all():
        row = int(np.flatnonzero(np.diff(time) <= 0)[0]) + 2
        raise ValueError(f"time does not increase at row {row}; sort the rows and drop repeated ones")


def _noise(readings: np.ndarray, config: SegmentationConfig) -> np.ndarray:
    """Estimate the standard deviation of each channel's rows at rest, from second differences in the quieter blocks."""
    second = readings[2:] - 2 * readings[1:-1] + readings[:-2]  # an even motion cancels
    blocks = np.array_split(second, min(config.noise_blocks, max(len(second) // config.min_rows, 1)))
    spread = np.array([np.sqrt(np.mean(block**2, axis=0)) for block in blocks]) / np.sqrt(6)
    robust = MAD_TO_STD * np.median(np.abs(second), axis=0) / np.sqrt(6)
    return np.maximum(np.maximum(np.quantile(spread, 0.25, axis=0), 0.5 * robust), config.min_noise_ut)


def _spike_size(readings: np.ndarray, config: SegmentationConfig) -> np.ndarray:
    """Compute by how much a spike stands out in each channel: far more than the noise and the channel's resolution."""
    steps = np.abs(np.diff(readings, axis=0))
    resolution = np.min(np.where(steps > 0, steps, np.inf), axis=0, initial=np.inf)
    second = np.abs(np.diff(readings, 2, axis=0))
    noise = np.maximum(MAD_TO_STD * np.median(second, axis=0) / np.sqrt(6), config.min_noise_ut)
    return config.min_spike_stds * np.maximum(noise, np.where(np.isfinite(resolution), resolution, 0.0))


def _mend_spikes(readings: np.ndarray, spike: np.ndarray, min_spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Replace spikes by the median of the two rows on either side; also return the mask of rows with a spike."""
    spiked = np.zeros(len(readings), bool)
    if len(readings) < 5 or not np.isfinite(spike).any():
        return readings, spiked
    far = (np.abs(readings[2:-2] - readings[1:-3]) > spike) & (np.abs(readings[2:-2] - readings[3:-1]) > spike)
    rows = np.flatnonzero(far.any(1)) + 2
    if not len(rows):
        return readings, spiked
    around = np.sort(readings[rows[:, None] + np.array([-2, -1, 1, 2])], axis=1)
    middle, spread = around[:, 1:3].mean(1), around[:, 2] - around[:, 1]  # one of the four may be a spike too
    stands_out = np.abs(readings[rows] - middle) > np.maximum(spike, min_spread * spread)
    mended = readings.copy()
    mended[rows] = np.where(stands_out, middle, readings[rows])
    spiked[rows[stands_out.any(1)]] = True
    return mended, spiked


def _fresh_share(readings: np.ndarray, config: SegmentationConfig) -> float:
    """Compute the share of rows that do not repeat the row before; 1 if runs of one value vary in length."""
    begins = np.flatnonzero(np.append(True, np.diff(readings, axis=0).any(1)))
    if len(begins) < config.min_rows or len(readings) < config.min_held_rows * len(begins):
        return 1.0
    short, long = np.quantile(np.diff(begins), (0.1, 0.9))
    return len(begins) / len(readings) if long <= config.max_held_spread * short else 1.0


def _first_still(blocks: np.ndarray, rules: SegmentationRules) -> tuple[int, np.ndarray | None]:
    """Find the first block, and the level in uT, at which the skin stays still for longer than between two presses.

    The search covers the blocks of a baseline. The level is None if the skin does not stay still there.
    """
    size = max(rules.gap, rules.config.still_blocks)
    for start in range(min(rules.rest, len(blocks) - size) + 1):
        window = blocks[start : start + size]
        level = np.median(window, axis=0)
        if _distance(window - level, rules.unit).max() < rules.config.end_distance:
            return start, level
    return 0, None


def _advance(recording: OpenRecording, *, last: bool) -> tuple[OpenRecording, list[SegmentedPress]]:
    """Find presses as far as later rows cannot change them, or up to the end if these rows are the last."""
    rules, unit, config = recording.rules, recording.rules.unit, recording.rules.config
    count = len(recording.readings) // rules.width
    shape = (count, rules.width, recording.readings.shape[1])
    mended, spiked = _mend_spikes(recording.readings, rules.spike, config.min_spike_spread)
    blocks = mended[: count * rules.width].reshape(shape).mean(1)
    at, rest_from, baseline = recording.at, recording.rest_from, recording.baseline
    earlier, sure, moved = recording.earlier, recording.sure, list(recording.moved)
    presses: list[SegmentedPress] = []
    while at < count and (last or at + 2 * rules.rest <= count):
        if baseline is None:
            still, baseline = _first_still(blocks[at:], rules)
            at = rest_from = at + still
            baseline = np.median(blocks[at : at + max(rules.rest // 4, 1)], axis=0) if baseline is None else baseline
        distance = _distance(blocks[at : at + rules.rest] - baseline, unit)
        beyond = np.flatnonzero(distance > config.begin_distance)
        if not len(beyond):
            at += max(1, min(rules.rest // 4, len(distance)))
            baseline = np.median(blocks[max(rest_from, at - rules.rest, 0) : at], axis=0)
            continue
        first = at + int(beyond[0])
        end, rests, is_final = _end(blocks, first, baseline, rules)
        following = max(first + end, first + 1)
        if not last and not (is_final and max(following + rules.gap, first + 2 * rules.rest) <= count):
            break
        if _has_moved(blocks[first:], baseline, None if sure else earlier, rules, came_back=is_final and rests):
            moved += [recording.others[rules.width * first].copy()] if first > at or not moved else []
            at, earlier, baseline, sure = max(first, at + 1), baseline if sure else earlier, None, False
            continue
        sure |= is_final and rests
        since = max(rest_from, first - rules.longest, 0)
        at_rest = _distance(blocks[since:first] - baseline, unit) < config.end_distance
        start = since + int(np.flatnonzero(at_rest)[-1]) + 1 if at_rest.any() else since
        presses.append(_press(recording, blocks, (start, first + end), baseline, over=is_final))
        at = rest_from = following
        if at < count:
            baseline = np.median(blocks[rest_from : rest_from + rules.gap], axis=0)
    drop = len(blocks) if last else max(min(max(rest_from, at - rules.longest), at - rules.rest), 0)
    rows = drop * rules.width
    state = recording._replace(
        first=recording.first + rows,
        time=recording.time[rows:].copy(),
        readings=recording.readings[rows:].copy(),
        others=recording.others[rows:].copy(),
        at=at - drop,
        rest_from=rest_from - drop,
        baseline=baseline,
        earlier=earlier,
        sure=sure,
        moved=tuple(moved),
        spikes=recording.spikes + int(spiked[:rows].sum()),
    )
    return state, presses


def _has_moved(
    blocks: np.ndarray, baseline: np.ndarray, earlier: np.ndarray | None, rules: SegmentationRules, *, came_back: bool
) -> bool:
    """Test whether a skin that leaves a level with these blocks was pressed there, or rests elsewhere from now on.

    That is so if the next still level is an earlier rest, or if the skin does not come back within the longest press.
    If the recording ends before that, it is so if presses come and go from the next still level.
    """
    if came_back and earlier is None:
        return False
    config = rules.config
    still, level = _first_still(blocks, rules)
    if earlier is not None and level is not None:
        before, after = _distance(np.stack([baseline, level]) - earlier, rules.unit)
        if before > config.begin_distance and after < max(config.end_distance, config.released_share * before):
            return True
    if came_back or len(blocks) > rules.longest:
        return not came_back
    if level is None:
        return False
    min_distance = config.min_move_share * float(_distance(level[None] - baseline, rules.unit)[0])
    min_distance = max(config.begin_distance, min_distance)
    beyond = np.flatnonzero(_distance(blocks[still:] - level, rules.unit) > min_distance)
    return len(beyond) > 0 and all(_end(blocks[still:], int(beyond[0]), level, rules)[1:])


def _press(
    recording: OpenRecording, blocks: np.ndarray, span: tuple[int, int], baseline: np.ndarray, *, over: bool
) -> SegmentedPress:
    """Describe the press between two blocks of a recording."""
    rules, width = recording.rules, recording.rules.width
    change = blocks[span[0] : span[1]] - baseline
    start, end = (width * block for block in span)
    steady = slice(*(start + width * i for i in _steady(change, rules.unit, rules.config.min_steady_share)))
    onset = slice(max(start - 1, 0), start + width + 1)
    steps = np.diff(recording.time[onset])
    gap = onset.start + int(np.argmax(steps)) if len(steps) else start
    return SegmentedPress(
        start=recording.first + start,
        end=recording.first + end,
        steady_start=recording.first + steady.start,
        steady_end=recording.first + steady.stop,
        reading=np.median(recording.readings[steady], axis=0) - baseline,
        baseline=baseline,
        at_start=recording.others[start].copy(),  # a view would keep all rows
        across=recording.others[gap : gap + 2].copy(),
        steady=np.quantile(recording.others[steady], 0.5, axis=0, method="lower"),  # one of the values
        start_time=float(recording.time[start]),
        end_time=float(recording.time[end - 1]),
        gap=float(steps.max(initial=0.0)),
        over=over,
        peak=float(_distance(change, rules.unit).max()),
    )


def _end(blocks: np.ndarray, first: int, baseline: np.ndarray, rules: SegmentationRules) -> tuple[int, bool, bool]:
    """Find where a press ends: the block, counted from `first`, at which the skin rests again; whether it rests at all;
    and whether later blocks cannot change that.
    """
    size = rules.rest
    while True:
        end, rests, is_final = _release(_distance(blocks[first : first + size] - baseline, rules.unit), rules)
        if is_final or first + size >= len(blocks):
            return end, rests, is_final
        size *= 2


def _release(distance: np.ndarray, rules: SegmentationRules) -> tuple[int, bool, bool]:
    """Find where a press ends, as `_end` does, from the distances of the blocks that follow its beginning."""
    config, begin, released = rules.config, rules.config.begin_distance, rules.config.released_share
    peak, lowest, lowest_at, is_final = 0.0, np.inf, 0, False
    for i, d in enumerate(distance.tolist()):
        peak = max(peak, d)
        if d < max(config.end_distance, released * peak) and d < lowest:
            lowest, lowest_at = d, i
        elif lowest < np.inf and (i - lowest_at >= rules.gap or d > lowest + max(begin, released / 2 * peak)):
            is_final = True
            break
        if i > rules.longest and lowest == np.inf:
            return i, False, True
    if lowest == np.inf:
        return len(distance), True, False
    moving = np.flatnonzero(distance[:lowest_at] > lowest + config.rest_scatter)
    return (int(moving[-1]) + 1 if len(moving) else 0), True, is_final


def _distance(difference: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Compute the distance of rows from rest: the larger of that of the worst channel and that of all together."""
    z = np.abs(difference) / unit
    together = np.sqrt(np.maximum(np.mean(z**2, axis=1) - 1, 0)) * (z.shape[1] / 2) ** 0.25
    return np.maximum(0.8 * z.max(axis=1), together)


def _steady(change: np.ndarray, unit: np.ndarray, min_share: float) -> tuple[int, int]:
    """Find the rows of a press that move least among those near its full load."""
    size = np.linalg.norm(change / unit, axis=1)
    size = median_filter(size, 3, mode="nearest") if len(size) > 3 else size
    full = size >= 0.85 * size.max()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], full.astype(int), [0]])))
    runs = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
    first, last = max(runs, key=lambda run: run[1] - run[0])
    length = last - first
    if length <= 2:
        return first, last
    window = max(1, int(np.ceil(min_share * length)))
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(change[first:last], axis=0) / unit, axis=1))])
    motion = np.linalg.norm((change[first + window - 1 : last] - change[first : last - window + 1]) / unit, axis=1)
    best = int(np.argmin(motion + 1e-6 * path[: len(motion)]))
    return first + best, first + best + window
