"""Clocks of recordings: time stamps of any form in seconds, those that contradict their neighbours, and coarse ones.

Stamps are numbers in a unit that a column's name states, Unix times, or dates and times of day in ISO 8601. A damaged
stamp stands out from the rows before it and after it, which agree. Where the stamps after a step back go on, the clock
itself has begun again: a full counter is counted on, and a clock that was set or a board that was started anew begins a
new part. Where several rows share a stamp, the clock is coarser than the rows, and where they come in batches, it is
the time at which a computer took them over: such rows follow each other evenly.
"""

import re
from datetime import UTC, datetime
from datetime import time as TimeOfDay
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from i2t.errors import DataError

PAUSE_S = 1.0  # between two rows: afterwards the skin may rest elsewhere
PAUSE_ROWS = 20  # where rows are so far apart that a second is none
MAX_BAD_STAMPS = 64  # in a row that are damage; more are a clock that was set
MIN_PART_ROWS = 8  # at a clock's beginning or end that can be a part of a recording; fewer are damage
MAX_BACK_SHARE = 0.05  # of the rows before which time goes back; beyond it rows are in no order
STEPS_S = (1e-4, 1.0)  # between rows of a log: no board sends faster, and slower ones miss a press
ASSUMED_RATE_HZ = 100.0  # of a log whose stamps do not tell: its presses last the same number of rows at 30 to 500 Hz
BATCH_SHARE = 3.0  # of the mean step that is many times longer than the steps within a batch of rows
BATCHED_ROWS = 0.4  # of all, at least, that follow the row before within a batch
BETWEEN_BATCHES = 1 / 3  # of all time, at least, that passes in the steps from one batch to the next
UNEVEN = 0.5  # of the time from one batch to the next, up to which it is told by its rows
DAY_S, HOUR_S = 86400.0, 3600.0
MINUTES_AND_SECONDS = re.compile(r"(\d+):(\d\d[.,]\d+)")  # as Excel shows times of day, without their hour
COUNTERS_S = {  # how long a counter of whole numbers runs until it begins again
    "a 32-bit counter of microseconds": 2.0**32 * 1e-6,
    "a 32-bit counter of milliseconds": 2.0**32 * 1e-3,
    "a 16-bit counter of milliseconds": 2.0**16 * 1e-3,
    "a clock of one hour": HOUR_S,
    "a clock of one day": DAY_S,
}
DECIMAL_MINUTES = re.compile(r"(^|[T ])\d+:\d\d[.,]\d")  # of which nothing tells whether they are hours and minutes
IN_ORDER = (
    "sort them by it where they were mixed up, or give --rate-hz where they are in order and its counter often begins "
    "again or its stamps are damaged"
)
UNIX_TIMES = {1e9: 1.0, 1e12: 1e-3, 1e15: 1e-6, 1e18: 1e-9}  # s in their unit, from these numbers to ten times these


class ClockVerdict(NamedTuple):
    """What the stamps of some rows tell."""

    damaged: Bool[np.ndarray, " n"]  # stamps that contradict the rows before and after them
    restarts: Int[np.ndarray, " k"]  # rows at which the clock goes back, and goes on from there
    settled: int  # rows of which later rows cannot change that


class RowClock(NamedTuple):
    """How the rows of a log follow each other."""

    step: float  # s, between rows
    by_rows: bool  # the stamps say nothing: rows are evenly spaced
    resolution: float  # s, of the stamps or between batches, where several rows share one; else 0
    assumed: bool  # nothing states the step
    within: float = 0.0  # s, up to which rows that follow each other are of one batch


def pause_of(step: float) -> float:
    """How far rows are apart at least between which a recording paused.

    Args:
        step: Between rows (s).

    Returns:
        s.
    """
    return max(PAUSE_S, PAUSE_ROWS * step)


def states_zone(stamp: str) -> bool:
    """Test whether a time stamp is no date and time, or one with its zone.

    Args:
        stamp: As it stands in the table.

    Returns:
        False for a date and time without a zone.
    """
    return ":" not in stamp or re.search(r"(Z|[+-]\d\d:?\d\d)$", stamp.strip()) is not None


