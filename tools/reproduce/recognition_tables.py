"""Tables of recognition: the paper's method, the belief, its studies, and policies for choosing touches."""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any

import numpy as np

from experiments.common.cells import Cell, Measured, Table, at, rows_over, shown
from experiments.common.tables import cell, markdown
from experiments.studies.tables import study_table
from i2t.intervals import COVERAGE, Estimate, holm, p_values


def last(scores: Mapping[str, Any]) -> str:
    """Format the accuracy after the last touch."""
    return cell(at(scores["accuracy"], -1))


def mean_of(key: str, decimals: int, scores: Mapping[str, Any]) -> str:
    """Format the mean over touches of a score."""
    return cell(sum(scores[key]) / len(scores[key]), decimals)


LARGEST = "fitted to the largest: "  # begins the columns of this temperature in the table of stopping


METHOD_HEAD = (
    "method", "after 10 [95 %]", "[95 %] for similar objects",
    "mean over 1 to 10 touches [95 %]",
)  # fmt: skip
METHOD_CELLS: tuple[Cell, ...] = (
    last,
    lambda scores: cell(scores["last_other_objects"], 2).partition(" ")[2],
    lambda scores: cell(scores["mean"], 2),
)


def methods_of_set(name: str) -> Table:
    """Table of the methods' scores on a set of objects, without the rows of the paper's own table and without pairs of
    evidence, except readings with presence.
    """
    of_paper_table = (", product", "depth", "measured force", "median force", "constant")
    pairs = ("and position", "position and", "presence, ")
    return rows_over(f"sets/{name}/methods", METHOD_HEAD, *METHOD_CELLS, hidden=of_paper_table + pairs)


def paper_methods(measured: Measured) -> str:
    """Accuracy after the last touch on the paper's two sets and on all their objects, below the published values."""
    from experiments.recognize.report import PUBLISHED_I2T, PUBLISHED_PROPRIOCEPTION  # imports JAX

    sets, means = measured["sets"], measured["mean of the sets"]
    rows = [
        [f"{name} (published: one real skin)", *(cell(published[column], 2) for column in (*sets, "mean"))]
        for name, published in (("Imagine2touch", PUBLISHED_I2T), ("proprioception", PUBLISHED_PROPRIOCEPTION))
    ]
    chances = [1 / len(entry["objects"]) for entry in sets.values()]
    chance_of_all = len(sets) / sum(1 / chance for chance in chances)
    rows.append(["chance", *(cell(chance, 2) for chance in (*chances, chance_of_all))])
    for method in means:
        if shown(method, "measured force", "median force, product", "constant reading, product"):
            rows.append([method, *(last(entry["methods"][method]) for entry in sets.values()), cell(means[method])])
    return markdown(["after 10 touches [95 %], {source}".format_map(measured), *sets, "mean of the five"], rows)


def mark_significant(
    differences: Sequence[Mapping[str, float]], measured: Measured, primary: int | None = None
) -> list[str]:
    """Format differences, with a dagger for those that are significant after Holm's correction over all but the primary
    one. Degrees of freedom are those of the pads, the fewest of an interval.
    """
    estimates = np.array([[difference["mean"], difference["low"], difference["high"]] for difference in differences]).T
    p = p_values(Estimate(*estimates), len(measured["pads"]) - 1)
    tested = np.flatnonzero(np.isfinite(p) & (np.arange(len(p)) != primary))
    significant = np.zeros(len(p), bool)
    significant[tested] = holm(p[tested]) < 1 - COVERAGE
    marked = zip(differences, significant, strict=True)
    return [cell(difference, 2, signed=True) + " †" * bool(mark) for difference, mark in marked]


def paper_differences(measured: Measured, hidden: Sequence[str] = ()) -> str:
    """Paired differences on the paper's two sets and of the means over all objects, without pairs whose name contains a
    hidden word.
    """
    sets, means = measured["sets"], measured["differences of these means"]
    rows, pairs = [], [pair for pair in next(iter(sets.values()))["paired"] if shown(pair, *hidden)]
    differences = [[*(entry["paired"][pair]["last"] for entry in sets.values()), means[pair]] for pair in pairs]
    marked = iter(mark_significant([item for row in differences for item in row], measured, primary=len(sets)))
    for pair in pairs:
        cells = islice(marked, len(sets) + 1)
        _, _, rule = pair.rpartition(", ")
        brief = re.sub(r"Imagine2touch \(paper's network, (.*?)\)", r"\1", pair)
        brief = re.sub(r"paper's network and measured force, (\w+)", r"\1 and force", brief)
        brief = re.sub(f"same rules, |, {rule}", "", brief)
        rows.append([f"{brief} ({rule})", *cells])
    head = ["difference after 10 touches", *(f"{name} [95 %]" for name in sets), "mean of the five [95 %]"]
    return markdown(head, rows)


def sets_of_the_paper(measured: Measured) -> str:
    """Accuracy of the belief after the last touch on the paper's two sets."""
    names = [name for name in ("primitives", "tools") if name in measured["sets"]]
    sets = [measured["sets"][name]["methods"] for name in names]
    rows = [[method, *(last(methods[method]) for methods in sets)] for method in ("readings", "position", "fused")]
    return markdown(["after 10 touches [95 %]", *names], rows)


