"""Tables, the figure and the warnings of the calibration experiment."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from experiments.calibrate.evaluate import INTERVAL_KEYS
from experiments.calibrate.methods import CALIBRATED, MEAN, NEIGHBOURS, PLAIN
from experiments.common.runs import write_json
from experiments.common.tables import cell, text_table
from i2t.intervals import MIN_CLUSTERS
from i2t.recordings.diagnose import Finding, FindingName
from i2t.viz import style

COLOURS = {
    MEAN: style.Colour.PINK, NEIGHBOURS: style.Colour.GREY, PLAIN: style.Colour.ORANGE, CALIBRATED: style.Colour.RED,
}  # fmt: skip


def figure(metrics: dict[str, Any]) -> Figure:
    """Plot R2 against the number of presses, with a panel for each test."""
    result = Figure(figsize=(max(6.5, 4.4 * len(metrics["r2"])), 4.4), layout="constrained")
    panels = result.subplots(1, len(metrics["r2"]), squeeze=False)[0]
    for axes, (name, methods) in zip(panels, metrics["r2"].items(), strict=True):
        _draw(axes, methods)
        axes.set_title(f"held out: {name}")
    result.axes[0].set_ylabel("R² over all channels")
    result.suptitle(f"Calibration of one skin ({metrics['source']}): {_over_draws(metrics['draws'])}")
    return result


def _over_draws(draws: int) -> str:
    """State how a number was averaged."""
    return "one draw" if draws == 1 else f"mean of {draws} draws and 95 % interval"


def _draw(axes: Any, by_method: dict[str, Any]) -> None:
    """Plot mean R2 with its interval against the number of presses, with a line for each method."""
    counts: list[int] = []
    for method, by_count in by_method.items():
        counts, colour = list(by_count), COLOURS[method]
        mean, low, high = ([by_count[n][key] for n in counts] for key in INTERVAL_KEYS)
        axes.plot(counts, mean, "o-", ms=3, color=colour, label=method)
        axes.fill_between(counts, low, high, color=colour, alpha=0.2, lw=0)
    axes.set(xscale="log", xlabel="presses to calibrate with", ylim=(0, 1))
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc="lower right")


def count_table(curves: dict[str, dict[int, dict[str, float]]], presses: str = "presses") -> str:
    """Format mean and interval of each curve at each number of presses.

    Args:
        curves: Mean and interval by name and number of presses.
        presses: Heading of the first column.

    Returns:
        The table as text, with a row for each curve.
    """
    counts = list(next(iter(curves.values())))
    rows = ([label, *(cell(by_count[n]) for n in counts)] for label, by_count in curves.items())
    return text_table([presses, *map(str, counts)], rows)


def print_tables(metrics: dict[str, Any]) -> None:
    """Print the tables."""
    head = "presses, at most" if metrics.get("held_out_in_turn") else "presses"
    for name, methods in metrics["r2"].items():
        held = f"{metrics['held_out'][name]} ({name})"
        print(f"\n{metrics['source']}, held out: {held}; R2, {_over_draws(metrics['draws'])}")
        print(count_table(methods, head))
    for name, over_blocks in metrics.get("calibrate_over_blocks", {}).items():
        clusters = f"{over_blocks['blocks']} {metrics['clusters']}"
        interval = "95 % interval" if over_blocks["blocks"] >= MIN_CLUSTERS else "no interval"
        print(f"\nheld out: {name}; {CALIBRATED} and its lead, {interval} over {clusters}")
        leads = {pair.removeprefix(CALIBRATED + " "): curve for pair, curve in over_blocks["differences"].items()}
        print(count_table({CALIBRATED: over_blocks["r2"], **leads}, head))


def write(out: Path, metrics: dict[str, Any]) -> None:
    """Write the figure and the metrics, and print the tables."""
    style.save_figure(figure(metrics), out / "curves.png")
    write_json(out / "metrics.json", metrics)
    print_tables(metrics)


def warning_metrics(findings: Sequence[Finding]) -> dict[str, Any]:
    """Convert the findings of the checks of the presses for metrics.json."""
    values = {finding.name: finding.estimate for finding in findings}
    return {
        "warnings": [finding.sentence for finding in findings if finding.wrong],
        "repeated_rows": int(values[FindingName.REPEATED_ROWS] or 0),
        "change_ratio": values[FindingName.CHANGED_SKIN],
    }
