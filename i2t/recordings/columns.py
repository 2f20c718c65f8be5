"""Columns of tables: the names, quantities and units that every reader of recordings understands.

A column is named by its stem and our unit: x_mm, force_N, b0x_uT. Other spellings and units of the same stems become
these.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from i2t.errors import DataError
from i2t.recordings.cells import parse_number

NEWTONS_PER_GRAM = 9.80665e-3  # weight of a gram
UNITS: dict[str, tuple[str, dict[str, float]]] = {  # our unit of each quantity, and other units with their factors
    "length": ("mm", {"m": 1e3, "cm": 10.0, "um": 1e-3}),
    "field": ("uT", {"t": 1e6, "mt": 1e3, "nt": 1e-3, "g": 100.0, "gauss": 100.0}),
    "force": ("N", {"mn": 1e-3, "kn": 1e3, "g": NEWTONS_PER_GRAM, "kg": 9.80665}),
    "time": ("s", {"sec": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}),
}
LIBRARY_UNITS = {"mm": 1e-3}  # factors from our units of tables to those of the library, where they differ
# Columns of each target of a recording; those of one target stand next to each other.
TARGET_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "position": ("x_mm", "y_mm"),
    "depth": ("depth_mm",),
    "force": ("force_N",),
    "shear": ("shear_x_N", "shear_y_N", "shear_N"),
    "contact": ("contact",),
    "slip": ("slip",),
}
PLACES = (*TARGET_COLUMNS["position"], *TARGET_COLUMNS["depth"])
HEIGHT_COLUMNS = ("z_mm", "height_mm")  # height of the tip, in place of a depth
FORCE, TIME, SOURCE_COLUMN = "force_N", "time_s", "source"
NAME_COLUMNS = ("pad", "session")
TEXT_COLUMNS = (*NAME_COLUMNS, SOURCE_COLUMN)
FIELD_STEM = re.compile("[ab][0-9]+[xyz]")  # column of a chip's value or ambient field, without its unit
FIELD_COLUMN = re.compile("b([0-9]+)[xyz]_uT")  # column of a chip's value under our name
QUANTITY_OF_UNIT = {ours: quantity for quantity, (ours, _) in UNITS.items()}
QUANTITY_OF = {  # quantity of a column by its name without the unit
    name.rpartition("_")[0]: QUANTITY_OF_UNIT[name.rpartition("_")[2]]
    for name in (*sum(TARGET_COLUMNS.values(), ()), *HEIGHT_COLUMNS, TIME)
    if "_" in name
}
WORDS = {name: name for name in (*NAME_COLUMNS, "contact", "slip")} | {"run": "session"}
STAMPS = ("time", "timestamp", "time_stamp", "datetime", "date_time", "stamp", "utc", "unix_time", "epoch")  # no unit
UNIT_WORDS = {"-", "1", "#"} | {word for own, others in UNITS.values() for word in (own.lower(), *others)}
MICRO_SIGNS = str.maketrans(dict.fromkeys("\u00b5\u03bc\u00e6", "u"))  # the last is that of cp850, read as cp1252
MAX_SHOWN = 60  # letters that a message shows of a single name
SHOWN_NAMES = 6  # names that a message shows of a first line
MAX_NAMED = 5  # missing columns that a message names


def value_columns(chips: Iterable[int]) -> list[str]:
    """Name the columns of chips' values.

    Args:
        chips: Their numbers.

    Returns:
        The names b0x_uT, b0y_uT, b0z_uT, b1x_uT ...
    """
    return [f"b{chip}{axis}_uT" for chip in chips for axis in "xyz"]


def ambient_columns(values: Iterable[str]) -> list[str]:
    """Name the columns of the ambient field that belongs to values.

    Args:
        values: Their columns.

    Returns:
        The names a0x_uT ...
    """
    return ["a" + name[1:] for name in values]


def library_factor(name: str) -> float:
    """Factor from the unit of a column to the library's.

    Args:
        name: Of a column under our name.

    Returns:
        1e-3 for a length, as the library has metres; else 1.
    """
    return LIBRARY_UNITS.get(name.rpartition("_")[2], 1.0)


def field_columns(
    path: Path, header: list[str], chips: int, needed: Sequence[str], remedy: str = "name columns as in docs/data.md"
) -> list[str]:
    """Name the columns of a board's values, and refuse a table without them or with those of more chips.

    Args:
        path: The file, for messages.
        header: Names of its columns.
        chips: Number of chips of the board.
        needed: Other columns that the table must have.
        remedy: What the user is to do where a column is missing.

    Returns:
        The names b0x_uT, b0y_uT, b0z_uT, b1x_uT ...

    Raises:
        DataError: A column is missing, stands twice, or belongs to a chip that the board lacks.
    """
    values = value_columns(range(chips))
    if missing := [name for name in (*needed, *values) if name not in header]:
        named = ", ".join(missing[:MAX_NAMED]) + (" ..." if len(missing) > MAX_NAMED else "")
        raise DataError(f"{path}: column {named} is missing ({beginning_of(header)}); {remedy}")
    if beyond := [name for name in header if FIELD_COLUMN.fullmatch(name) and name not in values]:
        raise DataError(
            f"{path}: column {', '.join(beyond)} is of no chip of the board, which has {chips}; name it with --board"
        )
    if twice := next((name for name in header if header.count(name) > 1 and is_read(name)), ""):
        raise DataError(f"{path}: a column name, {twice}, stands twice in the first line; rename one")
    return values


def beginning_of(header: list[str]) -> str:
    """Describe the first line of a table, for a sentence that refuses it.

    Args:
        header: Names of its columns.

    Returns:
        Half a sentence on what its first line holds.
    """
    if not header:
        return "it holds no name of a column"
    if all(is_number(name) for name in header):
        return "its first line holds numbers and no names"
    if len(header) == 1:
        return f"its first line holds {header[0][:MAX_SHOWN]!r} alone: delete lines above the names"
    more = " ..." if len(header) > SHOWN_NAMES else ""
    return f"its first line names {', '.join(header[:SHOWN_NAMES])}{more}"


def is_ours(name: str) -> bool:
    """Test for the name of a quantity with its unit.

    Args:
        name: Of a column, as stated.

    Returns:
        Whether it is, under our name or another.
    """
    stem, _, unit = our_name(name)[0].rpartition("_")
    quantity = "field" if FIELD_STEM.fullmatch(stem) else QUANTITY_OF.get(stem)
    return quantity is not None and unit == UNITS[quantity][0]


def is_read(name: str) -> bool:
    """Test for a column that some reader of tables looks at.

    Args:
        name: Of a column.

    Returns:
        Whether it is read.
    """
    return is_ours(name) or name in WORDS.values() or name in TEXT_COLUMNS


def is_field_or_ours(name: str) -> bool:
    """Test for the name of a column that is read, with or without its unit.

    Args:
        name: Of a column, as stated.

    Returns:
        Whether it is.
    """
    return is_read(name) or FIELD_STEM.fullmatch(plain_name(name)) is not None


def plain_name(name: str) -> str:
    """A column's name in small letters, with its unit after an underscore: x_mm for X [mm] or x/mm.

    Args:
        name: As stated.

    Returns:
        The plain name.
    """
    plain = re.sub(r"[\s_]*[\[(]\s*([^\])]*?)\s*[\])]$", r"_\1", name)
    plain = re.sub(r"\s*/\s*([^\s/]+)$", r"_\1", plain)
    return plain.translate(MICRO_SIGNS).replace(" ", "_").lower()


def our_name(name: str) -> tuple[str, float]:
    """Our name of a column.

    Args:
        name: As stated.

    Returns:
        Our name, or the stated one if the column has no meaning here; and the factor from its unit to ours.
    """
    plain = plain_name(name)
    if plain in WORDS:
        return WORDS[plain], 1.0
    stem, _, unit = plain.lstrip("%").rpartition("_")
    stem = "time" if stem in STAMPS else stem
    quantity = "field" if FIELD_STEM.fullmatch(stem) else QUANTITY_OF.get(stem)
    if quantity is None:
        return name, 1.0
    ours, others = UNITS[quantity]
    if unit == ours.lower():
        return f"{stem}_{ours}", 1.0
    return (f"{stem}_{ours}", others[unit]) if unit in others else (name, 1.0)


def is_number(text: str) -> bool:
    """Test for the text of a number.

    Args:
        text: Any text.

    Returns:
        Whether it is one, infinite and NaN among them.
    """
    return parse_number(text) is not None
