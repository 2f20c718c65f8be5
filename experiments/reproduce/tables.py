"""Tables of the documents, written from what the steps measured.

A table stands between `<!-- table: STEP NAME -->` and `<!-- end of table -->`; STEP is a step's name, which has a file
in docs/results, and NAME one of its tables below. Most are rows over the entries of a dict of what was measured.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from pathlib import Path
from typing import Any

from experiments.common.tables import markdown

Measured = dict[str, Any]
Table = Callable[[Measured], str]
Cell = Callable[[Any], str]  # of what was measured of a row
MARK = re.compile(r"(<!-- table: (\w+) ([^>]+?) -->\n).*?(<!-- end of table -->)", re.DOTALL)
KEPT_SCORES = ("accuracy", "mean", "last_other_objects", "by_object", "calibration_error", "log_loss", "stopping")
KEPT_OF_STUDIES = ("source", "pads", "runs", "episodes", "touches", "tables")
UNSHOWN = ", average"  # a rule between the other two
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
    if name not in TABLES.get(step, {}):
        raise ValueError(f"{page}: there is no table {name!r} of {step}; there are {', '.join(TABLES.get(step, {}))}")
    path = docs / "results" / f"{step}.json"
    if not path.exists():
        raise ValueError(f"{page}: {path} is missing; run python -m experiments.reproduce --only {step}")
    return TABLES[step][name](json.loads(path.read_text()))


def shortened(step: str, measured: Measured) -> Measured:
    """Metrics of a step that are kept with the documents: what tables show, with a few decimals.

    Args:
        step: Whose.
        measured: Its metrics.json.
    """
    if step in STUDY_TABLES:
        measured = {name: x for name, x in measured.items() if name in KEPT_OF_STUDIES}
    if "sets" in measured:
        for entry in measured["sets"].values():
            entry["methods"] = {name: x for name, x in entry["methods"].items() if not name.endswith(UNSHOWN)}
            for scores in entry["methods"].values():
                for name in [name for name in scores if name not in KEPT_SCORES]:
                    del scores[name]
    return {"step": step, **_rounded(measured)}


def _rounded(node: Any) -> Any:
    if isinstance(node, dict):
        return {name: _rounded(value) for name, value in node.items()}
    if isinstance(node, list):
        return [_rounded(value) for value in node]
    return round(node, DECIMALS) if isinstance(node, float) else node


# --- pieces ---


def number(value: float | None, decimals: int = 3) -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else f"{value:.{decimals}f}"


def estimate(found: Any, decimals: int = 3, sign: bool = False) -> str:
    """A mean with its interval, from a dict of mean, low and high or a list of the three."""
    mean, low, high = found.values() if isinstance(found, dict) else found
    plus = "+" if sign else ""
    limits = "" if low is None or high is None else f" [{low:{plus}.{decimals}f}, {high:{plus}.{decimals}f}]"
    return f"{mean:{plus}.{decimals}f}{limits}"


def percent(found: Mapping[str, Any], decimals: int = 1) -> str:
    """A rate with its interval in percent."""
    mean, low, high = (None if value is None else 100 * value for value in found.values())
    limits = "" if low is None or high is None else f" [{low:.{decimals}f}, {high:.{decimals}f}]"
    return f"{mean:.{decimals}f} %{limits}"


def at(accuracy: Mapping[str, Sequence[Any]], touch: int) -> dict[str, Any]:
    """The estimate after a number of touches, -1 for the last."""
    index = touch - 1 if touch > 0 else touch
    return {name: values[index] for name, values in accuracy.items()}


def rows_over(path: str, head: Sequence[str], *cells: Cell, kept: bool = False) -> Table:
    """A table with a row for each entry of a dict.

    Args:
        path: Of the dict in what was measured, its names divided by "/".
        head: Names of the columns; the first may name a value of what was measured, as {source}.
        *cells: What makes the cells of a row after its name.
        kept: Whether the name of what was kept is marked.
    """

    def render(measured: Measured) -> str:
        entries = reduce(lambda node, name: node[name], path.split("/"), measured)
        best = measured["best"] if kept else None
        rows = [
            [f"{name} (kept)" if name == best else name, *(cell(found) for cell in cells)]
            for name, found in entries.items()
            if not name.endswith(UNSHOWN)
        ]
        return markdown([head[0].format_map(measured), *head[1:]], rows)

    return render


# --- recognition ---


def last(scores: Mapping[str, Any]) -> str:
    """Accuracy after the last touch."""
    return estimate(at(scores["accuracy"], -1))


def mean_of(key: str, decimals: int, scores: Mapping[str, Any]) -> str:
    """Mean over touches of a score."""
    return number(sum(scores[key]) / len(scores[key]), decimals)


METHOD_HEAD = (
    "method", "after 1", "after 3", "after 5", "after 10 [95 %]", "mean of 1 to 10 [95 %]", "ECE", "log loss",
)  # fmt: skip
METHOD_CELLS: tuple[Cell, ...] = (
    *(lambda scores, touch=touch: number(at(scores["accuracy"], touch)["mean"]) for touch in (1, 3, 5)),
    last,
    lambda scores: estimate(scores["mean"]),
    partial(mean_of, "calibration_error", 3),
    partial(mean_of, "log_loss", 2),
)


def methods_of_set(name: str) -> Table:
    """Accuracy of every method on a set of objects."""
    return rows_over(f"sets/{name}/methods", METHOD_HEAD, *METHOD_CELLS)


def differences_of_set(name: str) -> Table:
    """Paired differences between methods."""
    head = ("one method minus another", "after the last touch", "mean over touches")
    cells = (lambda found, key=key: estimate(found[key], sign=True) for key in ("last", "mean"))
    return rows_over(f"sets/{name}/paired", head, *cells)


def objects_of_set(name: str) -> Table:
    """Accuracy after the last touch by the object that was there."""

    def render(measured: Measured) -> str:
        objects = measured["sets"][name]["objects"]
        cells = (lambda scores, each=each: estimate(scores["by_object"][each]["last"], 2) for each in objects)
        return rows_over(f"sets/{name}/methods", ["method", *objects], *cells)(measured)

    return render


def stopping_of_set(name: str, method: str) -> Table:
    """Errors of the stopping rule against those asked for."""

    def render(measured: Measured) -> str:
        rows = [
            [
                f"{100 * found['requested_error']:.0f} %", percent(found["stopped"], 0),
                percent(found["stopped_error"]), f"{100 * found['stopped_predicted_error']:.1f} %",
                percent(found["error"]), f"{100 * found['predicted_error']:.1f} %", estimate(found["touches"], 1),
            ]
            for found in measured["sets"][name]["methods"][method]["stopping"]
        ]  # fmt: skip
        return markdown(
            ["asked error", "stopped early", "of those: observed error", "reported", "all episodes: observed error",
             "reported", "mean touches"],
            rows,
        )  # fmt: skip

    return render


# --- studies of recognition ---


def study_table(name: str) -> Table:
    """One of the tables that a study's metrics hold in a form of their own (`experiments.studies.report`)."""

    def render(measured: Measured) -> str:
        found = measured["tables"][name]
        rows = [[_cell(x, column) for x, column in zip(row, found["columns"], strict=True)] for row in found["rows"]]
        return markdown([column["name"] for column in found["columns"]], rows)

    return render


