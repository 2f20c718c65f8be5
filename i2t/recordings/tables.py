"""Tables as labs write them: a line of column names, then a row for each reading or press.

Differences between programs that do not change the meaning are removed here, each with a note: other delimiters and
decimal commas, titles and comments before the names, columns without a name (a row's number), capital letters, units in
brackets or below the names, and units other than mm, uT, N and s. Two modules interpret the columns:
`i2t.convert.presses` refuses damaged rows, and `i2t.recordings.read` keeps what it can.
"""

import csv
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from i2t.errors import DataError
from i2t.files.kinds import UTF_8, WINDOWS_1252
from i2t.files.reading import encoding_of_file, read_lines, require_unpackable
from i2t.recordings.cells import (
    AMBIGUOUS,
    DECIMAL,
    GROUPED_MARK,
    NO_TIME_MARK,
    DecimalSigns,
    as_written,
    count_kinds,
    kind_of_number,
    parse_number,
)
from i2t.recordings.clocks import CLOCK, stamp_in_seconds, states_zone, unix_unit
from i2t.recordings.columns import (
    MICRO_SIGNS,
    STAMPS,
    TEXT_COLUMNS,
    TIME,
    UNITS,
    is_field_or_ours,
    is_number,
    is_ours,
    is_read,
    our_name,
    plain_name,
)
from i2t.recordings.files import os_errors_as_data_errors
from i2t.recordings.log import ReadingLog

MAX_TABLE_VALUE = 1e9  # bound of a plausible number, in its unit
SAMPLE_ROWS = 64  # first rows, which decide decimals, times and units
COMMENT_MARK, SPREADSHEET_ERROR = "#", re.compile("#(N/A|[A-Z0-9/]+[!?])")
SEPARATOR_LINE = re.compile(r"sep=(\\t|.)", re.IGNORECASE)  # line in which spreadsheets name the delimiter
DELIMITERS = {";": "semicolons", "\t": "tabs", ",": "commas", "|": "vertical bars", " ": "spaces"}
EMPTY = " \t\r\n\0\x1a\ufeff\u00a0"  # characters of empty cells, with the end-of-file mark of DOS
MAX_TITLE_LINES = 20  # lines above the names of the columns
EXCEL_DAYS = (36526.0, 73051.0)  # the years 2000 to 2099, as spreadsheets count days
UNIT_BRACKETS = re.compile(r"[\s\[\]()]")
ENCODING_NAMES = {WINDOWS_1252: "Windows-1252 (cp1252)"}


class TextTable(NamedTuple):
    """A table's texts under the names and in the units of this package."""

    header: list[str]
    rows: list[tuple[int, list[str]]]  # number of the line in the file, and its fields
    notes: list[str]  # sentences on what was changed


class TableRows(NamedTuple):
    """A table whose rows are read one after the other, once."""

    header: list[str]
    rows: Iterator[tuple[int, list[str]]]
    notes: list[str]


def read_text_table(path: Path) -> TextTable:
    """Read a table of any program.

    Args:
        path: The file, plain or gzip-ed.

    Returns:
        The table.

    Raises:
        DataError: The file cannot be read, or is not a table.
    """
    with os_errors_as_data_errors(path):
        require_unpackable(path)
    table = open_text_table(path)
    return TextTable(table.header, list(table.rows), table.notes)


