"""Presses found in a continuous recording of a skin: where each begins and ends, and what it reads when steady.

A skin at rest drifts slowly and its noise is white; a press moves many channels together and comes and goes, and after
it the skin may stay displaced and recover. Rows are averaged over 20 ms. The distance of each average from a baseline,
the median of the last second at rest, is counted in standard deviations of the noise over all channels. A press begins
where it rises over a threshold. It ends where it has fallen to a tenth of the press's own peak and falls no further:
there is the next rest, with a baseline of its own. Any rate, regular or not, and any number of channels.

The first level at which the skin stays still is taken as its rest until it moves from there. Where it moves to the rest
of an earlier recording, or does not come back, it was pressed or has moved: the next still level is taken then.

A row that stands out from two rows on either side is a spike, which their median replaces. Rows that repeat the one
before, as of a sensor that is read faster than it measures, tell nothing of the noise.

`segment_presses` takes a whole recording. One that does not fit into memory is given piece by piece to `find_more`,
which keeps no more than the rows of the longest press.
"""

from collections.abc import Sequence
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
BEGIN_AT, END_AT = 8.0, 4.0  # distances from rest that a press exceeds, and below which the skin is at rest
SMOOTH_S = 0.02  # over which rows are averaged before they are compared
BASELINE_S = 1.0  # at rest, that a baseline is the median of
SHORTEST_S, LONGEST_S = 0.1, 60.0  # of a press: what is shorter is left out, what lasts longer is a new rest
GAP_S = 0.1  # presses closer than this are one
NOISE_BLOCKS = 20  # of rows, whose differences are compared to find those at rest
SPIKE_AT, SPIKE_TIMES = 10.0, 4.0  # standard deviations that a spike stands out by, and times its neighbours' spread
HELD_SPREAD = 2.0  # of the lengths of runs of one value, where a sensor is read faster than it measures
MIN_SHARE_OF_MOVE = 0.3  # of the way to a level: presses from there are larger, and a held press that wavers moves less
STILL_BLOCKS = 3  # of a level, at least
HELD_ROWS = 1.3  # in a run, at least


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


class FoundPress(NamedTuple):
    """One press of a recording; rows count from the recording's first."""

    start: int  # first row
    end: int  # row after its last
    steady_start: int
    steady_end: int
    reading: Float[np.ndarray, " c"]  # uT, steady, less the baseline before it
    baseline: Float[np.ndarray, " c"]  # uT
    at_start: Float[np.ndarray, " e"]  # other columns where it begins
    across: Float[np.ndarray, "2 e"]  # other columns in the rows before and after the longest step where it begins
    steady: Float[np.ndarray, " e"]  # their medians where it is steady
    start_time: float  # s
    end_time: float  # s
    gap: float  # s, that step
    over: bool  # it ended before the recording did
    peak: float  # distance from rest, in standard deviations of a smoothed channel


class SegmentationRules(NamedTuple):
    """Noise and rate of one recording: times in rows, or in blocks of rows that are averaged."""

    noise_std: Float[np.ndarray, " c"]  # uT, of a row
    step: float  # s, between rows
    width: int  # rows of a block
    rest: int  # blocks
    gap: int  # blocks
    longest: int  # blocks
    spike: Float[np.ndarray, " c"]  # uT, that a row stands out by at least to be a spike; inf where one may be a press
    fresh: float  # share of rows that do not repeat the one before

    @property
    def unit(self) -> Float[np.ndarray, " c"]:
        """The noise of a block (uT)."""
        return self.noise_std / np.sqrt(max(self.width * self.fresh, 1.0))


class OpenRecording(NamedTuple):
    """State of a recording of which more rows may come."""

    rules: SegmentationRules
    first: int  # row of the recording that is the first of those kept
    time: Float[np.ndarray, " n"]  # s
    readings: Float[np.ndarray, "n c"]  # uT
    others: Float[np.ndarray, "n e"]
    at: int  # block, among those kept, up to which presses were sought
    rest_from: int  # block from which the skin has been at rest; negative where that was dropped
    baseline: Float[np.ndarray, " c"] | None  # uT; None before the first rest was seen
    earlier: Float[np.ndarray, " c"] | None = None  # uT, a rest before, of another recording or of this one
    sure: bool = False  # the skin came back to its rest
    moved: tuple[np.ndarray, ...] = ()  # others where it left what was taken for rest, and did not come back
    spikes: int = 0  # rows that were replaced