def _cell(value: Any, column: Mapping[str, Any]) -> str:
    """A word as it is; a number or an interval as its column says; a dash where there is none."""
    if isinstance(value, str):
        return value
    if not isinstance(value, dict):
        return number(value, column["decimals"])
    if value["mean"] is None:
        return "-"
    if column["percent"]:
        return percent(value, column["decimals"])
    return estimate(value, column["decimals"], column["signed"])


# --- prediction ---


def r2_of(decimals: int, scores: Mapping[str, Any]) -> str:
    """R² of one pad and seed with its interval over sessions."""
    return estimate([scores["r2"], *scores["r2_interval"]], decimals)


def numbers_of(keys: Sequence[str], decimals: int = 2) -> tuple[Cell, ...]:
    """Cells of single scores."""
    return tuple(lambda scores, key=key: number(scores[key], decimals) for key in keys)


ERRORS, ERROR_TITLES = ("rmse", "rmse_sigma", "cosine"), ("RMSE µT", "RMSE / sigma", "median cosine")
ON_UNSEEN = ("on six unseen objects, {source}", "R² [95 % over sessions]", *ERROR_TITLES)
OVER_PADS = ("method", "R² [95 % over pads]", *ERROR_TITLES)
OVER_PADS_CELLS: tuple[Cell, ...] = (
    lambda scores: estimate(scores["r2"], 2),
    *(lambda scores, key=key: number(scores[key][0], 2) for key in ERRORS),
)


