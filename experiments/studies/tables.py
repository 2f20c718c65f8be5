"""Tables of the studies."""

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.common.cells import Measured, Table, percent, shown
from experiments.common.tables import cell, markdown


def study_table(name: str, hidden: Sequence[str] = ()) -> Table:
    """One of the tables that a study's metrics hold in a form of their own (`experiments.studies.report`), without rows
    whose first cell has a hidden word.
    """

    def render(measured: Measured) -> str:
        found = measured["tables"][name]
        rows = [
            [_cell(x, column) for x, column in zip(row, found["columns"], strict=True)]
            for row in found["rows"]
            if shown(str(row[0]), *hidden)
        ]
        return markdown([column["name"] for column in found["columns"]], rows)

    return render


def _cell(value: Any, column: Mapping[str, Any]) -> str:
    """A word as it is; a number or an interval as its column says; a dash where there is none."""
    if isinstance(value, str):
        return value
    if column["percent"] and isinstance(value, dict) and value["mean"] is not None:
        return percent(value, column["decimals"])
    return cell(value, column["decimals"], signed=column["signed"] and isinstance(value, dict))
