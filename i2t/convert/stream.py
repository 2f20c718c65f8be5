"""Logs of a skin: a row for every sample, at any rate and of any length. The presses in them become a table.

A log is a table with the columns time_s and the board's values (b0x_uT ...) and, if a stage or an arm was recorded with
them, x_mm, y_mm, travel_mm or z_mm, force_N, pad and session (`i2t.convert.presses` defines them). It is read row by
row, and `i2t.recordings.segmentation` finds the presses meanwhile. At most the rows of the longest press are kept, so
that memory does not grow with the log.

A press becomes one row: its steady reading minus the rest before it, and the medians of the other columns over the same
rows; its time is that of its beginning. A height becomes travel, which counts from the height at which the reading
left its rest. The search begins anew if the pad changes, after a pause and if the clock begins again, unless the skin
is pressed there and continues to read the same. A press belongs to the session of its steady rows. Rows in which a chip
did not answer are not part of a press, and end a press only if they hide it for longer than a pause. Rows that repeat
earlier ones after a step back are left out. `i2t.recordings.clocks` judges the time stamps.
"""

import csv
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from i2t.convert import log_rows, presses
from i2t.convert.common import Converted
from i2t.convert.log_rows import LabelColumn, LogRows, TimedRows, on_one_clock
from i2t.errors import DataError
from i2t.files.writing import replacing
from i2t.patches.dimensions import PATCH_WINDOW, REACH
from i2t.recordings.clocks import pause_threshold
from i2t.recordings.columns import (
    FORCE_COLUMN,
    HEIGHT_COLUMNS,
    PLACE_COLUMNS,
    TEXT_COLUMNS,
    TIME_COLUMN,
    field_columns,
    notes_on_depth,
)
from i2t.recordings.log import ReadingLog
from i2t.recordings.segmentation import (
    OpenRecording,
    SegmentationConfig,
    SegmentedPress,
    extend_recording,
    filter_presses,
    finish_recording,
    open_recording,
    segmentation_rules,
)
from i2t.recordings.tables import TableRows, TextTable, open_text_table, valid_rows
from i2t.runtime.progress import progress
from i2t.skin.boards import AXES_OF_CHIP, without_silent_chips
from i2t.types import Board


@dataclass(frozen=True)
class PartRules:
    """Thresholds that decide whether a press at the beginning or end of a part of a log was recorded whole, in rows,
    standard deviations between rows, mm or N, and fractions.
    """

    head_rows: int = 20  # number of rows at rest at the beginning of a part
    level_rows: int = 3  # number of rows whose mean is a level
    # Deviations in units of the standard deviation between rows.
    max_same_level: float = 4.0  # largest difference of two levels that count as the same
    min_pressed: float = 8.0  # smallest difference of a level from rest that counts as pressed
    max_label_change: float = 0.2  # mm or N, largest change of place and strength within a press that continues
    max_gap_rows: float = 3.0  # largest gap, in steps of rows, at which the beginning of a press counts as recorded
    # smallest fraction of steady rows in a press at the end of a part; a ramp has fewer
    min_steady_fraction: float = 1 / 6
    max_unseen_travel: float = 0.05  # largest motion of the tip in a gap before a press, as a fraction of the travel


_PART_RULES = PartRules()  # rules by which a press at an end of a part of a log counts as recorded whole


class _Columns(NamedTuple):
    """Columns of a log that are read."""

    names: list[str]  # names of the columns pad and session, as far as they are present
    values: list[str]  # columns of the board's values
    labels: list[str]  # other columns that a press takes over
    notes: list[str]  # notes on the remaining columns


