"""Tables of predictors, of calibration from few presses, and of the fidelity of recordings."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from experiments.common.cells import Cell, Measured, Table, numbers_of, rows_over
from experiments.common.tables import cell, markdown


def r2_of(decimals: int, scores: Mapping[str, Any]) -> str:
    """Format R² of one pad and seed with its interval over sessions."""
    return cell([scores["r2"], *scores["r2_interval"]], decimals)


def r2_over(scores: Mapping[str, Any]) -> str:
    """Format R² over pads or skins with its interval."""
    return cell(scores["r2"], 2)


RMSE, RMSE_TITLE = "rmse", "RMSE µT"


def predictors_on_recording(over: str, hidden: Sequence[str] = ()) -> Table:
    """Table of predictors' scores on a recording's held-out presses, without those whose name contains a hidden word;
    intervals resample `over`.
    """
    head = ("method ({source}, one skin)", f"R² [95 % over {over}]", "90 % coverage")
    return rows_over("methods", head, partial(r2_of, 3), *numbers_of(["coverage_90"]), kept=True, hidden=hidden)


def choice_on_validation(measured: Measured) -> str:
    """The best method on validation touches over pads, and its lead over the best baseline."""
    choice = measured["choice"]
    counts, r2 = choice["validated_on"], choice["validation_r2"]
    objects = "1 object" if counts["objects"] == 1 else f"{counts['objects']} objects"
    heading = f"{counts['touches']} validation touches of {objects}, {measured['source']}"
    best, baseline = choice["best"], choice["best_baseline"]
    lead = cell(choice["over_best_baseline"], 2, signed=True)
    rows = [
        [f"best: {best}", cell(r2[best], 2)],
        [f"best baseline: {baseline}", cell(r2[baseline], 2)],
        ["lead over that baseline", lead],
    ]
    return markdown([heading, "R² [95 % over pads]"], rows)


CALIBRATED, PLAIN, NEIGHBOURS = "i2t.calibrate", "plain Gaussian process", "k nearest presses"
GAIN = f"{CALIBRATED} - {PLAIN}"
SESSIONS = {  # titles of eFlesh sessions by folder
    "20250316_155729_probe": "`spatial`",
    "20250401_014340_probe": "`normal`, first",
    "20250401_015037_probe": "`normal`, second",
    "20250416_200533_probe": "`shear`",
}
KEPT_SECTIONS = {
    "Overview": ("rows", "channels"),
    "Noise and drift": ("noise", "drift"),
    "Hysteresis and creep": ("hysteresis", "creep", "hysteresis_of_chips"),
    "Repeatability": ("repeat_std_uT", "r2_repeatability_limit"),
    "Heads": ("heads",),
    "Predictions across sessions": ("r2",),
}


def press_counts(test: str, held_out: str) -> Table:
    """Make the table of R² on one skin by the number of presses, with intervals over blocks for `i2t.calibrate` and its
    gain.

    Args:
        test: Key in the metrics of the way of holding out.
        held_out: Description of the held-out presses for the heading.

    Returns:
        A function that formats the metrics as a Markdown table.
    """

    def render(measured: Measured) -> str:
        curves, with_intervals = measured["r2"][test], measured["calibrate_over_blocks"][test]
        inside = measured["inside_90"][test][CALIBRATED]
        counts = _shown(with_intervals["r2"])
        rows = [
            *([name, *(cell(curves[name][n]["mean"]) for n in counts)] for name in (NEIGHBOURS, PLAIN)),
            [f"`{CALIBRATED}`", *(cell(with_intervals["r2"][n]) for n in counts)],
            [f"gain over the {PLAIN}", *(cell(with_intervals["differences"][GAIN][n], signed=True) for n in counts)],
            ["90 % coverage", *(cell(inside[n]["mean"], 2) for n in counts)],
        ]
        over = f"[95 % over {with_intervals['blocks']} blocks]"
        head = f"R² on {measured['held_out'][test]} held-out {held_out}, {measured['source']} {over}"
        return markdown([head, *_presses(counts)], rows)

    return render


def kinds_of_skin(measured: Measured) -> str:
    """R² of `i2t.calibrate` on kinds of skin by the number of presses, with its gain over a plain Gaussian process."""
    rows, counts = [], _shown(next(iter(measured["cases"].values()))["inside_90"])
    for name, case in measured["cases"].items():
        r2, gains = case["r2"][CALIBRATED], case["differences"][GAIN]
        inside = [rate["mean"] for rate in case["inside_90"].values()]
        reached = (f"{cell(r2[n]['mean'], 2)}, {cell(gains[n], 2, signed=True)}" for n in counts)
        rows.append([name, *reached, f"{min(inside):.2f} to {max(inside):.2f}"])
    return markdown([f"skin and load, {measured['source']}", *_presses(counts), "90 % coverage"], rows)


def ranges_of_pads(measured: Measured) -> str:
    """Coverage of the true values by the intervals of fitted pads, for all parameters and for those that are covered
    least, and R² at held-out places.
    """
    by_load = measured["by_load"]
    counts = [part["inside"] | {"all parameters": part["inside_all"]} for part in by_load.values()]
    rows = [
        [name.replace("_", " "), *(" of ".join(map(str, part[name])) for part in counts)]
        for name in ("tip_offset", "gains", "all parameters")
    ]
    at_places = [cell(sum(part["r2_places"]) / len(part["r2_places"])) for part in by_load.values()]
    rows.append(["mean R² at held-out places", *at_places])
    return markdown([f"parameter, {measured['source']}", *(f"presses by {load}" for load in by_load)], rows)


def _shown(curve: Mapping[str, Any]) -> list[str]:
    """Numbers of presses that a table shows."""
    return [count for count in ("5", "20", "100", "300") if count in curve]


def _presses(counts: Sequence[str]) -> list[str]:
    """Headings of the columns of numbers of presses."""
    return [f"{count} presses" for count in counts]


def sections_of_recordings(recordings: Measured) -> Measured:
    """Reduce the sections of a fidelity report to the values in tables."""
    return {
        name: {
            title: {key: section[key] for key in KEPT_SECTIONS[title] if key in section}
            for title, section in sections.items()
            if title in KEPT_SECTIONS
        }
        for name, sections in recordings.items()
    }


def eflesh_sessions(measured: Measured) -> str:
    """Noise, drift, hysteresis and creep of eFlesh's sessions and of the simulator."""
    sessions = {name: measured["recordings"][name] for name in SESSIONS}
    moving = {name: sections["Hysteresis and creep"] for name, sections in sessions.items()}
    at_rest_and_drift = {name: sections["Noise and drift"] for name, sections in sessions.items()}
    drift = {name: parts["drift"] for name, parts in at_rest_and_drift.items()}
    at_rest = {name: x["noise"] for name, x in at_rest_and_drift.items() if "in air" in x["noise"]["how"]}
    strokes = {name: x["hysteresis"] for name, x in moving.items() if "hysteresis" in x}
    creep = {name: x["creep"] for name, x in moving.items() if "creep" in x}
    chips = {name: x["hysteresis_of_chips"] for name, x in moving.items() if "hysteresis_of_chips" in x}
    repeated = {name: sections["Repeatability"] for name, sections in sessions.items()}
    ends = {name: x for name, x in repeated.items() if "r2_repeatability_limit" in x}

    def noise(x: Any) -> str:
        return f"{x['xy_uT']:.2f}, {x['z_uT']:.2f}"

    def stroke(x: Any) -> str:
        return ", ".join(cell(sum(x[key]) / len(x[key])) for key in ("loop_share", "left_share"))

    def spread(x: Any) -> str:
        square = [std**2 for std in x["repeat_std_uT"]]
        return f"{(sum(square) / len(square)) ** 0.5:.1f}, {x['r2_repeatability_limit']:.3f}"

    def growth(x: Any) -> str:
        return cell(sum(x["share_per_decade"]) / x["holds"])

    quantities: list[tuple[str, Measured, Cell, Callable[[Any], str]]] = [
        ("noise: x and y, z (µT)", at_rest, noise, lambda x: noise(x["simulator"])),
        ("drift: median channel, largest (µT)", drift, lambda x: f"{x['median_uT']:.1f}, {x['largest_uT']:.1f}",
         lambda _: "-"),
        ("stroke hysteresis, remainder after the stroke", strokes, stroke, lambda _: "0, 0"),
        ("creep per tenfold increase in time", creep, growth, lambda x: cell(x["simulator"])),
        ("remainder of the previous press", chips, lambda x: cell(max(map(abs, x["by_chip"]))),
         lambda x: cell(x["simulator"])),
        ("scatter of repeated presses (µT), largest possible R²", ends, spread, lambda _: "-"),
    ]  # fmt: skip
    rows = [
        [title, *(cell(values[name]) if name in values else "-" for name in SESSIONS), own(next(iter(values.values())))]
        for title, values, cell, own in quantities
        if values
    ]
    return markdown(["quantity, real skins", *SESSIONS.values(), "simulator"], rows)


