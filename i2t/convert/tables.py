"""Tables as labs write them: a line of column names, then a row for each reading or press.

What programs and people vary without changing the meaning is undone here, and said: fields between semicolons or tabs
with decimal commas, lines of comments before the names, columns without a name (a row's number), small and large
letters, units in brackets, and units other than mm, uT, N and s. What the columns mean is for `i2t.convert.presses`,
which refuses what is damaged, and `i2t.calibration.recordings`, which keeps what can be kept.
"""

import csv
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from i2t.convert.clocks import stamp_in_seconds, states_zone, unix_unit
from i2t.convert.common import ConversionLog, data_error
from i2t.errors import DataError
from i2t.files import UTF_8, WINDOWS_1252, encoding_of_file, read_lines

FIELD_STEM = re.compile("[ab][0-9]+[xyz]")  # of a chip's value, or of its ambient field
FIELD_COLUMN = re.compile("b[0-9]+[xyz]_uT")  # of a chip's value, in our words
QUANTITY_OF = {
    **dict.fromkeys(("x", "y", "z", "height", "depth"), "length"),
    **dict.fromkeys(("force", "shear", "shear_x", "shear_y"), "force"),
    "time": "time",
}  # by a column's name without its unit
UNITS: dict[str, tuple[str, dict[str, float]]] = {  # of each quantity: ours, and others with their factors
    "length": ("mm", {"m": 1e3, "cm": 10.0, "um": 1e-3}),
    "field": ("uT", {"t": 1e6, "mt": 1e3, "nt": 1e-3, "g": 100.0}),
    "force": ("N", {"mn": 1e-3, "kn": 1e3, "g": 9.80665e-3, "kg": 9.80665}),
    "time": ("s", {"ms": 1e-3, "us": 1e-6, "min": 60.0}),
}
WORDS = {name: name for name in ("session", "pad", "contact", "slip")} | {"run": "session"}
HEIGHT_COLUMNS = ("z_mm", "height_mm")  # of the tip, in place of a depth
SHOWN_NAMES = 6  # of a table that is not understood
MAX_NAMED = 5  # columns that a sentence names
MAX_TABLE_VALUE = 1e9  # of any number, in its unit
TIME = "time_s"
NAME_COLUMNS = ("pad", "session")
SOURCE_COLUMN = "source"
TEXT_COLUMNS = (*NAME_COLUMNS, SOURCE_COLUMN)
STAMPS = ("time", "timestamp", "time_stamp", "datetime", "date_time", "stamp", "utc", "unix_time", "epoch")  # no unit
SAMPLE_ROWS = 64  # by which decimals, times and units are told
COMMENT_MARK, SPREADSHEET_ERROR = "#", re.compile("#(N/A|[A-Z0-9/]+[!?])")
SEPARATOR_LINE = re.compile("sep=(.)", re.IGNORECASE)  # with which spreadsheets name the delimiter
DELIMITERS = {";": "semicolons", "\t": "tabs", ",": "commas", "|": "vertical bars", " ": "spaces"}
DECIMAL = {sign: re.compile(rf"[-+]?[0-9]*[{sign}][0-9]+([eE][-+]?[0-9]+)?") for sign in ".,"}
GROUPED = {  # numbers that may have this sign between thousands
    ".": re.compile(r"[-+]?[1-9][0-9]{0,2}([.][0-9]{3})+(,[0-9]*)?"),
    ",": re.compile(r"[-+]?[1-9][0-9]{0,2}(,[0-9]{3})+([.][0-9]*)?"),
}
MAYBE_GROUPED = "?"  # behind such a number that cannot be read
UNIT_BRACKETS = re.compile(r"[\s\[\]()]")
UNIT_WORDS = {"-", "1", "#"} | {word for own, others in UNITS.values() for word in (own.lower(), *others)}
ENCODING_NAMES = {WINDOWS_1252: "Windows-1252 (cp1252)"}


class TextTable(NamedTuple):
    """A table's texts under the names and in the units of this package."""

    header: list[str]
    rows: list[tuple[int, list[str]]]  # number of the line in the file, and its fields, as many as there are
    notes: list[str]  # what was undone, a sentence each

    @property
    def beginning(self) -> str:
        """The first names, for a sentence that refuses the table."""
        return beginning_of(self.header)


class TableRows(NamedTuple):
    """A table as it is read: its rows come one after the other, once."""

    header: list[str]
    rows: Iterator[tuple[int, list[str]]]
    notes: list[str]


