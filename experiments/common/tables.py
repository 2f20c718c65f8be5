"""Tables as text and in Markdown, in one way for all experiments."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from i2t.errors import printable

NO_SIGN = 5e-7  # a number below is 0.0, without the sign that rounding leaves it


def cell(value: Any, digits: int = 3, *, ends: int | None = None, signed: bool = False) -> str:
    """A number, or one with its 95 % interval in brackets; without brackets where there is no interval, as of too few
    clusters.

    Args:
        value: The number, or the number and the lower and upper end of its interval, as a sequence or a dict in that
            order; None or NaN stands for what is not known.
        digits: Decimals.
        ends: Decimals of the interval, if others.
        signed: Whether positive numbers have a sign too.

    Returns:
        Such as `0.81 [0.79, 0.83]`, `0.81`, or `-`.
    """
    values = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else (value,)
    number, *limits = (math.nan if part is None else 0.0 if abs(part) < NO_SIGN else float(part) for part in values)
    if not math.isfinite(number):
        return "-"
    sign = "+" if signed else ""
    text = f"{number:{sign}.{digits}f}"
    if not limits or not all(map(math.isfinite, limits)):
        return text
    return f"{text} [{', '.join(f'{limit:{sign}.{digits if ends is None else ends}f}' for limit in limits)}]"


def text_table(head: Sequence[str], rows: Iterable[Sequence[str]], indent: str = "") -> str:
    """A table for a terminal, each column as wide as its widest cell.

    Args:
        head: Names of the columns.
        rows: Cells, as many in each row.
        indent: What stands before every line.
    """
    lines = [[printable(cell) for cell in line] for line in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    padded = ("  ".join(f"{cell:{width}}" for cell, width in zip(line, widths, strict=True)) for line in lines)
    return "\n".join(f"{indent}{line}".rstrip() for line in padded)


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table for a page.

    Args:
        head: Names of the columns.
        rows: Cells, as many in each row.
    """
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
