"""Tables of surfaces from touches, patches below single presses, and recognised shapes."""

from experiments.common.cells import Measured, Table, shown, span
from experiments.common.tables import cell, markdown
from experiments.reconstruct.tables import conditions, conditions_and_goals, hidden, policies, savings

PATCH_SCORES = (
    ("mask_iou", "mask IoU"), ("mask_skill", "mask skill"),
    ("centre_mm_median", "median centre error, mm"), ("coverage_90", "90 % coverage"), ("crps_mm", "CRPS, mm"),
    ("crps_ratio", "CRPS / CRPS of the prior"),
)  # fmt: skip
METHOD_TITLES = ("prior", "one stop", "press curve", "press curve, pad fitted to 300 presses")
LEAD = "lead of time-warped strokes"  # over each other method, on the same strokes


def local_shapes(measured: Measured) -> str:
    """Scores of every method over all test objects, the goals of CRPS, and medians over the few edges."""
    methods = measured["methods"].values()
    shown = [(score, title) for score, title in PATCH_SCORES if all(score in scores for scores in methods)]
    rows = [
        [
            name,
            *(span(score, 2, scores) for score, _ in shown),
            goal,
            f"{cell(scores['edge_degrees_median'][0], 0)}, {cell(scores['edge_mm_median'][0], 1)}",
        ]
        for name, scores, goal in zip(METHOD_TITLES, methods, ("", "0.65", "0.52", ""), strict=False)
    ]
    edges = f"median edge error, degrees and mm ({measured['edges']} presses)"
    return markdown(["method", *(title for _, title in shown), "CRPS goal", edges], rows)


def local_shapes_by_source(measured: Measured) -> str:
    """Scores of masks, with a row for each source of test objects."""
    shown = (("mask_iou", "mask IoU", 0), ("mask_skill", "mask skill", 1))  # score, title, first method
    titles = METHOD_TITLES[: len(measured["methods"])]
    head = [f"{title}: {stop}" for _, title, first in shown for stop in titles[first:]]
    rows = [
        [
            f"{source} ({result['objects']})",
            *(
                span(score, 2, scores)
                for score, _, first in shown
                for scores in list(result["methods"].values())[first:]
            ),
        ]
        for source, result in measured["sources"].items()
    ]
    return markdown(["test objects", *head], rows)


def stamps(measured: Measured) -> str:
    """Accuracy of stamp recognition by the way of holding out, below the published accuracy."""
    held_out = {
        "random": "random fifths", "location": "position, by squares", "travel": "travel, by fifths",
        "angle": "rotation, by sectors",
    }  # fmt: skip
    goals = {"random": "0.92 (classifier); 0.95 (best)", "location": "0.85", "20": "0.85"}
    methods = list(measured["splits"]["random"])
    totals = {
        name: {method: scores["total"] for method, scores in by_method.items()}
        for name, by_method in measured["splits"].items()
    }
    rows = [
        [
            title,
            *(
                "".join(cell(by_method[scores], 2) for scores in by_method if scores.startswith(method))
                for method in methods
            ),
            goals.get(name, ""),
        ]
        for name, by_method in (totals | measured["new"]).items()
        for title in [held_out.get(name, f"new skin, {name} training presses per shape")]
    ]
    head = [f"held out, {measured['source']}", *(f"{method} [95 %]" for method in methods), "goal"]
    published = ["random fifths (published: one real skin)", "0.92", *[""] * len(methods)]
    return markdown(head, [published, *rows])


def strokes(measured: Measured) -> str:
    """Accuracy and calibration of methods on later strokes."""
    rows = [
        [
            name,
            cell(scores["accuracy"], 2),
            f"{cell(scores['calibration']['error'])} ({cell(scores['calibration']['chance'])})",
            cell(scores[LEAD], 2, signed=True) if LEAD in scores else "",
        ]
        for name, scores in measured["splits"]["in file order"]["methods"].items()
        if shown(name, "logistic", "paper's classifier, raw", "paths")
    ]
    goal = ["goal", "0.95", "0.030", ""]
    head = ["method", "accuracy on later strokes [95 %]", "calibration error (expected by chance)", LEAD]
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