def read_text_table(path: Path) -> TextTable:
    """Read a table of any program.

    Args:
        path: of the file, plain or gzip-ed.

    Returns:
        The table.

    Raises:
        DataError: it cannot be read, or is no table.
    """
    table = _table(path)
    return TextTable(table.header, list(table.rows), table.notes)


def open_text_table(path: Path, *, as_named: bool = False) -> TableRows:
    """Begin to read a table that may be larger than memory.

    Args:
        path: of the file, plain or gzip-ed.
        as_named: leave names and units of columns as they are.

    Returns:
        The table, its rows as they are asked for, once.

    Raises:
        DataError: it cannot be read, or is no table; of a later row when that row is asked for.
    """
    return _table(path, as_named)


def field_columns(
    path: Path, header: list[str], chips: int, needed: Sequence[str], remedy: str = "name columns as in docs/data.md"
) -> list[str]:
    """Names of the columns of a board's values; a table without them, or with those of another board, is refused.

    Args:
        path: of the file, for messages.
        header: names of its columns.
        chips: of the board.
        needed: other columns that it must have.
        remedy: what to do where a column is missing.

    Returns:
        b0x_uT, b0y_uT, b0z_uT, b1x_uT ...

    Raises:
        DataError: a column is missing, stands twice, or is of no chip of the board.
    """
    values = [f"b{chip}{axis}_uT" for chip in range(chips) for axis in "xyz"]
    if missing := [name for name in (*needed, *values) if name not in header]:
        named = ", ".join(missing[:MAX_NAMED]) + (" ..." if len(missing) > MAX_NAMED else "")
        raise DataError(f"{path}: column {named} is missing ({beginning_of(header)}); {remedy}")
    if beyond := [name for name in header if FIELD_COLUMN.fullmatch(name) and name not in values]:
        raise DataError(
            f"{path}: column {', '.join(beyond)} is of no chip of the board, which has {chips}; name it with --board"
        )
    if twice := next((name for name in header if header.count(name) > 1), ""):
        raise DataError(f"{path}: a column name, {twice}, stands twice in the first line; rename one")
    return values


def sound_rows(
    path: Path,
    header: list[str],
    rows: Iterable[tuple[int, list[str]]],
    columns: Sequence[str],
    needed: Callable[[np.ndarray], np.ndarray],
    notes: ConversionLog,
) -> tuple[list[tuple[int, list[str]]], np.ndarray]:
    """Rows that hold plausible numbers, and the numbers; others are damage.

    Args:
        path: of the file, for messages.
        header: names of its columns.
        rows: lines and fields.
        columns: whose numbers are wanted.
        needed: says of a mask (n, columns) of fields that are empty which of these may not be.
        notes: that hear of damage.

    Returns:
        The rows that are left, and their numbers (n, columns), NaN where nothing stands.

    Raises:
        DataError: a row is damaged, and may not be left out.
    """
    complete = []
    for number, cells in rows:
        if len(cells) == len(header):
            complete.append((number, cells))
        else:
            remedy = "give one for each column"
            if 3 * len(cells) > 4 * len(header):  # a field in three or more is torn
                remedy = "if its numbers have decimal commas, export it with semicolons between fields"
            notes.skip_row(DataError(f"{path}: line {number} has not {len(header)} fields but {len(cells)}; {remedy}"))
    at = [header.index(name) for name in columns]
    numbers = _numbers([[cells[i] for i in at] for _, cells in complete], len(at))
    wrong = (np.abs(numbers) >= MAX_TABLE_VALUE) & (np.array(columns) != TIME)  # Unix time is larger than all else
    wrong |= np.isinf(numbers) | (np.isnan(numbers) & needed(np.isnan(numbers)))
    for k in np.flatnonzero(wrong.any(1)):
        (line, cells), j = complete[k], int(np.flatnonzero(wrong[k])[0])
        cell, problem = cells[at[j]], "which is no such number; correct it"
        if columns[j] == TIME and re.search("[0-9]:[0-9]", cell):
            problem = "which is no time in ISO 8601; write it as 2025-10-20 12:00:00.010, or in seconds"
        if cell.endswith(MAYBE_GROUPED):
            cell = cell.removesuffix(MAYBE_GROUPED)
            problem = "which may be decimal or grouped thousands; write all numbers with one decimal sign and no other"
        notes.skip_row(DataError(f"{path}: line {line} has {cell!r} in column {columns[j]}, {problem}"))
    sound = ~wrong.any(1)
    return [row for row, kept in zip(complete, sound, strict=True) if kept], numbers[sound]