def open_text_table(path: Path, *, as_named: bool = False, texts: Sequence[str] = ()) -> TableRows:
    """Begin to read a table that may be larger than memory.

    Args:
        path: The file, plain or gzip-ed.
        as_named: Whether names and units of columns stay as they are.
        texts: Columns whose cells stay as they are; the line of names is the one that has them all.

    Returns:
        The table, whose rows are read when they are asked for.

    Raises:
        DataError: The file cannot be read, or is not a table. Errors in a row are raised when that row is read.
    """
    with os_errors_as_data_errors(path):
        encoding = encoding_of_file(path)
    lines = _lines(path, encoding)
    begins = _beginning(lines, texts)
    parts = [cells for _, cells in _parsed(path, begins.sample, begins.delimiter, strict=False) if not _is_empty(cells)]
    units = parts[0] if parts and _are_units(parts[0]) else []
    sample = parts[bool(units) :]
    kept = [i for i, name in enumerate(begins.names) if name]
    stated = [_with_unit(path, begins.names[i], *units[i : i + 1]) for i in kept]
    cells_of = [[cells[i].strip() for cells in sample if i < len(cells) and cells[i].strip()] for i in kept]
    notes = _notes_on(encoding, begins)
    columns = _Columns(stated, [1.0] * len(stated), False, texts) if as_named else _our_columns(stated, cells_of, notes)
    dates = columns.where(lambda name, _: columns.stamps and name == TIME)
    seconds = columns.where(lambda name, factor: name == TIME and factor == 1)
    seconds = [i for i in seconds if not as_named and i not in dates and _is_decimal_time(cells_of[i])]
    numbers = columns.where(lambda name, _: name not in columns.texts and (as_named or is_read(name)))
    numbers = [i for i in numbers if i not in (*dates, *seconds)]
    at, counters = [kept[i] for i in numbers], [kept[i] for i in columns.where(lambda name, _: name == TIME)]

    def all_kinds() -> Counter[str]:
        return count_kinds(
            (cells for _, cells in _parsed(path, _lines(path, encoding), begins.delimiter, strict=False)), at, counters
        )

    signs = DecimalSigns(path, count_kinds(sample, at, counters), all_kinds, begins.delimiter)
    changes: list[tuple[list[int], Callable[[str], str]]] = [(dates, _stamp), (seconds, _with_decimal_point)]
    if begins.delimiter != "," or signs.sign == ",":
        decimal = ", and commas are decimal" if signs.sign == "," else ""
        notes.append(f"fields are separated by {DELIMITERS[begins.delimiter]}{decimal}")
    if units:
        notes.append("units stand in the line below the names of the columns")
    numbered = _parsed(path, chain(begins.sample, lines), begins.delimiter, begins.before)
    rows = _without_other_lines(path, numbered, begins, columns, units, notes)
    return TableRows(columns.header, _undone(rows, begins, columns, kept, numbers, signs, changes, notes), notes)


def sound_rows(
    path: Path,
    header: list[str],
    rows: Iterable[tuple[int, list[str]]],
    columns: Sequence[str],
    needed: Callable[[np.ndarray], np.ndarray],
    notes: ReadingLog,
    *,
    bound: float = MAX_TABLE_VALUE,
    remedy: str = "correct it",
) -> tuple[list[tuple[int, list[str]]], np.ndarray]:
    """Read the numbers of rows, and leave out rows without plausible numbers as damaged.

    Args:
        path: The file, for messages.
        header: Names of its columns.
        rows: The number of each line, and its fields.
        columns: Names of the columns to read.
        needed: Takes the mask (n, columns) of empty fields, and returns the mask of fields that may not be empty.
        notes: Log that refuses or counts damaged rows.
        bound: Bound of a plausible number.
        remedy: What the user is to do about a cell without one.

    Returns:
        The rows that are left, and their numbers (n, columns), NaN in empty fields.

    Raises:
        DataError: A row is damaged, and damaged rows may not be left out.
    """
    complete = []
    for number, cells in rows:
        if len(cells) == len(header):
            complete.append((number, cells))
        else:
            advice = "give one for each column"
            if 3 * len(cells) > 4 * len(header):  # a field in three or more is torn
                advice = "if its numbers have decimal commas, export it with semicolons between fields"
            notes.skip_row(DataError(f"{path}: line {number} has not {len(header)} fields but {len(cells)}; {advice}"))
    at = [header.index(name) for name in columns]
    numbers = _numbers([[cells[i] for i in at] for _, cells in complete], len(at))
    wrong = (np.abs(numbers) >= bound) & (np.array(columns) != TIME)  # Unix time is larger than all else
    wrong |= np.isinf(numbers) | (np.isnan(numbers) & needed(np.isnan(numbers)))
    for k in np.flatnonzero(wrong.any(1)):
        (line, cells), j = complete[k], int(np.flatnonzero(wrong[k])[0])
        cell = cells[at[j]]
        problem = _problem(cell, columns[j], remedy)
        cell = as_written(cell)
        notes.skip_row(DataError(f"{path}: line {line} has {cell!r} in column {columns[j]}, {problem}"))
    sound = ~wrong.any(1)
    return [row for row, kept in zip(complete, sound, strict=True) if kept], numbers[sound]


