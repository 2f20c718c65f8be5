"""Rows of a log on one clock: without damaged stamps and repeated rows, and evenly spaced if the clock is coarse.

`i2t.recordings.clocks` judges the stamps. This module puts the rows of a log, which is read in pieces, on the resulting
clock.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from functools import reduce
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from i2t.errors import DataError
from i2t.recordings.clocks import (
    CLOCK,
    COUNTER_PERIODS_S,
    ClockVerdict,
    RowClock,
    check_stamps,
    even_times,
    pause_threshold,
    require_order,
    rollover_counter,
    row_clock,
)
from i2t.recordings.log import ReadingLog

ROWS_READ_AT_ONCE = 8192  # rows of a log read at once, 20 s at 400 Hz; rate and noise are estimated from the first ones


class LabelColumn(IntEnum):
    """Column indices in `LogRows.labels`: line number, time stamp, names of pad and session, first further value."""

    LINE = 0
    STAMP = 1
    NAMES = 2
    FIRST_VALUE = 3


class LogRows(NamedTuple):
    """Rows of a log of sensor samples, in its order: time stamps (s), readings (uT; NaN for a chip that did not
    answer), and labels, whose columns begin as in `LabelColumn`.
    """

    time: np.ndarray  # (n,) s, time stamps of the rows
    readings: np.ndarray  # (n, c) uT; NaN for a chip that did not answer
    # (n, 3 + e): line in the file, time (s; NaN if stamps do not show it), number of its pad's and session's names,
    # values
    labels: np.ndarray

    def select(self, which: slice | np.ndarray) -> "LogRows":
        """Select some of the rows.

        Args:
            which: A slice or a mask.

        Returns:
            The selected rows, in the order of the log.
        """
        return LogRows(self.time[which], self.readings[which], self.labels[which])

    def append(self, more: "LogRows") -> "LogRows":
        """Append rows that follow in the log.

        Args:
            more: The rows that follow.

        Returns:
            All rows in their order.
        """
        return LogRows(*(np.concatenate(both) for both in zip(self, more, strict=True)))

    @property
    def complete(self) -> np.ndarray:
        """Mask of the rows in which every chip answered."""
        return ~np.isnan(self.readings).any(1)


class TimedRows(NamedTuple):
    """Rows of a log with ascending times, a mask of the rows that begin a part (after a pause or a restart of the
    clock), and the time (s) between rows.
    """

    rows: LogRows  # rows with ascending time, except at the beginning of a part
    begins: np.ndarray  # (n,) mask of rows after a pause, or at which the clock begins again
    step: float  # s, time between rows


def on_one_clock(pieces: Iterator[LogRows], name: str, notes: ReadingLog, rate: float | None) -> Iterator[TimedRows]:
    """Give the rows of a log of sensor samples valid times, from its time stamps or a stated rate.

    Args:
        pieces: Rows in the order of the log, some at a time.
        name: Name of the log and its time, for messages.
        notes: Log that receives findings and omissions.
        rate: Rate (Hz) of the rows, if stated; then stamps are ignored.

    Yields:
        Rows without damaged stamps and without repetitions of earlier rows, evenly spaced if the clock is coarse.

    Raises:
        DataError: If a stamp is damaged and may not be left out, or the rows have no order.
    """
    clock: RowClock | None = None
    held: LogRows | None = None
    stamps, memory = _Stamps(), _Memory()
    for piece, last in _with_last(pieces):
        new = piece if rate is not None else memory.leave_out(piece)
        held = new if held is None else held.append(new)
        if clock is None and len(held.time) < ROWS_READ_AT_ONCE and not last:
            continue
        begins = np.append(False, np.diff(held.labels[:, LabelColumn.NAMES]) != 0)
        if clock is None:
            clock = row_clock(held.time, name, rate=rate, begins=begins)
            _note_clock(clock, held.time, notes)
        if clock.by_rows:
            yield stamps.counted(held, clock)
            held = None
            continue
        require_order(held.time, name, begins)
        verdict = stamps.judge(held.time, last=last)
        for line, stamp in held.labels[: verdict.settled][verdict.damaged, :2]:
            notes.skip_row(
                DataError(
                    f"{name} at line {line:.0f}, {stamp:.6f} s, contradicts the rows before and after it; correct it"
                )
            )
        if verdict.settled:
            yield stamps.timed(held.select(slice(0, verdict.settled)), verdict, clock, notes)
        held = held.select(slice(verdict.settled, None))
    if memory.repeats:
        notes.change(
            "repeated rows",
            f"left out: {memory.repeats} rows that repeat earlier ones with their times, the first at line "
            f"{memory.first}",
        )


@dataclass
class _Memory:
    """Memory of the rows of a log, by a hash of each."""

    prints: list[np.ndarray] = field(default_factory=list)
    latest: float = -np.inf  # s, latest of all time stamps
    repeats: int = 0  # number of rows that were left out as repeats
    first: int = 0  # line of the first row that was left out

    def leave_out(self, rows: LogRows) -> LogRows:
        """Leave out rows that go back in time and repeat earlier ones with their time, at least several in a row."""
        before = np.maximum.accumulate(np.append(self.latest, rows.time))[:-1]
        parts = np.ascontiguousarray(
            np.column_stack([rows.time, rows.labels[:, LabelColumn.NAMES], rows.readings])
        ).view(np.uint64)
        odd = 2 * np.random.default_rng(0).integers(2**62, size=parts.shape[1], dtype=np.uint64) + np.uint64(1)
        prints = ((parts * odd).sum(1) >> np.uint64(32)).astype(np.uint32)
        repeated = np.zeros(len(rows.time), bool)
        if (rows.time < before).any():
            whole = np.concatenate([*self.prints, prints])
            _, firsts, which = np.unique(whole, return_index=True, return_inverse=True)
            again = (firsts[which] < np.arange(len(whole)))[-len(prints) :] & (rows.time <= before)
            edges = np.flatnonzero(np.diff(np.concatenate([[False], again, [False]])))
            for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                varied = np.diff(rows.readings[start:end], axis=0).any()
                repeated[start:end] = end - start >= 8 and rows.time[start] < before[start] and varied
        if repeated.any():
            self.first = self.first or int(rows.labels[repeated, LabelColumn.LINE][0])
            self.repeats += int(repeated.sum())
        self.latest = max(self.latest, float(rows.time.max()))
        self.prints = [*self.prints, prints][-(2**20 // ROWS_READ_AT_ONCE) :]  # about a million rows
        return rows.select(~repeated) if repeated.any() else rows


@dataclass
class _Stamps:
    """State of a log's clock after the settled rows."""

    last: float = np.nan  # s, time stamp of the last sound row
    names: float = np.nan  # number of the last sound row's names
    offset: float = 0.0  # s, offset that is added to time stamps after a counter restarted
    end: float = np.nan  # s, evenly spaced time of the last sound row
    sharing: int = 0  # number of rows that share the last sound row's time stamp
    rows: int = 0

    def counted(self, rows: LogRows, clock: RowClock) -> TimedRows:
        """Space rows evenly, ignoring their time stamps; each session may be another recording."""
        n = len(rows.time)
        time = clock.step * np.arange(self.rows, self.rows + n)
        codes = rows.labels[:, LabelColumn.NAMES]
        begins = np.diff(codes, prepend=codes[0] if np.isnan(self.names) else self.names) != 0
        self.rows, self.names = self.rows + n, float(codes[-1])
        labels = rows.labels.copy()
        labels[:, LabelColumn.STAMP] = np.nan
        return TimedRows(rows._replace(time=time, labels=labels), begins, clock.step)

    def judge(self, time: np.ndarray, *, last: bool) -> ClockVerdict:
        """Judge the next stamps."""
        if np.isnan(self.last):
            return check_stamps(time, last=last)
        verdict = check_stamps(np.concatenate([[self.last], time]), begun=True, last=last)
        settled = max(verdict.settled - 1, 0)
        return ClockVerdict(verdict.damaged[1:], verdict.restarts - 1, settled)

    def timed(self, rows: LogRows, verdict: ClockVerdict, clock: RowClock, notes: ReadingLog) -> TimedRows:
        """Put settled rows in the order of time, evenly spaced if they share a stamp."""
        parts: list[LogRows] = []
        begins: list[np.ndarray] = []
        for start, end in pairwise([0, *verdict.restarts.tolist(), len(rows.time)]):
            part = rows.select(slice(start, end)).select(~verdict.damaged[start:end])
            if not len(part.time):
                continue
            again = start in verdict.restarts and self._begin_again(part, clock, notes)
            stamps = part.time + self.offset
            shared = self.sharing if stamps[0] <= self.last + self.offset + clock.within and not again else 0
            time = even_times(stamps, clock, shared)
            before = time[0] if again or np.isnan(self.end) else self.end
            time = np.maximum(time, before) if not again else time
            pauses = np.diff(time, prepend=before) > pause_threshold(clock.step)
            pauses[0] |= again
            self.last, self.end, self.names = (
                float(part.time[-1]),
                float(time[-1]),
                float(part.labels[-1, LabelColumn.NAMES]),
            )
            apart = np.flatnonzero(np.diff(part.time) > clock.within)
            self.sharing = len(part.time) - (int(apart[-1]) + 1 if len(apart) else -shared)
            labels = part.labels.copy()
            labels[:, LabelColumn.STAMP] = time
            parts.append(part._replace(time=time, labels=labels))
            begins.append(pauses)
        whole = reduce(LogRows.append, parts) if parts else rows.select(slice(0, 0))
        return TimedRows(whole, np.concatenate(begins) if begins else np.zeros(0, bool), clock.step)

    def _begin_again(self, part: LogRows, clock: RowClock, notes: ReadingLog) -> bool:
        """Test whether a part begins with rows at which the clock goes back; otherwise the time is continued."""
        line, back = f"{part.labels[0, LabelColumn.LINE]:.0f}", self.last - float(part.time[0])
        other_session = part.labels[0, LabelColumn.NAMES] != self.names
        if counter := rollover_counter(self.last, float(part.time[0])):
            self.offset += COUNTER_PERIODS_S[counter]
            notes.change("time", f"time restarts at line {line}, where {counter} overflows: it was continued")
            return False
        if back <= CLOCK.pause_s and not other_session:
            self.offset += back + clock.step
            notes.change("time", f"time goes back by {back:.3g} s at line {line}: it was continued")
            return False
        self.offset = 0.0
        if not other_session:
            notes.doubt("time", f"time goes back by {back:.6g} s at line {line}, where the clock was set or restarted")
        return True


