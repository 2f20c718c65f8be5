"""Tables of recognition: the paper's method, the belief, its studies, and policies of touching."""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from experiments.common.cells import Cell, Measured, Table, at, percent, rows_over, shown
from experiments.common.tables import cell, markdown
from experiments.studies.tables import study_table
from i2t.intervals import COVERAGE, Estimate, holm, p_values


def last(scores: Mapping[str, Any]) -> str:
    """Accuracy after the last touch."""
    return cell(at(scores["accuracy"], -1))


def mean_of(key: str, decimals: int, scores: Mapping[str, Any]) -> str:
    """Mean over touches of a score."""
    return cell(sum(scores[key]) / len(scores[key]), decimals)


STANDS = " †"  # after Holm's correction
METHOD_HEAD = (
    "method", "after 1", "after 3", "after 5", "after 10 [95 %]", "for objects like these", "mean of 1 to 10 [95 %]",
    "ECE", "log loss",
)  # fmt: skip
METHOD_CELLS: tuple[Cell, ...] = (
    *(lambda scores, touch=touch: cell(at(scores["accuracy"], touch)["mean"], 2) for touch in (1, 3, 5)),
    last,
    lambda scores: cell(scores["last_other_objects"], 2).partition(" ")[2],
    lambda scores: cell(scores["mean"], 2),
    partial(mean_of, "calibration_error", 2),
    partial(mean_of, "log_loss", 2),
)


def methods_of_set(name: str) -> Table:
    """Accuracy of each evidence, of readings with presence and of all on a set of objects and, of the paper's rules, by
    votes with masks and with the GP.
    """
    others = (", product", "depth", "measured force", "median force", "constant")  # in the paper's own table
    pairs = ("and position", "position and", "presence, ")  # of kinds of evidence
    return rows_over(f"sets/{name}/methods", METHOD_HEAD, *METHOD_CELLS, hidden=others + pairs)


def paper_methods(measured: Measured) -> str:
    """Accuracy after the last touch on the paper's two sets and on all their objects, below what the paper reports."""
    from experiments.recognize.report import PUBLISHED_I2T, PUBLISHED_PROPRIOCEPTION  # here, as it imports JAX

    sets, means = measured["sets"], measured["mean of the sets"]
    rows = [
        [f"{name}, the paper, one real skin", *(cell(found[column], 2) for column in (*sets, "mean"))]
        for name, found in (("Imagine2touch", PUBLISHED_I2T), ("proprioception", PUBLISHED_PROPRIOCEPTION))
    ]
    chances = [1 / len(each["objects"]) for each in sets.values()]
    rows.append(["chance", *(cell(each, 2) for each in (*chances, len(sets) / sum(1 / each for each in chances)))])
    for method in (each for each in means if shown(each, "measured force")):
        found = [last(each["methods"][method]) for each in sets.values()]
        rows.append([method, *found, cell(means[method])])
    return markdown(["after 10 touches [95 %], {source}".format_map(measured), *sets, "mean of the five"], rows)


def stand_together(
    differences: Sequence[Mapping[str, float]], measured: Measured, primary: int | None = None
) -> list[str]:
    """Cells of differences, marked where they stand after Holm's correction over all but the primary one; degrees of
    freedom are those of the pads, the least that an interval has.
    """
    estimates = np.array([[each["mean"], each["low"], each["high"]] for each in differences]).T
    p = p_values(Estimate(*estimates), len(measured["pads"]) - 1)
    others = np.flatnonzero(np.isfinite(p) & (np.arange(len(p)) != primary))
    stands = np.zeros(len(p), bool)
    stands[others] = holm(p[others]) < 1 - COVERAGE
    return [cell(each, 2, signed=True) + STANDS * bool(mark) for each, mark in zip(differences, stands, strict=True)]


def paper_differences(measured: Measured, hidden: Sequence[str] = ()) -> str:
    """Paired differences on the paper's two sets with how many pads would tell them within 3 points, and of the means
    over all objects; none of a pair whose name has a hidden word.
    """
    sets, means = measured["sets"], measured["differences of these means"]
    rows, pairs = [], [pair for pair in next(iter(sets.values()))["paired"] if shown(pair, *hidden)]
    found = [[*(each["paired"][pair]["last"] for each in sets.values()), means[pair]] for pair in pairs]
    stand = stand_together([each for row in found for each in row], measured, primary=len(sets))
    for number, pair in enumerate(pairs):
        *parts, mean = stand[number * (len(sets) + 1) : (number + 1) * (len(sets) + 1)]
        needed = [each["paired"][pair]["pads_needed"] for each in sets.values()]
        cells = [f"{part}; {pads}" for part, pads in zip(parts, needed, strict=True)]
        _, _, rule = pair.rpartition(", ")
        brief = re.sub(r"Imagine2touch \(paper's network, (.*?)\)", r"\1", pair)
        brief = re.sub(r"paper's network and measured force, (\w+)", r"\1 and force", brief)
        brief = re.sub(f"same rules, |, {rule}", "", brief)
        rows.append([f"{brief} ({rule})", *cells, mean])
    return markdown(["after 10 touches", *(f"{name} [95 %]; pads" for name in sets), "mean of five"], rows)


def sets_of_the_paper(measured: Measured) -> str:
    """Accuracy of the belief after the last touch on the paper's two sets."""
    names = [name for name in ("primitives", "tools") if name in measured["sets"]]
    sets = [measured["sets"][name]["methods"] for name in names]
    rows = [[method, *(last(each[method]) for each in sets)] for method in ("readings", "position", "fused")]
    return markdown(["after 10 touches [95 %]", *names], rows)


