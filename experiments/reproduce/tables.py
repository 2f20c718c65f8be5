"""Tables of the documents, written from what the steps measured.

A table stands between `<!-- table: STEP NAME -->` and `<!-- end of table -->`; STEP is a step's name, which has a file
in docs/results, and NAME one of its tables below. What stands below `<!-- table to come: STEP NAME -->` is kept until
there is such a file; then the mark becomes that of a table.
"""

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

Measured = dict[str, Any]
Table = Callable[[Measured], str]
MARK = re.compile(r"(<!-- table: (\w+) ([^>]+?) -->\n).*?(<!-- end of table -->)", re.DOTALL)
TO_COME = re.compile(r"<!-- table to come: (\w+) ([^>]+?) -->\n")
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

        after = MARK.sub(fill, TO_COME.sub(partial(_measured_now, docs), before))
        if after != before:
            page.write_text(after)
    return written


def _measured_now(docs: Path, found: re.Match[str]) -> str:
    """The mark of a table to come, or of a table if it was measured since."""
    if not (docs / "results" / f"{found[1]}.json").exists():
        return found[0]
    return f"<!-- table: {found[1]} {found[2]} -->\n"


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


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table.

    Args:
        head: Names of the columns.
        rows: Cells.
    """
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float | None, decimals: int = 3) -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else f"{value:.{decimals}f}"


def estimate(found: Any, decimals: int = 3, sign: bool = False) -> str:
    """A mean with its interval, from a dict of mean, low and high or a list of the three."""
    mean, low, high = found.values() if isinstance(found, dict) else found
    plus = "+" if sign else ""
    limits = "" if low is None or high is None else f" [{low:{plus}.{decimals}f}, {high:{plus}.{decimals}f}]"
    return f"{mean:{plus}.{decimals}f}{limits}"


def at(accuracy: Mapping[str, Sequence[Any]], touch: int) -> dict[str, Any]:
    """The estimate after a number of touches, -1 for the last."""
    index = touch - 1 if touch > 0 else touch
    return {name: values[index] for name, values in accuracy.items()}


# --- recognition ---


def methods_of_set(name: str) -> Table:
    """Accuracy of every method on a set of objects."""

    def render(measured: Measured) -> str:
        entry = measured["sets"][name]
        rows = []
        for method, scores in entry["methods"].items():
            accuracy = scores["accuracy"]
            early = [number(at(accuracy, touch)["mean"]) for touch in (1, 3, 5)]
            errors = [number(sum(scores[key]) / len(scores[key]), places) for key, places in _ERRORS]
            rows.append([method, *early, estimate(at(accuracy, -1)), estimate(scores["mean"]), *errors])
        return markdown(
            ["method", "after 1", "after 3", "after 5", "after 10 [95 %]", "mean of 1 to 10 [95 %]", "ECE", "log loss"],
            rows,
        )

    return render


_ERRORS = (("calibration_error", 3), ("log_loss", 2))


def other_objects(name: str) -> Table:
    """Accuracy after the last touch, for these objects and for others like them."""

    def render(measured: Measured) -> str:
        rows = [
            [method, estimate(at(scores["accuracy"], -1)), estimate(scores["last_other_objects"])]
            for method, scores in measured["sets"][name]["methods"].items()
        ]
        return markdown(["method", "these objects", "objects like these"], rows)

    return render


def objects_of_set(name: str) -> Table:
    """Accuracy after the last touch by the object that was there."""

    def render(measured: Measured) -> str:
        entry = measured["sets"][name]
        rows = [
            [method, *(estimate(scores["by_object"][one]["last"], 2) for one in entry["objects"])]
            for method, scores in entry["methods"].items()
        ]
        return markdown(["method", *entry["objects"]], rows)

    return render


def differences_of_set(name: str) -> Table:
    """Paired differences between methods."""

    def render(measured: Measured) -> str:
        rows = [
            [pair, estimate(found["last"], sign=True), estimate(found["mean"], sign=True)]
            for pair, found in measured["sets"][name]["paired"].items()
        ]
        return markdown(["one method minus another", "after the last touch", "mean over touches"], rows)

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


def percent(found: Mapping[str, Any], decimals: int = 1) -> str:
    """A rate with its interval in percent."""
    mean, low, high = (None if value is None else 100 * value for value in found.values())
    limits = "" if low is None or high is None else f" [{low:.{decimals}f}, {high:.{decimals}f}]"
    return f"{mean:.{decimals}f} %{limits}"


def means_of_sets(measured: Measured) -> str:
    """The paper's last column: all objects of both sets."""
    rows = [
        [method, estimate(found)] for method, found in measured["mean of the sets"].items() if "average" not in method
    ]
    return markdown(["method", "after 10 [95 %]"], rows)


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


def predictors(measured: Measured) -> str:
    """Scores of every predictor over pads."""
    rows = []
    for method, scores in measured["over_pads"].items():
        others = [number(scores[key][0], 2) for key in ("rmse", "rmse_sigma", "cosine")]
        rows.append([method, estimate(scores["r2"], 2), *others])
    return markdown(["method", "R² [95 % over pads]", "RMSE µT", "RMSE / sigma", "median cosine"], rows)