@dataclass
class _Search:
    """Search for presses in rows that belong together: of one pad, without a pause."""

    origin: float  # s, time on the clock from which the rows' time counts
    early: list[LogRows] = field(default_factory=list)  # rows that came before rate and noise were known
    recording: OpenRecording | None = None
    presses: list[SegmentedPress] = field(default_factory=list)
    rows: int = 0
    end: float = 0.0  # s, time of the last row
    head: np.ndarray | None = None  # first readings of the part, at rest
    tail: LogRows | None = None  # last rows of the part
    earlier: np.ndarray | None = None  # (c,) uT, reading at rest in the previous search

    def take(self, rows: LogRows, step: float) -> None:
        """Search presses in further rows of a clock with this step (s), without those of silent chips."""
        self.end = float(rows.time[-1]) - self.origin
        rows = rows.select(rows.complete)
        if not len(rows.time):
            return
        order = 1e-6 * step * np.arange(self.rows, self.rows + len(rows.time))  # of rows that share a time
        rows = rows._replace(time=rows.time - self.origin + order)
        self.rows += len(rows.time)
        self.head = rows.readings[: _PART_RULES.head_rows].copy() if self.head is None else self.head
        self.tail = rows.select(slice(-_PART_RULES.head_rows, None))
        if self.recording is not None:
            self.recording, more = extend_recording(self.recording, rows.time, rows.readings, rows.labels)
            self.presses += more
            return
        self.early.append(rows)
        if self.rows >= log_rows.ROWS_READ_AT_ONCE:
            self._begin()

    def continues_press(self, rows: LogRows) -> bool:
        """Test whether the skin was pressed at the end, and these rows continue the press."""
        if self.head is None or self.tail is None or not len(rows.time) or self.rows < SegmentationConfig().min_rows:
            return False
        tail = self.tail.readings
        last, following = tail[-_PART_RULES.level_rows :].mean(0), rows.readings[: _PART_RULES.level_rows].mean(0)

        def distance(difference: np.ndarray, rows: np.ndarray) -> float:
            between_rows = np.diff(rows, axis=0).std(0) if len(rows) > 1 else np.zeros(rows.shape[1])
            return float((np.abs(difference) / np.maximum(between_rows, SegmentationConfig().min_noise_ut)).max())

        pressed = distance(last - np.median(self.head, axis=0), self.head) > _PART_RULES.min_pressed
        elsewhere = (
            np.abs(rows.labels[0, LabelColumn.FIRST_VALUE :] - self.tail.labels[-1, LabelColumn.FIRST_VALUE :])
            > _PART_RULES.max_label_change
        )
        return (
            pressed
            and not elsewhere.any()
            and distance(following - last, np.vstack([tail, self.head])) < _PART_RULES.max_same_level
        )

    def finish(self) -> None:
        """End the search: find the last presses, if there were enough rows."""
        if self.recording is None and self.rows < SegmentationConfig().min_rows:
            return
        self.recording, more = finish_recording(self.recording or self._begin())
        self.presses = filter_presses([*self.presses, *more], self.recording.rules)

    @property
    def rest(self) -> np.ndarray | None:
        """Reading (c,) of the skin at rest (uT) after the last row."""
        state = self.recording
        if state is None:
            return self.earlier
        return state.baseline if state.sure or state.earlier is None else state.earlier

    def _begin(self) -> OpenRecording:
        """Estimate rate and noise from the first rows, and find their presses."""
        time, readings, labels = (np.concatenate([part[i] for part in self.early]) for i in range(3))
        empty = open_recording(segmentation_rules(time, readings), labels.shape[1], self.earlier)
        self.recording, self.presses = extend_recording(empty, time, readings, labels)
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
    """Find the presses of one indenter in a log of sensor samples and convert them to a data set.

    Args:
        source: File of the log, plain or gzip-ed.
        indenter: `sphere:RADIUS` or `cylinder:RADIUS` with the radius in mm, or `mesh:FILE` in `unit`.
        board: Board that sent the values.
        window: Edge (m) of the square that a patch shows; presses whose tip it does not show are left out.
        reach: Depth (m) behind the indenter's lowest point to which patches are clipped.
        unit: Unit of a mesh file: m, cm, mm or inch.
        as_stated: Whether to skip the search for and correction of mistakes in units, signs and axes.
        skip_bad: Whether to leave out damaged rows, with a note on their number.
        rate: Rate (Hz) of the rows, if no time stamps show it.
        stated_source: "real" or "simulated", if the log does not state it.

    Returns:
        The data set, with one touch for each press, and notes on assumptions and omissions.

    Raises:
        DataError: If the log or the indenter cannot be used, or the log holds no press.
    """
    table = table_of_presses(source, board=board, skip_bad=skip_bad, rate=rate)
    missing = [name for name in ("x_mm", "y_mm") if name not in table.header]
    if missing:
        raise DataError(
            f"{source}: column {' and '.join(missing)} is missing, so the positions of presses are unknown; end DST in "
            ".csv, complete that table of presses, and convert it with the sub-command presses"
        )
    converted = presses.convert(
        source, indenter=indenter, board=board, window=window, reach=reach, unit=unit, as_stated=as_stated,
        skip_bad=skip_bad, table=table, stated_source=stated_source,
    )  # fmt: skip
    dataset = converted.dataset
    return converted._replace(dataset=replace(dataset, meta={**dataset.meta, "converter": "stream"}))


