"""Logs of a skin: a row for every sample, at any rate and of any length; the presses in them become a table.

A log is a table with the columns time_s and the board's values (b0x_uT ...) and, where a stage or an arm was recorded
with them, x_mm, y_mm, depth_mm or z_mm, force_N, pad and session (`i2t.convert.presses` has their meanings). It is read
row by row, and `i2t.unknowns.segmentation` finds the presses meanwhile. At most the rows of the longest press are kept,
so memory does not grow with the log.

A press becomes one row: its steady reading less the rest before it, and the medians of the other columns over the same
rows; its time is that of its beginning. A height becomes a depth, which counts from the height at which the reading
left its rest. Where pad or session change, after a pause and where the clock begins again, the search begins anew,
unless the skin is pressed there and goes on to read the same. Rows in which a chip did not answer are no part of a
press, and end none. What the time stamps tell is for `i2t.convert.clocks`.
"""

import csv
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from itertools import compress, groupby, islice, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from i2t.convert import presses
from i2t.convert.clocks import (
    COUNTERS_S,
    PAUSE_ROWS,
    PAUSE_S,
    ClockVerdict,
    RowClock,
    even_times,
    judge_stamps,
    require_order,
    rolls_over,
    row_clock,
)
from i2t.convert.common import ConversionLog, Converted
from i2t.convert.presses import PLACES
from i2t.convert.tables import (
    HEIGHT_COLUMNS,
    TEXT_COLUMNS,
    TIME,
    TableRows,
    TextTable,
    field_columns,
    open_text_table,
    sound_rows,
)
from i2t.errors import DataError
from i2t.files import replacing
from i2t.progress import progress
from i2t.skin.boards import AXES_OF_CHIP, without_silent_chips
from i2t.types import Board
from i2t.unknowns.segmentation import (
    MIN_NOISE_UT,
    MIN_ROWS,
    FoundPress,
    OpenRecording,
    find_last,
    find_more,
    open_recording,
    segmentation_rules,
    true_presses,
)
from i2t.windows import PATCH_WINDOW, REACH

ROWS_READ_AT_ONCE = 8192  # 20 s at 400 Hz; rate and noise are found from the first of them
SILENCE_S = 10.0  # in which no row has all chips: afterwards the skin may rest elsewhere
HEAD_ROWS, LEVEL_ROWS = 20, 3  # at the beginning of a part, at rest; and of which a level is the mean
GOES_ON, IS_PRESSED = 4.0, 8.0  # standard deviations between rows: up to the one two levels are the same, beyond the
# other a level is none of rest
PRESS_DECIMALS = 6  # of the table's numbers


class _Columns(NamedTuple):
    """The columns of a log that are read."""

    names: list[str]  # pad and session, as far as it has them
    values: list[str]  # of the board
    labels: list[str]  # what else a press takes over
    notes: list[str]  # on the others


class _Rows(NamedTuple):
    """Rows in the order of the log."""

    names: list[tuple[str, ...]]
    time: np.ndarray  # (n,) s
    readings: np.ndarray  # (n, c) uT; NaN of a chip that did not answer
    labels: np.ndarray  # (n, 2 + e): line in the file, time stamp (s; NaN where stamps say nothing), and the labels

    def pick(self, which: slice | np.ndarray) -> "_Rows":
        """Some of the rows, by a slice or a mask."""
        names = self.names[which] if isinstance(which, slice) else list(compress(self.names, which))
        return _Rows(names, self.time[which], self.readings[which], self.labels[which])

    def then(self, more: "_Rows") -> "_Rows":
        """These rows and further ones."""
        arrays = (np.concatenate(both) for both in zip(self[1:], more[1:], strict=True))
        return _Rows(self.names + more.names, *arrays)

    @property
    def heard(self) -> np.ndarray:
        """Rows in which every chip answered."""
        return ~np.isnan(self.readings).any(1)