def segment_presses(time: ArrayLike, readings: ArrayLike) -> SegmentedPresses:
    """Find the presses of a recording.

    Args:
        time: (n,) when each row was read (s), increasing.
        readings: (n, c) what the board sent (uT), ambient and drift and all.

    Returns:
        The presses in the order of time; none where nothing presses.

    Raises:
        ValueError: Times do not increase, shapes do not belong together, or a value is not finite.

    Example:
        presses = segment_presses(time, readings)
        presses.reading, presses.start_time
    """
    time, readings = np.asarray(time, np.float64), np.asarray(readings, np.float64)
    rules = segmentation_rules(time, readings)
    recording, found = find_more(open_recording(rules), time, readings)
    kept = true_presses([*found, *find_last(recording)[1]], rules)
    columns = {name: np.array([getattr(press, name) for press in kept]) for name in SegmentedPresses._fields}
    columns |= {name: columns[name].reshape(-1, readings.shape[1]) for name in ("reading", "baseline")}
    return SegmentedPresses(**columns)


def segmentation_rules(time: ArrayLike, readings: ArrayLike) -> SegmentationRules:
    """Rules that define a press in a recording, by the rate and the noise of some of its rows.

    Args:
        time: (n,) when each row was read (s), increasing.
        readings: (n, c) uT.

    Returns:
        The rules, in rows.

    Raises:
        ValueError: Times do not increase, shapes do not belong together, or a value is not finite.
    """
    time, readings = np.asarray(time, np.float64), np.asarray(readings, np.float64)
    _check(time, readings)
    step = float(np.median(np.diff(time)))
    width = min(max(1, round(SMOOTH_S / step)), max(len(time) // MIN_ROWS, 1))
    rest, gap, longest = (max(1, max(1, round(s / step)) // width) for s in (BASELINE_S, GAP_S, LONGEST_S))
    fresh = _fresh_share(readings)
    new = readings[np.append(True, np.diff(readings, axis=0).any(1))] if fresh < 1 else readings
    spike = _spike_size(new) if 2 * step < SHORTEST_S and fresh == 1 else np.full(readings.shape[1], np.inf)
    noise = _noise(_without_spikes(new, spike)[0])
    return SegmentationRules(noise, step, width, rest=rest, gap=gap, longest=longest, spike=spike, fresh=fresh)


def open_recording(
    rules: SegmentationRules, columns: int = 0, earlier: Float[np.ndarray, " c"] | None = None
) -> OpenRecording:
    """A recording of which no row has come.

    Args:
        rules: What is a press.
        columns: Other columns that come with its readings.
        earlier: (c,) uT, the rest of the recording before, where there was one.

    Returns:
        The recording.
    """
    channels = len(rules.noise_std)
    nothing = (np.zeros(0), np.zeros((0, channels)), np.zeros((0, columns)))
    return OpenRecording(rules, 0, *nothing, at=0, rest_from=0, baseline=None, earlier=earlier)


def find_more(
    recording: OpenRecording, time: ArrayLike, readings: ArrayLike, others: ArrayLike | None = None
) -> tuple[OpenRecording, list[FoundPress]]:
    """Take further rows of a recording, and find the presses that are over.

    Args:
        recording: What came before.
        time: (n,) s, of the further rows.
        readings: (n, c) uT, finite.
        others: (n, e) other columns, such as the tip's position; may hold NaN.

    Returns:
        The recording with its last rows, and the presses that ended, short and weak ones too: ask `true_presses`.
    """
    rows = np.asarray(readings, np.float64)
    more = np.zeros((len(rows), 0)) if others is None else np.asarray(others, np.float64)
    longer = recording._replace(
        time=np.concatenate([recording.time, np.asarray(time, np.float64)]),
        readings=np.concatenate([recording.readings, rows]),
        others=np.concatenate([recording.others, more]),
    )
    return _advance(longer, last=False)


def find_last(recording: OpenRecording) -> tuple[OpenRecording, list[FoundPress]]:
    """The presses in the last rows of a recording.

    Args:
        recording: To which nothing is added any more.

    Returns:
        The recording, and those presses that `find_more` has not found; one that was not over ends with the recording.
    """
    return _advance(recording, last=True)


def true_presses(found: Sequence[FoundPress], rules: SegmentationRules) -> list[FoundPress]:
    """Presses without those too short to be one, and without what is only a skin that recovers from one.

    Args:
        found: All presses of a recording.
        rules: By which they were found.

    Returns:
        Those that count.
    """
    enough = MIN_PEAK_SHARE * float(np.median([press.peak for press in found])) if found else 0.0
    shortest = SHORTEST_S - 1.5 * rules.step
    return [press for press in found if press.end_time - press.start_time >= shortest and press.peak >= enough]


def _check(time: np.ndarray, readings: np.ndarray) -> None:
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


def _noise(readings: np.ndarray) -> np.ndarray:
    """Standard deviation of a row of each channel at rest, from second differences in the quietest half of blocks."""
    second = readings[2:] - 2 * readings[1:-1] + readings[:-2]  # what moves evenly takes no part
    blocks = np.array_split(second, min(NOISE_BLOCKS, max(len(second) // MIN_ROWS, 1)))
    spread = np.array([np.sqrt(np.mean(block**2, axis=0)) for block in blocks]) / np.sqrt(6)
    robust = MAD_TO_STD * np.median(np.abs(second), axis=0) / np.sqrt(6)
    return np.maximum(np.maximum(np.quantile(spread, 0.25, axis=0), 0.5 * robust), MIN_NOISE_UT)


def _spike_size(readings: np.ndarray) -> np.ndarray:
    """How far a row stands out that is a spike, in each channel: by far more than noise and than a channel's steps."""
    steps = np.abs(np.diff(readings, axis=0))
    resolution = np.min(np.where(steps > 0, steps, np.inf), axis=0, initial=np.inf)
    second = np.abs(np.diff(readings, 2, axis=0))
    noise = np.maximum(MAD_TO_STD * np.median(second, axis=0) / np.sqrt(6), MIN_NOISE_UT)
    return SPIKE_AT * np.maximum(noise, np.where(np.isfinite(resolution), resolution, 0.0))


def _without_spikes(readings: np.ndarray, spike: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows with spikes replaced by the median of the two rows on either side; and which rows had one."""
    spiked = np.zeros(len(readings), bool)
    if len(readings) < 5 or not np.isfinite(spike).any():
        return readings, spiked
    far = (np.abs(readings[2:-2] - readings[1:-3]) > spike) & (np.abs(readings[2:-2] - readings[3:-1]) > spike)
    rows = np.flatnonzero(far.any(1)) + 2
    if not len(rows):
        return readings, spiked
    around = np.sort(readings[rows[:, None] + np.array([-2, -1, 1, 2])], axis=1)
    middle, spread = around[:, 1:3].mean(1), around[:, 2] - around[:, 1]  # one of the four may be a spike too
    out = np.abs(readings[rows] - middle) > np.maximum(spike, SPIKE_TIMES * spread)
    mended = readings.copy()
    mended[rows] = np.where(out, middle, readings[rows])
    spiked[rows[out.any(1)]] = True
    return mended, spiked


def _fresh_share(readings: np.ndarray) -> float:
    """Share of rows that do not repeat the one before, where runs of one value are about equally long; else 1."""
    begins = np.flatnonzero(np.append(True, np.diff(readings, axis=0).any(1)))
    if len(begins) < MIN_ROWS or len(readings) < HELD_ROWS * len(begins):
        return 1.0
    short, long = np.quantile(np.diff(begins), (0.1, 0.9))
    return len(begins) / len(readings) if long <= HELD_SPREAD * short else 1.0


def _first_still(blocks: np.ndarray, rules: SegmentationRules) -> tuple[int, np.ndarray | None]:
    """First block, and level (uT), at which the skin stays still for longer than between two presses.

    It is sought over the blocks of a rest; there is no level where it does not stay still.
    """
    size = max(rules.gap, STILL_BLOCKS)
    for start in range(min(rules.rest, len(blocks) - size) + 1):
        some = blocks[start : start + size]
        level = np.median(some, axis=0)
        if _distance(some - level, rules.unit).max() < END_AT:
            return start, level
    return 0, None


def _advance(recording: OpenRecording, *, last: bool) -> tuple[OpenRecording, list[FoundPress]]:
    """Look for presses as far as later rows cannot change them, or to the end where these rows are the last."""
    rules, unit = recording.rules, recording.rules.unit
    count = len(recording.readings) // rules.width
    shape = (count, rules.width, recording.readings.shape[1])
    mended, spiked = _without_spikes(recording.readings, rules.spike)
    blocks = mended[: count * rules.width].reshape(shape).mean(1)
    at, rest_from, baseline = recording.at, recording.rest_from, recording.baseline
    earlier, sure, moved = recording.earlier, recording.sure, list(recording.moved)
    found: list[FoundPress] = []
    while at < count and (last or at + 2 * rules.rest <= count):
        if baseline is None:
            still, baseline = _first_still(blocks[at:], rules)
            at = rest_from = at + still
            baseline = np.median(blocks[at : at + max(rules.rest // 4, 1)], axis=0) if baseline is None else baseline
        distance = _distance(blocks[at : at + rules.rest] - baseline, unit)
        over = np.flatnonzero(distance > BEGIN_AT)
        if not len(over):
            at += max(1, min(rules.rest // 4, len(distance)))
            baseline = np.median(blocks[max(rest_from, at - rules.rest, 0) : at], axis=0)
            continue
        first = at + int(over[0])
        end, rests, known = _end(blocks, first, baseline, rules)
        following = max(first + end, first + 1)
        if not last and not (known and max(following + rules.gap, first + 2 * rules.rest) <= count):
            break
        if _has_moved(blocks[first:], baseline, None if sure else earlier, rules, came_back=known and rests):
            moved += [recording.others[rules.width * first].copy()] if first > at or not moved else []
            at, earlier, baseline, sure = max(first, at + 1), baseline if sure else earlier, None, False
            continue
        sure |= known and rests
        since = max(rest_from, first - rules.longest, 0)
        back = _distance(blocks[since:first] - baseline, unit) < END_AT
        start = since + int(np.flatnonzero(back)[-1]) + 1 if back.any() else since
        found.append(_press(recording, blocks, (start, first + end), baseline, over=known))
        at = rest_from = following
        if at < count:
            baseline = np.median(blocks[rest_from : rest_from + rules.gap], axis=0)
    drop = len(blocks) if last else max(min(max(rest_from, at - rules.longest), at - rules.rest), 0)
    rows = drop * rules.width
    kept = recording._replace(
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
    return kept, found


def _has_moved(
    blocks: np.ndarray,
    baseline: np.ndarray,
    earlier: np.ndarray | None,
    rules: SegmentationRules,
    *,
    came_back: bool,
) -> bool:
    """Test whether a skin that leaves a level, with these blocks, has left a press or rests elsewhere from then on.

    It has where the next still level is an earlier rest, or where it does not come back for longer than a press lasts.
    Where the recording ends before, it has where presses come and go after it from the next still level.
    """
    if came_back and earlier is None:
        return False
    still, level = _first_still(blocks, rules)
    if earlier is not None and level is not None:
        apart, away = _distance(np.stack([baseline, level]) - earlier, rules.unit)
        if apart > BEGIN_AT and away < max(END_AT, RELEASED_SHARE * apart):
            return True
    if came_back or len(blocks) > rules.longest:
        return not came_back
    if level is None:
        return False
    least = MIN_SHARE_OF_MOVE * float(_distance(level[None] - baseline, rules.unit)[0])
    over = np.flatnonzero(_distance(blocks[still:] - level, rules.unit) > max(BEGIN_AT, least))
    return len(over) > 0 and all(_end(blocks[still:], int(over[0]), level, rules)[1:])


def _press(
    recording: OpenRecording, blocks: np.ndarray, span: tuple[int, int], baseline: np.ndarray, *, over: bool
) -> FoundPress:
    """The press between two blocks of a recording."""
    rules, width = recording.rules, recording.rules.width
    moved = blocks[span[0] : span[1]] - baseline
    start, end = (width * block for block in span)
    first, last = (start + width * block for block in _steady(moved, rules.unit))
    onset = slice(max(start - 1, 0), start + width + 1)
    steps = np.diff(recording.time[onset])
    gap = onset.start + int(np.argmax(steps)) if len(steps) else start
    return FoundPress(
        start=recording.first + start,
        end=recording.first + end,
        steady_start=recording.first + first,
        steady_end=recording.first + last,
        reading=np.median(recording.readings[first:last], axis=0) - baseline,
        baseline=baseline,
        at_start=recording.others[start].copy(),  # a view would keep all rows
        across=recording.others[gap : gap + 2].copy(),
        steady=np.quantile(recording.others[first:last], 0.5, axis=0, method="lower"),  # one of the values
        start_time=float(recording.time[start]),
        end_time=float(recording.time[end - 1]),
        gap=float(steps.max(initial=0.0)),
        over=over,
        peak=float(_distance(moved, rules.unit).max()),
    )


def _end(blocks: np.ndarray, first: int, baseline: np.ndarray, rules: SegmentationRules) -> tuple[int, bool, bool]:
    """Block, counted from `first`, at which the skin is at rest again; whether it is, or rests where it is; and whether
    later blocks cannot change that.
    """
    size = rules.rest
    while True:
        end, rests, known = _release(_distance(blocks[first : first + size] - baseline, rules.unit), rules)
        if known or first + size >= len(blocks):
            return end, rests, known
        size *= 2


def _release(distance: np.ndarray, rules: SegmentationRules) -> tuple[int, bool, bool]:
    """As `_end`, of the distances of all that follows the beginning of a press."""
    peak, least, least_at, known = 0.0, np.inf, 0, False
    for i, d in enumerate(distance.tolist()):
        peak = max(peak, d)
        if d < max(END_AT, RELEASED_SHARE * peak) and d < least:
            least, least_at = d, i
        elif least < np.inf and (i - least_at >= rules.gap or d > least + max(BEGIN_AT, RELEASED_SHARE / 2 * peak)):
            known = True
            break
        if i > rules.longest and least == np.inf:
            return i, False, True
    if least == np.inf:
        return len(distance), True, False
    moving = np.flatnonzero(distance[:least_at] > least + REST_SCATTER)
    return (int(moving[-1]) + 1 if len(moving) else 0), True, known


def _distance(difference: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Distance of rows from rest: the larger of the worst channel and of what all channels show together."""
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
