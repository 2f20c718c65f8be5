"""Tables, the figure and the warnings of the calibration experiment."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from experiments.calibrate.data import PressRecording
from experiments.calibrate.evaluate import INTERVAL
from experiments.calibrate.methods import CALIBRATED, MEAN, NEIGHBOURS, PLAIN
from experiments.common.intervals import with_interval
from experiments.common.runs import write_json
from experiments.common.tables import text_table
from i2t.calibration import DataWarnings, check_presses
from i2t.viz import style

COLOURS = {
    MEAN: style.PINK, NEIGHBOURS: style.GREY, PLAIN: style.ORANGE, CALIBRATED: style.RED,
}  # fmt: skip


def figure(metrics: dict[str, Any]) -> Figure:
    """R2 against the number of presses, a panel for each test."""
    result = Figure(figsize=(max(6.5, 4.4 * len(metrics["r2"])), 4.4), layout="constrained")
    panels = result.subplots(1, len(metrics["r2"]), squeeze=False)[0]
    for axes, (name, methods) in zip(panels, metrics["r2"].items(), strict=True):
        _draw(axes, methods)
        axes.set_title(f"held out: {name}")
    result.axes[0].set_ylabel("R² over all channels")
    result.suptitle(
        f"Calibration of one skin ({metrics['source']}): mean of {metrics['draws']} draws and 95 % interval"
    )
    return result


def _draw(axes: Any, by_method: dict[str, Any]) -> None:
    """Mean R2 with its interval against the number of presses, a line for each method."""
    counts: list[int] = []
    for method, by_count in by_method.items():
        counts, colour = list(by_count), COLOURS[method]
        mean, low, high = ([by_count[n][key] for n in counts] for key in INTERVAL)
        axes.plot(counts, mean, "o-", ms=3, color=colour, label=method)
        axes.fill_between(counts, low, high, color=colour, alpha=0.2, lw=0)
    axes.set(xscale="log", xlabel="presses to calibrate with", ylim=(0, 1))
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc="lower right")


def count_table(curves: dict[str, dict[int, dict[str, float]]]) -> str:
    """Mean and interval of each curve at each number of presses."""
    counts = list(next(iter(curves.values())))
    rows = (
        [label, *(with_interval(*(by_count[n][end] for end in INTERVAL)) for n in counts)]
        for label, by_count in curves.items()
    )
    return text_table(["presses", *map(str, counts)], rows)


def print_tables(metrics: dict[str, Any]) -> None:
    """The tables a person reads."""
    for name, methods in metrics["r2"].items():
        print(f"\n{metrics['source']}, held out: {metrics['held_out'][name]} ({name}); mean R2 [95 %] over draws")
        print(count_table(methods))
    for name, found in metrics.get("calibrate_over_blocks", {}).items():
        print(f"\nheld out: {name}; {CALIBRATED} and its gain, 95 % over {found['blocks']} blocks of positions")
        gains = {what.removeprefix(CALIBRATED + " "): by_count for what, by_count in found["differences"].items()}
        print(count_table({CALIBRATED: found["r2"], **gains}))


def write(out: Path, metrics: dict[str, Any]) -> None:
    """Write the figure and the metrics, and print the tables."""
    style.save_figure(figure(metrics), out / "curves.png")
    write_json(out / "metrics.json", metrics)
    print_tables(metrics)


def warn(recording: PressRecording) -> DataWarnings:
    """Print what in the presses contradicts a sound skin."""
    found = check_presses(recording.position, recording.load, recording.readings, by_force=recording.by_force)
    for message in found.messages():
        print(f"warning: {message}")
    return found


def warning_metrics(found: DataWarnings) -> dict[str, Any]:
    """Findings of the checks of the presses."""
    return {
        "warnings": found.messages(),
        "repeated_rows": int(found.repeated.sum()),
        "change_ratio": found.change_ratio,
    }