@dataclass
class _Search:
    """Presses of rows that belong together: of one pad and session, without a pause."""

    names: tuple[str, ...]
    origin: float  # s, of the clock, from which the time of its rows counts
    early: list[_Rows] = field(default_factory=list)  # before rate and noise are known
    recording: OpenRecording | None = None
    found: list[FoundPress] = field(default_factory=list)
    rows: int = 0
    end: float = 0.0  # s, of the last row
    head: np.ndarray | None = None  # first readings, at rest
    tail: np.ndarray | None = None  # last readings

    def take(self, rows: _Rows, step: float) -> None:
        """Look for presses in further rows, of a clock with this step (s), leaving out those of silent chips."""
        self.end = float(rows.time[-1]) - self.origin
        rows = rows.pick(rows.heard)
        if not len(rows.time):
            return
        order = 1e-6 * step * np.arange(self.rows, self.rows + len(rows.time))  # of rows that share a time
        rows = rows._replace(time=rows.time - self.origin + order)
        self.rows += len(rows.time)
        self.head = rows.readings[:HEAD_ROWS].copy() if self.head is None else self.head
        self.tail = rows.readings[-HEAD_ROWS:].copy()
        if self.recording is not None:
            self.recording, more = find_more(self.recording, rows.time, rows.readings, rows.labels)
            self.found += more
            return
        self.early.append(rows)
        if self.rows >= ROWS_READ_AT_ONCE:
            self._begin()

    def goes_on_pressed(self, readings: np.ndarray) -> bool:
        """Test whether the skin was pressed last, and these readings go on from there."""
        if self.head is None or self.tail is None or not len(readings) or self.rows < MIN_ROWS:
            return False
        last, following = self.tail[-LEVEL_ROWS:].mean(0), readings[:LEVEL_ROWS].mean(0)

        def distance(difference: np.ndarray, rows: np.ndarray) -> float:
            between_rows = np.diff(rows, axis=0).std(0) if len(rows) > 1 else np.zeros(rows.shape[1])
            return float((np.abs(difference) / np.maximum(between_rows, MIN_NOISE_UT)).max())

        pressed = distance(last - np.median(self.head, axis=0), self.head) > IS_PRESSED
        return pressed and distance(following - last, np.vstack([self.tail, self.head])) < GOES_ON

    def presses(self) -> list[FoundPress]:
        """All presses, after the last row; none where there were too few rows."""
        if self.recording is None and self.rows < MIN_ROWS:
            return []
        recording = self.recording or self._begin()
        return true_presses([*self.found, *find_last(recording)], recording.rules)

    def _begin(self) -> OpenRecording:
        """Find rate and noise in the first rows, and their presses."""
        time, readings, labels = (np.concatenate([part[i] for part in self.early]) for i in (1, 2, 3))
        empty = open_recording(segmentation_rules(time, readings), labels.shape[1])
        self.recording, self.found = find_more(empty, time, readings, labels)
        self.early = []
        return self.recording


def convert(
    source: Path,
    *,
    indenter: str,
    board: Board,
    window: float = PATCH_WINDOW,
    reach: float = REACH,
    unit: str | None = None,
    as_stated: bool = False,
    skip_bad: bool = False,
    rate: float | None = None,
    stated_source: str | None = None,
) -> Converted:
    """Convert a log of presses of one indenter.

    Args:
        source: the log, plain or gzip-ed.
        indenter: as of `i2t.convert.presses.convert`, like all that follow.
        board: which the values are of.
        window: m.
        reach: m.
        unit: of a mesh file.
        as_stated: look for no mistake and correct none.
        skip_bad: leave out damaged rows, and note how many.
        rate: of the rows (Hz), where no time stamps tell it.
        stated_source: "real" or "simulated", where the log does not say it.

    Returns:
        The data set, a touch for each press, and what was assumed and left out.

    Raises:
        DataError: the log or the indenter cannot be used, or nothing presses.
    """
    table = table_of_presses(source, board=board, skip_bad=skip_bad, rate=rate)
    missing = [name for name in ("x_mm", "y_mm") if name not in table.header]
    if missing:
        raise DataError(
            f"{source}: column {' and '.join(missing)} is missing, so where it was pressed is not known; end DST in "
            ".csv, complete that table of presses, and convert it with the sub-command presses"
        )
    dataset, notes = presses.convert(
        source, indenter=indenter, board=board, window=window, reach=reach, unit=unit, as_stated=as_stated,
        skip_bad=skip_bad, table=table, stated_source=stated_source,
    )  # fmt: skip
    return Converted(replace(dataset, meta={**dataset.meta, "converter": "stream"}), notes)


def write_presses(target: Path, table: TextTable) -> Path:
    """Write presses as the table that `i2t.convert.presses` reads.

    Args:
        target: of the table.
        table: the presses.

    Returns:
        The file.

    Raises:
        DataError: it cannot be written.
    """
    with replacing(target) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(table.header)
        rows.writerows(cells for _, cells in table.rows)
    return target


