"""Summaries, the table and the figure of the calibration experiment."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.calibrate.data import PressRecording
from experiments.calibrate.evaluate import Curves, ErrorCurves
from experiments.calibrate.methods import (
    CALIBRATED,
    HEIGHT,
    MEAN,
    NEIGHBOURS,
    PERIOD,
    PLAIN,
    PRETRAINED,
    PREVIOUS_ALONE,
    PREVIOUS_MEAN,
    RESIDUAL,
    SCRATCH,
    SELECTED,
    STRUCTURED,
)
from experiments.common.intervals import with_interval
from experiments.common.runs import write_json
from i2t.calibration import DataWarnings, check_presses
from i2t.dataset import Dataset
from i2t.prediction.metrics import grouped_interval, student_interval
from i2t.unknowns import RecordedPresses, estimate_labels, findings_from_meta, metrics_of
from i2t.viz import style

SESSION = {PREVIOUS_MEAN: "previous session as the mean", PREVIOUS_ALONE: "previous session alone"}
ALIGNED_ALONE = "previous session alone, aligned"
STYLES: dict[str, tuple[str, str]] = {
    NEIGHBOURS: (style.GREY, "-"), PLAIN: (style.ORANGE, "-"), STRUCTURED: (style.BLUE, "-"),
    HEIGHT: (style.GREEN, "-"), SELECTED: (style.RED, ":"), PREVIOUS_MEAN: (style.BLUE, "-"),
    PREVIOUS_ALONE: (style.RED, "--"), PERIOD: (style.GREEN, ":"), SCRATCH: (style.GREY, "--"),
    PRETRAINED: (style.ORANGE, "--"), RESIDUAL: (style.BLUE, "--"),
    MEAN: (style.GREY, ":"), CALIBRATED: (style.RED, "-"),
    SESSION[PREVIOUS_MEAN]: (style.BLUE, "-"), SESSION[PREVIOUS_ALONE]: (style.RED, "--"),
    ALIGNED_ALONE: (style.ORANGE, "-"),
}  # fmt: skip
LABEL_WIDTH = 56
_INTERVAL = ("mean", "low", "high")


def summarise(curves: Curves) -> dict[str, Any]:
    """Mean over draws with its 95 % interval (Student's t)."""
    return {
        name: {count: dict(zip(_INTERVAL, student_interval(values), strict=True)) for count, values in by_count.items()}
        for name, by_count in curves.items()
    }


def differences(curves: Curves, reference: str = HEIGHT) -> dict[str, Any]:
    """R2 of the reference minus that of each other method, draw by draw."""
    base = curves[reference]
    return summarise(
        {
            f"{reference} - {name}": {n: list(np.subtract(base[n], values)) for n, values in by_count.items()}
            for name, by_count in curves.items()
            if name != reference
        }
    )


def over_blocks(readings: np.ndarray, errors: ErrorCurves, block: np.ndarray) -> dict[str, Any]:
    """R2 of `i2t.calibrate`, and by how much it is above each other method, with 95 % intervals over whole blocks of
    the held-out presses (cluster bootstrap of the mean over draws): what other positions on the skin would have given.
    """
    names, of = np.unique(block, return_inverse=True)
    inside = (of == np.arange(len(names))[:, None]).astype(float)  # sums over each block
    left = readings - readings.mean(0)
    presses, first, second = inside.sum(1), inside @ left, inside @ (left**2).sum(1)
    missed = {method: {n: inside @ np.mean(draws, axis=0) for n, draws in by.items()} for method, by in errors.items()}

    def share(error: np.ndarray, rows: np.ndarray) -> float:
        spread = second[rows].sum() - (first[rows].sum(0) ** 2).sum() / presses[rows].sum()
        return float(error[rows].sum() / spread)

    def r2(error: np.ndarray, rows: np.ndarray) -> float:
        return 1 - share(error, rows)

    def interval(statistic: Callable[[np.ndarray], float]) -> dict[str, float]:
        every = np.arange(len(names))
        return dict(zip(_INTERVAL, (statistic(every), *grouped_interval(statistic, every)), strict=True))

    return {
        "blocks": len(names),
        "r2": {n: interval(partial(r2, error)) for n, error in missed[CALIBRATED].items()},
        "differences": {
            f"{CALIBRATED} - {other}": {
                n: interval(partial(share, error - missed[CALIBRATED][n])) for n, error in by.items()
            }
            for other, by in missed.items()
            if other != CALIBRATED
        },
    }


def equivalent_presses(curves: Curves) -> dict[str, Any]:
    """For each method and count, how many presses of every other method reach the same mean R2.

    Interpolated in the logarithm of the count; None where even the largest count does not.
    """
    means = {name: {n: float(np.mean(r2)) for n, r2 in by_count.items()} for name, by_count in curves.items()}

    def needed(other: str, r2: float) -> float | None:
        counts = np.array(list(means[other]))
        best = np.maximum.accumulate(list(means[other].values()))
        if best[-1] < r2:
            return None
        after = int(np.argmax(best >= r2))
        if after == 0:
            return float(counts[0])
        share = (r2 - best[after - 1]) / (best[after] - best[after - 1])
        return float(np.exp(np.log(counts[after - 1]) * (1 - share) + np.log(counts[after]) * share))

    return {
        name: {n: {other: needed(other, r2) for other in means if other != name} for n, r2 in by_count.items()}
        for name, by_count in means.items()
    }


def draw_curves(axes: Any, by_method: dict[str, Any], styles: dict[str, tuple[str, str]]) -> None:
    """Mean R2 with its interval against the number of presses, a line for each method."""
    counts: list[int] = []
    for method, by_count in by_method.items():
        counts, (colour, line) = list(by_count), styles[method]
        mean, low, high = ([by_count[n][key] for n in counts] for key in _INTERVAL)
        axes.plot(counts, mean, "o" + line, ms=3, color=colour, label=method)
        axes.fill_between(counts, low, high, color=colour, alpha=0.2, lw=0)
    axes.set(xscale="log", xlabel="presses to calibrate with", ylim=(0, 1))
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc="lower right")


