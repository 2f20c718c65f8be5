"""Clocks of recordings: time stamps of any form in seconds, damaged stamps, clocks that restart and coarse clocks.

Stamps are numbers in a unit that the column's name states, Unix times, or dates and times of day in ISO 8601. A damaged
stamp stands out from the rows before and after it, which agree with each other. If the stamps continue from a step
back, the clock itself has restarted: a full counter is continued, and a clock that was set or a board that was
restarted begins a new part. If several rows share a stamp, the clock is coarser than the rows; if rows come in batches,
the stamp is the time at which a computer received them. The rows are then evenly spaced.
"""

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from datetime import time as TimeOfDay
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from i2t.errors import DataError


@dataclass(frozen=True)
class ClockConfig:
    """Thresholds for interpreting the time stamps of a recording's rows.

    Attributes:
        pause_s: Time between two rows above which the recording paused and the skin may rest elsewhere.
        pause_rows: The same threshold in rows; the longer one applies.
        max_damaged_run: Number of successive stamps that can be damaged; after more of them the clock was set.
        min_part_rows: Number of rows at the beginning or end of a clock that can be a part of a recording; fewer are
            damaged.
        max_backward_share: Share of the rows before which time may go back; beyond it the rows have no order.
        min_step_s: Time between rows, at least: no board is faster.
        max_step_s: Time between rows below which presses are not missed.
        assumed_rate_hz: Rate of a log whose stamps do not determine it. Presses last the same number of rows at 30 to
            500 Hz.
        batch_ratio: Ratio of the mean step to the steps within a batch of rows, at least.
        min_batched_share: Share of the steps that lie within a batch, at least.
        min_between_share: Share of the time that passes between batches, at least.
        max_batch_error: Share of the time between batches by which the number of rows may fail to predict it.
    """

    pause_s: float = 1.0
    pause_rows: int = 20
    max_damaged_run: int = 64
    min_part_rows: int = 8
    max_backward_share: float = 0.05
    min_step_s: float = 1e-4
    max_step_s: float = 1.0
    assumed_rate_hz: float = 100.0
    batch_ratio: float = 3.0
    min_batched_share: float = 0.4
    min_between_share: float = 1 / 3
    max_batch_error: float = 0.5


CLOCK = ClockConfig()  # default thresholds for pauses, damaged stamps, steps and batches in the time stamps of a log
# s, time after which a full counter restarts, by kind of counter
COUNTER_PERIODS_S = {
    "a 32-bit counter of microseconds": 2.0**32 * 1e-6,
    "a 32-bit counter of milliseconds": 2.0**32 * 1e-3,
    "a 16-bit counter of milliseconds": 2.0**16 * 1e-3,
    "a clock of one hour": 3600.0,
    "a clock of one day": 86400.0,
}


class ClockVerdict(NamedTuple):
    """Mask of the damaged time stamps among n rows, rows at which the clock restarts, and number of final verdicts."""

    damaged: Bool[np.ndarray, " n"]  # True for time stamps that contradict the rows before and after them
    restarts: Int[np.ndarray, " k"]  # rows at which the clock goes back and continues from there
    settled: int  # number of rows whose judgement later rows cannot change


class RowClock(NamedTuple):
    """Time between the rows of a recorded log, the resolution of its time stamps, and whether rows are taken as evenly
    spaced or the time between them is assumed.
    """

    step: float  # s, time between rows
    by_rows: bool  # whether rows are taken as evenly spaced because the time stamps do not show the spacing
    resolution: float  # s, resolution of the time stamps, or time between batches if several rows share one; else 0
    assumed: bool  # whether the step is assumed because nothing determines it
    within: float = 0.0  # s, largest step between successive rows of one batch


def pause_threshold(step: float) -> float:
    """Compute the time between two rows above which a recording paused.

    Args:
        step: Usual time between rows, in s.

    Returns:
        The threshold in s.
    """
    return max(CLOCK.pause_s, CLOCK.pause_rows * step)


def has_time_zone(stamp: str) -> bool:
    """Test whether a time stamp needs no time zone or has one.

    Args:
        stamp: Time stamp as written in the table.

    Returns:
        False for a date and time, or a time of day, without a zone; else True.
    """
    return ":" not in stamp or re.search(r"(Z|[+-]\d\d:?\d\d)$", stamp.strip()) is not None


def stamp_in_seconds(text: str) -> str:
    """Convert a time stamp to seconds.

    Args:
        text: A number, a date and time in ISO 8601 (in UTC if it has no zone), a time of day, or minutes and seconds
            with decimals.

    Returns:
        The text of a number in s; the text itself if it is not a stamp.
    """
    plain = text.strip()
    if ":" not in plain:
        return text
    # Excel shows a time of day without its hour.
    if minutes := re.fullmatch(r"(\d+):(\d\d[.,]\d+)", plain):
        return repr(60.0 * int(minutes[1]) + float(minutes[2].replace(",", ".")))
    # Two numbers with decimals may be hours and minutes or minutes and seconds.
    if re.search(r"(^|[T ])\d+:\d\d[.,]\d", plain):
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
    """Determine the unit of a Unix time of this century by its size.

    Args:
        number: The time stamp.

    Returns:
        Length of the unit in seconds, or None if the number cannot be a Unix time of this century.
    """
    units = ((1e9, 1.0), (1e12, 1e-3), (1e15, 1e-6), (1e18, 1e-9))
    return next((unit for smallest, unit in units if smallest <= number < 10 * smallest), None)