def table_of_presses(source: Path, *, board: Board, skip_bad: bool = False, rate: float | None = None) -> TextTable:
    """The presses of a log, in the columns that `i2t.convert.presses` reads.

    Args:
        source: the log, plain or gzip-ed.
        board: which the values are of.
        skip_bad: leave out damaged rows, and note how many.
        rate: of the rows (Hz), where no time stamps tell it.

    Returns:
        A row for each press, with the line of the log where it begins, and what was assumed and left out.

    Raises:
        DataError: it is no log of this board, a row is damaged, or nothing presses in it.
    """
    table = open_text_table(source)
    columns = _columns(source, table, board.num_chips, timed=rate is None)
    notes = ConversionLog(skip_bad, [*table.notes, *columns.notes])
    found: list[tuple[tuple[str, ...], FoundPress]] = []
    rows = parts = 0
    for search in _searches(_rows(source, table, columns, notes), f"{source}: its time", notes, rate):
        found += [(search.names, press) for press in search.presses()]
        rows, parts = rows + search.rows, parts + 1
    for note in table.notes:  # the last of which came with the last row
        notes.info(note)
    notes.require_heard(source)
    if notes.damaged_rows and not rows:
        raise DataError(f"{source}: all of its {notes.damaged_rows} rows are damaged; the first: {notes.first_damage}")
    if not found:
        raise DataError(f"{source}: nothing presses in its {rows} rows; give a log that begins at rest and has presses")
    pieces = (
        f" of {parts} parts, between which it paused, its clock was set, or another session began" if parts > 1 else ""
    )
    notes.info(f"found: {len(found)} presses in {rows} rows{pieces}")
    height = next((name for name in columns.labels if name in HEIGHT_COLUMNS), None)
    if height is not None:
        notes.info(
            f"assumed: {height} grows out of the skin, and depth counts from the height at which a press's reading "
            "left its rest"
        )
    labels = ["depth_mm" if name == height else name for name in columns.labels]
    header = [*columns.names, TIME, *labels, *columns.values]
    return TextTable(header, [_press_row(names, press, columns, height) for names, press in found], notes.sentences())


def _press_row(
    names: tuple[str, ...], press: FoundPress, columns: _Columns, height: str | None
) -> tuple[int, list[str]]:
    """A press's line in the log, and its fields."""
    steady = press.steady[2:].copy()
    if height is not None:
        at = columns.labels.index(height)
        steady[at] = press.at_start[2 + at] - steady[at]
    numbers = [press.at_start[1], *steady.tolist(), *press.reading.tolist()]
    return int(press.at_start[0]), [*names, *("" if np.isnan(x) else f"{x:.{PRESS_DECIMALS}f}" for x in numbers)]


def _columns(source: Path, table: TableRows, chips: int, *, timed: bool) -> _Columns:
    """Columns of a log; a table without time or without the values of the board is refused."""
    header = table.header
    remedy = f"so this is no log of a board of {chips} chips: name columns as in docs/data.md"
    if timed and TIME not in header:
        remedy = "name the column of time by its unit (time_s, time_ms, time_us), or give --rate-hz where there is none"
    values = field_columns(source, header, chips, [TIME] if timed else [], remedy)
    labels = [name for name in (*PLACES, "force_N") if name in header]
    if "depth_mm" not in header:
        labels += [name for name in HEIGHT_COLUMNS if name in header][:1]
    names = [name for name in TEXT_COLUMNS if name in header]
    unread = [name for name in header if name not in {TIME, *values, *labels, *names}]
    notes = [f"left out: columns {', '.join(unread)}, which are not read in a log"] if unread else []
    return _Columns(names, values, labels, notes)


def _rows(source: Path, table: TableRows, columns: _Columns, notes: ConversionLog) -> Iterator[_Rows]:
    """The rows of a log, some at a time; those in which a chip did not answer are counted."""
    timed = [TIME] if TIME in table.header else []
    wanted = [*timed, *columns.values, *columns.labels]
    first, end = len(timed), len(timed) + len(columns.values)
    with progress(desc=source.name, unit="row", unit_scale=True) as bar:
        while some := list(islice(table.rows, ROWS_READ_AT_ONCE)):
            bar.update(len(some))
            rows, numbers = sound_rows(source, table.header, some, wanted, partial(_needed, timed=first), notes)
            if not rows:
                continue
            readings = without_silent_chips(numbers[:, first:end])
            notes.keep_heard(np.isnan(readings).reshape(len(rows), -1, AXES_OF_CHIP).any(2))
            names = [tuple(cells[table.header.index(name)].strip() for name in columns.names) for _, cells in rows]
            time = numbers[:, 0] if timed else np.zeros(len(rows))
            labels = np.column_stack([np.array([line for line, _ in rows], float), time, numbers[:, end:]])
            yield _Rows(names, time, readings, labels)