def names_in(header: list[str], cells: list[str], kind: str) -> str:
    """The pad or session of a row.

    Args:
        header: names of the columns.
        cells: of the row.
        kind: of `NAME_COLUMNS`.

    Returns:
        Its name; the kind itself where it has none.
    """
    return (cells[header.index(kind)] if kind in header else "").strip() or kind


def beginning_of(header: list[str]) -> str:
    """The first names of a table, for a sentence that refuses it.

    Args:
        header: names of its columns.

    Returns:
        What its first line holds.
    """
    if not header:
        return "it holds no name of a column"
    if all(_is_number(name) for name in header):
        return "its first line holds numbers and no names"
    more = " ..." if len(header) > SHOWN_NAMES else ""
    return f"its first line names {', '.join(header[:SHOWN_NAMES])}{more}"


def _numbers(texts: list[list[str]], columns: int) -> np.ndarray:
    """(n, columns) numbers: NaN where nothing stands, infinite where no number does."""
    try:
        return np.array([[text or "nan" for text in row] for row in texts], float).reshape(-1, columns)
    except ValueError:
        return np.array([[_number(text) for text in row] for row in texts]).reshape(-1, columns)


def _number(text: str) -> float:
    try:
        return float(text) if text.strip() else np.nan
    except ValueError:
        return np.inf


def _lines(path: Path, encoding: str) -> Iterator[str]:
    try:
        yield from read_lines(path, encoding)
    except OSError as error:
        raise data_error(path, f"cannot be read ({error.strerror or error})") from error


class _Beginning(NamedTuple):
    """What stands before the first row of numbers, and how fields are separated."""

    names: list[str]  # of the columns, as stated
    delimiter: str  # a space stands for any number of them
    before: int  # lines up to the names
    comments: int  # of these
    sample: list[str]  # lines that follow and were read already


class _Columns(NamedTuple):
    """Names and units of the columns that have a name."""

    header: list[str]  # in our words
    factors: list[float]  # by which numbers grow
    stamps: bool  # times are dates, or times of day

    def where(self, wanted: Callable[[str, float], bool]) -> list[int]:
        """Columns whose name and factor are wanted."""
        return [i for i, both in enumerate(zip(self.header, self.factors, strict=True)) if wanted(*both)]


def _table(path: Path, as_named: bool = False) -> TableRows:
    """Names of the columns, the rows in our words and units, and what was undone."""
    try:
        encoding = encoding_of_file(path)
    except OSError as error:
        raise data_error(path, f"cannot be read ({error.strerror or error})") from error
    lines = _lines(path, encoding)
    begins = _beginning(lines)
    parts = [cells for _, cells in _parsed(path, begins.sample, begins.delimiter, strict=False)]
    has_units = bool(parts) and _are_units(parts[0])
    units, first = parts[0] if has_units else [], next(iter(parts[has_units:]), [])
    comma = _decimal_sign(parts, begins.delimiter) == ","
    notes = _notes_on(encoding, begins, comma=comma)
    kept = [i for i, name in enumerate(begins.names) if name]
    stated = [_with_unit(path, begins.names[i], *units[i : i + 1]) for i in kept]
    columns = _Columns(stated, [1.0] * len(stated), False)
    if not as_named:
        shown = [_with_point(first[i], comma=comma, quoted=False) if i < len(first) else "" for i in kept]
        columns = _our_columns(stated, shown, notes)
    if has_units:
        notes.append("units stand in the line below the names of the columns")
    numbered = _parsed(path, chain(begins.sample, lines), begins.delimiter, begins.before)
    rows = islice(_undone(numbered, begins, columns, kept, notes, comma=comma), int(has_units), None)
    return TableRows(columns.header, rows, notes)


def _undone(
    rows: Iterator[tuple[int, list[str]]],
    begins: _Beginning,
    columns: _Columns,
    kept: list[int],
    notes: list[str],
    *,
    comma: bool,
) -> Iterator[tuple[int, list[str]]]:
    """Rows with decimal points, in our units, without what is no row of numbers; the last notes come with their end."""
    width, all_named = len(begins.names), len(kept) == len(begins.names)
    numbers = columns.where(lambda name, _: name not in TEXT_COLUMNS and not (columns.stamps and name == TIME))
    others = columns.where(lambda _, factor: factor != 1)
    stamps = columns.where(lambda name, _: columns.stamps and name == TIME)
    with_point = partial(_with_point, comma=comma, quoted=begins.delimiter == ",")
    comments = repeats = 0
    for line, cells in rows:
        if cells[0].lstrip().startswith(COMMENT_MARK) and not SPREADSHEET_ERROR.fullmatch(cells[0].strip()):
            comments += 1
            continue
        if [cell.strip().removeprefix("\ufeff") for cell in cells[:width]] == begins.names:
            repeats += 1
            continue
        while len(cells) > width and not cells[-1].strip():
            cells.pop()
        if not all_named:
            cells = [cells[i] for i in kept if i < len(cells)] + cells[width:]
        changes: list[tuple[list[int], Callable[[str], str]]] = [(stamps, stamp_in_seconds)]
        if begins.delimiter != "," or any("," in cell for cell in cells):
            changes.append((numbers, with_point))
        for which, change in changes:
            for i in which:
                if i < len(cells):
                    cells[i] = change(cells[i])
        for i in others:
            if i < len(cells):
                cells[i] = _scaled(cells[i], columns.factors[i])
        yield line, cells
    counts = {"lines of comments between the rows": comments, "lines that repeat the names of the columns": repeats}
    notes += [f"left out: {count} {what}" for what, count in counts.items() if count]


