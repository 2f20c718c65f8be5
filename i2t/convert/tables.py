"""Tables as labs write them: a line of column names, then a row for each reading or press.

What programs and people vary without changing the meaning is undone here, and said: fields between semicolons or tabs
with decimal commas, lines of comments before the names, columns without a name (a row's number), small and large
letters, units in brackets, and units other than mm, uT, N and s. What the columns mean is for `i2t.convert.presses`,
which refuses what is damaged, and `i2t.calibration.recordings`, which keeps what can be kept.
"""

import csv
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from i2t.convert.common import ConversionLog, data_error, read_text
from i2t.errors import DataError
from i2t.files import read_lines

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
    table = _table(path, iter(read_text(path).splitlines()))
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
    return _table(path, _lines(path), as_named)


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
    if len(set(header)) != len(header):
        raise DataError(f"{path}: a column name stands twice in the first line; rename one")
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
            notes.skip_row(DataError(f"{path}: line {number} has not {len(header)} fields; give one for each column"))
    at = [header.index(name) for name in columns]
    numbers = _numbers([[cells[i] for i in at] for _, cells in complete], len(at))
    wrong = (np.abs(numbers) >= MAX_TABLE_VALUE) & (np.array(columns) != TIME)  # Unix time is larger than all else
    wrong |= np.isinf(numbers) | (np.isnan(numbers) & needed(np.isnan(numbers)))
    for k in np.flatnonzero(wrong.any(1)):
        (line, cells), j = complete[k], int(np.flatnonzero(wrong[k])[0])
        said = f"line {line} has {cells[at[j]]!r} in column {columns[j]}, which is no such number"
        notes.skip_row(DataError(f"{path}: {said}; correct it"))
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


def _lines(path: Path) -> Iterator[str]:
    try:
        yield from read_lines(path)
    except OSError as error:
        raise data_error(path, f"cannot be read ({error.strerror or error})") from error


def _table(path: Path, lines: Iterator[str], as_named: bool = False) -> TableRows:
    """Names of the columns, the rows in our words and units, and what was undone."""
    before, comments, first = 0, 0, ""
    for first in lines:
        if first.strip() and not first.startswith("#"):
            break
        comments, before, first = comments + first.startswith("#"), before + 1, ""
    delimiter = next((each for each in (";", "\t") if each in first and "," not in first), ",")
    numbered = _parsed(path, chain([first] if first else [], lines), delimiter, before)
    stated, notes = [name.strip() for name in next(numbered, (0, []))[1]], []
    if comments:
        notes.append(f"left out: {comments} lines of comments before the names of the columns")
    if delimiter != ",":
        notes.append(f"fields are separated by {'semicolons' if delimiter == ';' else 'tabs'}, and commas are decimal")
    nameless = {i for i, name in enumerate(stated) if not name}
    if nameless:
        notes.append(f"left out: {len(nameless)} columns without a name")
    named = [name for name in stated if name]
    ours = [(name, 1.0) if as_named else _in_our_words(name) for name in named]
    header, factors = zip(*ours, strict=True) if named else ((), ())
    others = any(factor != 1 for factor in factors)
    if others:
        units = ", ".join(name for name, factor in zip(named, factors, strict=True) if factor != 1)
        notes.append(f"columns {units} are in other units than mm, uT, N and s, and were turned into these")

    def undone() -> Iterator[tuple[int, list[str]]]:
        for number, cells in numbered:
            if delimiter != ",":
                cells = [_with_point(text) for text in cells]
            if nameless:
                cells = [text for i, text in enumerate(cells) if i not in nameless]
            if others:
                beyond = cells[len(factors) :]
                cells = [*(_scaled(text, by) for text, by in zip(cells, factors, strict=False)), *beyond]
            yield number, cells

    return TableRows(list(header), undone(), notes)


def _parsed(path: Path, lines: Iterable[str], delimiter: str, before: int) -> Iterator[tuple[int, list[str]]]:
    """Fields of each row that has any, and the number of its line, of which `before` were read already."""
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    try:
        for cells in reader:
            if cells:
                yield before + reader.line_num, cells
    except csv.Error as error:
        raise DataError(f"{path}: is no comma-separated table ({error}); save it as CSV") from error


def _in_our_words(name: str) -> tuple[str, float]:
    """A column's name here, and the factor by which its numbers grow."""
    plain = re.sub(r"[\s_]*[\[(]\s*([^\])]*?)\s*[\])]$", r"_\1", name)
    plain = plain.replace("\u00b5", "u").replace("\u03bc", "u").replace(" ", "_").lower()
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


def _with_point(text: str) -> str:
    """A number with a decimal point in place of a comma."""
    return text.replace(",", ".") if re.fullmatch(r"\s*[-+]?[0-9]*,[0-9]+([eE][-+]?[0-9]+)?\s*", text) else text


def _scaled(text: str, factor: float) -> str:
    """A number in another unit; what is no number stays, and is judged later."""
    return repr(factor * float(text)) if factor != 1 and _is_number(text) else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
