"""Logs of a skin: a row for every sample, at any rate and of any length; the presses in them become a table.

A log is a table with the columns time_s and the board's values (b0x_uT ...) and, where a stage or an arm was recorded
with them, x_mm, y_mm, depth_mm or z_mm, force_N, pad and session (`i2t.convert.presses` has their meanings). It is read
row by row, and `i2t.unknowns.segmentation` finds the presses meanwhile. At most the rows of the longest press are kept,
so memory does not grow with the log.

A press becomes one row: its steady reading less the rest before it, and the medians of the other columns over the same
rows; its time is that of its beginning. A height becomes a depth, which counts from the height at which the reading
left its rest. Where pad or session change, and after a pause, the search begins anew.
"""

import csv
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from i2t.convert import presses
from i2t.convert.common import ConversionLog, Converted
from i2t.convert.presses import PLACES
from i2t.convert.tables import (
    HEIGHT_COLUMNS,
    NAME_COLUMNS,
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
from i2t.types import Board
from i2t.unknowns.segmentation import (
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
PAUSE_S = 1.0  # between two rows: afterwards the skin may rest elsewhere
PAUSE_ROWS = 20  # where rows are so far apart that a second is none
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
    readings: np.ndarray  # (n, c) uT
    labels: np.ndarray  # (n, 1 + e): line in the file, and the labels

    def part(self, start: int, end: int) -> "_Rows":
        """Some of the rows, one after the other."""
        some = slice(start, end)
        return _Rows(self.names[some], self.time[some], self.readings[some], self.labels[some])


@dataclass
class _Search:
    """Presses of rows that belong together: of one pad and session, without a pause."""

    names: tuple[str, ...]
    early: list[_Rows] = field(default_factory=list)  # before rate and noise are known
    recording: OpenRecording | None = None
    found: list[FoundPress] = field(default_factory=list)
    rows: int = 0

    def take(self, rows: _Rows) -> None:
        """Look for presses in further rows."""
        self.rows += len(rows.time)
        if self.recording is not None:
            self.recording, more = find_more(self.recording, rows.time, rows.readings, rows.labels)
            self.found += more
            return
        self.early.append(rows)
        if self.rows >= ROWS_READ_AT_ONCE:
            self._begin()

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

    Returns:
        The data set, a touch for each press, and what was assumed and left out.

    Raises:
        DataError: the log or the indenter cannot be used, or nothing presses.
    """
    table = table_of_presses(source, board=board, skip_bad=skip_bad)
    missing = [name for name in ("x_mm", "y_mm") if name not in table.header]
    if missing:
        raise DataError(
            f"{source}: column {' and '.join(missing)} is missing, so where it was pressed is not known; end DST in "
            ".csv, complete that table of presses, and convert it with the sub-command presses"
        )
    dataset, notes = presses.convert(
        source, indenter=indenter, board=board, window=window, reach=reach, unit=unit, as_stated=as_stated,
        skip_bad=skip_bad, table=table,
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


def table_of_presses(source: Path, *, board: Board, skip_bad: bool = False) -> TextTable:
    """The presses of a log, in the columns that `i2t.convert.presses` reads.

    Args:
        source: the log, plain or gzip-ed.
        board: which the values are of.
        skip_bad: leave out damaged rows, and note how many.

    Returns:
        A row for each press, with the line of the log where it begins, and what was assumed and left out.

    Raises:
        DataError: it is no log of this board, a row is damaged, or nothing presses in it.
    """
    table = open_text_table(source)
    columns = _columns(source, table, board.num_chips)
    notes = ConversionLog(skip_bad, [*table.notes, *columns.notes])
    found: list[tuple[tuple[str, ...], FoundPress]] = []
    rows = parts = 0
    for search in _searches(_rows(source, table, columns, notes), source, notes):
        found += [(search.names, press) for press in search.presses()]
        rows, parts = rows + search.rows, parts + 1
    if not found:
        raise DataError(f"{source}: nothing presses in its {rows} rows; give a log that begins at rest and has presses")
    pieces = f" of {parts} parts, between which it paused or another session began" if parts > 1 else ""
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
    steady = press.steady[1:].copy()
    if height is not None:
        at = columns.labels.index(height)
        steady[at] = press.at_start[1 + at] - steady[at]
    numbers = [press.start_time, *steady.tolist(), *press.reading.tolist()]
    return int(press.at_start[0]), [*names, *("" if np.isnan(x) else f"{x:.{PRESS_DECIMALS}f}" for x in numbers)]


def _columns(source: Path, table: TableRows, chips: int) -> _Columns:
    """Columns of a log; a table without time or without the values of the board is refused."""
    header = table.header
    remedy = f"so this is no log of a board of {chips} chips: name columns as in docs/data.md"
    values = field_columns(source, header, chips, [TIME], remedy)
    labels = [name for name in (*PLACES, "force_N") if name in header]
    if "depth_mm" not in header:
        labels += [name for name in HEIGHT_COLUMNS if name in header][:1]
    names = [name for name in NAME_COLUMNS if name in header]
    unread = [name for name in header if name not in {TIME, *values, *labels, *names}]
    notes = [f"left out: columns {', '.join(unread)}, which are not read in a log"] if unread else []
    return _Columns(names, values, labels, notes)


def _rows(source: Path, table: TableRows, columns: _Columns, notes: ConversionLog) -> Iterator[_Rows]:
    """The rows of a log in which every chip answered, some at a time."""
    wanted = [TIME, *columns.values, *columns.labels]
    end = 1 + len(columns.values)
    with progress(desc=source.name, unit="row", unit_scale=True) as bar:
        while some := list(islice(table.rows, ROWS_READ_AT_ONCE)):
            bar.update(len(some))
            rows, numbers = sound_rows(source, table.header, some, wanted, _needed, notes)
            heard = ~np.isnan(numbers[:, 1:end]).any(1)
            rows, numbers = [row for row, kept in zip(rows, heard, strict=True) if kept], numbers[heard]
            names = [tuple(cells[table.header.index(name)].strip() for name in columns.names) for _, cells in rows]
            lines = np.array([line for line, _ in rows], float)
            labels = np.column_stack([lines, numbers[:, end:]])
            notes.silent_rows += int((~heard).sum())
            yield _Rows(names, numbers[:, 0], numbers[:, 1:end], labels)


def _needed(empty: np.ndarray) -> np.ndarray:
    """Fields that may not be empty: the time, which comes first."""
    return np.arange(empty.shape[1]) < np.ones((len(empty), 1))


def _searches(chunks: Iterator[_Rows], source: Path, notes: ConversionLog) -> Iterator[_Search]:
    """A search for each part of a log that belongs together, after its last row."""
    search: _Search | None = None
    last = np.nan  # s, of the row before
    for chunk in chunks:
        for named in _of_one_name(chunk):
            if search is None or named.names[0] != search.names:
                if search is not None:
                    yield search
                search, last = _Search(named.names[0]), np.nan
            rows = _in_order(source, named, last, notes)
            if not len(rows.time):
                continue
            steps = np.diff(rows.time, prepend=rows.time[0] if np.isnan(last) else last)
            pauses = np.flatnonzero(steps > max(PAUSE_S, PAUSE_ROWS * float(np.median(steps))))
            for start, end in pairwise([0, *pauses.tolist(), len(steps)]):
                if start in pauses:
                    yield search
                    search = _Search(search.names)
                search.take(rows.part(start, end))
            last = float(rows.time[-1])
    if search is not None:
        yield search


def _of_one_name(rows: _Rows) -> Iterator[_Rows]:
    """Rows up to where pad or session change."""
    ends = [i for i, (one, other) in enumerate(pairwise(rows.names), 1) if one != other]
    for start, end in pairwise([0, *ends, len(rows.names)]):
        if start < end:
            yield rows.part(start, end)


def _in_order(source: Path, rows: _Rows, last: float, notes: ConversionLog) -> _Rows:
    """Rows whose time is later than that of all rows before them."""
    latest = np.fmax.accumulate(np.concatenate([[last], rows.time[:-1]]))
    late = rows.time <= latest  # not where there is no row before
    for k in np.flatnonzero(late):
        notes.skip_row(
            DataError(
                f"{source}: at line {rows.labels[k, 0]:.0f} time does not increase; sort the rows, or name "
                "the sessions in a column session"
            )
        )
    if not late.any():
        return rows
    names = [name for name, drop in zip(rows.names, late, strict=True) if not drop]
    return _Rows(names, rows.time[~late], rows.readings[~late], rows.labels[~late])
