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
    if step == "fidelity":
        measured |= {"recordings": sections_of_recordings(measured["recordings"])}
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


def shown(name: str, *hidden: str) -> bool:
    """Tell whether a row is shown: an average rule, or a name with one of the hidden words, is not."""
    return not name.endswith(UNSHOWN) and not any(word in name for word in hidden)


METHOD_HEAD = (
    "method", "after 1", "after 3", "after 5", "after 10 [95 %]", "for objects like these", "mean of 1 to 10 [95 %]",
    "ECE", "log loss",
)  # fmt: skip
METHOD_CELLS: tuple[Cell, ...] = (
    *(lambda scores, touch=touch: number(at(scores["accuracy"], touch)["mean"], 2) for touch in (1, 3, 5)),
    last,
    lambda scores: estimate(scores["last_other_objects"], 2).partition(" ")[2],
    lambda scores: estimate(scores["mean"], 2),
    partial(mean_of, "calibration_error", 2),
    partial(mean_of, "log_loss", 2),
)


def methods_of_set(name: str) -> Table:
    """Accuracy of every method on a set of objects, of the paper's rules by votes."""

    def render(measured: Measured) -> str:
        methods = measured["sets"][name]["methods"]
        found = {method: scores for method, scores in methods.items() if shown(method, ", product")}
        return rows_over("methods", METHOD_HEAD, *METHOD_CELLS)({"methods": found})

    return render


def paper_methods(measured: Measured) -> str:
    """Accuracy after the last touch on the paper's two sets and on all their objects, below what the paper reports."""
    from experiments.recognize.report import PUBLISHED_I2T, PUBLISHED_PROPRIOCEPTION  # here, as it imports JAX

    sets, means = measured["sets"], measured["mean of the sets"]
    rows = [
        [f"{name}, the paper, one real skin", *(number(found[column], 2) for column in (*sets, "mean"))]
        for name, found in (("Imagine2touch", PUBLISHED_I2T), ("proprioception", PUBLISHED_PROPRIOCEPTION))
    ]
    for method in filter(shown, means):
        found = [last(each["methods"][method]) for each in sets.values()]
        rows.append([method, *found, estimate(means[method])])
    return markdown(["after 10 touches [95 %], {source}".format_map(measured), *sets, "mean of the five objects"], rows)


def paper_differences(measured: Measured) -> str:
    """Paired differences of votes on the paper's two sets, and how many pads would tell them within 3 points."""
    sets = measured["sets"]
    rows = []
    for pair in filter(lambda pair: shown(pair, "product"), next(iter(sets.values()))["paired"]):
        found = (each["paired"][pair] for each in sets.values())
        cells = ((estimate(each["last"], sign=True), str(each["pads_needed"])) for each in found)
        rows.append([pair.replace(", votes", ""), *(cell for both in cells for cell in both)])
    head = (cell for name in sets for cell in (f"{name} [95 %]", "pads for ± 3 points"))
    return markdown(["by votes, after 10 touches", *head], rows)


def sets_of_the_paper(measured: Measured) -> str:
    """Accuracy of the belief after the last touch on the paper's two sets."""
    names = [name for name in ("primitives", "tools") if name in measured["sets"]]
    sets = [measured["sets"][name]["methods"] for name in names]
    rows = [[method, *(last(each[method]) for each in sets)] for method in sets[0] if shown(method, ", ")]
    return markdown(["after 10 touches [95 %]", *names], rows)


def differences_of_set(name: str) -> Table:
    """Paired differences between kinds of evidence, and to the paper's rules."""

    def render(measured: Measured) -> str:
        rows = [
            [pair, *(estimate(found[key], sign=True) for key in ("last", "mean"))]
            for pair, found in measured["sets"][name]["paired"].items()
            if shown(pair, "votes", "proprioception", "readings and position")
        ]
        return markdown(["one method minus another", "after 10 touches", "mean of 1 to 10"], rows)

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


def settings_by_evidence(*kinds: str, hidden: Sequence[str] = ()) -> Table:
    """One row for each setting of a study (rows of `experiments.studies.report`): for some kinds of evidence the
    accuracy and its difference to the first setting, after the last touch for a single kind and over all touches.
    """

    def render(measured: Measured) -> str:
        found = measured["tables"]["methods"]
        _, _, last, *_ = names = [column["name"] for column in found["columns"]]
        by_setting: dict[str, list[str]] = {}
        for setting, evidence, after, _, whole, less, log_loss in found["rows"]:
            if (evidence in kinds or setting == "-") and shown(setting, *hidden):
                cells = [estimate(whole, 2), estimate(less, 2, sign=True), number(log_loss, 2)]
                cells = [estimate(after, 2), *cells] if len(kinds) == 1 else cells
                by_setting.setdefault(evidence if setting == "-" else setting, []).extend(cells)
        few = names[4:] if len(kinds) > 1 else [last, *names[4:]]
        head = [f"{kind}: {name}" for kind in kinds for name in few]
        return markdown(["setting", *head], [[setting, *cells] for setting, cells in by_setting.items()])

    return render


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