def settings_by_evidence(*kinds: str, hidden: Sequence[str] = ()) -> Table:
    """One row for each setting of a study (rows of `experiments.studies.report`): for some kinds of evidence the
    accuracy over all touches, its difference to the first setting, and log loss.
    """

    def render(measured: Measured) -> str:
        found = measured["tables"]["methods"]
        names = [column["name"] for column in found["columns"]][4:]
        by_setting: dict[str, list[str]] = {}
        for setting, evidence, _, _, whole, less, log_loss in found["rows"]:
            if evidence in kinds and shown(setting, *hidden):
                cells = [cell(whole, 2), cell(less, 2, signed=True), cell(log_loss, 2)]
                by_setting.setdefault(setting, []).extend(cells)
        head = [f"{kind}: {name}" for kind in kinds for name in names]
        return markdown(["setting", *head], [[setting, *cells] for setting, cells in by_setting.items()])

    return render


def physics_by_touches(evidence: str) -> Table:
    """One row for each physics, one column for each number of own touches: the mean over touches from one kind of
    evidence, with its difference to the matched physics.
    """

    def render(measured: Measured) -> str:
        cells: dict[str, dict[str, str]] = {}
        rows_of = [row for row in measured["tables"]["methods"]["rows"] if row[1] == evidence]
        for (physics, _, touches, mean, *_), lost in zip(
            rows_of, stand_together([row[4] for row in rows_of], measured), strict=True
        ):
            cells.setdefault(physics, {})[touches] = f"{cell(mean['mean'], 2)}: {lost}"
        columns = max(cells.values(), key=len)
        rows = [[physics, *(row.get(touches, "-") for touches in columns)] for physics, row in cells.items()]
        return markdown([f"{evidence}, own touches", *columns], rows)

    return render


ACTIVE_TOUCHES = (1, 4, 16)  # touches of the table


def policies(measured: Measured) -> str:
    """Accuracy of every policy after some touches, with intervals over pads."""
    rows = [
        [name, *(cell(curve[touch - 1], 2) for touch in ACTIVE_TOUCHES)] for name, curve in measured["accuracy"].items()
    ]
    return markdown(["policy", "after 1", *map(str, ACTIVE_TOUCHES[1:])], rows)


SHARED = "in file order"  # the split that keeps errors of later touches out of training


def rules_of_readings(measured: Measured) -> str:
    """Every rule on recorded readings, split in file order; its accuracy at the end of a random split last."""
    entry, random = (measured["splits"][split] for split in (SHARED, "at random"))
    last = entry["touches"]
    rows = []
    for name, found in entry["methods"].items():
        accuracy, error = found["accuracy"], found["calibration_error"]
        cells = [cell(at(accuracy, min(touch, last))["mean"], 2) for touch in (1, 3, 5)]
        scores = [mean_of("mean", 2, found["log_loss"]), f"{cell(error['error'])} ({cell(error['chance'])})"]
        others = random["methods"][name]["accuracy"]
        flattered = f"{cell(at(others, 1)['mean'], 2)}, {cell(at(others, -1)['mean'], 2)}"
        rows.append([name, *cells, cell(at(accuracy, -1), 2), *scores, flattered])
    head = ["after 1", "after 3", "after 5", f"after {last} [95 %]", "log loss", "ECE (by chance)"]
    return markdown(["rule", *head, f"split at random: after 1, {last}"], rows)


def doubts_about_readings(measured: Measured) -> str:
    """How often the belief stops and errs then, beside the product as it is; how well what was never taught is told, by
    the belief's doubt and by distance.
    """
    methods, belief = measured["splits"][SHARED]["methods"], "calibrated belief"
    rows = []
    for pair in zip(methods[belief]["stopping"], methods["product"]["stopping"], strict=True):
        cells = [f"{percent(each['stopped'], 0)} stop, {percent(each['stopped_error'])} of these err" for each in pair]
        rows.append([f"stop at an error of {100 * pair[0]['requested_error']:.0f} %", *cells])
    unknown = measured["unknown"]
    first, last = unknown["touches"][0], unknown["touches"][-1]
    for name in (belief, "distance from what was taught"):
        found = ", ".join(cell(at(unknown[name], touch), 2) for touch in (1, -1))
        rows.append([f"unknown objects, by {name}: AUROC after {first}, {last}", found, ""])
    return markdown(["what [95 %]", belief, "product"], rows)


STUDY_TABLES = {
    "mismatch": ("methods",),
    "open_set": ("auroc", "accuracy"),
    "physics": ("methods",),
    "stopping": ("errors", "constants", "hardness"),
}
OWN_TABLES: dict[str, dict[str, Table]] = {
    "mismatch": {"settings": settings_by_evidence("fused", "readings", hidden=("meshes", "arm ", "chip "))},
    "physics": {evidence: physics_by_touches(evidence) for evidence in ("readings", "fused")},
    "stopping": {"errors": study_table("errors", hidden=("half",))},
}


TABLES: dict[str, dict[str, Table]] = {
    "paper": {
        "methods": paper_methods,
        "differences": partial(paper_differences, hidden=("Gaussian", "measured force", "constant")),
    },
    "recognize": {
        "all": methods_of_set("all"),
        "sets of the paper": sets_of_the_paper,
    },
    "active_touch": {"policies": policies},
    "grasps": {"rules": rules_of_readings, "doubts": doubts_about_readings},
    **{
        step: {name: study_table(name) for name in names} | OWN_TABLES.get(step, {})
        for step, names in STUDY_TABLES.items()
    },
}
