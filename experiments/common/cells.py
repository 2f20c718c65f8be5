"""Cells and rows of tables in Markdown, made of what was measured."""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any

from experiments.common.tables import cell, markdown

Measured = dict[str, Any]
Table = Callable[[Measured], str]
Cell = Callable[[Any], str]  # of what was measured of a row
UNSHOWN = ", average"  # a rule between the other two


def percent(found: Mapping[str, Any], decimals: int = 1) -> str:
    """A rate with its interval in percent."""
    mean, low, high = (None if value is None else 100 * value for value in found.values())
    limits = "" if low is None or high is None else f" [{low:.{decimals}f}, {high:.{decimals}f}]"
    return f"{mean:.{decimals}f} %{limits}"


def at(accuracy: Mapping[str, Sequence[Any]], touch: int) -> dict[str, Any]:
    """The estimate after a number of touches, -1 for the last."""
    index = touch - 1 if touch > 0 else touch
    return {name: values[index] for name, values in accuracy.items()}


def shown(name: str, *hidden: str) -> bool:
    """Tell whether a row is shown: an average rule, or a name with one of the hidden words, is not."""
    return not name.endswith(UNSHOWN) and not any(word in name for word in hidden)


def rows_over(path: str, head: Sequence[str], *cells: Cell, kept: bool = False, hidden: Sequence[str] = ()) -> Table:
    """A table with a row for each entry of a dict.

    Args:
        path: Of the dict in what was measured, its names divided by "/".
        head: Names of the columns; the first may name a value of what was measured, as {source}.
        *cells: What makes the cells of a row after its name.
        kept: Whether the name of what was kept is marked.
        hidden: Words in the names of entries that have no row.
    """

    def render(measured: Measured) -> str:
        entries = reduce(lambda node, name: node[name], path.split("/"), measured)
        best = measured["best"] if kept else None
        rows = [
            [f"{name} (kept)" if name == best else name, *(render_cell(found) for render_cell in cells)]
            for name, found in entries.items()
            if shown(name, *hidden)
        ]
        return markdown([head[0].format_map(measured), *head[1:]], rows)

    return render


def numbers_of(keys: Sequence[str], decimals: int = 2) -> tuple[Cell, ...]:
    """Cells of single scores."""
    return tuple(lambda scores, key=key: cell(scores[key], decimals) for key in keys)


def span(name: str, decimals: int, scores: Mapping[str, Any]) -> str:
    """A mean with its interval, if it has any; nothing where there is no such score."""
    if name not in scores:
        return ""
    mean, low, high = scores[name]
    return cell([mean, low, high] if low < high else mean, decimals)
