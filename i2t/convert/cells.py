"""Numbers in the cells of a table: decimal points, decimal commas, and the same signs between thousands.

1.234 is a little more than one, or one thousand two hundred and thirty-four. Other numbers of the table tell: those
with one, two, four or more decimals, or with decimals below one, can be read in one way only. Where no number tells, or
as many contradict, such a cell is marked and is no number.
"""

import re
from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from pathlib import Path

from i2t.errors import DataError

DECIMAL = {sign: re.compile(rf"[-+]?[0-9]*[{sign}][0-9]+([eE][-+]?[0-9]+)?") for sign in ".,"}
GROUPED = {  # numbers that may have this sign between thousands
    ".": re.compile(r"[-+]?[1-9][0-9]{0,2}([.][0-9]{3})+(,[0-9]*)?"),
    ",": re.compile(r"[-+]?[1-9][0-9]{0,2}(,[0-9]{3})+([.][0-9]*)?"),
}
OTHER_SIGN = {".": ",", ",": "."}
SIGN_NAMES = {".": "points", ",": "commas"}
WHOLE, MAYBE = "whole", "maybe "  # kinds of numbers: without a sign, and with one (which follows) of unknown meaning
GROUPED_MARK, NO_TIME_MARK = "\ufffe", "\uffff"  # behind cells that are no numbers; Unicode has no such characters


def parse_number(text: str) -> float | None:
    """The number that a text is.

    Args:
        text: Any text; signs between digits, as Python has them in 1_000, are no part of a number.

    Returns:
        The number, which may be infinite or NaN; None where the text is none.
    """
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def as_written(cell: str) -> str:
    """A cell as it stands in the file.

    Args:
        cell: With or without a mark.

    Returns:
        The text without a mark.
    """
    return cell.rstrip(GROUPED_MARK + NO_TIME_MARK)


def kind_of_number(text: str) -> str:
    """What a number tells of the sign before decimals.

    Args:
        text: Of a cell.

    Returns:
        The sign that it shows to be decimal; `MAYBE` and a sign that may be decimal or group thousands; `WHOLE`; or ""
        for what is no number.
    """
    plain = text.strip()
    if plain.lstrip("+-").isdigit():
        return WHOLE
    for sign in ".,":
        if sign in plain and DECIMAL[sign].fullmatch(plain):
            return MAYBE + sign if GROUPED[sign].fullmatch(plain) else sign
    return next((OTHER_SIGN[sign] for sign in ".," if GROUPED[sign].fullmatch(plain)), "")


def count_kinds(rows: Iterable[Sequence[str]], columns: Sequence[int], counters: Container[int] = ()) -> Counter[str]:
    """How many numbers of each kind a table has.

    Args:
        rows: Cells.
        columns: Which of them to look at.
        counters: Of these, columns in which numbers without decimals tell nothing, as they count milliseconds.

    Returns:
        The numbers by kind, as of `kind_of_number`.
    """
    counts: Counter[str] = Counter()
    for cells in rows:
        for i in columns:
            if i < len(cells):
                kind = kind_of_number(cells[i])
                counts["" if kind == WHOLE and i in counters else kind] += 1
    return counts


def decimal_sign(counts: Counter[str], delimiter: str) -> str:
    """The sign before decimals, by the numbers of a table.

    Args:
        counts: Of the numbers, by kind.
        delimiter: Between fields.

    Returns:
        The sign that more numbers show to be decimal. Where none does: the sign that every number has, as grouped
        numbers of less than a thousand have none; or the point, in a table that is separated by commas. Else "".
    """
    if counts["."] != counts[","]:
        return "." if counts["."] > counts[","] else ","
    signs = [sign for sign in ".," if counts[MAYBE + sign]]
    if not counts["."] and not counts[WHOLE] and len(signs) == 1:
        return signs[0]
    return "." if delimiter == "," and not counts[","] else ""


class DecimalSigns:
    """Reads the numbers of a table row by row. Its first rows tell the sign before decimals; where they do not, or
    where a later number contradicts them, all rows are counted, once.
    """

    def __init__(self, path: Path, first: Counter[str], all_rows: Callable[[], Counter[str]], delimiter: str) -> None:
        """Begin.

        Args:
            path: Of the table, for messages.
            first: Kinds of the numbers in its first rows.
            all_rows: Counts those of all rows.
            delimiter: Between fields.
        """
        self.sign = decimal_sign(first, delimiter)
        self._path, self._all_rows, self._delimiter = path, all_rows, delimiter
        self._final = False

    def with_point(self, text: str, line: int) -> str:
        """A number with a decimal point.

        Args:
            text: Of a cell.
            line: Where it stands.

        Returns:
            The number; marked where its sign may group thousands; what is no number stays as it is.

        Raises:
            DataError: Most numbers of the table have another decimal sign than those of its first rows, which were read
                already.
        """
        sign = "," if "," in text else "."
        if sign not in text or (sign == self.sign == "."):
            return text
        plain = text.strip()
        if sign == self.sign and DECIMAL[sign].fullmatch(plain):
            return plain.replace(",", ".")
        kind = kind_of_number(plain)
        is_clear = kind in SIGN_NAMES
        if not self._final and ((is_clear and kind != self.sign) or (kind.startswith(MAYBE) and not self.sign)):
            self._count_all(plain, line)
        if not is_clear and not kind.startswith(MAYBE):
            return text
        if not DECIMAL[sign].fullmatch(plain) or (not is_clear and sign != self.sign):
            return plain + GROUPED_MARK
        if sign == "," and self.sign != "," and self._delimiter == ",":
            return text
        return plain.replace(",", ".")

    def _count_all(self, plain: str, line: int) -> None:
        """Decide by all rows of the table."""
        counts, before = self._all_rows(), self.sign
        self._final, self.sign = True, decimal_sign(counts, self._delimiter)
        if before and self.sign != before and counts[MAYBE + before]:
            raise DataError(
                f"{self._path}: line {line} has {plain!r}, but {SIGN_NAMES[before]} seemed to be decimal in the rows "
                "before it; write all numbers with one decimal sign and no other"
            )
