"""Columns of tables: the names, quantities and units that all readers of recordings understand.

A column is named by its stem and i2t's unit, such as x_mm, force_N or b0x_uT. Other spellings and units of the same
stems are converted to these.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from i2t.errors import DataError
from i2t.recordings.cells import parse_number

NEWTONS_PER_GRAM = 9.80665e-3  # N, weight of one gram under standard gravity
# i2t's unit of each quantity in tables, and the factors that convert other units to it.
UNIT_FACTORS: dict[str, tuple[str, dict[str, float]]] = {
    "length": ("mm", {"m": 1e3, "cm": 10.0, "um": 1e-3}),
    "field": ("uT", {"t": 1e6, "mt": 1e3, "nt": 1e-3, "g": 100.0, "gauss": 100.0}),
    "force": ("N", {"mn": 1e-3, "kn": 1e3, "g": NEWTONS_PER_GRAM, "kg": 9.80665}),
    "time": ("s", {"sec": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}),
}
# Table columns of each target that a head can predict, in their order.
TARGET_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "position": ("x_mm", "y_mm"),
    "travel": ("travel_mm",),
    "force": ("force_N",),
    "shear": ("shear_x_N", "shear_y_N", "shear_N"),
    "contact": ("contact",),
    "slip": ("slip",),
}
# table columns of the position and the travel of a press
PLACE_COLUMNS = (*TARGET_COLUMNS["position"], *TARGET_COLUMNS["travel"])
HEIGHT_COLUMNS = ("z_mm", "height_mm")  # table columns that hold the height of the tip instead of a travel
# table columns of the force, the time and the source (real or simulated)
FORCE_COLUMN, TIME_COLUMN, SOURCE_COLUMN = "force_N", "time_s", "source"
NAME_COLUMNS = ("pad", "session")  # table columns that hold names
TEXT_COLUMNS = (*NAME_COLUMNS, SOURCE_COLUMN)  # table columns that hold texts instead of numbers
UNITLESS_COLUMNS = (*NAME_COLUMNS, "contact", "slip")  # table columns whose names state no unit
FIELD_STEM = re.compile("[ab][0-9]+[xyz]")  # column name, without its unit, of a chip's value (b) or ambient field (a)
FIELD_COLUMN = re.compile("b([0-9]+)[xyz]_uT")  # column name of a chip's value
# Quantity of a table column, a key of `UNIT_FACTORS`, by the column's name without its unit.
QUANTITY_OF_STEM = {"time": "time"}
QUANTITY_OF_STEM |= dict.fromkeys(("x", "y", "z", "travel", "height"), "length")
QUANTITY_OF_STEM |= dict.fromkeys(("force", "shear", "shear_x", "shear_y"), "force")
# Names of a time column without a unit.
TIME_NAMES = ("time", "timestamp", "time_stamp", "datetime", "date_time", "stamp", "utc", "unix_time", "epoch")
# Signs for micro, which are read as u. The last is the micro sign of cp850, read as cp1252.
MICRO_SIGNS = str.maketrans(dict.fromkeys("\u00b5\u03bc\u00e6", "u"))


def value_columns(chips: Iterable[int]) -> list[str]:
    """Name the columns of chips' values.

    Args:
        chips: Numbers of the chips.

    Returns:
        The names b0x_uT, b0y_uT, b0z_uT, b1x_uT ..., three for each chip.
    """
    return [f"b{chip}{axis}_uT" for chip in chips for axis in "xyz"]


def ambient_columns(values: Iterable[str]) -> list[str]:
    """Name the columns of the ambient field that belongs to values.

    Args:
        values: Names of the values' columns.

    Returns:
        The names a0x_uT ..., in the order of the values.
    """
    return ["a" + name[1:] for name in values]


def library_factor(name: str) -> float:
    """Look up the factor from the unit of a column to the unit that the library uses.

    Args:
        name: Name of the column as i2t writes it, ending in its unit.

    Returns:
        1e-3 for a length, because the library uses metres; else 1.
    """
    return 1e-3 if name.endswith("_mm") else 1.0


def field_columns(
    path: Path,
    header: list[str],
    chips: int,
    needed: Sequence[str],
    remedy: str = "name columns as in docs/data.md",
    *,
    stated: Sequence[str] = (),
) -> list[str]:
    """Name the columns of a board's values, after checking that a table has exactly those of its chips.

    Args:
        path: Path of the table, for messages.
        header: Names of its columns.
        chips: Number of chips of the board.
        needed: Names of other columns that the table must have.
        remedy: Advice on a missing column.
        stated: Names of the columns as the file spells them, for messages; by default, those of `header`.

    Returns:
        The names b0x_uT, b0y_uT, b0z_uT, b1x_uT ..., three for each chip.

    Raises:
        DataError: A column is missing, appears twice, or belongs to a chip that the board lacks.
    """
    values = value_columns(range(chips))
    if missing := [name for name in (*needed, *values) if name not in header]:
        names = ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
        raise DataError(f"{path}: column {names} is missing ({describe_header(list(stated or header))}); {remedy}")
    if beyond := [name for name in header if FIELD_COLUMN.fullmatch(name) and name not in values]:
        raise DataError(
            f"{path}: column {', '.join(beyond)} belongs to no chip of the board, which has {chips}; name the right "
            "board with --board"
        )
    if twice := next((name for name in header if header.count(name) > 1 and is_used_column(name)), ""):
        raise DataError(
            f"{path}: {twice} appears twice in the first line, under this name or another for the same quantity; "
            "rename one column"
        )
    return values


def describe_header(header: list[str]) -> str:
    """Describe the first line of a table, for a message that refuses the table.

    Args:
        header: Names of its columns.

    Returns:
        A clause on the contents of the first line.
    """
    if not header:
        return "it holds no name of a column"
    if all(is_number(name) for name in header):
        return "its first line holds numbers and no names"
    if len(header) == 1:
        return f"its first line holds only {header[0][:60]!r}: delete lines above the names"
    more = " ..." if len(header) > 6 else ""
    return f"its first line names {', '.join(header[:6])}{more}"


def notes_on_depth(header: Sequence[str], stated: Sequence[str]) -> list[str]:
    """Note the column of travel that the file calls a depth.

    Args:
        header: Names of the columns as i2t writes them.
        stated: Names of the same columns as the file spells them.

    Returns:
        A clause for each column.
    """
    pairs = zip(header, stated, strict=False)
    return [f"{own} is read as travel" for name, own in pairs if name == "travel_mm" and "depth" in own.lower()]


def is_library_column(name: str) -> bool:
    """Test whether a column's name is that of a quantity with its unit that i2t reads.

    Args:
        name: Name of a column as spelt in the table's header.

    Returns:
        True for i2t's name of the quantity and for other spellings and units.
    """
    stem, _, unit = library_name(name)[0].rpartition("_")
    quantity = _quantity_of(stem)
    return quantity is not None and unit == UNIT_FACTORS[quantity][0]


def is_used_column(name: str) -> bool:
    """Test whether some reader of tables uses a column.

    Args:
        name: Name of the column as spelt in the table's header, or as `library_name` converts it.

    Returns:
        True if the column is used.
    """
    return is_library_column(name) or name in UNITLESS_COLUMNS or name in TEXT_COLUMNS


def is_usable_column(name: str) -> bool:
    """Test whether some reader of tables uses a column, or would with a unit in the name of a chip's value.

    Args:
        name: Name of the column as spelt in the table's header.

    Returns:
        True if the column is used, with or without a unit.
    """
    return is_used_column(name) or FIELD_STEM.fullmatch(normalised_name(name)) is not None


def normalised_name(name: str) -> str:
    """Write a column's name in lower case, with its unit after an underscore: x_mm for X [mm] or x/mm.

    Args:
        name: Name of the column as spelt in the table's header.

    Returns:
        The name in lower case without spaces or brackets.
    """
    plain = re.sub(r"[\s_]*[\[(]\s*([^\])]*?)\s*[\])]$", r"_\1", name)
    plain = re.sub(r"\s*/\s*([^\s/]+)$", r"_\1", plain)
    return plain.translate(MICRO_SIGNS).replace(" ", "_").lower()


def library_name(name: str) -> tuple[str, float]:
    """Find i2t's name of a column, and the factor from its unit to i2t's.

    Args:
        name: Name of the column as spelt in the table's header.

    Returns:
        i2t's name and the factor; the given name and 1 if i2t does not read the column.
    """
    plain = normalised_name(name)
    if plain == "run":
        return "session", 1.0
    if plain in UNITLESS_COLUMNS:
        return plain, 1.0
    stem, _, unit = plain.lstrip("%").rpartition("_")
    stem = "time" if stem in TIME_NAMES else {"depth": "travel"}.get(stem, stem)
    quantity = _quantity_of(stem)
    if quantity is None:
        return name, 1.0
    ours, others = UNIT_FACTORS[quantity]
    if unit == ours.lower():
        return f"{stem}_{ours}", 1.0
    return (f"{stem}_{ours}", others[unit]) if unit in others else (name, 1.0)


def _quantity_of(stem: str) -> str | None:
    return "field" if FIELD_STEM.fullmatch(stem) else QUANTITY_OF_STEM.get(stem)


def is_number(text: str) -> bool:
    """Test whether a text is a number.

    Args:
        text: Any text.

    Returns:
        True for a number, including infinity and NaN.
    """
    return parse_number(text) is not None