def predictors_on_recording(over: str) -> Table:
    """Scores of every predictor on a recording's held-out presses; `over` says what the intervals resample."""
    head = ("on one skin, {source}", f"R² [95 % over {over}]", "median over channels", "in the 90 % range")
    cells: tuple[Cell, ...] = (partial(r2_of, 3), *numbers_of(["r2_median"], 3), *numbers_of(["coverage_90"]))
    return rows_over("methods", head, *cells, kept=True)


def predictors_by_object(measured: Measured) -> str:
    """R² of every predictor on each test object, mean over pads."""
    scores = measured["by_object"]
    rows = [
        [method, *(number(scores[name][method][0], 2) for name in scores)] for method in next(iter(scores.values()))
    ]
    return markdown(["method", *scores], rows)


# --- active touch ---

ACTIVE_TOUCHES = (1, 4, 16)  # touches of the table


def policies(measured: Measured) -> str:
    """Accuracy of every policy after some touches, with intervals over pads."""
    rows = [
        [name, *(estimate(curve[touch - 1], 2) for touch in ACTIVE_TOUCHES)]
        for name, curve in measured["accuracy"].items()
    ]
    return markdown(["policy", "after 1", *map(str, ACTIVE_TOUCHES[1:])], rows)


# --- shapes from touches ---

_ENDS = (("iou", 2), ("f_score", 2), ("coverage", 2), ("band_mm", 1))  # scores after the last touch, and decimals


def reconstructions(measured: Measured) -> str:
    """Scores of every condition after some touches: the distance as a share of that at the start, and the last ones."""
    conditions = measured["conditions"]
    counts = sorted({int(count) for found in conditions.values() for count in found["after"]} - {0})
    rows = []
    for name, found in conditions.items():
        after = found["after"]
        begun = number(after["0"]["chamfer_mm"][0], 2)
        course = [estimate(after[str(count)]["ratio"], 2) if str(count) in after else "" for count in counts]
        last = after[max(after, key=int)]
        rows.append([name, begun, *course, *(number(last[score][0], decimals) for score, decimals in _ENDS)])
    touches = [f"{count} touch{'es' if count > 1 else ''}" for count in counts]
    return markdown(["condition", "start, mm", *touches, "IoU", "F-score", "in the 90 % band", "band, mm"], rows)


SURFACE_GOALS = {"5 touches": "0.45", "20 touches": "0.28", "IoU": "0.75", "in the 90 % band": "0.88 to 0.92"}
NOT_ON_THE_PAGE = ("10 touches", "F-score")


def reconstructions_and_goals(measured: Measured) -> str:
    """The main columns of the same, with a last row of what was wanted."""
    lines = reconstructions(measured).splitlines()
    head, _, *rows = ([cell.strip() for cell in line[1:-1].split("|")] for line in lines)
    kept = [place for place, column in enumerate(head) if column not in NOT_ON_THE_PAGE]
    rows += [["goal", *(SURFACE_GOALS.get(column, "") for column in head[1:])]]
    return markdown([head[place] for place in kept], [[row[place] for place in kept] for row in rows])


def scores_of(*scores: tuple[str, str, int]) -> Table:
    """Scores of every method, each by its name, its title and its decimals; nothing where a method has none."""
    head = ["method", *(title for _, title, _ in scores)]
    return rows_over("methods", head, *(partial(_span, name, decimals) for name, _, decimals in scores))


