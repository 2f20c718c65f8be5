"""Tables as text and in Markdown, in one way for all experiments."""

from collections.abc import Iterable, Sequence

from i2t.errors import printable


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
