"""Tables of the studies."""

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.common.cells import Measured, Table, percent, shown
from experiments.common.tables import cell, markdown


def study_table(name: str, hidden: Sequence[str] = ()) -> Table:
    """Make the formatter of one table of a study's metrics (`experiments.studies.report.make_table`).

    Args:
        name: Name of the table.
        hidden: Words; rows whose first cell contains one are omitted.

    Returns:
        A function that formats the table of the metrics in Markdown.
    """

    def render(measured: Measured) -> str:
        table = measured["tables"][name]
        rows = [
            [_cell(x, column) for x, column in zip(row, table["columns"], strict=True)]
            for row in table["rows"]
            if shown(str(row[0]), *hidden)
        ]
        return markdown([column["name"] for column in table["columns"]], rows)

    return render


def _cell(value: Any, column: Mapping[str, Any]) -> str:
    """Format a cell: text unchanged, a number or an interval as its column requires, a dash if it is missing."""
    if isinstance(value, str):
        return value
    if column["percent"] and isinstance(value, dict) and value["mean"] is not None:
        return percent(value, column["decimals"])
    return cell(value, column["decimals"], signed=column["signed"] and isinstance(value, dict))
