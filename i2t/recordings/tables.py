"""Tables as labs write them: a line of column names, then a row for each reading or press.

Differences between programs that do not change the meaning are removed here, each with a note: delimiters and decimal
commas, titles and comments before the names, columns without a name (such as row numbers), capital letters, units in
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
    count_kinds,
    kind_of_number,
    parse_number,
    strip_marks,
)
from i2t.recordings.clocks import CLOCK, has_time_zone, stamp_in_seconds, unix_unit
from i2t.recordings.columns import (
    MICRO_SIGNS,
    TEXT_COLUMNS,
    TIME_COLUMN,
    TIME_NAMES,
    UNIT_FACTORS,
    is_library_column,
    is_number,
    is_usable_column,
    is_used_column,
    library_name,
    normalised_name,
)
from i2t.recordings.files import os_errors_as_data_errors
from i2t.recordings.log import ReadingLog

# Number in a table, in any unit, from which it counts as damaged; its row, or the value alone, is not used.
MAX_TABLE_VALUE = 1e9
COMMENT_MARK = "#"  # sign that begins a comment line of a table
# signs that may separate the cells of a table, with their names in messages
DELIMITERS = {";": "semicolons", "\t": "tabs", ",": "commas", "|": "vertical bars", " ": "spaces"}
# characters of empty cells of tables; \x1a is the end-of-file mark of DOS
EMPTY_CELL_CHARACTERS = " \t\r\n\0\x1a\ufeff\u00a0"
# day numbers of spreadsheets that begin the years 2000 and 2100; numbers between them may be dates
EXCEL_DAYS = (36526.0, 73051.0)


class TextTable(NamedTuple):
    """A table in memory: rows of cells as texts, with i2t's column names and units, and notes on what was changed."""

    header: list[str]
    rows: list[tuple[int, list[str]]]  # number of the line in the file, and its fields
    notes: list[str]  # what was changed in the table, one sentence each
    log: ReadingLog | None = None  # log of the table from which this one was made
    stated: Sequence[str] = ()  # names of the columns as the file spells them


class TableRows(NamedTuple):
    """A table as `TextTable`, whose rows are an iterator that reads the file once; the last notes follow its end."""

    header: list[str]
    rows: Iterator[tuple[int, list[str]]]  # number of the line in the file, and its fields
    notes: list[str]  # what was changed in the table, one sentence each; the last ones are added when the rows end
    stated: Sequence[str]  # names of the columns as the file spells them


def read_text_table(path: Path) -> TextTable:
    """Read a table that any program wrote.

    Args:
        path: Path of the file, plain or gzipped.

    Returns:
        The cells of the table as texts, with columns and units converted to i2t's.

    Raises:
        DataError: The file cannot be read, or is not a table.
    """
    with os_errors_as_data_errors(path):
        require_unpackable(path)
    table = open_text_table(path)
    return TextTable(table.header, list(table.rows), table.notes, stated=table.stated)


def open_text_table(path: Path, *, as_named: bool = False, texts: Sequence[str] = ()) -> TableRows:
    """Open a table that may be larger than memory.

    Args:
        path: Path of the file, plain or gzipped.
        as_named: Whether to keep the names and units of the columns as written in the file.
        texts: Names of columns whose cells are kept unchanged. The line of names is the first that has all of them.

    Returns:
        The table, whose rows are read lazily.

    Raises:
        DataError: The file cannot be read, or is not a table. Errors in a row are raised when that row is read.
    """
    with os_errors_as_data_errors(path):
        encoding = encoding_of_file(path)
    lines = _lines(path, encoding)
    top = _read_top(lines, texts)
    sample = [cells for _, cells in _parsed(path, top.sample, top.delimiter, strict=False) if not _is_empty(cells)]
    units = sample.pop(0) if sample and _are_units(sample[0]) else []
    named = [i for i, name in enumerate(top.names) if name]
    stated = [_with_unit(path, top.names[i], *units[i : i + 1]) for i in named]
    cells_of = [[cells[i].strip() for cells in sample if i < len(cells) and cells[i].strip()] for i in named]
    notes = _notes_on(encoding, top)
    columns = _Columns(stated, [1.0] * len(stated), False, texts) if as_named else _our_columns(stated, cells_of, notes)
    dates = columns.where(lambda name, _: columns.stamps and name == TIME_COLUMN)
    seconds = columns.where(lambda name, factor: name == TIME_COLUMN and factor == 1)
    seconds = [i for i in seconds if not as_named and i not in dates and _is_decimal_time(cells_of[i])]
    numbers = columns.where(lambda name, _: name not in columns.texts and (as_named or is_used_column(name)))
    numbers = [i for i in numbers if i not in (*dates, *seconds)]
    at, counters = [named[i] for i in numbers], [named[i] for i in columns.where(lambda name, _: name == TIME_COLUMN)]

    def all_kinds() -> Counter[str]:
        return count_kinds(
            (cells for _, cells in _parsed(path, _lines(path, encoding), top.delimiter, strict=False)), at, counters
        )

    signs = DecimalSigns(path, count_kinds(sample, at, counters), all_kinds, top.delimiter)
    changes: list[tuple[list[int], Callable[[str], str]]] = [(dates, _stamp), (seconds, _with_decimal_point)]
    if top.delimiter != "," or signs.sign == ",":
        decimal = ", and commas are decimal" if signs.sign == "," else ""
        notes.append(f"fields are separated by {DELIMITERS[top.delimiter]}{decimal}")
    if units:
        notes.append("the line below the names of the columns states the units")
    numbered = _parsed(path, chain(top.sample, lines), top.delimiter, top.before)
    rows = _data_rows(path, numbered, top, columns, units, notes)
    rows = _converted(rows, top, columns, named, numbers, signs, changes, notes)
    return TableRows(columns.header, rows, notes, [top.names[i] for i in named])