def write_presses(target: Path, table: TextTable) -> Path:
    """Write presses as a table (.csv) that `i2t.convert.presses` reads.

    Args:
        target: File of the table.
        table: The presses.

    Returns:
        The path of the file.

    Raises:
        DataError: If the file cannot be written.
    """
    with replacing(target) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(table.header)
        rows.writerows(cells for _, cells in table.rows)
    return target


def table_of_presses(source: Path, *, board: Board, skip_bad: bool = False, rate: float | None = None) -> TextTable:
    """Find the presses in a log of sensor samples and make the table of them that `i2t.convert.presses` reads.

    Args:
        source: File of the log, plain or gzip-ed.
        board: Board that sent the values.
        skip_bad: Whether to leave out damaged rows, with a note on their number.
        rate: Rate (Hz) of the rows, if no time stamps show it.

    Returns:
        A table with a row for each press and the line of the log where it begins, and notes on assumptions and
        omissions.

    Raises:
        DataError: If the file is not a log of this board, a row is damaged, or the log holds no press.
    """
    table = open_text_table(source)
    columns = _columns(source, table, board.num_chips, timed=rate is None)
    notes = ReadingLog(skip_bad, [*table.notes, *columns.notes])
    for note in notes_on_depth(table.header, table.stated):
        notes.change("travel", note)
    names: list[tuple[str, ...]] = []
    log_presses = _LogPresses(columns)
    timed = on_one_clock(_rows(source, table, columns, notes, names), f"{source}: its time", notes, rate)
    for search in _search_parts(timed, columns.names, names):
        log_presses.add(search)
    for note in table.notes:  # again, because notes are added until the last row is read
        notes.info(note)
    notes.require_answers(source)
    if notes.damaged_rows and not log_presses.rows:
        raise DataError(f"{source}: all of its {notes.damaged_rows} rows are damaged; the first: {notes.first_damage}")
    if not log_presses.presses:
        cut = len(log_presses.moved) + log_presses.unsteady
        but = f" except {cut} that are cut off" if cut else ""
        raise DataError(
            f"{source}: no press was found in its {log_presses.rows} rows{but}; "
            "give a log that begins at rest and has presses"
        )
    log_presses.note(notes)
    header = [*columns.names, TIME_COLUMN, *log_presses.labels, *columns.values]
    rows = [log_presses.row(press, names) for press in log_presses.presses]
    return TextTable(header, rows, notes.sentences(), notes)