def _problem(cell: str, column: str, remedy: str) -> str:
    """Half a sentence on what is wrong with a cell without a plausible number, and what to do."""
    if cell.endswith(GROUPED_MARK):
        return "which may be decimal or grouped thousands; write all numbers with one decimal sign and no other"
    if column != TIME or not (cell.endswith(NO_TIME_MARK) or re.search("[0-9][:./-][0-9]", cell)):
        return f"which is not a plausible number; {remedy}"
    days = parse_number(as_written(cell))
    counted = " but may count days, as spreadsheets do" if days and EXCEL_DAYS[0] <= days < EXCEL_DAYS[1] else ""
    return f"which is no time in ISO 8601{counted}; write it as 2025-10-20 12:00:00.010, or in seconds"


def names_in(header: list[str], cells: list[str], kind: str) -> str:
    """Find the pad or session of a row.

    Args:
        header: Names of the columns.
        cells: Fields of the row.
        kind: "pad" or "session".

    Returns:
        Its name; the kind itself where the row has no name.
    """
    return (cells[header.index(kind)] if kind in header else "").strip() or kind


def _numbers(texts: list[list[str]], columns: int) -> np.ndarray:
    """Numbers (n, columns): NaN for an empty text, infinite for a text that is not a number."""
    try:
        if "_" not in "".join(map("".join, texts)):  # NumPy reads 3_2 as 32
            return np.array([[text or "nan" for text in row] for row in texts], float).reshape(-1, columns)
    except ValueError:
        pass
    return np.array([[_number(text) for text in row] for row in texts]).reshape(-1, columns)


def _number(text: str) -> float:
    number = parse_number(text) if text.strip() else np.nan
    return np.inf if number is None else number


def _lines(path: Path, encoding: str) -> Iterator[str]:
    with os_errors_as_data_errors(path):
        yield from read_lines(path, encoding)


class _Beginning(NamedTuple):
    """The lines before the first row of numbers, and how fields are separated."""

    names: list[str]  # names of the columns as stated
    delimiter: str  # a space stands for any number of spaces
    before: int  # lines up to and with the names
    comments: int  # comments among these lines
    titles: int  # other lines above the names
    sample: list[str]  # the following lines, which were read already


class _Columns(NamedTuple):
    """Names and units of the columns that have a name."""

    header: list[str]  # our names
    factors: list[float]  # factors from the stated units to ours
    stamps: bool  # whether times are dates or times of day
    texts: Sequence[str] = TEXT_COLUMNS  # columns without numbers

    def where(self, wanted: Callable[[str, float], bool]) -> list[int]:
        """Indices of the columns whose name and factor are wanted."""
        return [i for i, both in enumerate(zip(self.header, self.factors, strict=True)) if wanted(*both)]


def _without_other_lines(
    path: Path,
    rows: Iterator[tuple[int, list[str]]],
    begins: _Beginning,
    columns: _Columns,
    units: list[str],
    notes: list[str],
) -> Iterator[tuple[int, list[str]]]:
    """Rows without empty ones, comments, and repeated names and units; the last notes come with their end."""
    width, comments, repeats = len(begins.names), 0, 0
    has_text_first = bool(begins.names and begins.names[0]) and columns.header[0] in columns.texts
    marked_rows: bool | None = None  # whether rows begin with the mark of comments, as some labels do
    for line, cells in rows:
        if _is_empty(cells) or cells == units:
            continue
        if not is_number(cells[0].replace(",", ".")):
            words = [cell.strip().strip(EMPTY) for cell in [cells[0].lstrip(EMPTY + COMMENT_MARK + "%"), *cells[1:]]]
            if words[:width] == begins.names and not any(words[width:]):
                repeats += 1
                continue
            if _names_other_columns(words, begins.names):
                raise DataError(
                    f"{path}: line {line} names other columns ({', '.join(words[:3])} ...); split the file there"
                )
        is_marked = cells[0].lstrip().startswith(COMMENT_MARK) and not SPREADSHEET_ERROR.fullmatch(cells[0].strip())
        if is_marked and not (has_text_first and len(cells) == width):
            comments += 1
            continue
        if marked_rows is None:
            marked_rows = is_marked
        if has_text_first and is_marked != marked_rows:
            raise DataError(
                f"{path}: some rows up to line {line} ({cells[0]!r}) begin with {COMMENT_MARK} and some do not, so "
                "that they may be rows or comments; remove these lines, or rename their first cells"
            )
        yield line, cells
    counts = {"lines of comments between the rows": comments, "lines that repeat the names of the columns": repeats}
    notes += [f"left out: {count} {what}" for what, count in counts.items() if count]