def settings_by_evidence(*kinds: str, hidden: Sequence[str] = ()) -> Table:
    """Table with a row for each setting of a study: accuracy over all touches and difference from the first setting,
    for some kinds of evidence.
    """

    def render(measured: Measured) -> str:
        table = measured["tables"]["methods"]
        names = [column["name"] for column in table["columns"]][4:6]
        by_setting: dict[str, list[str]] = {}
        for setting, evidence, _, _, whole, less, _ in table["rows"]:
            if evidence in kinds and shown(setting, *hidden):
                cells = [cell(whole, 2), cell(less, 2, signed=True)]
                by_setting.setdefault(setting, []).extend(cells)
        head = [f"{kind}: {name}" for kind in kinds for name in names]
        return markdown(["setting", *head], [[setting, *cells] for setting, cells in by_setting.items()])

    return render


def physics_by_touches(measured: Measured) -> str:
    """Table with a row for each physics and columns for each evidence by numbers of touches of the skin: mean accuracy
    over touches, and its difference from the matched physics with all touches.
    """
    touches_shown = {"readings": ("none", "20", "200"), "fused": ("none", "200")}
    shown_columns = [(evidence, touches) for evidence, counts in touches_shown.items() for touches in counts]
    cells: dict[str, dict[tuple[str, str], str]] = {}
    for evidence in ("readings", "fused"):
        rows_of = [row for row in measured["tables"]["methods"]["rows"] if row[1] == evidence]
        for (physics, _, touches, mean, *_), lost in zip(
            rows_of, mark_significant([row[4] for row in rows_of], measured), strict=True
        ):
            cells.setdefault(physics, {})[evidence, touches] = f"{cell(mean['mean'], 2)}: {lost}"
    rows = [[physics, *(row.get(column, "-") for column in shown_columns)] for physics, row in cells.items()]
    head = [f"{evidence}, {touches}" for evidence, touches in shown_columns]
    matched = next(iter(cells.values()))
    whole = ", ".join(f"{evidence} {matched[evidence, 'all'].partition(':')[0]}" for evidence in ("readings", "fused"))
    return markdown([f"touches of this skin (bonded layer, all: {whole})", *head], rows)


def stopping_errors(measured: Measured) -> str:
    """Episodes stopped early and their error rates by placement error and requested error, with the temperature fitted
    to the largest placement errors. The smallest placement errors, at which hardly any decision is wrong, and the
    largest requested error are not shown.
    """
    table = measured["tables"]["errors"]
    names = [column["name"] for column in table["columns"]]
    start = next(i for i, name in enumerate(names) if name.startswith(LARGEST))
    rows = [[*row[:2], *row[start:]] for row in table["rows"] if row[1] != "10%"]
    stopped = table["columns"][start] | {"name": names[start].removeprefix(LARGEST)}
    columns = [*table["columns"][:2], stopped, *table["columns"][start + 1 :]]
    return study_table("errors", hidden=("half",))({"tables": {"errors": {"columns": columns, "rows": rows}}})


def policies(measured: Measured) -> str:
    """Accuracy of every policy after some touches, with intervals over pads."""
    curves = measured["accuracy"].items()
    rows = [[name, *(cell(curve[touch - 1], 2) for touch in (1, 4, 16))] for name, curve in curves]
    return markdown(["policy", "after 1 touch [95 %]", "after 4 [95 %]", "after 16 [95 %]"], rows)


IN_FILE_ORDER = "in file order"  # the split that keeps errors of later touches out of training


def rules_of_readings(measured: Measured) -> str:
    """Scores of every rule on recorded readings, split in file order; the last column is for a random split."""
    entry, random = (measured["splits"][split] for split in (IN_FILE_ORDER, "at random"))
    last = entry["touches"]
    rows = []
    for name, result in entry["methods"].items():
        accuracy, error = result["accuracy"], result["calibration_error"]
        cells = [cell(at(accuracy, 1)["mean"], 2)]
        scores = [mean_of("mean", 2, result["log_loss"]), f"{cell(error['error'])} ({cell(error['chance'])})"]
        others = random["methods"][name]["accuracy"]
        at_random = f"{cell(at(others, 1)['mean'], 2)}, {cell(at(others, -1)['mean'], 2)}"
        rows.append([name, *cells, cell(at(accuracy, -1), 2), *scores, at_random])
    head = ["after 1", f"after {last} [95 %]", "log loss", "ECE (expected by chance)"]
    return markdown(["rule", *head, f"random split: after 1, {last}"], rows)


STUDY_TABLES = {
    "mismatch": ("methods",),
    "open_set": ("auroc", "accuracy"),
    "physics": ("methods",),
    "stopping": ("errors", "constants", "hardness"),
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
    "grasps": {"rules": rules_of_readings},
    **{step: {name: study_table(name) for name in names} for step, names in STUDY_TABLES.items()},
}
TABLES["mismatch"]["settings"] = settings_by_evidence("fused", "readings", hidden=("meshes", "arm ", "hysteresis"))
TABLES["open_set"]["auroc"] = study_table("auroc", hidden=("3",))
TABLES["physics"]["by touches"] = physics_by_touches
TABLES["stopping"]["errors"] = stopping_errors