def valid_rows(
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
    """Parse the numbers in a table's rows, and leave out rows with implausible numbers as damaged.

    Args:
        path: Path of the file, for messages.
        header: Names of its columns.
        rows: Number of each line, and its fields.
        columns: Names of the columns to read.
        needed: Function from the `(n, columns)` mask of empty fields to the mask of fields that may not be empty.
        notes: Log that refuses or counts damaged rows.
        bound: Largest plausible number.
        remedy: Advice on a cell without a plausible number.

    Returns:
        The remaining rows, and their `(n, columns)` numbers, which are NaN in empty fields.

    Raises:
        DataError: A row is damaged, and damaged rows may not be left out.
    """
    complete = []
    for number, cells in rows:
        if len(cells) == len(header):
            complete.append((number, cells))
        else:
            advice = "give one for each column"
            if 3 * len(cells) > 4 * len(header):  # decimal commas split at least one field in three
                advice = "if its numbers have decimal commas, export it with semicolons between fields"
            notes.skip_row(
                DataError(f"{path}: line {number} has {len(cells)} fields instead of {len(header)}; {advice}")
            )
    at = [header.index(name) for name in columns]
    numbers = _numbers([[cells[i] for i in at] for _, cells in complete], len(at))
    wrong = (np.abs(numbers) >= bound) & (np.array(columns) != TIME_COLUMN)  # Unix time may exceed any bound
    wrong |= np.isinf(numbers) | (np.isnan(numbers) & needed(np.isnan(numbers)))
    for k in np.flatnonzero(wrong.any(1)):
        (line, cells), j = complete[k], int(np.flatnonzero(wrong[k])[0])
        cell = cells[at[j]]
        problem = _problem(cell, columns[j], remedy)
        cell = strip_marks(cell)
        notes.skip_row(DataError(f"{path}: line {line} has {cell!r} in column {columns[j]}, {problem}"))
    sound = ~wrong.any(1)
    return [row for row, is_sound in zip(complete, sound, strict=True) if is_sound], numbers[sound]


def _problem(cell: str, column: str, remedy: str) -> str:
    """Describe what is wrong with a cell without a plausible number, and the remedy, as a clause."""
    if cell.endswith(GROUPED_MARK):
        return "which may be decimal or grouped thousands; write all numbers with one decimal sign and no other"
    if column != TIME_COLUMN or not (cell.endswith(NO_TIME_MARK) or re.search("[0-9][:./-][0-9]", cell)):
        return f"which is not a plausible number; {remedy}"
    days = parse_number(strip_marks(cell))
    counted = " but may count days, as spreadsheets do" if days and EXCEL_DAYS[0] <= days < EXCEL_DAYS[1] else ""
    return f"which is not a time in ISO 8601{counted}; write it as 2025-10-20 12:00:00.010, or in seconds"


def names_in(header: list[str], cells: list[str], kind: str) -> str:
    """Look up the name of a row's pad or session.

    Args:
        header: Names of the columns.
        cells: Fields of the row.
        kind: "pad" or "session".

    Returns:
        The name; the kind itself if the row has no name.
    """
    return (cells[header.index(kind)] if kind in header else "").strip() or kind


def _numbers(texts: list[list[str]], columns: int) -> np.ndarray:
    """Read `(n, columns)` numbers: NaN for an empty text, infinity for a text that is not a number."""
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


class _Top(NamedTuple):
    """The lines before the first row of numbers, and the delimiter between fields."""

    names: list[str]  # names of the columns as written in the file
    delimiter: str  # delimiter of the columns; a space stands for any number of spaces
    before: int  # number of lines up to and including that of the names
    comments: int  # number of comments up to the line of the names
    titles: int  # number of other lines above the names
    sample: list[str]  # lines after the names that were read already


class _Columns(NamedTuple):
    """Names and units of the columns that have a name."""

    header: list[str]  # i2t's names of the columns
    factors: list[float]  # factors from the units in the file to i2t's
    stamps: bool  # whether times are dates or times of day
    texts: Sequence[str] = TEXT_COLUMNS  # columns without numbers

    def where(self, wanted: Callable[[str, float], bool]) -> list[int]:
        """Find the indices of the columns whose name and factor are wanted."""
        return [i for i, column in enumerate(zip(self.header, self.factors, strict=True)) if wanted(*column)]


def _data_rows(
    path: Path,
    rows: Iterator[tuple[int, list[str]]],
    top: _Top,
    columns: _Columns,
    units: list[str],
    notes: list[str],
) -> Iterator[tuple[int, list[str]]]:
    """Yield rows without empty lines, comments, and repeated names and units; then add notes on these."""
    width, comments, repeats = len(top.names), 0, 0
    has_text_first = bool(top.names and top.names[0]) and columns.header[0] in columns.texts
    marked_rows: bool | None = None  # whether rows begin with the comment mark, as some labels do
    for line, cells in rows:
        if _is_empty(cells) or cells == units:
            continue
        if not is_number(cells[0].replace(",", ".")):
            words = [
                cell.strip().strip(EMPTY_CELL_CHARACTERS)
                for cell in [cells[0].lstrip(EMPTY_CELL_CHARACTERS + COMMENT_MARK + "%"), *cells[1:]]
            ]
            if words[:width] == top.names and not any(words[width:]):
                repeats += 1
                continue
            if _names_other_columns(words, top.names):
                raise DataError(
                    f"{path}: line {line} names other columns ({', '.join(words[:3])} ...); split the file there"
                )
        is_error = re.fullmatch("#(N/A|[A-Z0-9/]+[!?])", cells[0].strip())  # of a spreadsheet, such as #DIV/0!
        is_marked = cells[0].lstrip().startswith(COMMENT_MARK) and not is_error
        if is_marked and not (has_text_first and len(cells) == width):
            comments += 1
            continue
        if marked_rows is None:
            marked_rows = is_marked
        if has_text_first and is_marked != marked_rows:
            raise DataError(
                f"{path}: some rows up to line {line} ({cells[0]!r}) begin with {COMMENT_MARK} and others do not, "
                "so they may be rows or comments; remove these lines, or rename their first cells"
            )
        yield line, cells
    counts = {"lines of comments between the rows": comments, "lines that repeat the names of the columns": repeats}
    notes += [f"left out: {count} {what}" for what, count in counts.items() if count]


def _converted(
    rows: Iterator[tuple[int, list[str]]],
    top: _Top,
    columns: _Columns,
    named: list[int],
    numbers: list[int],
    signs: DecimalSigns,
    changes: list[tuple[list[int], Callable[[str], str]]],
    notes: list[str],
) -> Iterator[tuple[int, list[str]]]:
    """Yield rows with decimal points, in i2t's units."""
    width, all_named, before = len(top.names), len(named) == len(top.names), signs.sign
    scaled = columns.where(lambda _, factor: factor != 1)
    for line, cells in rows:
        while len(cells) > width and not cells[-1].strip():
            cells.pop()
        if not all_named:
            cells = [cells[i] for i in named if i < len(cells)] + cells[width:]
        if top.delimiter != "," or signs.sign != "." or any("," in cell for cell in cells):
            for i in numbers:
                if i < len(cells):
                    cells[i] = signs.with_decimal_point(cells[i], line)
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
    """Convert a date or time of day to seconds; mark any other text."""
    seconds = stamp_in_seconds(text)
    return text + NO_TIME_MARK if seconds == text and text.strip() else seconds


def _is_decimal_time(cells: list[str]) -> bool:
    """Test whether all times have three decimals, because no program groups the thousands of whole seconds."""
    kinds = set(map(kind_of_number, cells))
    return len(cells) > 1 and len(kinds) == 1 and kinds.pop().startswith(AMBIGUOUS)


def _is_empty(cells: list[str]) -> bool:
    """Test whether all cells of a row are empty."""
    return not any(cell.strip(EMPTY_CELL_CHARACTERS) for cell in cells)


def _names_other_columns(words: list[str], names: list[str]) -> bool:
    """Test whether a line names columns: half of its words do, or there is a different name for each column."""
    words = [word.strip() for word in (re.split("[;\t|]", words[0]) if len(words) == 1 else words) if word.strip()]
    if len(words) < 2 or any(is_number(word.replace(",", ".")) for word in words):
        return False
    if 2 * sum(word in names or is_usable_column(word) for word in words) >= len(words):
        return True
    are_distinct = len(words) == len(set(words)) == len(names) > 2
    return are_distinct and all(re.fullmatch(r"[^\W\d][\w .()/\[\]-]*", word) for word in words)


def _read_top(lines: Iterator[str], texts: Sequence[str]) -> _Top:
    """Read up to the names of the columns.

    The names are on the first line that is not a comment. If that line holds only numbers, the names are in the comment
    before it, as `numpy.savetxt` writes them. Below titles, the names are on the first line with all of `texts`, or
    with two of i2t's columns.
    """
    before, comments, stated, comment, first = 0, 0, "", "", ""
    for line in lines:
        before += 1
        # Spreadsheets name the delimiter in a line of its own.
        if separator := re.fullmatch(r"sep=(\\t|.)", line.strip(' "\r'), re.IGNORECASE):
            stated = separator[1].replace("\\t", "\t")
        elif line.startswith(COMMENT_MARK):
            comments, comment = comments + 1, line
        elif line.strip(EMPTY_CELL_CHARACTERS + "".join(DELIMITERS) + '"'):
            first = line
            break
    sample = list(islice(lines, 64))  # these rows decide decimals, times and units
    if first.count('"') % 2 and sample and sample[0].count('"') % 2:  # a quoted name spans two lines
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
            return _Top(names, separated, before - 1, comments - 1, 0, [first, *sample])
    for titles, line in enumerate([first, *sample[:20]]):
        if is_numeric:
            break
        below = sample[titles:]
        names = parsed(line.lstrip("%" + COMMENT_MARK + " "), separated := delimiter_of(line, below))
        if all(name in names for name in texts) if texts else sum(map(is_usable_column, names)) > 1:
            sample = [*below, *islice(lines, titles)]
            return _Top(names, separated, before + titles, comments, titles, sample)
    return _Top(parsed(first.lstrip("% "), delimiter), delimiter, before, comments, 0, sample)


def _delimiter(names: str, rows: list[str]) -> str:
    """Choose the delimiter that gives the line of names and the first row equally many fields."""
    row = next((line for line in rows if line.strip() and not line.startswith(COMMENT_MARK)), "")
    counts = {sign: len(_fields(names, sign)) for sign in DELIMITERS}
    equal = [sign for sign, count in counts.items() if count > 1 and (not row or count == len(_fields(row, sign)))]
    several = [sign for sign, count in counts.items() if count > 1 and sign != " "]
    return next(iter([*equal, *several]), ",")


def _fields(line: str, delimiter: str) -> list[str]:
    """Split a line into fields; a quoted field may hold the delimiter."""
    if delimiter == " ":
        return line.split()
    return next(csv.reader([line], delimiter=delimiter), [])


def _notes_on(encoding: str, top: _Top) -> list[str]:
    """Describe the encoding and the lines before the first row, a sentence each."""
    notes = []
    if encoding != UTF_8:
        name = encoding.upper()
        if encoding == WINDOWS_1252:
            name = "Windows-1252 (cp1252): letters beyond ASCII in names may be wrong"
        notes.append(f"the text is not in UTF-8 and was read as {name}")
    if top.comments:
        notes.append(f"left out: {top.comments} lines of comments before the names of the columns")
    if top.titles:
        notes.append(f"left out: {top.titles} lines above the names of the columns")
    if nameless := top.names.count(""):
        notes.append(f"left out: {nameless} columns without a name")
    return notes


def _our_columns(stated: list[str], cells_of: list[list[str]], notes: list[str]) -> _Columns:
    """Find i2t's names and units of the columns, from the stated names and the non-empty cells of the first rows."""
    ours = _one_clock(stated, [library_name(name) for name in stated])
    header, factors = [name for name, _ in ours], [factor for _, factor in ours]
    bare = next((i for i, name in enumerate(stated) if normalised_name(name).lstrip("%") in TIME_NAMES), None)
    at = header.index(TIME_COLUMN) if TIME_COLUMN in header else bare
    stamps = False
    if at is not None:
        stamps, unit = _form_of_times(cells_of[at], has_unit=TIME_COLUMN in header)
        if TIME_COLUMN not in header and (stamps or unit is not None):
            header[at], factors[at] = TIME_COLUMN, 1.0 if stamps else float(unit or 1.0)
            size = "" if stamps else f" in units of {unit:g} s, by the size of its numbers"
            notes.append(f"column {stated[at]} holds the time{size}")
    if stamps and at is not None:
        factors[at] = 1.0
        understood = [cell for cell in cells_of[at] if stamp_in_seconds(cell) != cell]
        if not understood:
            notes.append(f"column {stated[at]} holds neither times in ISO 8601 nor seconds, but {cells_of[at][0]!r}")
        elif not has_time_zone(understood[0]):
            notes.append("assumed: times without a zone are in UTC, and times without a date are of one day")
    units = [name for name, own, factor in zip(stated, ours, factors, strict=True) if factor != 1 and own[1] != 1]
    if units:
        notes.append(f"columns {', '.join(units)} are in units other than mm, uT, N and s, and were converted to these")
    return _Columns(header, factors, stamps)


def _one_clock(stated: list[str], ours: list[tuple[str, float]]) -> list[tuple[str, float]]:
    """Choose one column as the time, `time_s` and the like before `timestamp_s`; the others keep their names."""
    times = [i for i, (name, _) in enumerate(ours) if name == TIME_COLUMN]
    others = [
        i for i in times if not normalised_name(stated[i]).startswith("time_") or "stamp" in normalised_name(stated[i])
    ]
    dropped = others if len(others) < len(times) else others[1:]
    return [(stated[i], 1.0) if i in dropped else own for i, own in enumerate(ours)]


def _form_of_times(cells: list[str], *, has_unit: bool) -> tuple[bool, float | None]:
    """Test whether most of the first times are dates or times of day; if not, find the unit of Unix times in a column
    that states none, in s, or None.
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
    step = 86400 * np.median(np.abs(np.diff(numbers))) if len(numbers) > 1 else 0.0  # s, if the numbers are days
    are_days = all(EXCEL_DAYS[0] <= number < EXCEL_DAYS[1] for number in numbers)
    return bool(0 < step < CLOCK.max_step_s) and are_days, None


def _are_units(cells: list[str]) -> bool:
    """Test whether a line below the names holds units."""
    words = [_without_brackets(cell).lower().translate(MICRO_SIGNS) for cell in cells]
    unit_words = {"", "-", "1", "#"} | {
        word for ours, others in UNIT_FACTORS.values() for word in (ours.lower(), *others)
    }
    return any(words) and unit_words.issuperset(words) and not any(map(is_number, words))


def _with_unit(path: Path, name: str, unit: str = "") -> str:
    """Append the unit below a column's name if only both together are understood; DataError if the name states another
    unit.
    """
    plain = _without_brackets(unit)
    if is_library_column(name):
        stem, _, own = normalised_name(name).rpartition("_")
        if plain and library_name(f"{stem}_{plain}") != library_name(name):
            raise DataError(f"{path}: column {name} has the unit {own} by its name and {plain} below it; correct one")
        return name
    with_unit = f"{name}_{plain}"
    return with_unit if is_library_column(with_unit) else name


def _without_brackets(unit: str) -> str:
    return re.sub(r"[\s\[\]()]", "", unit)


def _parsed(
    path: Path, lines: Iterable[str], delimiter: str, before: int = 0, *, strict: bool = True
) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the fields of each row that has any; `before` lines were read already."""
    if delimiter == " ":
        yield from ((before + k, line.split()) for k, line in enumerate(lines, 1) if line.strip())
        return
    reader = csv.reader(lines, delimiter=delimiter, strict=strict)
    try:
        for cells in reader:
            if cells:
                yield before + reader.line_num, cells
    except csv.Error as error:
        raise DataError(f"{path}: is not a comma-separated table ({error}); save it as CSV") from error


def _scaled(text: str, factor: float) -> str:
    """Convert a number to another unit; other text is returned unchanged and checked later."""
    number = parse_number(text)
    return text if number is None else repr(factor * number)