def _undone(
    rows: Iterator[tuple[int, list[str]]],
    begins: _Beginning,
    columns: _Columns,
    kept: list[int],
    numbers: list[int],
    signs: DecimalSigns,
    changes: list[tuple[list[int], Callable[[str], str]]],
    notes: list[str],
) -> Iterator[tuple[int, list[str]]]:
    """Rows with decimal points, in our units."""
    width, all_named, before = len(begins.names), len(kept) == len(begins.names), signs.sign
    scaled = columns.where(lambda _, factor: factor != 1)
    for line, cells in rows:
        while len(cells) > width and not cells[-1].strip():
            cells.pop()
        if not all_named:
            cells = [cells[i] for i in kept if i < len(cells)] + cells[width:]
        if begins.delimiter != "," or signs.sign != "." or any("," in cell for cell in cells):
            for i in numbers:
                if i < len(cells):
                    cells[i] = signs.with_point(cells[i], line)
        for which, change in changes:
            for i in which:
                if i < len(cells):
                    cells[i] = change(cells[i])
        for i in scaled:
            if i < len(cells):
                cells[i] = _scaled(cells[i], columns.factors[i])
        yield line, cells
    if signs.sign == "," != before:
        notes.append("commas are decimal")


def _with_decimal_point(text: str) -> str:
    return text.replace(",", ".") if DECIMAL[","].fullmatch(text.strip()) else text


def _stamp(text: str) -> str:
    """The seconds of a date or time of day; another text with a mark."""
    seconds = stamp_in_seconds(text)
    return text + NO_TIME_MARK if seconds == text and text.strip() else seconds


def _is_decimal_time(cells: list[str]) -> bool:
    """Test whether all times have three decimals: no program writes whole seconds with grouped thousands."""
    kinds = set(map(kind_of_number, cells))
    return len(cells) > 1 and len(kinds) == 1 and kinds.pop().startswith(AMBIGUOUS)


def _is_empty(cells: list[str]) -> bool:
    """Test for a row that holds nothing."""
    return not any(cell.strip(EMPTY) for cell in cells)


def _names_other_columns(words: list[str], names: list[str]) -> bool:
    """Test for a line of names: half of them are names of columns, or each column has a name of its own."""
    words = [word.strip() for word in (re.split("[;\t|]", words[0]) if len(words) == 1 else words) if word.strip()]
    if len(words) < 2 or any(is_number(word.replace(",", ".")) for word in words):
        return False
    if 2 * sum(word in names or is_field_or_ours(word) for word in words) >= len(words):
        return True
    as_many = len(words) == len(set(words)) == len(names) > 2
    return as_many and all(re.fullmatch(r"[^\W\d][\w .()/\[\]-]*", word) for word in words)