def _note_clock(clock: RowClock, time: np.ndarray, notes: ReadingLog) -> None:
    """Add a note if the stamps do not show everything."""
    steps = np.diff(time)
    shared = int(np.sum((steps >= 0) & (steps <= clock.within)))
    if clock.assumed:
        seen = f"in steps of {clock.resolution:g} s" if clock.resolution else "always the same"
        notes.doubt(
            "rate",
            f"assumed: {1 / clock.step:g} rows per second, as time is {seen} and does not show the rate (Unix time in "
            "float32 has steps of 128 s); give --rate-hz if the rate is known; the times of presses are unknown",
        )
    elif clock.by_rows and clock.resolution:
        notes.info(
            f"time has steps of {clock.resolution:g} s: rows are evenly spaced at {1 / clock.step:.4g} Hz, and the "
            "times of presses are unknown"
        )
    elif clock.within:
        notes.info(
            f"rows come in batches every {clock.resolution:.3g} s: they are evenly spaced at {1 / clock.step:.4g} Hz"
        )
    elif shared and not clock.by_rows:
        notes.info(
            f"{shared} of the first {len(time)} rows have the time of the row before, as the clock has steps of "
            f"{clock.resolution:.3g} s: such rows are evenly spaced at {1 / clock.step:.4g} Hz"
        )


def _with_last(pieces: Iterator[LogRows]) -> Iterator[tuple[LogRows, bool]]:
    """Yield pieces, and whether each is the last."""
    before = next(pieces, None)
    for piece in pieces:
        if before is not None:
            yield before, False
        before = piece
    if before is not None:
        yield before, True
