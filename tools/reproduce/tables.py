"""Tables of the documents, written from what the steps measured.

A table stands between `<!-- table: STEP NAME -->` and `<!-- end of table -->`; STEP is a step's name, which has a file
in docs/results, and NAME one of its tables in `TABLES`.
"""

import json
import re
from pathlib import Path
from typing import Any

from experiments.common.cells import AVERAGE_SUFFIX, Measured, Table
from tools.reproduce import recognition_tables as recognition
from tools.reproduce import shape_tables as shapes
from tools.reproduce import skin_tables as skins
from tools.reproduce.limits_table import safety_limits
from tools.reproduce.readme_table import summary

MARK = re.compile(r"(<!-- table: (\w+) ([^>]+?) -->\n).*?(<!-- end of table -->)", re.DOTALL)
README_TABLE = ("all", "summary")  # made of all steps
LIMITS_TABLE = ("safety", "limits")  # made of i2t/hardware/limits.py
KEPT_SCORES = ("accuracy", "mean", "last_other_objects", "calibration_error", "log_loss")
KEPT_OF_STUDIES = ("source", "pads", "runs", "episodes", "touches", "tables")
DECIMALS = 6  # of what is kept: fewer would be rounded twice in a table, .3146 to .315 and to .32


def write_tables(docs: Path) -> list[str]:
    """Write every table that the documents ask for.

    Args:
        docs: Folder of the documents, with what was measured in results/.

    Returns:
        The tables that were written, as "page: STEP NAME".

    Raises:
        ValueError: A page asks for a table that there is not, or its step was not measured.
    """
    written = []
    for page in sorted([*docs.glob("*.md"), docs.parent / "README.md"]):
        before = page.read_text() if page.exists() else ""

        def fill(found: re.Match[str], page: Path = page) -> str:
            step, name = found[2], found[3]
            written.append(f"{page.name}: {step} {name}")
            return found[1] + table(docs, step, name, page.name) + "\n" + found[4]

        after = MARK.sub(fill, before)
        if after != before:
            page.write_text(after)
    return written


def table(docs: Path, step: str, name: str, page: str = "") -> str:
    """One table in Markdown.

    Args:
        docs: Folder of the documents.
        step: Whose measurements are shown.
        name: Of the table.
        page: That asks for it, for messages.

    Raises:
        ValueError: There is no such table, or nothing was measured.
    """
    if (step, name) == README_TABLE:
        return summary({path.stem: json.loads(path.read_text()) for path in (docs / "results").glob("*.json")})
    if (step, name) == LIMITS_TABLE:
        return safety_limits()
    if name not in TABLES.get(step, {}):
        raise ValueError(f"{page}: there is no table {name!r} of {step}; there are {', '.join(TABLES.get(step, {}))}")
    path = docs / "results" / f"{step}.json"
    if not path.exists():
        raise ValueError(f"{page}: {path} is missing; run python -m tools.reproduce --only {step}")
    return TABLES[step][name](json.loads(path.read_text()))


def shortened(step: str, measured: Measured) -> Measured:
    """Metrics of a step that are kept with the documents: what tables show, with a few decimals.

    Args:
        step: Whose.
        measured: Its metrics.json.
    """
    if step in recognition.STUDY_TABLES:
        measured = {name: x for name, x in measured.items() if name in KEPT_OF_STUDIES}
    if "sets" in measured:
        for entry in measured["sets"].values():
            entry["methods"] = {name: x for name, x in entry["methods"].items() if not name.endswith(AVERAGE_SUFFIX)}
            for scores in entry["methods"].values():
                for name in [name for name in scores if name not in KEPT_SCORES]:
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
    return round(node, DECIMALS) if isinstance(node, float) else node


TABLES: dict[str, dict[str, Table]] = recognition.TABLES | skins.TABLES | shapes.TABLES