def stamp_in_seconds(text: str) -> str:
    """A time stamp as a number of seconds.

    Args:
        text: A number, or a date and time in ISO 8601, or a time of day, or minutes and seconds with decimals; without
            a zone it is taken as UTC.

    Returns:
        The text of a number; what is no stamp stays as it is.
    """
    plain = text.strip()
    if ":" not in plain:
        return text
    if short := MINUTES_AND_SECONDS.fullmatch(plain):
        return repr(60.0 * int(short[1]) + float(short[2].replace(",", ".")))
    if DECIMAL_MINUTES.search(plain):
        return text
    try:
        moment = datetime.fromisoformat(plain.replace("/", "-"))
    except ValueError:
        try:
            day = TimeOfDay.fromisoformat(plain)
        except ValueError:
            return text
        return repr(3600.0 * day.hour + 60.0 * day.minute + day.second + 1e-6 * day.microsecond)
    return repr((moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp())


def unix_unit(number: float) -> float | None:
    """The unit of a Unix time of this century, by its size.

    Args:
        number: The stamp.

    Returns:
        Seconds in the unit; None for a number that is no such time.
    """
    return next((unit for least, unit in UNIX_TIMES.items() if least <= number < 10 * least), None)


def row_clock(
    time: Float[np.ndarray, " n"],
    name: str,
    *,
    rate: float | None = None,
    begins: Bool[np.ndarray, " n"] | None = None,
) -> RowClock:
    """How the rows of a log follow each other, by the stamps of some of its first rows.

    Args:
        time: s.
        name: Of the log and its column, for messages.
        rate: Hz, where it is stated: then the stamps are not looked at.
        begins: Rows with which another session begins, whose clock may start anew.

    Returns:
        The clock.

    Raises:
        DataError: Rows follow each other at a rate that no board has, so that the stamps are in another unit, or
            they are in no order.
    """
    if rate is not None:
        return RowClock(1 / rate, by_rows=True, resolution=0.0, assumed=False)
    require_order(time, name, begins)
    steps = np.diff(time)
    forward = steps[steps > 0]
    within = _within_batches(time)
    if not (steps == 0).any() and not within:
        step = float(np.median(forward)) if len(forward) else 0.0
        _require_rate(step, len(time), name)
        return RowClock(step, by_rows=False, resolution=0.0, assumed=False)
    widths, counts = _batches(time, within)
    resolution = float(np.median(widths)) if len(widths) else float(np.median(forward)) if len(forward) else 0.0
    usual = (widths <= pause_of(resolution)) & (widths > 0)
    if not usual.any():
        return RowClock(1 / ASSUMED_RATE_HZ, by_rows=True, resolution=resolution, assumed=True)
    step = float(widths[usual].sum() / counts[usual].sum())
    _require_rate(step, len(time), name)
    return RowClock(step, by_rows=resolution > PAUSE_S, resolution=resolution, assumed=False, within=within)


def _batches(time: np.ndarray, within: float) -> tuple[np.ndarray, np.ndarray]:
    """Time from one whole batch to the next (s), and how many rows it has; the first may have begun before."""
    begins = np.flatnonzero(np.diff(time) > within) + 1
    return time[begins[1:]] - time[begins[:-1]], np.diff(begins)


def _within_batches(time: np.ndarray) -> float:
    """Step (s) up to which rows are of one batch; 0 where they do not come in batches, or share stamps.

    Rows come in batches where many steps are far shorter than the mean, and the time up to the next batch grows with
    the rows of each. It does not where rows were lost, or where the rate changes.
    """
    steps = np.diff(time)
    usual = steps[(steps >= 0) & (steps <= PAUSE_S)]
    if len(usual) < MIN_PART_ROWS:
        return 0.0
    close = usual <= usual.mean() / BATCH_SHARE
    if not (usual[close] > 0).any() or close.mean() < BATCHED_ROWS:
        return 0.0
    longest = np.sort(usual)[::-1]
    between = longest[np.searchsorted(np.cumsum(longest), BETWEEN_BATCHES * longest.sum())]
    widths, counts = _batches(time, between / 2)
    widths, counts = widths[widths <= PAUSE_S], counts[widths <= PAUSE_S]
    told = widths.sum() / max(counts.sum(), 1) * counts
    even = np.abs(widths - told).sum() < UNEVEN * widths.sum() and counts.sum() > len(time) / 2
    return float(between) / 2 if even else 0.0


def _require_rate(step: float, rows: int, name: str) -> None:
    if rows < MIN_PART_ROWS or STEPS_S[0] <= step < STEPS_S[1]:
        return
    pace = "slower than a press" if step >= STEPS_S[1] else "faster than any board"
    raise DataError(
        f"{name} says that rows are {step:.3g} s apart, {pace}; name its column by the unit that it counts (time_s, "
        "time_ms, time_us), or give --rate-hz"
    )


def require_order(
    time: Float[np.ndarray, " n"],
    name: str,
    begins: Bool[np.ndarray, " n"] | None = None,
    remedy: str = IN_ORDER,
) -> None:
    """Refuse rows in no order.

    Args:
        time: s.
        name: Of the log and its column, for messages.
        begins: Rows with which another session begins, whose clock may start anew.
        remedy: What to do.

    Raises:
        DataError: Time goes back at many rows.
    """
    goes_back = np.diff(time) < 0
    back = int(np.sum(goes_back if begins is None else goes_back & ~begins[1:]))
    if back > max(MAX_BACK_SHARE * len(time), 3):
        raise DataError(f"{name} goes back at {back} of {len(time)} rows, so they are in no order; {remedy}")


def judge_stamps(time: Float[np.ndarray, " n"], *, begun: bool = False, last: bool = True) -> ClockVerdict:
    """Find damaged stamps, and where the clock begins again.

    A run of stamps is damaged that stands out: later than the row after it and far from the row before it, or earlier
    than the row before it and far from the row after it. The shorter of two such runs is. Fewer rows than can be a part
    are damaged too where the clock goes back after the first of all rows, or before the last.

    Args:
        time: s, finite, in the order of the file.
        begun: The first is a sound row that was judged before.
        last: No more rows follow.

    Returns:
        The verdict on these rows.
    """
    damaged = np.zeros(len(time), bool)
    restarts: list[int] = []
    decided = len(time) if last else max(len(time) - MAX_BAD_STAMPS, 0)
    while True:
        rows = np.flatnonzero(~damaged)
        back = np.flatnonzero(np.diff(time[rows]) < 0) + 1
        back = back[(rows[back] < decided) & ~np.isin(rows[back], restarts)]
        if not len(back):
            break
        at, first = int(back[0]), int(np.searchsorted(rows, restarts[-1])) if restarts else 0
        both = (_late_rows(time[rows], at, first, begun), _early_rows(time[rows], at, last))
        runs = sorted(filter(None, both), key=lambda run: (not run.closed, run.end - run.start))
        if rolls_over(time[rows[at - 1]], time[rows[at]]) or not runs:
            restarts.append(int(rows[at]))
        else:
            damaged[rows[runs[0].start : runs[0].end]] = True
    settled = len(time) if last else max(len(time) - 2 * MAX_BAD_STAMPS, 0)
    return ClockVerdict(damaged[:settled], np.array([row for row in restarts if row < settled], int), settled)


def rolls_over(before: float, after: float) -> str:
    """Name the counter that begins again between two stamps because it is full.

    Args:
        before: s, the last stamp.
        after: s, the next.

    Returns:
        What counts so; "" where no counter does.
    """
    for name, period in COUNTERS_S.items():
        full = any(0 < end - before <= PAUSE_S for end in (period, period / 2))  # without a sign, and with one
        if 0 <= after + period - before <= PAUSE_S and full:
            return name
    return ""


def even_times(time: Float[np.ndarray, " n"], clock: RowClock, shared: int = 0) -> Float[np.ndarray, " n"]:
    """Times of rows that share the stamp of a coarse clock, evenly from each stamp onwards.

    Args:
        time: s, not decreasing.
        clock: Of the log.
        shared: Rows before these that have the first stamp too.

    Returns:
        s, not decreasing, as given where no two rows share a stamp.
    """
    begins = np.flatnonzero(np.diff(time, prepend=-np.inf) > clock.within)
    sizes = np.diff(np.append(begins, len(time)))
    within = np.arange(len(time)) - np.repeat(begins, sizes)
    within[: sizes[0]] += shared
    stamps = np.repeat(time[begins], sizes) if clock.resolution else time
    even = stamps + clock.step * within
    if clock.resolution and not shared and len(begins) > 1:  # of the first stamp, the last rows alone may be here
        end = min(time[begins[1]], time[0] + clock.resolution)
        even[: sizes[0]] = np.maximum(even[: sizes[0]], end - clock.step * np.arange(sizes[0], 0, -1))
    # A batch is taken over after its last row was measured, and so is stamped later than its rows by its length.
    return np.maximum.accumulate(even) - (clock.resolution - clock.step if clock.within else 0.0)


class _Run(NamedTuple):
    """Rows whose stamps stand out."""

    start: int
    end: int
    closed: bool  # from the rows before and from those after; else a side has no rows


def _late_rows(time: np.ndarray, at: int, first: int, begun: bool) -> _Run | None:
    """Rows before `at` that are later than it and stand out from those before, of which the part begins at `first`."""
    window = time[max(at - MAX_BAD_STAMPS - 1, first) : at][::-1] > time[at]
    start = at - (len(window) if window.all() else int(np.argmin(window)))
    if at - start > MAX_BAD_STAMPS:
        return None
    if start == first:
        return None if first or begun or at - start >= MIN_PART_ROWS else _Run(start, at, closed=False)
    return _Run(start, at, closed=True) if 2 * (time[start] - time[start - 1]) >= time[at - 1] - time[at] else None


def _early_rows(time: np.ndarray, at: int, last: bool) -> _Run | None:
    """Rows from `at` that are earlier than the row before and stand out from those after."""
    window = time[at : at + MAX_BAD_STAMPS + 1] < time[at - 1]
    end = at + (len(window) if window.all() else int(np.argmin(window)))
    if end - at > MAX_BAD_STAMPS:
        return None
    if end == len(time):
        return _Run(at, end, closed=False) if last and end - at < MIN_PART_ROWS else None
    return _Run(at, end, closed=True) if 2 * (time[end] - time[end - 1]) >= time[at - 1] - time[at] else None