def figure(metrics: dict[str, Any]) -> Figure:
    """R2 against the number of presses, a panel for each test."""
    result = Figure(figsize=(max(6.5, 4.4 * len(metrics["r2"])), 4.4), layout="constrained")
    panels = result.subplots(1, len(metrics["r2"]), squeeze=False)[0]
    for axes, (name, methods) in zip(panels, metrics["r2"].items(), strict=True):
        draw_curves(axes, methods, STYLES)
        axes.set_title(f"held out: {name}")
    result.axes[0].set_ylabel("R² over all channels")
    result.suptitle(
        f"Calibration of one skin ({metrics['source']}): mean of {metrics['draws']} draws and 95 % interval"
    )
    return result


def table_row(label: str, by_count: dict[int, dict[str, float]], width: int = LABEL_WIDTH) -> str:
    """A label, and mean and interval at each number of presses."""
    cells = (f"{n}: {with_interval(*(v[end] for end in _INTERVAL))}" for n, v in by_count.items())
    return f"{label:{width}}" + "  ".join(cells)


def print_tables(metrics: dict[str, Any]) -> None:
    """The tables a person reads."""
    for name, methods in metrics["r2"].items():
        print(f"\n{metrics['source']}, held out: {metrics['held_out'][name]} ({name}); mean R2 [95 %] over draws")
        for method, by_count in methods.items():
            print(table_row(method, by_count))
    for name, found in metrics.get("calibrate_over_blocks", {}).items():
        print(f"\nheld out: {name}; {CALIBRATED} and its gain, 95 % over {found['blocks']} blocks of positions")
        for what, by_count in {CALIBRATED: found["r2"], **found["differences"]}.items():
            print(table_row(what.removeprefix(CALIBRATED + " "), by_count))


def write(out: Path, metrics: dict[str, Any]) -> None:
    """Write the figure and the metrics, and print the tables."""
    style.save_figure(figure(metrics), out / "curves.png")
    write_json(out / "metrics.json", metrics)
    print_tables(metrics)


def warn(recording: PressRecording, which: str = "") -> DataWarnings:
    """Print what in the presses contradicts a sound skin."""
    found = check_presses(recording.position, recording.load, recording.readings, by_force=recording.by_force)
    for message in found.messages():
        print(f"warning{which}: {message}")
    return found


def unknowns_of(dataset: Dataset, recording: PressRecording) -> dict[str, Any]:
    """Findings on the recording's unknowns: those its converter kept with it, or else those that labels and readings
    tell of each other; what is wrong is printed.
    """
    found = findings_from_meta(dataset.meta)
    if not found:
        load = {"force": recording.load} if recording.by_force else {"height": -recording.load}
        presses = RecordedPresses(recording.position, recording.readings, **load)
        found = {"this recording": estimate_labels(presses)}
    for session, findings in found.items():
        for finding in findings:
            if finding.wrong:
                print(f"unknowns of {session}: {finding.sentence}")
    return {session: metrics_of(findings) for session, findings in found.items()}


def warning_metrics(found: DataWarnings) -> dict[str, Any]:
    """Findings of the checks of the presses."""
    return {
        "warnings": found.messages(),
        "repeated_rows": int(found.repeated.sum()),
        "r2_by_lag": found.r2_by_lag,
        "change_ratio": found.change_ratio,
    }
