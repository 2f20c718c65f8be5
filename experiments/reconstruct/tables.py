"""Tables of surfaces from touches."""

from experiments.common.cells import Measured
from experiments.common.tables import cell, markdown

SURFACE_GOALS = {"5 touches": "0.45", "20 touches": "0.28", "IoU": "0.75", "90 % coverage": "0.88 to 0.92"}


def reconstructions(measured: Measured) -> str:
    """All tables of a run: scores of every condition, gains over poses alone, policies, and hidden surface."""
    tables = [markdown(*_surfaces(measured))]
    tables += [table(measured) for table in (savings, policies, hidden) if table(measured).count("\n") > 1]
    return "\n\n".join(tables)


def conditions(measured: Measured) -> str:
    """Distances and coverage of every condition."""
    return _main_columns(*_surfaces(measured), "initial distance, mm", "IoU")


def conditions_and_goals(measured: Measured) -> str:
    """Main scores of every condition, with the goals in the last row."""
    head, rows = _surfaces(measured)
    goals = ["goal", *(SURFACE_GOALS.get(column, "") for column in head[1:])]
    return _main_columns(head, [*rows, goals], "10 touches")


def _main_columns(head: list[str], rows: list[list[str]], *others: str) -> str:
    columns = [
        i for i, column in enumerate(head) if column not in ("1 touch", "F-score", "90 % half-width, mm", *others)
    ]
    return markdown([head[i] for i in columns], [[row[i] for i in columns] for row in rows])


def savings(measured: Measured) -> str:
    """Reduction of the distance relative to poses alone on the same objects, with the better choice of shapes."""
    return _by_touches("distance saved relative to the better pose-only condition", measured["less_than_pose"])


def policies(measured: Measured) -> str:
    """Fraction of the gap between random sites and the oracle that each policy closes."""
    return _by_touches("closed share of the gap to the oracle", measured["share_of_oracles_gap"])


def hidden(measured: Measured) -> str:
    """Distance of the surface hidden from the view, relative to its value after the view."""
    viewed = {name: results for name, results in measured["conditions"].items() if "view" in name}
    return _by_touches(
        "distance to the hidden surface, relative to that after the view",
        {
            name: {count: scores["hidden_ratio"] for count, scores in results["after"].items() if count != "0"}
            for name, results in viewed.items()
        },
    )


def _left(scores: Measured) -> str:
    """Distance as a fraction of the start's, and in millimetres."""
    return f"{cell(scores['ratio'], 2)}, {cell(scores['chamfer_mm'][0], 2)} mm"


def _by_touches(title: str, results: Measured) -> str:
    """Table with a row for each condition and a column for each number of touches."""
    counts = sorted({int(count) for by_count in results.values() for count in by_count})
    rows = [
        [name, *(cell(by_count[str(count)], 2) if str(count) in by_count else "" for count in counts)]
        for name, by_count in results.items()
    ]
    return markdown([title, *map(_touches, counts)], rows)


def _touches(count: int) -> str:
    return f"{count} touch{'es' if count > 1 else ''}"


def _surfaces(measured: Measured) -> tuple[list[str], list[list[str]]]:
    """Header and rows with all columns."""
    conditions = measured["conditions"]
    counts = sorted({int(count) for results in conditions.values() for count in results["after"]} - {0})
    rows, final = [], (("iou", 2), ("f_score", 2), ("coverage", 2), ("band_mm", 1))  # scores after the last touch
    for name, results in conditions.items():
        after = results["after"]
        start = cell(after["0"]["chamfer_mm"][0] / after["0"]["ratio"][0], 2)
        course = [_left(after[str(count)]) if str(count) in after else "" for count in counts]
        last = after[max(after, key=int)]
        rows.append([name, start, *course, *(cell(last[score][0], digits) for score, digits in final)])
    last_columns = ["IoU", "F-score", "90 % coverage", "90 % half-width, mm"]
    return ["condition", "initial distance, mm", *map(_touches, counts), *last_columns], rows
