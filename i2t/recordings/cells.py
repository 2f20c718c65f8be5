"""Numbers in the cells of a table: decimal points, decimal commas, and the same signs between thousands.

1.234 is a little more than one, or one thousand two hundred and thirty-four. Other numbers of the table decide: those
with one, two, four or more decimals, or with a zero before the sign, have only one reading. If there are none, or as
many of either kind, such a cell is marked and does not count as a number.
"""

import re
from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from pathlib import Path

from i2t.errors import DataError

# Patterns of numbers with a decimal point or comma, by this sign.
DECIMAL = {sign: re.compile(rf"[-+]?[0-9]*[{sign}][0-9]+([eE][-+]?[0-9]+)?") for sign in ".,"}
# Patterns of numbers that may have this sign between thousands.
GROUPED = {
    ".": re.compile(r"[-+]?[1-9][0-9]{0,2}([.][0-9]{3})+(,[0-9]*)?"),
    ",": re.compile(r"[-+]?[1-9][0-9]{0,2}(,[0-9]{3})+([.][0-9]*)?"),
}
SIGN_NAMES = {".": "points", ",": "commas"}  # names of the signs in messages
# kinds of numbers in text: without a sign; with a sign, which is appended, that may be decimal or group thousands
WHOLE, AMBIGUOUS = "whole", "maybe "
# Marks appended to a cell that must not be read as a number: one whose sign may group thousands, and one in a time
# column that is neither a date nor a time of day. No text contains these two code points.
GROUPED_MARK, NO_TIME_MARK = "\ufffe", "\uffff"


def parse_number(text: str) -> float | None:
    """Parse a text as a number.

    Args:
        text: Any text. Unlike in Python, a number has no underscores between digits.

    Returns:
        The number, which may be infinite or NaN; None if the text is not a number.
    """
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def strip_marks(cell: str) -> str:
    """Remove from a cell the marks that keep it from being read as a number.

    Args:
        cell: Text of a cell, with or without a mark (`GROUPED_MARK`, `NO_TIME_MARK`) at its end.

    Returns:
        The text as it stands in the file.
    """
    return cell.rstrip(GROUPED_MARK + NO_TIME_MARK)


def kind_of_number(text: str) -> str:
    """Classify a number by what it shows about a table's decimal sign (point or comma).

    Args:
        text: The text of a cell.

    Returns:
        "." or "," if the number shows that this sign is decimal; `AMBIGUOUS` and the sign if it may be decimal or group
        thousands; `WHOLE` for a number without a sign; "" for a text that is not a number.
    """
    plain = text.strip()
    if plain.lstrip("+-").isdigit():
        return WHOLE
    for sign in ".,":
        if sign in plain and DECIMAL[sign].fullmatch(plain):
            return AMBIGUOUS + sign if GROUPED[sign].fullmatch(plain) else sign
    return next((decimal for decimal, grouping in (",.", ".,") if GROUPED[grouping].fullmatch(plain)), "")


def count_kinds(rows: Iterable[Sequence[str]], columns: Sequence[int], counters: Container[int] = ()) -> Counter[str]:
    """Count the numbers of each kind in a table.

    Args:
        rows: The cells of each row.
        columns: Indices of the columns to look at.
        counters: Indices of columns whose whole numbers show nothing about decimals, because they count milliseconds.

    Returns:
        The number of cells of each kind of `kind_of_number`.
    """
    counts: Counter[str] = Counter()
    for cells in rows:
        for i in columns:
            if i < len(cells):
                kind = kind_of_number(cells[i])
                counts["" if kind == WHOLE and i in counters else kind] += 1
    return counts


def decimal_sign(counts: Counter[str], delimiter: str) -> str:
    """Decide from a table's numbers whether the point or the comma is the decimal sign.

    Args:
        counts: The number of cells of each kind of `kind_of_number`.
        delimiter: The character between fields.

    Returns:
        The sign that more numbers show to be decimal. If no number decides, the sign that every number has, because
        grouped numbers below a thousand would have none, or the point in a table separated by commas. Else "".
    """
    if counts["."] != counts[","]:
        return "." if counts["."] > counts[","] else ","
    signs = [sign for sign in ".," if counts[AMBIGUOUS + sign]]
    if not counts["."] and not counts[WHOLE] and len(signs) == 1:
        return signs[0]
    return "." if delimiter == "," and not counts[","] else ""


class DecimalSigns:
    """Reader of a table's numbers, row by row.

    The first rows decide the decimal sign. If they do not, or if a later number contradicts them, the numbers of all
    rows are counted, once.
    """

    def __init__(self, path: Path, first: Counter[str], all_rows: Callable[[], Counter[str]], delimiter: str) -> None:
        """Begin to read a table.

        Args:
            path: Path of the table, for messages.
            first: Counts of `count_kinds` for its first rows.
            all_rows: Function that reads the table again and returns the counts for all rows.
            delimiter: The character between fields.
        """
        self.sign = decimal_sign(first, delimiter)
        self._path, self._all_rows, self._delimiter = path, all_rows, delimiter
        self._final = False

    def with_decimal_point(self, text: str, line: int) -> str:
        """Rewrite a number of the table with a decimal point.

        Args:
            text: The text of a cell.
            line: Number of its line in the file.

        Returns:
            The number, marked if its sign may group thousands. A text that is not a number is returned unchanged.

        Raises:
            DataError: Most numbers of the table have another decimal sign than its first rows, which were read already.
        """
        sign = "," if "," in text else "."
        if sign not in text or (sign == self.sign == "."):
            return text
        plain = text.strip()
        if sign == self.sign and DECIMAL[sign].fullmatch(plain):
            return plain.replace(",", ".")
        kind = kind_of_number(plain)
        is_clear = kind in SIGN_NAMES
        if not self._final and ((is_clear and kind != self.sign) or (kind.startswith(AMBIGUOUS) and not self.sign)):
            self._count_all(plain, line)
        if not is_clear and not kind.startswith(AMBIGUOUS):
            return text
        if not DECIMAL[sign].fullmatch(plain) or (not is_clear and sign != self.sign):
            return plain + GROUPED_MARK
        if sign == "," and self.sign != "," and self._delimiter == ",":
            return text
        return plain.replace(",", ".")

    def _count_all(self, plain: str, line: int) -> None:
        """Decide the decimal sign by all rows of the table."""
        counts, before = self._all_rows(), self.sign
        self._final, self.sign = True, decimal_sign(counts, self._delimiter)
        if before and self.sign != before and counts[AMBIGUOUS + before]:
            raise DataError(
                f"{self._path}: line {line} has {plain!r}, but {SIGN_NAMES[before]} seemed to be decimal in the rows "
                "before it; write all numbers with one decimal sign and no other"
            )