@dataclass
class _LogPresses:
    """Results of the parts of a log."""

    columns: _Columns
    presses: list[SegmentedPress] = field(default_factory=list)
    rows: int = 0
    parts: int = 0
    spikes: int = 0
    held: int = 0  # number of rows that repeat a reading because the sensor was read faster than it measures
    # lines at which the skin left a level that was not its level at rest
    moved: list[int] = field(default_factory=list)
    hidden: int = 0  # number of presses whose beginning was not recorded
    unsteady: int = 0  # number of presses left out because a part ended before they were steady

    @property
    def height(self) -> int | None:
        """Index of the label that is a height, if any."""
        return next((i for i, name in enumerate(self.columns.labels) if name in HEIGHT_COLUMNS), None)

    @property
    def labels(self) -> list[str]:
        """Names of a press's labels, in which a height has become travel."""
        return ["travel_mm" if i == self.height else name for i, name in enumerate(self.columns.labels)]

    def add(self, search: _Search) -> None:
        """Add a finished search."""
        self.rows, self.parts = self.rows + search.rows, self.parts + 1
        state = search.recording
        if state is None:
            return
        for press in search.presses:
            steady = (press.steady_end - press.steady_start) / (press.end - press.start)
            if not press.over and steady < _PART_RULES.min_steady_fraction:
                self.unsteady += 1
                continue
            if press.gap > _PART_RULES.max_gap_rows * state.rules.step and self._travelled(press):
                press.at_start[LabelColumn.FIRST_VALUE + (self.height or 0)] = np.nan
                self.hidden += 1
            self.presses.append(press)
        self.spikes += state.spikes
        self.held += search.rows if state.rules.fresh < 1 else 0
        self.moved += [int(row[LabelColumn.LINE]) for row in state.moved]

    def _travelled(self, press: SegmentedPress) -> bool:
        """Test whether the tip moved while no row was recorded at the beginning of a press."""
        if self.height is None:
            return False
        heights = press.across[:, LabelColumn.FIRST_VALUE + self.height]
        travel = abs(heights[0] - press.steady[LabelColumn.FIRST_VALUE + self.height])
        return bool(abs(np.diff(heights)).max(initial=0.0) > _PART_RULES.max_unseen_travel * travel)

    def note(self, notes: ReadingLog) -> None:
        """Note findings, assumptions and omissions."""
        pieces = ", between which it paused, its clock was set, or the pad changed"
        parts = f" of {self.parts} parts{pieces}" if self.parts > 1 else ""
        notes.info(f"found: {len(self.presses)} presses in {self.rows} rows{parts}")
        if self.height is not None:
            notes.info(
                f"assumed: {self.columns.labels[self.height]} increases away from the skin, and travel counts from the "
                "height at which a press's reading left its value at rest"
            )
        if self.hidden:
            notes.doubt(
                "presses at missing rows",
                f"{self.hidden} presses begin where rows are missing: their travel is left empty, and their time is "
                "that of the first row afterwards",
            )
        if self.moved:
            notes.change(
                "presses that are cut off",
                f"left out: {len(self.moved)} presses that had begun before their part of the log, or lasted over "
                f"{SegmentationConfig().max_press_s:g} s; the first was released at line {min(self.moved)} (or the "
                "reading at rest differs from there on)",
            )
        if self.unsteady:
            notes.change(
                "unsteady presses",
                f"left out: {self.unsteady} presses that were not steady before their part of the log ended",
            )
        if self.spikes:
            notes.change(
                "single rows", f"replaced: values of {self.spikes} single rows that stand out from those around them"
            )
        if self.held:
            notes.doubt(
                "repeated rows",
                f"{self.held} rows repeat a reading: the sensor was read faster than it measures, or they were "
                "written twice",
            )

    def row(self, press: SegmentedPress, names: list[tuple[str, ...]]) -> tuple[int, list[str]]:
        """Return a press's line in the log, and its fields."""
        steady = press.steady[LabelColumn.FIRST_VALUE :].copy()
        if self.height is not None:
            steady[self.height] = press.at_start[LabelColumn.FIRST_VALUE + self.height] - steady[self.height]
        numbers = [press.at_start[LabelColumn.STAMP], *steady.tolist(), *press.reading.tolist()]
        cells = ["" if np.isnan(x) else f"{x:.6f}" for x in numbers]
        return int(press.at_start[LabelColumn.LINE]), [*names[int(press.steady[LabelColumn.NAMES])], *cells]


def _columns(source: Path, table: TableRows, chips: int, *, timed: bool) -> _Columns:
    """List the columns of a log; refuse a table without time or without the values of the board."""
    header = table.header
    remedy = f"so this is not a log of a board of {chips} chips: name columns as in docs/data.md"
    if timed and TIME_COLUMN not in header:
        remedy = "name the column of time by its unit (time_s, time_ms, time_us), or give --rate-hz where there is none"
    values = field_columns(source, header, chips, [TIME_COLUMN] if timed else [], remedy, stated=table.stated)
    labels = [name for name in (*PLACE_COLUMNS, FORCE_COLUMN) if name in header]
    if "travel_mm" not in header:
        labels += [name for name in HEIGHT_COLUMNS if name in header][:1]
    names = [name for name in TEXT_COLUMNS if name in header]
    unread = [name for name in header if name not in {TIME_COLUMN, *values, *labels, *names}]
    notes = [f"left out: columns {', '.join(unread)}, which are not read in a log"] if unread else []
    return _Columns(names, values, labels, notes)