def _beginning(lines: Iterator[str], texts: Sequence[str]) -> _Beginning:
    """Read up to the names of the columns.

    These are the first line that is not a comment. Where that line holds numbers alone, they are the comment before it,
    as `numpy.savetxt` writes it. Below titles, they are the first line with all of `texts`, or with two of our columns.
    """
    before, comments, stated, comment, first = 0, 0, "", "", ""
    for line in lines:
        before += 1
        if separator := SEPARATOR_LINE.fullmatch(line.strip(' "\r')):
            stated = separator[1].replace("\\t", "\t")
        elif line.startswith(COMMENT_MARK):
            comments, comment = comments + 1, line
        elif line.strip(EMPTY + "".join(DELIMITERS) + '"'):
            first = line
            break
    sample = list(islice(lines, SAMPLE_ROWS))
    if first.count('"') % 2 and sample and sample[0].count('"') % 2:  # a name of two lines
        first, before = f"{first} {sample.pop(0)}", before + 1

    def delimiter_of(names: str, rows: list[str]) -> str:
        return stated if stated and stated in names else _delimiter(names, rows)

    def parsed(line: str, delimiter: str) -> list[str]:
        return [name.strip() for name in _fields(line, delimiter)]

    hidden, delimiter = comment.lstrip(COMMENT_MARK + "% "), delimiter_of(first, sample)
    is_numeric = all(is_number(text.replace(",", ".")) for text in _fields(first, delimiter) if text.strip())
    if hidden and is_numeric and not first.startswith("%"):
        separated = delimiter_of(hidden, [first])
        if len(names := parsed(hidden, separated)) == len(_fields(first, separated)) > 1:
            return _Beginning(names, separated, before - 1, comments - 1, 0, [first, *sample])
    for titles, line in enumerate([first, *sample[:MAX_TITLE_LINES]]):
        if is_numeric:
            break
        below = sample[titles:]
        names = parsed(line.lstrip("%" + COMMENT_MARK + " "), separated := delimiter_of(line, below))
        if all(name in names for name in texts) if texts else sum(map(is_field_or_ours, names)) > 1:
            sample = [*below, *islice(lines, titles)]
            return _Beginning(names, separated, before + titles, comments, titles, sample)
    return _Beginning(parsed(first.lstrip("% "), delimiter), delimiter, before, comments, 0, sample)


def _delimiter(names: str, rows: list[str]) -> str:
    """The delimiter that gives the line of names and the first row equally many fields."""
    row = next((line for line in rows if line.strip() and not line.startswith(COMMENT_MARK)), "")
    counts = {sign: len(_fields(names, sign)) for sign in DELIMITERS}
    alike = [sign for sign, count in counts.items() if count > 1 and (not row or count == len(_fields(row, sign)))]
    several = [sign for sign, count in counts.items() if count > 1 and sign != " "]
    return next(iter([*alike, *several]), ",")


def _fields(line: str, delimiter: str) -> list[str]:
    """The fields of one line; a quoted field may hold the delimiter."""
    if delimiter == " ":
        return line.split()
    return next(csv.reader([line], delimiter=delimiter), [])


def _notes_on(encoding: str, begins: _Beginning) -> list[str]:
    """Sentences on the encoding and on lines before the first row."""
    notes = []
    if encoding != UTF_8:
        named = ENCODING_NAMES.get(encoding, encoding.upper())
        doubt = ": letters beyond ASCII in names may be wrong" if encoding == WINDOWS_1252 else ""
        notes.append(f"the text is not in UTF-8 and was read as {named}{doubt}")
    if begins.comments:
        notes.append(f"left out: {begins.comments} lines of comments before the names of the columns")
    if begins.titles:
        notes.append(f"left out: {begins.titles} lines above the names of the columns")
    if nameless := begins.names.count(""):
        notes.append(f"left out: {nameless} columns without a name")
    return notes


def _our_columns(stated: list[str], cells_of: list[list[str]], notes: list[str]) -> _Columns:
    """Columns under our names and in our units, by the stated names and the non-empty cells of the first rows."""
    ours = _one_clock(stated, [our_name(name) for name in stated])
    header, factors = [name for name, _ in ours], [factor for _, factor in ours]
    bare = next((i for i, name in enumerate(stated) if plain_name(name).lstrip("%") in STAMPS), None)
    at = header.index(TIME) if TIME in header else bare
    stamps = False
    if at is not None:
        stamps, unit = _form_of_times(cells_of[at], has_unit=TIME in header)
        if TIME not in header and (stamps or unit is not None):
            header[at], factors[at] = TIME, 1.0 if stamps else float(unit or 1.0)
            size = "" if stamps else f" in units of {unit:g} s, by the size of its numbers"
            notes.append(f"column {stated[at]} holds the time{size}")
    if stamps and at is not None:
        factors[at] = 1.0
        understood = [cell for cell in cells_of[at] if stamp_in_seconds(cell) != cell]
        if not understood:
            notes.append(f"column {stated[at]} holds no time in ISO 8601 or in seconds, but {cells_of[at][0]!r}")
        elif not states_zone(understood[0]):
            notes.append("assumed: times without a zone are in UTC, and times without a date are of one day")
    units = [name for name, own, factor in zip(stated, ours, factors, strict=True) if factor != 1 and own[1] != 1]
    if units:
        notes.append(f"columns {', '.join(units)} are in other units than mm, uT, N and s, and were turned into these")
    return _Columns(header, factors, stamps)


