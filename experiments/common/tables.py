"""Tables as plain text and in Markdown, in the same style for all experiments."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from i2t.errors import printable


def cell(value: Any, digits: int = 3, *, ends: int | None = None, signed: bool = False) -> str:
    """Format a number, with its 95 % interval in brackets if it has one.

    Args:
        value: The number, or the number and the lower and upper end of its interval, as a sequence or a dict in that
            order. None and NaN mean unknown.
        digits: Number of decimals.
        ends: Number of decimals of the interval, if different.
        signed: Whether positive numbers have a sign too.

    Returns:
        A text such as `0.81 [0.79, 0.83]`, `0.81`, or `-`.
    """
    values = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else (value,)
    # Tiny numbers become 0.0, so that rounding leaves no minus sign.
    number, *limits = (math.nan if part is None else 0.0 if abs(part) < 5e-7 else float(part) for part in values)
    if not math.isfinite(number):
        return "-"
    sign = "+" if signed else ""
    text = f"{number:{sign}.{digits}f}"
    if not limits or not all(map(math.isfinite, limits)):
        return text
    return f"{text} [{', '.join(f'{limit:{sign}.{digits if ends is None else ends}f}' for limit in limits)}]"


def text_table(head: Sequence[str], rows: Iterable[Sequence[str]], indent: str = "") -> str:
    """Format a table for a terminal, with each column as wide as its widest cell.

    Args:
        head: Names of the columns.
        rows: Cells of each row.
        indent: Prefix of every line.

    Returns:
        The lines of the table, joined by newlines.
    """
    lines = [[printable(cell) for cell in line] for line in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    padded = ("  ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True)) for line in lines)
    return "\n".join(f"{indent}{line}".rstrip() for line in padded)


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a table in Markdown.

    Args:
        head: Names of the columns.
        rows: Cells of each row.

    Returns:
        The lines of the table, joined by newlines.
    """
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