def _needed(empty: np.ndarray, *, timed: int) -> np.ndarray:
    """Fields that may not be empty: the time, which comes first where there is one."""
    return np.tile(np.arange(empty.shape[1]) < timed, (len(empty), 1))


def _searches(chunks: Iterator[_Rows], name: str, notes: ConversionLog, rate: float | None) -> Iterator[_Search]:
    """A search for each part of a log that belongs together, after its last row."""
    pieces = (piece for chunk in chunks for piece in _of_one_name(chunk))
    for names, same in groupby(pieces, key=lambda rows: rows.names[0]):
        yield from _parts(names, _on_one_clock(same, name, notes, rate))


def _parts(names: tuple[str, ...], pieces: "Iterator[_Timed]") -> Iterator[_Search]:
    """Searches of rows of one pad and session, of which each begins after a pause or where the clock begins again."""
    search: _Search | None = None
    last_heard = np.nan  # s
    for piece in pieces:
        rows, heard = piece.rows, piece.rows.heard
        heard_at = np.fmax.accumulate(np.concatenate([[last_heard], np.where(heard, rows.time, np.nan)]))
        silences = np.flatnonzero(heard & (rows.time - heard_at[:-1] > SILENCE_S))
        begins = {*np.flatnonzero(piece.begins).tolist(), *silences.tolist()}
        for start, end in pairwise(sorted({0, *begins, len(rows.time)})):
            part = rows.pick(slice(start, end))
            if start in begins and search is not None:
                if search.goes_on_pressed(part.readings[part.heard]):
                    search.origin = float(part.time[0]) - search.end - piece.step
                else:
                    yield search
                    search = None
            search = search or _Search(names, origin=float(part.time[0]))
            search.take(part, piece.step)
        last_heard = float(heard_at[-1])
    if search is not None:
        yield search


class _Timed(NamedTuple):
    """Rows whose stamps are sound."""

    rows: _Rows  # their time does not go back but where a part begins
    begins: np.ndarray  # (n,) rows before which there was a pause, or at which the clock begins again
    step: float  # s, between rows


def _on_one_clock(pieces: Iterator[_Rows], name: str, notes: ConversionLog, rate: float | None) -> Iterator[_Timed]:
    """Rows without those whose stamp is damaged, in even time where the clock is coarse."""
    clock: RowClock | None = None
    held: _Rows | None = None
    stamps = _Stamps()
    for piece, last in _with_last(pieces):
        held = piece if held is None else held.then(piece)
        if clock is None and len(held.time) < ROWS_READ_AT_ONCE and not last:
            continue
        if clock is None:
            clock = row_clock(held.time, name, rate=rate)
            _say_clock(clock, held.time, notes)
        if clock.by_rows:
            yield stamps.counted(held, clock)
            held = None
            continue
        require_order(held.time, name)
        verdict = stamps.judge(held.time, last=last)
        for line, stamp in held.labels[: verdict.settled][verdict.damaged, :2]:
            notes.skip_row(
                DataError(
                    f"{name} at line {line:.0f}, {stamp:.6f} s, contradicts the rows before and after it; correct it"
                )
            )
        if verdict.settled:
            yield stamps.timed(held.pick(slice(0, verdict.settled)), verdict, clock, notes)
        held = held.pick(slice(verdict.settled, None))