def _one_clock(stated: list[str], ours: list[tuple[str, float]]) -> list[tuple[str, float]]:
    """Names and factors in which one column is the time: `time_s` and the like before `timestamp_s` and the like."""
    times = [i for i, (name, _) in enumerate(ours) if name == TIME]
    others = [i for i in times if not plain_name(stated[i]).startswith("time_") or "stamp" in plain_name(stated[i])]
    dropped = others if len(others) < len(times) else others[1:]
    return [(stated[i], 1.0) if i in dropped else own for i, own in enumerate(ours)]


def _form_of_times(cells: list[str], *, has_unit: bool) -> tuple[bool, float | None]:
    """Whether most of the first times are written as dates or times of day; else the unit of Unix times in a column
    that states none, in seconds, or None.
    """
    numbers = [number for cell in cells if (number := parse_number(_with_decimal_point(cell))) is not None]
    if 2 * len(numbers) <= len(cells):
        return any(re.search("[0-9]", cell) for cell in cells), None
    if has_unit:
        return False, None
    units = Counter(unit for unit in map(unix_unit, numbers) if unit is not None)
    unit, count = next(iter(units.most_common(1)), (None, 0))
    if 2 * count > len(numbers):
        return False, unit
    step = 86400 * np.median(np.abs(np.diff(numbers))) if len(numbers) > 1 else 0.0  # s, if they count days
    are_days = all(EXCEL_DAYS[0] <= number < EXCEL_DAYS[1] for number in numbers)
    return bool(0 < step < CLOCK.max_step_s) and are_days, None


def _are_units(cells: list[str]) -> bool:
    """Test for a line of units below the names."""
    words = [UNIT_BRACKETS.sub("", cell).lower().translate(MICRO_SIGNS) for cell in cells]
    known = {"", "-", "1", "#"} | {word for ours, others in UNITS.values() for word in (ours.lower(), *others)}
    return any(words) and known.issuperset(words) and not any(map(is_number, words))


def _with_unit(path: Path, name: str, unit: str = "") -> str:
    """A column's name, with the unit below it where only both together are understood; raises DataError where the name
    states another unit.
    """
    plain = UNIT_BRACKETS.sub("", unit)
    if is_ours(name):
        stem, _, own = plain_name(name).rpartition("_")
        if plain and our_name(f"{stem}_{plain}") != our_name(name):
            raise DataError(f"{path}: column {name} has the unit {own} by its name and {plain} below it; correct one")
        return name
    both = f"{name}_{plain}"
    return both if is_ours(both) else name


def _parsed(
    path: Path, lines: Iterable[str], delimiter: str, before: int = 0, *, strict: bool = True
) -> Iterator[tuple[int, list[str]]]:
    """Number of the line and fields of each row that has any; `before` lines were read already."""
    if delimiter == " ":
        yield from ((before + k, line.split()) for k, line in enumerate(lines, 1) if line.strip())
        return
    reader = csv.reader(lines, delimiter=delimiter, strict=strict)
    try:
        for cells in reader:
            if cells:
                yield before + reader.line_num, cells
    except csv.Error as error:
        raise DataError(f"{path}: is no comma-separated table ({error}); save it as CSV") from error


def _scaled(text: str, factor: float) -> str:
    """A number in another unit; a text that is not a number stays as it is, and is judged later."""
    number = parse_number(text)
    return text if number is None else repr(factor * number)