def predictors_of_one_pad(measured: Measured) -> str:
    """Scores of every predictor with one pad and seed, with intervals over sessions."""
    rows = []
    for method, scores in measured["methods"].items():
        r2 = estimate([scores["r2"], *scores["r2_interval"]], 2)
        rows.append([method, r2, *(number(scores[key], 2) for key in ("rmse", "rmse_sigma", "cosine"))])
    head = f"on six unseen objects, {measured['source']}"
    return markdown([head, "R² [95 % over sessions]", "RMSE µT", "RMSE / sigma", "median cosine"], rows)


def predictors_on_recording(over: str) -> Table:
    """Scores of every predictor on a recording's held-out presses.

    Args:
        over: What the intervals resample.
    """

    def render(measured: Measured) -> str:
        rows = [
            [
                f"{method} (kept)" if method == measured["best"] else method,
                estimate([scores["r2"], *scores["r2_interval"]]),
                number(scores["r2_median"]),
                number(scores["coverage_90"], 2),
            ]
            for method, scores in measured["methods"].items()
        ]
        return markdown(
            [
                f"on one skin, {measured['source']}",
                f"R² [95 % over {over}]",
                "median over channels",
                "in the 90 % range",
            ],
            rows,
        )

    return render


def predictors_by_object(measured: Measured) -> str:
    """R² of every predictor on each test object, mean over pads."""
    scores = measured["by_object"]
    rows = [
        [method, *(number(scores[name][method][0], 2) for name in scores)] for method in next(iter(scores.values()))
    ]
    return markdown(["method", *scores], rows)


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


_PATCH_SCORES = (
    ("mask_iou", "mask IoU", 2), ("contact_iou", "contact IoU", 2), ("centre_mm_median", "centre, median mm", 2),
    ("centre_mm_90", "centre, 90 % mm", 1), ("crps_ratio", "CRPS / prior's", 2), ("coverage_90", "90 % covers", 2),
)  # fmt: skip


def local_shapes(measured: Measured) -> str:
    """Scores of every method that tells a patch from a press."""
    head = ["method", *(title for _, title, _ in _PATCH_SCORES)]
    return markdown(head, _patch_rows(measured["methods"], _PATCH_SCORES))


_TIP_SCORES = (
    ("position_mm_median", "position, median mm", 2), ("position_mm_90", "position, 90 % mm", 1),
    ("within_1mm", "within 1 mm", 2), ("depth_error", "depth, mean mm", 2), ("coverage_90", "90 % covers", 2),
    ("bits", "bits", 1),
)  # fmt: skip


def tips_of_recording(measured: Measured) -> str:
    """Scores of every method that tells where a tip pressed."""
    head = ["method", *(title for _, title, _ in _TIP_SCORES)]
    return markdown(head, _patch_rows(measured["methods"], _TIP_SCORES))


def _patch_rows(methods: Mapping[str, Any], scores: Sequence[tuple[str, str, int]]) -> list[list[str]]:
    return [
        [name, *(_span(found[score], decimals) if score in found else "" for score, _, decimals in scores)]
        for name, found in methods.items()
    ]


def _span(found: Sequence[float], decimals: int) -> str:
    """A mean with its interval."""
    mean, low, high = found
    return f"{mean:.{decimals}f} ({low:.{decimals}f}-{high:.{decimals}f})"


STUDY_TABLES = {
    "mismatch": ("methods",),
    "open_set": ("auroc", "accuracy"),
    "sensitivity": ("methods",),
    "new_pad": ("methods",),
}
TABLES: dict[str, dict[str, Table]] = {
    "train": {"predictors": predictors_of_one_pad},
    "train_blocks": {"predictors": predictors_on_recording("blocks")},
    "train_time": {"predictors": predictors_on_recording("groups of 20 presses")},
    "study": {"predictors": predictors, "by object": predictors_by_object},
    "paper": {
        "primitives": methods_of_set("primitives"),
        "tools": methods_of_set("tools"),
        "mean": means_of_sets,
        "primitives differences": differences_of_set("primitives"),
        "tools differences": differences_of_set("tools"),
        "primitives by object": objects_of_set("primitives"),
        "tools by object": objects_of_set("tools"),
    },
    "recognize": {
        "all": methods_of_set("all"),
        "primitives": methods_of_set("primitives"),
        "tools": methods_of_set("tools"),
        "all other objects": other_objects("all"),
        "all by object": objects_of_set("all"),
        "all differences": differences_of_set("all"),
        "stopping": stopping_of_set("all", "fused"),
    },
    **{step: {name: study_table(name) for name in names} for step, names in STUDY_TABLES.items()},
    "reconstruct": {"conditions": reconstructions},
    "reconstruct_patch": {"methods": local_shapes},
    "reconstruct_tip": {"methods": tips_of_recording},
}