def _beginning(lines: Iterator[str]) -> _Beginning:
    """Read up to the names of the columns: the first line that is no comment, or, where that holds numbers alone, the
    comment before it, as `numpy.savetxt` writes them.
    """
    before, comments, stated, comment, first = 0, 0, "", "", ""
    for line in lines:
        before += 1
        if separator := SEPARATOR_LINE.fullmatch(line.strip().strip('"')):
            stated = separator[1]
        elif line.startswith(COMMENT_MARK):
            comments, comment = comments + 1, line
        elif line.strip():
            first = line
            break
    sample = list(islice(lines, SAMPLE_ROWS))
    hidden = comment.lstrip(COMMENT_MARK + "% ")
    delimiter = stated or _delimiter(first, sample)
    if first.startswith("%"):  # as ROS and MATLAB begin the line of names
        first = first.lstrip("% ")
    elif hidden and all(_is_number(text.replace(",", ".")) for text in _fields(first, delimiter) if text.strip()):
        separated = stated or _delimiter(hidden, [first])
        if len(_fields(hidden, separated)) == len(_fields(first, separated)) > 1:
            return _Beginning(
                [name.strip() for name in _fields(hidden, separated)], separated, before - 1, comments - 1,
                [first, *sample],
            )  # fmt: skip
    return _Beginning([name.strip() for name in _fields(first, delimiter)], delimiter, before, comments, sample)


def _delimiter(names: str, rows: list[str]) -> str:
    """What separates the names of the columns, and the fields of the first row likewise."""
    row = next((line for line in rows if line.strip() and not line.startswith(COMMENT_MARK)), "")
    counts = {sign: len(_fields(names, sign)) for sign in DELIMITERS}
    alike = [sign for sign, count in counts.items() if count > 1 and (not row or count == len(_fields(row, sign)))]
    several = [sign for sign, count in counts.items() if count > 1 and sign != " "]
    return next(iter([*alike, *several]), ",")


def _fields(line: str, delimiter: str) -> list[str]:
    """The fields of one line, of which a quoted one may hold the delimiter."""
    if delimiter == " ":
        return line.split()
    return next(csv.reader([line], delimiter=delimiter), [])


def _decimal_sign(rows: list[list[str]], delimiter: str) -> str:
    """The sign before decimals: the one that more numbers have which cannot be grouped thousands."""
    texts = [text.strip() for cells in rows for text in cells]
    counts = {
        sign: sum(bool(DECIMAL[sign].fullmatch(text)) and not GROUPED[sign].fullmatch(text) for text in texts)
        for sign in ".,"
    }
    if delimiter != ",":  # whoever separates fields otherwise does so because numbers have commas
        counts[","] += sum(bool(GROUPED[","].fullmatch(text)) for text in texts)
    return "," if counts[","] > counts["."] else "."


def _notes_on(encoding: str, begins: _Beginning, *, comma: bool) -> list[str]:
    """What was undone before the first row."""
    notes = []
    if encoding != UTF_8:
        named = ENCODING_NAMES.get(encoding, encoding.upper())
        doubt = ": letters beyond ASCII in names may be wrong" if encoding == WINDOWS_1252 else ""
        notes.append(f"the text is not in UTF-8 and was read as {named}{doubt}")
    if begins.comments:
        notes.append(f"left out: {begins.comments} lines of comments before the names of the columns")
    if begins.delimiter != "," or comma:
        decimal = ", and commas are decimal" if comma else ""
        notes.append(f"fields are separated by {DELIMITERS[begins.delimiter]}{decimal}")
    if nameless := begins.names.count(""):
        notes.append(f"left out: {nameless} columns without a name")
    return notes