def _rows(
    source: Path, table: TableRows, columns: _Columns, notes: ReadingLog, all_names: list[tuple[str, ...]]
) -> Iterator[LogRows]:
    """Read the rows of a log in pieces. Count those in which a chip did not answer, and add new names."""
    timed = [TIME_COLUMN] if TIME_COLUMN in table.header else []
    wanted = [*timed, *columns.values, *columns.labels]
    first, end = len(timed), len(timed) + len(columns.values)
    which = [table.header.index(name) for name in columns.names]
    number_of: dict[tuple[str, ...], int] = {} if which else {(): 0}
    with progress(desc=source.name, unit="rows", unit_scale=True) as bar:
        while some := list(islice(table.rows, log_rows.ROWS_READ_AT_ONCE)):
            bar.update(len(some))
            rows, numbers = valid_rows(source, table.header, some, wanted, partial(_needed, timed=first), notes)
            if not rows:
                continue
            readings = without_silent_chips(numbers[:, first:end])
            notes.select_answered(np.isnan(readings).reshape(len(rows), -1, AXES_OF_CHIP).any(2))
            codes = np.zeros(len(rows))
            if which:
                names = (tuple(cells[i].strip() for i in which) for _, cells in rows)
                codes += [number_of.setdefault(name, len(number_of)) for name in names]
            all_names[:] = number_of
            time = numbers[:, 0] if timed else np.zeros(len(rows))
            labels = np.column_stack([np.array([line for line, _ in rows], float), time, codes, numbers[:, end:]])
            yield LogRows(time, readings, labels)


def _needed(empty: np.ndarray, *, timed: int) -> np.ndarray:
    """Compute the mask of fields that may not be empty: the time, which comes first if present."""
    return np.tile(np.arange(empty.shape[1]) < timed, (len(empty), 1))


def _search_parts(pieces: "Iterator[TimedRows]", columns: list[str], names: list[tuple[str, ...]]) -> Iterator[_Search]:
    """Run a search from each pause, each beginning of the clock and each change of the pad."""
    search: _Search | None = None
    last_complete, pad = np.nan, ""
    for piece in pieces:
        rows, complete = piece.rows, piece.rows.complete
        complete_at = np.fmax.accumulate(np.concatenate([[last_complete], np.where(complete, rows.time, np.nan)]))
        silences = np.flatnonzero(complete & (rows.time - complete_at[:-1] > pause_threshold(piece.step)))
        begins = {*np.flatnonzero(piece.begins).tolist(), *silences.tolist()}
        pads = [name[columns.index("pad")] if "pad" in columns else "" for name in names]
        others, pad = _other_pads(rows, pads, pad)
        for start, end in pairwise(sorted({0, *begins, *others, len(rows.time)})):
            part = rows.select(slice(start, end))
            if search is not None and start in others:
                search.finish()
                yield search
                search = None
            if search is not None and start in begins:
                if search.continues_press(part.select(part.complete)):
                    search.origin = float(part.time[0]) - search.end - piece.step
                else:
                    search.finish()
                    yield search
                    search = _Search(origin=float(part.time[0]), earlier=search.rest)
            search = search or _Search(origin=float(part.time[0]))
            search.take(part, piece.step)
        last_complete = float(complete_at[-1])
    if search is not None:
        search.finish()
        yield search


def _other_pads(rows: LogRows, pads: list[str], pad: str) -> tuple[set[int], str]:
    """List the rows at which the pad changes, and the last pad; a row without a name has the previous pad."""
    others = set()
    codes = rows.labels[:, LabelColumn.NAMES]
    for at in np.flatnonzero(np.diff(codes, prepend=-1.0)).tolist():
        pad_there = pads[int(codes[at])] or pad
        if pad not in ("", pad_there):
            others.add(at)
        pad = pad_there
    return others, pad
