"""Tables of shapes from touches: surfaces, and the surface below one press."""

from experiments.common.tables import markdown
from experiments.reproduce.cells import Measured, Table, estimate, number, span

_ENDS = (("iou", 2), ("f_score", 2), ("coverage", 2), ("band_mm", 1))  # scores after the last touch, and decimals
SURFACE_GOALS = {"5 touches": "0.45", "20 touches": "0.28", "IoU": "0.75", "in the 90 % band": "0.88 to 0.92"}
NOT_ON_THE_PAGE = ("1 touch", "F-score")


def reconstructions(measured: Measured) -> str:
    """Scores of every condition after some touches, what readings save, and what policies close of the oracle's gap."""
    tables = [markdown(*_surfaces(measured))]
    tables += [table(measured) for table in (savings, policies, hidden) if table(measured).count("\n") > 1]
    return "\n\n".join(tables)


def reconstructions_and_goals(measured: Measured) -> str:
    """The main columns of the same, with a last row of what was wanted."""
    head, rows = _surfaces(measured)
    kept = [place for place, column in enumerate(head) if column not in NOT_ON_THE_PAGE]
    rows += [["goal", *(SURFACE_GOALS.get(column, "") for column in head[1:])]]
    return markdown([head[place] for place in kept], [[row[place] for place in kept] for row in rows])


def savings(measured: Measured) -> str:
    """By how much touches that tell more are nearer to the surface than those of the same objects by pose alone."""
    return _by_touches("nearer than by pose alone, by", measured["less_than_pose"])


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


def _by_touches(title: str, found: Measured) -> str:
    """A row for each condition, a column for each number of touches."""
    counts = sorted({int(count) for each in found.values() for count in each})
    rows = [
        [name, *(estimate(each[str(count)], 2) if str(count) in each else "" for count in counts)]
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
        begun = number(after["0"]["chamfer_mm"][0] / after["0"]["ratio"][0], 2)
        course = [estimate(after[str(count)]["ratio"], 2) if str(count) in after else "" for count in counts]
        last = after[max(after, key=int)]
        rows.append([name, begun, *course, *(number(last[score][0], decimals) for score, decimals in _ENDS)])
    return ["condition", "start, mm", *map(_touches, counts), "IoU", "F-score", "in the 90 % band", "band, mm"], rows


PATCH_SCORES = (
    ("mask_iou", "mask IoU"), ("mask_skill", "mask skill"), ("contact_iou", "contact IoU"),
    ("centre_mm_median", "centre, median mm"), ("coverage_90", "90 % covers"), ("crps_ratio", "CRPS / prior's"),
)  # fmt: skip
CRPS_GOALS = ("", "0.65", "0.52")  # of the prior, one stop and the press curve
STOPS = ("prior", "one stop", "press curve")


def local_shapes(measured: Measured) -> str:
    """Scores of every method over all test objects, what was wanted of CRPS, and medians of edges, which are few."""
    rows = [
        [
            name,
            *(span(score, 2, found) for score, _ in PATCH_SCORES),
            goal,
            f"{number(found['edge_degrees_median'][0], 0)}, {number(found['edge_mm_median'][0], 1)}",
        ]
        for name, found, goal in zip(STOPS, measured["methods"].values(), CRPS_GOALS, strict=True)
    ]
    edges = f"edge, degrees and mm ({measured['edges']} presses)"
    return markdown(["method", *(title for _, title in PATCH_SCORES), "its goal", edges], rows)


def local_shapes_by_source(measured: Measured) -> str:
    """Masks on objects of the catalogue, and on those drawn at random: a row for each source."""
    shown = (("mask_iou", "IoU", 0), ("mask_skill", "skill", 1))  # and the first method
    head = [f"{title}, {stop}" for _, title, first in shown for stop in STOPS[first:]]
    rows = [
        [
            f"{source} ({found['objects']})",
            *(span(score, 2, of) for score, _, first in shown for of in list(found["methods"].values())[first:]),
        ]
        for source, found in measured["sources"].items()
    ]
    return markdown(["test objects", *head], rows)


HELD_OUT = {
    "random": "random fifths", "location": "squares of position", "depth": "fifths of depth",
    "angle": "sectors of rotation",
}  # fmt: skip
STAMP_GOALS = {"random": "0.92 (classifier); 0.95 (best)", "location": "0.85", "20": "0.85"}


def stamps(measured: Measured) -> str:
    """Rates at which stamps are told apart, by what is held out, below the paper's."""
    methods = list(measured["splits"]["random"])
    found = {name: {method: each["total"] for method, each in of.items()} for name, of in measured["splits"].items()}
    rows = [
        [
            title,
            *("".join(estimate(of[each], 2) for each in of if each.startswith(method)) for method in methods),
            STAMP_GOALS.get(name, ""),
        ]
        for name, of in (found | measured["new"]).items()
        for title in [HELD_OUT.get(name, f"a new skin, {name} presses of each shape known")]
    ]
    head = [f"held out, {measured['source']}", *(f"{method} [95 %]" for method in methods), "goal"]
    published = ["random fifths, the paper, one real skin", "0.92", *[""] * len(methods)]
    return markdown(head, [published, *rows])


def strokes(measured: Measured) -> str:
    """Accuracy, log loss and calibration of every method on later strokes, and accuracy on strokes drawn at random."""
    order, drawn = (split["methods"] for split in measured["splits"].values())
    rows = [
        [
            name,
            estimate(found["accuracy"], 2),
            number(found["log_loss"][0], 2),
            f"{number(found['calibration']['error'])} ({number(found['calibration']['chance'])})",
            estimate(drawn[name]["accuracy"], 2),
        ]
        for name, found in order.items()
    ]
    goal = ["goal", "0.95", "", "0.030", ""]
    head = ["method", "later strokes [95 %]", "log loss", "calibration error (by chance)", "at random [95 %]"]
    return markdown(head, [*rows, goal])


TABLES: dict[str, dict[str, Table]] = {
    "strokes": {"methods": strokes},
    "shapes": {"stamps": stamps},
    "reconstruct": {"conditions": reconstructions_and_goals, "savings": savings, "hidden": hidden},
    "reconstruct_objects": {"conditions": reconstructions_and_goals, "savings": savings, "hidden": hidden},
    "reconstruct_policies": {"policies": policies},
    "reconstruct_patch": {"methods": local_shapes, "by source": local_shapes_by_source},
    "reconstruct_patch_exact": {"methods": local_shapes},
}