def _span(name: str, decimals: int, scores: Mapping[str, Any]) -> str:
    """A mean with its interval, if it has any; nothing where there is no such score."""
    if name not in scores:
        return ""
    mean, low, high = scores[name]
    return estimate([mean, low, high] if low < high else [mean, None, None], decimals)


TIPS = scores_of(
    ("position_mm_median", "position, median mm", 2), ("position_mm_90", "position, 90 % mm", 1),
    ("depth_error", "depth, mean mm", 2), ("coverage_90", "90 % covers", 2),
)  # fmt: skip
PATCH_SCORES = (
    ("mask_iou", "mask IoU"), ("mask_skill", "mask skill"), ("contact_iou", "contact IoU"),
    ("centre_mm_median", "centre, median mm"), ("coverage_90", "90 % covers"), ("crps_ratio", "CRPS / prior's"),
)  # fmt: skip
CRPS_GOALS = ("", "0.65", "0.52")  # of the prior, one stop and the press curve
STOPS = ("prior", "one stop", "press curve")


def local_shapes(measured: Measured) -> str:
    """Scores of every method over all test objects, and what was wanted of CRPS."""
    rows = [
        [name, *(_span(score, 2, found) for score, _ in PATCH_SCORES), goal]
        for name, found, goal in zip(STOPS, measured["methods"].values(), CRPS_GOALS, strict=True)
    ]
    return markdown(["method", *(title for _, title in PATCH_SCORES), "its goal"], rows)


def local_shapes_by_source(measured: Measured) -> str:
    """Masks on objects of the catalogue, and on those drawn at random: a row for each source."""
    shown = (("mask_iou", "IoU", 0), ("mask_skill", "skill", 1))  # and the first method
    head = [f"{title}, {stop}" for _, title, first in shown for stop in STOPS[first:]]
    rows = [
        [
            f"{source} ({found['objects']})",
            *(_span(score, 2, of) for score, _, first in shown for of in list(found["methods"].values())[first:]),
        ]
        for source, found in measured["sources"].items()
    ]
    return markdown(["test objects", *head], rows)


STUDY_TABLES = {
    "mismatch": ("methods",),
    "open_set": ("auroc", "accuracy"),
    "sensitivity": ("methods",),
    "new_pad": ("methods",),
}
TABLES: dict[str, dict[str, Table]] = {
    "train": {"predictors": rows_over("methods", ON_UNSEEN, partial(r2_of, 2), *numbers_of(ERRORS))},
    "train_blocks": {"predictors": predictors_on_recording("blocks")},
    "train_time": {"predictors": predictors_on_recording("groups of 20 presses")},
    "study": {
        "predictors": rows_over("over_pads", OVER_PADS, *OVER_PADS_CELLS),
        "by object": predictors_by_object,
    },
    "paper": {
        "primitives": methods_of_set("primitives"),
        "tools": methods_of_set("tools"),
        "mean": rows_over("mean of the sets", ("method", "after 10 [95 %]"), estimate),
        "primitives differences": differences_of_set("primitives"),
        "tools differences": differences_of_set("tools"),
        "primitives by object": objects_of_set("primitives"),
        "tools by object": objects_of_set("tools"),
    },
    "recognize": {
        "all": methods_of_set("all"),
        "primitives": methods_of_set("primitives"),
        "tools": methods_of_set("tools"),
        "all other objects": rows_over(
            "sets/all/methods",
            ("method", "these objects", "objects like these"),
            last,
            lambda scores: estimate(scores["last_other_objects"]),
        ),
        "all by object": objects_of_set("all"),
        "all differences": differences_of_set("all"),
        "stopping": stopping_of_set("all", "fused"),
    },
    **{step: {name: study_table(name) for name in names} for step, names in STUDY_TABLES.items()},
    "active_touch": {"policies": policies},
    "reconstruct": {"conditions": reconstructions_and_goals},
    "reconstruct_patch": {"methods": local_shapes, "by source": local_shapes_by_source},
    "reconstruct_tip": {"methods": TIPS},
}
