"""Tables as labs write them: a line of column names, then a row for each reading or press.

What programs and people vary without changing the meaning is undone here, and said: fields between semicolons or tabs
with decimal commas, lines of comments before the names, columns without a name (a row's number), small and large
letters, units in brackets, and units other than mm, uT, N and s. What the columns mean is for `i2t.convert.presses`,
which refuses what is damaged, and `i2t.calibration.heads`, which keeps what can be kept.
"""

import csv
import re
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from i2t.convert.common import data_error, read_text
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


class TextTable(NamedTuple):
    """A table's texts under the names and in the units of this package."""

    header: list[str]
    rows: list[tuple[int, list[str]]]  # number of the line in the file, and its fields, as many as there are
    notes: list[str]  # what was undone, a sentence each

    @property
    def beginning(self) -> str:
        """The first names, for a sentence that refuses the table."""
        if not self.header:
            return "it holds no name of a column"
        if all(_is_number(name) for name in self.header):
            return "its first line holds numbers and no names"
        more = " ..." if len(self.header) > SHOWN_NAMES else ""
        return f"its first line names {', '.join(self.header[:SHOWN_NAMES])}{more}"


class TableRows(NamedTuple):
    """A table as it is read: what its first line says, and then one row after the other."""

    header: list[str]
    rows: Iterator[tuple[int, list[str]]]  # number of the line in the file, and its fields, as many as there are
    notes: list[str]  # what is undone, a sentence each


def read_text_table(path: Path) -> TextTable:
    """Read a table of any program.

    Args:
        path: of the file, plain or gzip-ed.

    Returns:
        The table.

    Raises:
        DataError: it cannot be read, or is no table.
    """
    header, rows, notes = _table(path, iter(read_text(path).splitlines()))
    return TextTable(header, list(rows), notes)


def open_text_table(path: Path) -> TableRows:
    """Begin to read a table that may be larger than memory.

    Args:
        path: of the file, plain or gzip-ed.

    Returns:
        Its columns, and its rows as they are asked for.

    Raises:
        DataError: it cannot be read, or is no table; of a later row when that row is asked for.
    """
    return TableRows(*_table(path, _lines(path)))


def _lines(path: Path) -> Iterator[str]:
    try:
        yield from read_lines(path)
    except OSError as error:
        raise data_error(path, f"cannot be read ({error.strerror or error})") from error


def _table(path: Path, lines: Iterator[str]) -> tuple[list[str], Iterator[tuple[int, list[str]]], list[str]]:
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
    header, factors = zip(*map(_in_our_words, named), strict=True) if named else ((), ())
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

    return list(header), undone(), notes


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