# --- skins from few presses, and what a recording is worth ---

CALIBRATED, PLAIN, NEIGHBOURS = "i2t.calibrate", "plain Gaussian process", "k nearest presses"
GAIN = f"{CALIBRATED} - {PLAIN}"
SHOWN_COUNTS = ("5", "20", "100", "300")  # of presses, where there are so many
SESSIONS = {  # of eFlesh, by the names of their folders
    "20250316_155729_probe": "`spatial`",
    "20250401_014340_probe": "`normal`, first",
    "20250401_015037_probe": "`normal`, second",
    "20250416_200533_probe": "`shear`",
}
SHOWN_HEADS = ("position", "depth"), ("force",), ("force",), ("shear",)  # of each of these sessions
HEAD_UNITS = {"position": "mm", "depth": "mm", "force": "N", "shear": "N"}
KEPT_SECTIONS = {
    "What it is": ("rows", "channels"),
    "Noise and drift": ("noise", "drift"),
    "Hysteresis and creep": ("hysteresis", "creep", "hysteresis_of_chips"),
    "Ceilings": ("repeat_std_uT", "r2_ceiling"),
    "Heads": ("heads",),
    "What one session says of another": ("r2",),
}


def press_counts(test: str, held_out: str) -> Table:
    """R² on one skin by the number of presses; of `i2t.calibrate` and its gain with intervals over blocks.

    Args:
        test: What is held out, as the metrics name it.
        held_out: The same in words, for the head.
    """

    def render(measured: Measured) -> str:
        curves, over = measured["r2"][test], measured["calibrate_over_blocks"][test]
        inside = measured["inside_90"][test][CALIBRATED]
        counts = _shown(over["r2"])
        rows = [
            *([name, *(number(curves[name][n]["mean"]) for n in counts)] for name in (NEIGHBOURS, PLAIN)),
            [f"`{CALIBRATED}`", *(estimate(over["r2"][n]) for n in counts)],
            [f"its gain on the {PLAIN}", *(estimate(over["differences"][GAIN][n], sign=True) for n in counts)],
            ["in its 90 % range", *(number(inside[n]["mean"], 2) for n in counts)],
        ]
        head = f"{measured['source']}, {measured['held_out'][test]} {held_out} [95 % over {over['blocks']} blocks]"
        return markdown([head, *counts], rows)

    return render


def kinds_of_skin(measured: Measured) -> str:
    """R² of `i2t.calibrate` on kinds of skin by the number of presses, with its gain on a plain Gaussian process."""
    rows, counts = [], _shown(next(iter(measured["cases"].values()))["inside_90"])
    for name, case in measured["cases"].items():
        r2, gains = case["r2"][CALIBRATED], case["differences"][GAIN]
        inside = [found["mean"] for found in case["inside_90"].values()]
        reached = (f"{number(r2[n]['mean'], 2)}, {estimate(gains[n], 2, sign=True)}" for n in counts)
        rows.append([name, *reached, f"{min(inside):.2f}-{max(inside):.2f}"])
    return markdown([measured["source"], *counts, "in its 90 % range"], rows)


def _shown(curve: Mapping[str, Any]) -> list[str]:
    """Numbers of presses that a table shows."""
    return [count for count in SHOWN_COUNTS if count in curve]


def sections_of_recordings(recordings: Measured) -> Measured:
    """What tables show of the sections of a report on recordings."""
    return {
        name: {
            title: {key: section[key] for key in KEPT_SECTIONS[title] if key in section}
            for title, section in sections.items()
            if title in KEPT_SECTIONS
        }
        for name, sections in recordings.items()
    }


