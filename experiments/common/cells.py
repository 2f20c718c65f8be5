"""Cells and rows of Markdown tables, made from an experiment's metrics."""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any

from experiments.common.tables import cell, markdown

Measured = dict[str, Any]
Table = Callable[[Measured], str]
Cell = Callable[[Any], str]  # makes a cell from the metrics of its row
AVERAGE_SUFFIX = ", average"  # tables omit rules whose names end with this


def percent(rate: Mapping[str, Any], decimals: int = 1) -> str:
    """Format a rate and its interval in percent."""
    mean, low, high = (None if value is None else 100 * value for value in rate.values())
    limits = "" if low is None or high is None else f" [{low:.{decimals}f}, {high:.{decimals}f}]"
    return f"{mean:.{decimals}f} %{limits}"


def at(accuracy: Mapping[str, Sequence[Any]], touch: int) -> dict[str, Any]:
    """Select the estimate after a number of touches; -1 is the last one."""
    index = touch - 1 if touch > 0 else touch
    return {name: values[index] for name, values in accuracy.items()}


def shown(name: str, *hidden: str) -> bool:
    """Test whether tables show a row: not if it belongs to an average rule or has a hidden word in its name."""
    return not name.endswith(AVERAGE_SUFFIX) and not any(word in name for word in hidden)


def rows_over(path: str, head: Sequence[str], *cells: Cell, kept: bool = False, hidden: Sequence[str] = ()) -> Table:
    """Make a function that renders a table with a row for each entry of a dict.

    Args:
        path: Path of the dict in the metrics, with names separated by "/".
        head: Names of the columns. The first may contain a value of the metrics, such as {source}.
        *cells: Functions that make the cells of a row after its name.
        kept: Whether to mark the name of the method that was kept.
        hidden: Words in the names of entries that are not shown.

    Returns:
        A function that formats the metrics as a Markdown table.
    """

    def render(measured: Measured) -> str:
        entries = reduce(lambda node, name: node[name], path.split("/"), measured)
        best = measured["best"] if kept else None
        rows = [
            [f"{name} (kept)" if name == best else name, *(render_cell(entry) for render_cell in cells)]
            for name, entry in entries.items()
            if shown(name, *hidden)
        ]
        return markdown([head[0].format_map(measured), *head[1:]], rows)

    return render


def numbers_of(keys: Sequence[str], decimals: int = 2) -> tuple[Cell, ...]:
    """Make functions that format cells of single scores."""
    return tuple(lambda scores, key=key: cell(scores[key], decimals) for key in keys)


def span(name: str, decimals: int, scores: Mapping[str, Any]) -> str:
    """Format a mean with its interval, if it has one, or return an empty text if the score is missing."""
    if name not in scores:
        return ""
    mean, low, high = scores[name]
    return cell([mean, low, high] if low < high else mean, decimals)
