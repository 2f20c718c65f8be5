"""Tables of surfaces from touches."""

from experiments.common.cells import Measured
from experiments.common.tables import cell, markdown

_ENDS = (("iou", 2), ("f_score", 2), ("coverage", 2), ("band_mm", 1))  # scores after the last touch, and decimals
SURFACE_GOALS = {"5 touches": "0.45", "20 touches": "0.28", "IoU": "0.75", "in the 90 % band": "0.88 to 0.92"}
NOT_ON_THE_PAGE = ("1 touch", "F-score")


def reconstructions(measured: Measured) -> str:
    """Scores of every condition after some touches, what readings save, and what policies close of the oracle's gap."""
    tables = [markdown(*_surfaces(measured))]
    tables += [table(measured) for table in (savings, policies, hidden) if table(measured).count("\n") > 1]
    return "\n\n".join(tables)


def conditions(measured: Measured) -> str:
    """The main columns of the same."""
    return _main_columns(*_surfaces(measured))


def conditions_and_goals(measured: Measured) -> str:
    """The main columns of the same, with a last row of what was wanted."""
    head, rows = _surfaces(measured)
    return _main_columns(head, [*rows, ["goal", *(SURFACE_GOALS.get(column, "") for column in head[1:])]])


def _main_columns(head: list[str], rows: list[list[str]]) -> str:
    kept = [place for place, column in enumerate(head) if column not in NOT_ON_THE_PAGE]
    return markdown([head[place] for place in kept], [[row[place] for place in kept] for row in rows])


def savings(measured: Measured) -> str:
    """By how much touches that tell more are nearer to the surface than those of the same objects by pose alone, by
    the better of the two choices of shapes.
    """
    return _by_touches("nearer than by the better poses alone, by", measured["less_than_pose"])


def policies(measured: Measured) -> str:
    """What share of the gap between random sites and the oracle policies close."""
    return _by_touches("share of the oracle's gap", measured["share_of_oracles_gap"])


def hidden(measured: Measured) -> str:
    """What is left, after touches, of the distance of the surface that a view did not show."""
    viewed = {name: found for name, found in measured["conditions"].items() if "view" in name}
    return _by_touches(
        "hidden surface, left of the view's distance",
        {
            name: {count: each["hidden_ratio"] for count, each in found["after"].items() if count != "0"}
            for name, found in viewed.items()
        },
    )


def _left(scores: Measured) -> str:
    """Share of the start's distance that is left, and that distance."""
    return f"{cell(scores['ratio'], 2)}, {cell(scores['chamfer_mm'][0], 2)} mm"


def _by_touches(title: str, found: Measured) -> str:
    """A row for each condition, a column for each number of touches."""
    counts = sorted({int(count) for each in found.values() for count in each})
    rows = [
        [name, *(cell(each[str(count)], 2) if str(count) in each else "" for count in counts)]
        for name, each in found.items()
    ]
    return markdown([title, *map(_touches, counts)], rows)


def _touches(count: int) -> str:
    return f"{count} touch{'es' if count > 1 else ''}"


def _surfaces(measured: Measured) -> tuple[list[str], list[list[str]]]:
    """Head and rows of all columns."""
    conditions = measured["conditions"]
    counts = sorted({int(count) for found in conditions.values() for count in found["after"]} - {0})
    rows = []
    for name, found in conditions.items():
        after = found["after"]
        begun = cell(after["0"]["chamfer_mm"][0] / after["0"]["ratio"][0], 2)
        course = [_left(after[str(count)]) if str(count) in after else "" for count in counts]
        last = after[max(after, key=int)]
        rows.append([name, begun, *course, *(cell(last[score][0], decimals) for score, decimals in _ENDS)])
    return ["condition", "start, mm", *map(_touches, counts), "IoU", "F-score", "in the 90 % band", "band, mm"], rows