def eflesh_heads(measured: Measured) -> str:
    """Errors of heads on eFlesh's sessions: the kept head, with its 90 % coverage, and a baseline."""
    splits, rows = ("random rows", "whole blocks or strokes", "later in time"), []
    units = {"position": "mm", "travel": "mm", "force": "N", "shear": "N"}
    heads = ("position", "travel"), ("force",), ("force",), ("shear",)  # by session
    for (name, title), targets in zip(SESSIONS.items(), heads, strict=True):
        for target in targets:
            tests = measured["recordings"][name]["Heads"]["heads"][target]
            cells = [
                f"{test['kept']['rmse']:.3f} ({test['kept']['inside_90']:.2f}), {cell(nearest['rmse'])}"
                for test in map(tests.__getitem__, splits)
                for nearest in [test["baselines"]["k nearest readings"]]
            ]
            rows.append([f"{title}, {target} ({units[target]})", *cells])
    return markdown(["session and target, real", *splits], rows)


def predictors_over_pads(measured: Measured) -> str:
    """R² of every predictor over pads with its interval."""
    rows = [[name, r2_over(scores)] for name, scores in measured["over_pads"].items()]
    return markdown(["method (simulated)", "R² [95 % over pads]"], rows)


def predictors_by_object(measured: Measured) -> str:
    """R² of every predictor over pads with its interval, and on the test object on which it is lowest."""
    objects = measured["by_object"].values()
    rows = [
        [name, r2_over(scores), cell(min(by_method[name][0] for by_method in objects), 2)]
        for name, scores in measured["over_pads"].items()
    ]
    return markdown(["method (simulated)", "R² [95 % over pads]", "lowest of the objects"], rows)


