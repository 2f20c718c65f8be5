"""Tables of the documents, written from the results of the steps.

A table is between `<!-- table: STEP NAME -->` and `<!-- end of table -->`: STEP is a step with a file in docs/results,
and NAME is one of its tables in `TABLES`.
"""

import json
import re
from pathlib import Path
from typing import Any

from experiments.common.cells import AVERAGE_SUFFIX, Measured, Table
from tools.reproduce import recognition_tables as recognition
from tools.reproduce import shape_tables as shapes
from tools.reproduce import skin_tables as skins
from tools.reproduce.readme_table import overview, summary

MARK = re.compile(r"(<!-- table: (\w+) ([^>]+?) -->\n).*?(<!-- end of table -->)", re.DOTALL)
ALL_STEPS = "all"
TABLES_OF_ALL_STEPS: dict[str, Table] = {"overview": overview, "summary": summary}


def write_tables(docs: Path) -> list[str]:
    """Write all tables of the documents.

    Args:
        docs: Folder of the documents, with the results in results/.

    Returns:
        The written tables, as "page: STEP NAME".

    Raises:
        ValueError: A page names an unknown table, or a step without results.
    """
    written = []
    for page in sorted([*docs.glob("*.md"), docs.parent / "README.md"]):
        before = page.read_text() if page.exists() else ""

        def fill(match: re.Match[str], page: Path = page) -> str:
            step, name = match[2], match[3]
            written.append(f"{page.name}: {step} {name}")
            return match[1] + table(docs, step, name, page.name) + "\n" + match[4]

        after = MARK.sub(fill, before)
        if after != before:
            page.write_text(after)
    return written


def table(docs: Path, step: str, name: str, page: str = "") -> str:
    """Format one table in Markdown.

    Args:
        docs: Folder of the documents.
        step: Name of the step.
        name: Name of the table.
        page: Name of the page, for error messages.

    Returns:
        The table in Markdown.

    Raises:
        ValueError: The table is unknown, or the step has no results.
    """
    if step == ALL_STEPS and name in TABLES_OF_ALL_STEPS:
        return TABLES_OF_ALL_STEPS[name](
            {path.stem: json.loads(path.read_text()) for path in (docs / "results").glob("*.json")}
        )
    if name not in TABLES.get(step, {}):
        raise ValueError(f"{page}: there is no table {name!r} of {step}; there are {', '.join(TABLES.get(step, {}))}")
    path = docs / "results" / f"{step}.json"
    if not path.exists():
        raise ValueError(f"{page}: {path} is missing; run python -m tools.reproduce --only {step}")
    return TABLES[step][name](json.loads(path.read_text()))


def shortened(step: str, measured: Measured) -> Measured:
    """Reduce the metrics of a step to the rounded values that tables show.

    Args:
        step: Name of the step.
        measured: Contents of its metrics.json.

    Returns:
        The kept metrics, with numbers rounded to six decimals.
    """
    if step in recognition.STUDY_TABLES:
        kept = ("source", "pads", "runs", "episodes", "touches", "tables")
        measured = {name: x for name, x in measured.items() if name in kept}
    if "sets" in measured:
        kept_scores = ("accuracy", "mean", "last_other_objects", "calibration_error", "log_loss")
        for entry in measured["sets"].values():
            entry["methods"] = {name: x for name, x in entry["methods"].items() if not name.endswith(AVERAGE_SUFFIX)}
            for scores in entry["methods"].values():
                for name in [name for name in scores if name not in kept_scores]:
                    del scores[name]
    if step == "fidelity":
        measured |= {"recordings": skins.sections_of_recordings(measured["recordings"])}
    if step == "strokes":
        for split in measured["splits"].values():
            split.pop("mean_paths", None)
            for scores in split["methods"].values():
                del scores["confusion"]
    return {"step": step, **_rounded(measured)}


def _rounded(node: Any) -> Any:
    if isinstance(node, dict):
        return {name: _rounded(value) for name, value in node.items()}
    if isinstance(node, list):
        return [_rounded(value) for value in node]
    # Fewer decimals would be rounded twice in a table, as .3146 to .315 and to .32.
    return round(node, 6) if isinstance(node, float) else node


TABLES: dict[str, dict[str, Table]] = recognition.TABLES | skins.TABLES | shapes.TABLES