def eflesh_sessions(measured: Measured) -> str:
    """Noise, drift, hysteresis and creep of eFlesh's sessions, next to the simulator's."""
    found = {name: measured["recordings"][name] for name in SESSIONS}
    moving = {name: sections["Hysteresis and creep"] for name, sections in found.items()}
    restless = {name: sections["Noise and drift"] for name, sections in found.items()}
    drift = {name: parts["drift"] for name, parts in restless.items()}
    at_rest = {name: x["noise"] for name, x in restless.items() if "in air" in x["noise"]["how"]}
    strokes = {name: x["hysteresis"] for name, x in moving.items() if "hysteresis" in x}
    creep = {name: x["creep"] for name, x in moving.items() if "creep" in x}
    chips = {name: x["hysteresis_of_chips"] for name, x in moving.items() if "hysteresis_of_chips" in x}
    ends = {name: sections["Ceilings"] for name, sections in found.items() if "r2_ceiling" in sections["Ceilings"]}

    def noise(x: Any) -> str:
        return f"{x['xy_uT']:.2f}, {x['z_uT']:.2f}"

    def stroke(x: Any) -> str:
        return ", ".join(number(sum(x[key]) / len(x[key])) for key in ("loop_share", "left_share"))

    def spread(x: Any) -> str:
        square = [each**2 for each in x["repeat_std_uT"]]
        return f"{(sum(square) / len(square)) ** 0.5:.1f}, {x['r2_ceiling']:.3f}"

    def growth(x: Any) -> str:
        return number(sum(x["share_per_decade"]) / x["holds"])

    quantities: list[tuple[str, Measured, Cell, Callable[[Any], str]]] = [
        ("noise in x and y, z (µT)", at_rest, noise, lambda x: noise(x["simulator"])),
        ("drift: median channel, largest (µT)", drift, lambda x: f"{x['median_uT']:.1f}, {x['largest_uT']:.1f}",
         lambda x: f"{x['simulator_uT']:.1f}, -"),
        ("hysteresis of a stroke, left after it", strokes, stroke, lambda _: "0, 0"),
        ("creep per tenfold time", creep, growth, lambda x: number(x["simulator"])),
        ("kept of the press before", chips, lambda x: number(max(map(abs, x["by_chip"]))),
         lambda x: number(x["simulator"])),
        ("scatter of repeats (µT), R² ceiling", ends, spread, lambda _: "-"),
    ]  # fmt: skip
    rows = [
        [title, *(cell(values[name]) if name in values else "-" for name in SESSIONS), own(next(iter(values.values())))]
        for title, values, cell, own in quantities
        if values
    ]
    return markdown(["real skins", *SESSIONS.values(), "simulator"], rows)


def eflesh_heads(measured: Measured) -> str:
    """Errors of heads on eFlesh's sessions: the kept one with the share in its 90 % range, and a baseline."""
    splits, rows = ("random rows", "whole blocks or strokes", "later in time"), []
    for (name, title), targets in zip(SESSIONS.items(), SHOWN_HEADS, strict=True):
        for target in targets:
            tests = measured["recordings"][name]["Heads"]["heads"][target]
            cells = [
                f"{test['kept']['rmse']:.3f} ({test['kept']['inside_90']:.2f}), {number(nearest['rmse'])}"
                for test in map(tests.__getitem__, splits)
                for nearest in [test["baselines"]["k nearest readings"]]
            ]
            rows.append([f"{title}, {target} ({HEAD_UNITS[target]})", *cells])
    return markdown(["real", *splits], rows)


STUDY_TABLES = {
    "mismatch": ("methods",),
    "open_set": ("auroc", "accuracy"),
    "sensitivity": ("methods",),
    "new_pad": ("methods",),
}
SETTINGS = {
    "mismatch": settings_by_evidence("fused", "readings", hidden=("meshes", "arm ")),
    "new_pad": settings_by_evidence("fused"),
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
        "methods": paper_methods,
        "differences": paper_differences,
    },
    "recognize": {
        "all": methods_of_set("all"),
        "sets of the paper": sets_of_the_paper,
        "all differences": differences_of_set("all"),
        "stopping": stopping_of_set("all", "fused"),
    },
    **{
        step: {name: study_table(name) for name in names} | ({"settings": SETTINGS[step]} if step in SETTINGS else {})
        for step, names in STUDY_TABLES.items()
    },
    "calibrate": {
        "random presses": press_counts("random presses", "random presses"),
        "whole blocks": press_counts("blocks of 6 mm", "presses in whole blocks"),
    },
    "calibrate_simulated": {"kinds of skin": kinds_of_skin},
    "fidelity": {"sessions": eflesh_sessions, "heads": eflesh_heads},
    "active_touch": {"policies": policies},
    "reconstruct": {"conditions": reconstructions_and_goals},
    "reconstruct_patch": {"methods": local_shapes, "by source": local_shapes_by_source},
    "reconstruct_tip": {"methods": TIPS},
}