def row_clock(
    time: Float[np.ndarray, " n"],
    name: str,
    *,
    rate: float | None = None,
    begins: Bool[np.ndarray, " n"] | None = None,
) -> RowClock:
    """Determine the timing of a log's rows from the stamps of some of its first rows.

    Args:
        time: `(n,)` stamps in s.
        name: Name of the log and its column, for messages.
        rate: Stated rate in Hz, or None if none is stated. A stated rate replaces the stamps.
        begins: `(n,)` mask of rows that begin another session, whose clock may restart.

    Returns:
        The timing of the rows.

    Raises:
        DataError: No board has the rate of the rows, so that the stamps are in another unit; or the rows have no order.
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
    usual = (widths <= pause_threshold(resolution)) & (widths > 0)
    if not usual.any():
        return RowClock(1 / CLOCK.assumed_rate_hz, by_rows=True, resolution=resolution, assumed=True)
    step = float(widths[usual].sum() / counts[usual].sum())
    _require_rate(step, len(time), name)
    return RowClock(step, by_rows=resolution > CLOCK.pause_s, resolution=resolution, assumed=False, within=within)


def _batches(time: np.ndarray, within: float) -> tuple[np.ndarray, np.ndarray]:
    """Measure the time in s from each complete batch to the next, and count its rows; the first may be incomplete."""
    begins = np.flatnonzero(np.diff(time) > within) + 1
    return time[begins[1:]] - time[begins[:-1]], np.diff(begins)


def _within_batches(time: np.ndarray) -> float:
    """Find the step in s up to which rows belong to one batch; 0 if they do not come in batches, or share stamps.

    Rows come in batches if many steps are far shorter than the mean, and the time up to the next batch grows with the
    number of rows in each. That time does not grow if rows were lost or the rate changes.
    """
    steps = np.diff(time)
    usual = steps[(steps >= 0) & (steps <= CLOCK.pause_s)]
    if len(usual) < CLOCK.min_part_rows:
        return 0.0
    short = usual <= usual.mean() / CLOCK.batch_ratio
    if not (usual[short] > 0).any() or short.mean() < CLOCK.min_batched_share:
        return 0.0
    longest = np.sort(usual)[::-1]
    between = longest[np.searchsorted(np.cumsum(longest), CLOCK.min_between_share * longest.sum())]
    widths, counts = _batches(time, between / 2)
    widths, counts = widths[widths <= CLOCK.pause_s], counts[widths <= CLOCK.pause_s]
    expected = widths.sum() / max(counts.sum(), 1) * counts
    is_even = np.abs(widths - expected).sum() < CLOCK.max_batch_error * widths.sum()
    return float(between) / 2 if is_even and counts.sum() > len(time) / 2 else 0.0


def _require_rate(step: float, rows: int, name: str) -> None:
    if rows < CLOCK.min_part_rows or CLOCK.min_step_s <= step < CLOCK.max_step_s:
        return
    pace = "slower than a press" if step >= CLOCK.max_step_s else "faster than any board"
    raise DataError(
        f"by {name}, rows are {step:.3g} s apart, {pace}; name its column by the unit that it counts (time_s, "
        "time_ms, time_us), or give --rate-hz"
    )


def require_order(
    time: Float[np.ndarray, " n"],
    name: str,
    begins: Bool[np.ndarray, " n"] | None = None,
    remedy: str = (
        "sort them by it if they were mixed up, or give --rate-hz if they are in order and its counter restarts often "
        "or its stamps are damaged"
    ),
) -> None:
    """Refuse rows whose time goes back too often.

    Args:
        time: `(n,)` stamps in s.
        name: Name of the log and its column, for messages.
        begins: `(n,)` mask of rows that begin another session, whose clock may restart.
        remedy: Advice at the end of the message.

    Raises:
        DataError: Time goes back at many rows.
    """
    goes_back = np.diff(time) < 0
    back = int(np.sum(goes_back if begins is None else goes_back & ~begins[1:]))
    if back > max(CLOCK.max_backward_share * len(time), 3):
        raise DataError(f"{name} goes back at {back} of {len(time)} rows, so they are not in order of time; {remedy}")


def check_stamps(time: Float[np.ndarray, " n"], *, begun: bool = False, last: bool = True) -> ClockVerdict:
    """Find damaged time stamps, and rows at which the clock restarts.

    A run of stamps is damaged if it stands out: it is later than the row after it and far from the row before it, or
    earlier than the row before it and far from the row after it. Of two such runs the shorter one is damaged. A run
    that is too short to be a part is also damaged if the clock goes back after the first row of all or before the last.

    Args:
        time: `(n,)` finite stamps in s, in the order of the file.
        begun: Whether the first row was judged before and is sound.
        last: Whether no more rows follow.

    Returns:
        The damaged stamps and the restarts among the settled rows, and the number of settled rows.
    """
    damaged = np.zeros(len(time), bool)
    restarts: list[int] = []
    decided = len(time) if last else max(len(time) - CLOCK.max_damaged_run, 0)
    while True:
        rows = np.flatnonzero(~damaged)
        back = np.flatnonzero(np.diff(time[rows]) < 0) + 1
        back = back[(rows[back] < decided) & ~np.isin(rows[back], restarts)]
        if not len(back):
            break
        at, first = int(back[0]), int(np.searchsorted(rows, restarts[-1])) if restarts else 0
        both = (_late_rows(time[rows], at, first, begun), _early_rows(time[rows], at, last))
        runs = sorted(filter(None, both), key=lambda run: (not run.closed, run.end - run.start))
        if rollover_counter(time[rows[at - 1]], time[rows[at]]) or not runs:
            restarts.append(int(rows[at]))
        else:
            damaged[rows[runs[0].start : runs[0].end]] = True
    settled = len(time) if last else max(len(time) - 2 * CLOCK.max_damaged_run, 0)
    return ClockVerdict(damaged[:settled], np.array([row for row in restarts if row < settled], int), settled)


def rollover_counter(before: float, after: float) -> str:
    """Name the counter that is full and restarts between two stamps.

    Args:
        before: Last stamp before the step back, in s.
        after: First stamp after it, in s.

    Returns:
        A key of `COUNTER_PERIODS_S`, or "" if no counter restarts there.
    """
    for name, period in COUNTER_PERIODS_S.items():
        is_full = any(0 < end - before <= CLOCK.pause_s for end in (period, period / 2))  # unsigned and signed
        if 0 <= after + period - before <= CLOCK.pause_s and is_full:
            return name
    return ""


def even_times(time: Float[np.ndarray, " n"], clock: RowClock, shared: int = 0) -> Float[np.ndarray, " n"]:
    """Space rows that share the time stamp of a coarse clock evenly, from that stamp onwards.

    Args:
        time: `(n,)` non-decreasing stamps in s.
        clock: Timing of the log's rows.
        shared: Number of rows before these that also have the first stamp.

    Returns:
        `(n,)` non-decreasing times in s; the stamps themselves if no two rows share one.
    """
    begins = np.flatnonzero(np.diff(time, prepend=-np.inf) > clock.within)
    sizes = np.diff(np.append(begins, len(time)))
    within = np.arange(len(time)) - np.repeat(begins, sizes)
    within[: sizes[0]] += shared
    stamps = np.repeat(time[begins], sizes) if clock.resolution else time
    even = stamps + clock.step * within
    if clock.resolution and not shared and len(begins) > 1:  # only the last rows of the first stamp may be here
        end = min(time[begins[1]], time[0] + clock.resolution)
        even[: sizes[0]] = np.maximum(even[: sizes[0]], end - clock.step * np.arange(sizes[0], 0, -1))
    # A batch is stamped after its last row was measured, so its rows are earlier by its length.
    return np.maximum.accumulate(even) - (clock.resolution - clock.step if clock.within else 0.0)


class _Run(NamedTuple):
    """Rows whose stamps stand out."""

    start: int
    end: int
    closed: bool  # whether there are rows on both sides to compare with


def _late_rows(time: np.ndarray, at: int, first: int, begun: bool) -> _Run | None:
    """Find rows before `at` that are later than it and stand out from those before; their part begins at `first`."""
    window = time[max(at - CLOCK.max_damaged_run - 1, first) : at][::-1] > time[at]
    start = at - (len(window) if window.all() else int(np.argmin(window)))
    if at - start > CLOCK.max_damaged_run:
        return None
    if start == first:
        return None if first or begun or at - start >= CLOCK.min_part_rows else _Run(start, at, closed=False)
    return _Run(start, at, closed=True) if 2 * (time[start] - time[start - 1]) >= time[at - 1] - time[at] else None


def _early_rows(time: np.ndarray, at: int, last: bool) -> _Run | None:
    """Find rows from `at` on that are earlier than the row before and stand out from those after."""
    window = time[at : at + CLOCK.max_damaged_run + 1] < time[at - 1]
    end = at + (len(window) if window.all() else int(np.argmin(window)))
    if end - at > CLOCK.max_damaged_run:
        return None
    if end == len(time):
        return _Run(at, end, closed=False) if last and end - at < CLOCK.min_part_rows else None
    return _Run(at, end, closed=True) if 2 * (time[end] - time[end - 1]) >= time[at - 1] - time[at] else None