@dataclass
class _Stamps:
    """A log's clock up to the rows that were settled."""

    last: float = np.nan  # s, stamp of the last sound row
    offset: float = 0.0  # s, added to stamps after a counter began again
    end: float = np.nan  # s, even time of the last sound row
    sharing: int = 0  # rows that have its stamp
    rows: int = 0

    def counted(self, rows: _Rows, clock: RowClock) -> _Timed:
        """Rows that are evenly spaced, whatever their stamps."""
        n = len(rows.time)
        time = clock.step * np.arange(self.rows, self.rows + n)
        self.rows += n
        labels = np.column_stack([rows.labels[:, :1], np.full(n, np.nan), rows.labels[:, 2:]])
        return _Timed(rows._replace(time=time, labels=labels), np.zeros(n, bool), clock.step)

    def judge(self, time: np.ndarray, *, last: bool) -> ClockVerdict:
        """The verdict on stamps that follow."""
        if np.isnan(self.last):
            return judge_stamps(time, last=last)
        verdict = judge_stamps(np.concatenate([[self.last], time]), begun=True, last=last)
        settled = max(verdict.settled - 1, 0)
        return ClockVerdict(verdict.damaged[1:], verdict.restarts - 1, settled)

    def timed(self, rows: _Rows, verdict: ClockVerdict, clock: RowClock, notes: ConversionLog) -> _Timed:
        """Settled rows in the order of time, evenly spaced where they share a stamp."""
        parts: list[_Rows] = []
        begins: list[np.ndarray] = []
        for start, end in pairwise([0, *verdict.restarts.tolist(), len(rows.time)]):
            part = rows.pick(slice(start, end)).pick(~verdict.damaged[start:end])
            if not len(part.time):
                continue
            again = start in verdict.restarts and self._begin_again(part, clock, notes)
            stamps = part.time + self.offset
            shared = self.sharing if stamps[0] == self.last + self.offset and not again else 0
            time = even_times(stamps, clock, shared)
            before = time[0] if again or np.isnan(self.end) else self.end
            time = np.maximum(time, before) if not again else time
            pauses = np.diff(time, prepend=before) > max(PAUSE_S, PAUSE_ROWS * clock.step)
            pauses[0] |= again
            self.last, self.end = float(part.time[-1]), float(time[-1])
            same = int(np.sum(part.time == part.time[-1]))
            self.sharing = same + (shared if same == len(part.time) else 0)
            labels = np.column_stack([part.labels[:, :1], stamps, part.labels[:, 2:]])
            parts.append(part._replace(time=time, labels=labels))
            begins.append(pauses)
        whole = reduce(_Rows.then, parts) if parts else rows.pick(slice(0, 0))
        return _Timed(whole, np.concatenate(begins) if begins else np.zeros(0, bool), clock.step)

    def _begin_again(self, part: _Rows, clock: RowClock, notes: ConversionLog) -> bool:
        """Whether a part begins with rows at which the clock goes back; otherwise it is counted on."""
        line, back = f"{part.labels[0, 0]:.0f}", self.last - float(part.time[0])
        if counter := rolls_over(self.last, float(part.time[0])):
            self.offset += COUNTERS_S[counter]
            notes.info(f"time begins again at line {line}, where {counter} is full: it was counted on")
            return False
        if back <= PAUSE_S:
            self.offset += back + clock.step
            notes.info(f"time goes back by {back:.3g} s at line {line}: it was taken as running on")
            return False
        self.offset = 0.0
        notes.info(f"time goes back by {back:.6g} s at line {line}, where the clock was set or began again")
        return True


def _say_clock(clock: RowClock, time: np.ndarray, notes: ConversionLog) -> None:
    """Note what the stamps tell, where they do not tell all."""
    shared = int(np.sum(np.diff(time) == 0))
    if clock.assumed:
        seen = f"in steps of {clock.resolution:g} s" if clock.resolution else "always the same"
        notes.info(
            f"assumed: {1 / clock.step:g} rows in a second, as time is {seen} and does not tell (Unix time in float32 "
            "has steps of 128 s); give --rate-hz where it is known; the times of presses are unknown"
        )
    elif clock.by_rows and clock.resolution:
        notes.info(
            f"time has steps of {clock.resolution:g} s: rows are evenly spaced at {1 / clock.step:.4g} Hz, and the "
            "times of presses are unknown"
        )
    elif shared and not clock.by_rows:
        notes.info(
            f"{shared} of the first {len(time)} rows have the time of the row before, as the clock has steps of "
            f"{clock.resolution:.3g} s: such rows are evenly spaced at {1 / clock.step:.4g} Hz"
        )


def _with_last(pieces: Iterator[_Rows]) -> Iterator[tuple[_Rows, bool]]:
    """Pieces, and whether each is the last."""
    before = next(pieces, None)
    for piece in pieces:
        if before is not None:
            yield before, False
        before = piece
    if before is not None:
        yield before, True


def _of_one_name(rows: _Rows) -> Iterator[_Rows]:
    """Rows up to where pad or session change."""
    ends = [i for i, (one, other) in enumerate(pairwise(rows.names), 1) if one != other]
    for start, end in pairwise([0, *ends, len(rows.names)]):
        if start < end:
            yield rows.pick(slice(start, end))