def _our_columns(stated: list[str], first: list[str], notes: list[str]) -> _Columns:
    """Columns in our words and units, by their names and the fields of the first row."""
    ours = [_in_our_words(name) for name in stated]
    header, factors = [name for name, _ in ours], [factor for _, factor in ours]
    stamped = next((i for i, name in enumerate(stated) if name.lower().lstrip("%").replace(" ", "_") in STAMPS), None)
    if TIME in header:
        at = header.index(TIME)
        stamps = stamp_in_seconds(first[at]) != first[at]
    elif stamped is not None:
        at, stamps = stamped, stamp_in_seconds(first[stamped]) != first[stamped]
        unit = unix_unit(float(first[at])) if _is_number(first[at]) else None
        if stamps or unit is not None:
            header[at], factors[at] = TIME, 1.0 if stamps else float(unit or 1.0)
            size = "" if stamps else f" in units of {unit:g} s, by the size of its numbers"
            notes.append(f"column {stated[at]} holds the time{size}")
    else:
        stamps = False
    if stamps:
        factors[header.index(TIME)] = 1.0
        if not states_zone(first[header.index(TIME)]):
            notes.append("assumed: times without a zone are in UTC, and times without a date are of one day")
    units = [name for name, own, factor in zip(stated, ours, factors, strict=True) if factor != 1 and own[1] != 1]
    if units:
        notes.append(f"columns {', '.join(units)} are in other units than mm, uT, N and s, and were turned into these")
    return _Columns(header, factors, stamps)


def _are_units(cells: list[str]) -> bool:
    """Test for a line of units below the names."""
    words = [UNIT_BRACKETS.sub("", cell).lower().replace("\u00b5", "u").replace("\u03bc", "u") for cell in cells]
    return any(words) and all(word in UNIT_WORDS or not word for word in words) and not any(map(_is_number, words))


def _with_unit(path: Path, name: str, unit: str = "") -> str:
    """A column's name with the unit that stands below it, where it makes the name one that is understood; DataError
    where the name has another unit.
    """
    plain = UNIT_BRACKETS.sub("", unit)
    if _is_ours(name):
        stem, _, own = _plain_name(name).rpartition("_")
        if plain and _in_our_words(f"{stem}_{plain}") != _in_our_words(name):
            raise DataError(f"{path}: column {name} has the unit {own} by its name and {plain} below it; correct one")
        return name
    both = f"{name}_{plain}"
    return both if _is_ours(both) else name


def _is_ours(name: str) -> bool:
    """Test for the name of a quantity with its unit."""
    stem, _, unit = _in_our_words(name)[0].rpartition("_")
    quantity = "field" if FIELD_STEM.fullmatch(stem) else QUANTITY_OF.get(stem)
    return quantity is not None and unit == UNITS[quantity][0]


def _parsed(
    path: Path, lines: Iterable[str], delimiter: str, before: int = 0, *, strict: bool = True
) -> Iterator[tuple[int, list[str]]]:
    """Fields of each row that has any, and the number of its line, of which `before` were read already."""
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


def _plain_name(name: str) -> str:
    """A column's name in small letters, with its unit after a line: x_mm for X [mm]."""
    plain = re.sub(r"[\s_]*[\[(]\s*([^\])]*?)\s*[\])]$", r"_\1", name)
    return plain.replace("\u00b5", "u").replace("\u03bc", "u").replace(" ", "_").lower()


def _in_our_words(name: str) -> tuple[str, float]:
    """A column's name here, and the factor by which its numbers grow."""
    plain = _plain_name(name)
    if plain in WORDS:
        return WORDS[plain], 1.0
    stem, _, unit = plain.rpartition("_")
    quantity = "field" if FIELD_STEM.fullmatch(stem) else QUANTITY_OF.get(stem)
    if quantity is None:
        return name, 1.0
    ours, others = UNITS[quantity]
    if unit == ours.lower():
        return f"{stem}_{ours}", 1.0
    return (f"{stem}_{ours}", others[unit]) if unit in others else (name, 1.0)


def _with_point(text: str, *, comma: bool, quoted: bool) -> str:
    """A number with a decimal point; marked where a point among decimal commas, or a comma among decimal points, may
    group thousands.
    """
    plain = text.strip()
    if GROUPED["." if comma else ","].fullmatch(plain):
        return plain + MAYBE_GROUPED
    if "," in plain and (comma or not quoted) and DECIMAL[","].fullmatch(plain):
        return plain.replace(",", ".")
    return text


def _scaled(text: str, factor: float) -> str:
    """A number in another unit; what is no number stays, and is judged later."""
    return repr(factor * float(text)) if factor != 1 and _is_number(text) else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
