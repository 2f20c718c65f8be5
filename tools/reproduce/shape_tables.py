"""Tables of shapes from touches: surfaces, and the surface below one press."""

from experiments.common.cells import Measured, Table, span
from experiments.common.tables import cell, markdown
from experiments.reconstruct.tables import conditions, conditions_and_goals, hidden, policies, savings

PATCH_SCORES = (
    ("mask_iou", "mask IoU"), ("mask_skill", "mask skill"), ("contact_iou", "contact IoU"),
    ("centre_mm_median", "centre, median mm"), ("coverage_90", "90 % covers"), ("crps_mm", "CRPS, mm"),
    ("crps_ratio", "CRPS / prior's"),
)  # fmt: skip
CRPS_GOALS = ("", "0.65", "0.52", "")  # of CRPS / prior's
STOPS = ("prior", "one stop", "press curve", "press curve, pad fitted to 300 presses")
BETTER_BY = "time-warped strokes better by"  # a score of every other method on the same strokes


def local_shapes(measured: Measured) -> str:
    """Scores of every method over all test objects, what was wanted of CRPS, and medians of edges, which are few."""
    methods = measured["methods"].values()
    shown = [(score, title) for score, title in PATCH_SCORES if all(score in found for found in methods)]
    rows = [
        [
            name,
            *(span(score, 2, found) for score, _ in shown),
            goal,
            f"{cell(found['edge_degrees_median'][0], 0)}, {cell(found['edge_mm_median'][0], 1)}",
        ]
        for name, found, goal in zip(STOPS, methods, CRPS_GOALS, strict=False)
    ]
    edges = f"edge, degrees and mm ({measured['edges']} presses)"
    return markdown(["method", *(title for _, title in shown), "its goal", edges], rows)


def local_shapes_by_source(measured: Measured) -> str:
    """Masks on objects of the catalogue, and on those drawn at random: a row for each source."""
    shown = (("mask_iou", "IoU", 0), ("mask_skill", "skill", 1))  # and the first method
    stops = STOPS[: len(measured["methods"])]
    head = [f"{title}, {stop}" for _, title, first in shown for stop in stops[first:]]
    rows = [
        [
            f"{source} ({found['objects']})",
            *(span(score, 2, of) for score, _, first in shown for of in list(found["methods"].values())[first:]),
        ]
        for source, found in measured["sources"].items()
    ]
    return markdown(["test objects", *head], rows)


HELD_OUT = {
    "random": "random fifths", "location": "squares of position", "travel": "fifths of travel",
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
            *("".join(cell(of[each], 2) for each in of if each.startswith(method)) for method in methods),
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
            cell(found["accuracy"], 2),
            cell(found["log_loss"][0], 2),
            f"{cell(found['calibration']['error'])} ({cell(found['calibration']['chance'])})",
            cell(found[BETTER_BY], 2, signed=True) if BETTER_BY in found else "",
            cell(drawn[name]["accuracy"], 2),
        ]
        for name, found in order.items()
    ]
    goal = ["goal", "0.95", "", "0.030", "", ""]
    head = [
        "method", "later strokes [95 %]", "log loss", "calibration error (by chance)", BETTER_BY, "at random [95 %]",
    ]  # fmt: skip
    return markdown(head, [*rows, goal])


TABLES: dict[str, dict[str, Table]] = {
    "strokes": {"methods": strokes},
    "shapes": {"stamps": stamps},
    "reconstruct": {"conditions": conditions_and_goals, "savings": savings, "hidden": hidden},
    "reconstruct_objects": {"conditions": conditions_and_goals, "savings": savings, "hidden": hidden},
    "reconstruct_baselines": {"conditions": conditions, "savings": savings},
    "reconstruct_fitted": {"conditions": conditions, "savings": savings},
    "reconstruct_policies": {"policies": policies},
    "reconstruct_patch": {"methods": local_shapes, "by source": local_shapes_by_source},
    "reconstruct_patch_exact": {"methods": local_shapes},
}