TABLES: dict[str, dict[str, Table]] = {
    "train": {
        "predictors": rows_over(
            "methods",
            ("method ({source}, six unseen objects)", "R² [95 % over sessions]", RMSE_TITLE),
            partial(r2_of, 2),
            *numbers_of([RMSE]),
        )
    },
    "train_blocks": {"predictors": predictors_on_recording("blocks", hidden=("ridge",))},
    "train_time": {
        "predictors": predictors_on_recording("groups of 20 presses", hidden=("ridge", "paper's", "mean reading"))
    },
    "study": {
        "predictors": rows_over(
            "over_pads",
            ("method ({source}, six unseen objects)", "R² [95 % over pads]", RMSE_TITLE),
            r2_over,
            lambda scores: cell(scores[RMSE][0], 2),
        ),
        "choice": choice_on_validation,
    },
    "train_registered": {"predictors": predictors_by_object},
    "train_camera": {"predictors": predictors_over_pads},
    "second_world": {
        "predictors": rows_over(
            "methods", ("method ({source}, other physics)", "R² [95 % over skins]"), r2_over, hidden=["nearest patches"]
        ),
    },
    "calibrate": {
        "random presses": press_counts("random presses", "random presses"),
        "whole blocks": press_counts("blocks of 6 mm", "presses in whole blocks"),
    },
    "calibrate_simulated": {"kinds of skin": kinds_of_skin},
    "calibrate_recovery": {"ranges": ranges_of_pads},
    "fidelity": {"sessions": eflesh_sessions, "heads": eflesh_heads},
}
