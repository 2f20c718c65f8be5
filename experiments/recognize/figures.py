"""Figures of recognition: accuracy against touches, reliability, confusion, touches to confidence, sensitivity.

Functions take scores (`i2t.recognition.metrics`) and return a matplotlib figure, which `i2t.viz.save_figure`
writes. Methods keep their colour, from the colour-blind safe set of Okabe and Ito (2008), their marker and their line
through all figures that name them in the same order; every figure made from simulated touches says so in its title.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, MultipleLocator, PercentFormatter

from i2t.recognition.intervals import Estimate
from i2t.recognition.metrics import Reliability
from i2t.viz.style import COLOURS, GREY, titled

METHOD_MARKERS = "osD^vPX"
LINES = ("-", "--", "-.", ":")


def accuracy(
    methods: Mapping[str, Estimate],
    title: str,
    simulated: bool,
    published: Mapping[str, float] | None = None,
    chance: float | None = None,
    ylabel: str = "accuracy",
) -> Figure:
    """Accuracy (t,) after touches 1 to t of each method, or another rate, shaded over its interval.

    `published` rates are ticks at the right edge; a grey line is the accuracy of guessing.
    """
    figure, axes = _wide(title, simulated)
    for (name, (mean, low, high)), style in zip(methods.items(), _styles(), strict=False):
        x = np.arange(1, len(mean) + 1)
        axes.fill_between(x, low, high, color=style["color"], alpha=0.18, lw=0)
        axes.plot(x, mean, label=name, markersize=4, **style)
    if chance is not None:
        axes.axhline(chance, color=GREY, lw=0.8)
        axes.annotate("guessing", (1, chance), (0, 3), textcoords="offset points", color=GREY, fontsize=8)
    if published:
        ticks = axes.secondary_yaxis("right")
        ticks.set_yticks(list(published.values()), [f"{name} {value:.0%}" for name, value in published.items()])
        ticks.tick_params(labelsize=8)
    axes.set(xlabel="touches", ylabel=ylabel, ylim=(0, 1.02))
    _finish(axes)
    return figure


def reliability(methods: Mapping[str, Reliability], title: str, simulated: bool) -> Figure:
    """Frequency of right decisions against their confidence, and below, the number of decisions of that confidence."""
    figure = Figure(figsize=(4.6, 5.4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    above.plot([0, 1], [0, 1], color=GREY, lw=0.8)
    above.annotate("calibrated", (0.03, 0.13), rotation=45, color=GREY, fontsize=8)
    for (name, (number, confidence, (mean, low, high))), style in zip(methods.items(), _styles(), strict=False):
        used = number > 0
        limits = np.stack([mean - low, high - mean])[:, used]
        dots = {key: value for key, value in style.items() if key != "linestyle"}
        x, bars = confidence[used], {"elinewidth": 1, "capsize": 2}
        above.errorbar(x, mean[used], limits, label=name, ls="", markersize=4, **bars, **dots)
        above.plot(x, mean[used], color=style["color"], ls=style["linestyle"], lw=0.8, alpha=0.5)
        below.plot(x, number[used], markersize=4, **style)
    above.set(ylabel="frequency of right decisions", xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    above.set_title(titled(title, simulated))
    below.set(xlabel="confidence: probability of the class decided for", ylabel="decisions")
    below.set_yscale("log")
    below.set_ylim(0.7)
    below.grid(alpha=0.25, lw=0.6)
    _finish(above)
    above.xaxis.set_major_locator(MultipleLocator(0.2))
    above.xaxis.set_major_formatter(PercentFormatter(1))
    return figure


def confusion(counts: np.ndarray, names: Sequence[str], title: str, simulated: bool) -> Figure:
    """Confusion matrix: shares of the decisions (columns) for each true class (rows); `counts` (c, c)."""
    counts = np.asarray(counts, np.float64)
    total = counts.sum(1, keepdims=True)
    share = counts / np.where(total > 0, total, 1)
    side = (0.48 if len(names) <= 12 else 0.25) * len(names) + 1.8
    figure = Figure(figsize=(side + 0.8, side), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(share, cmap="cividis", vmin=0, vmax=1)
    if len(names) <= 12:
        for (row, column), value in np.ndenumerate(share):
            shade = "black" if value > 0.55 else "white"
            axes.text(column, row, f"{value:.0%}", ha="center", va="center", fontsize=7.5, color=shade)
    axes.set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor", fontsize=8)
    rows = [f"{name} ({n:.0f})" for name, n in zip(names, total[:, 0], strict=True)]
    axes.set_yticks(range(len(names)), rows, fontsize=8)
    axes.set(xlabel="decided", ylabel="true (episodes)")
    axes.set_title(titled(title, simulated), fontsize=10)
    figure.colorbar(image, ax=axes, label="share of row", format=PercentFormatter(1), fraction=0.046, pad=0.03)
    return figure


def not_yet_confident(policies: Mapping[str, Estimate], title: str, simulated: bool, level: float = 0.95) -> Figure:
    """Share (t + 1,) of episodes not yet confident after 0 to t touches under each policy, shaded over its interval."""
    figure, axes = _wide(title, simulated)
    for (name, (mean, low, high)), style in zip(policies.items(), _styles(), strict=False):
        x = np.arange(len(mean))
        axes.fill_between(x, low, high, step="post", color=style["color"], alpha=0.18, lw=0)
        line = {key: value for key, value in style.items() if key != "marker"}
        axes.step(x, mean, where="post", label=name, **line)
    axes.axhline(0.5, color=GREY, lw=0.8)
    axes.annotate("median", (0, 0.5), (2, 3), textcoords="offset points", color=GREY, fontsize=8)
    axes.set(xlabel="touches", ylabel=f"episodes not yet {level:.0%} confident", ylim=(0, 1.02))
    axes.set_xlim(0, max(len(estimate.mean) for estimate in policies.values()) - 1)
    _finish(axes)
    return figure


def sensitivity(
    settings: Mapping[str, Mapping[str, Estimate | tuple[float, float, float]]],
    title: str,
    xlabel: str,
    simulated: bool,
) -> Figure:
    """Bars with intervals, a group of bars per setting and in it one per method, the first setting on top.

    A method may be missing from a setting.
    """
    methods = list(dict.fromkeys(name for group in settings.values() for name in group))
    figure = Figure(figsize=(6.4, 0.2 * len(settings) * (len(methods) + 1) + 1.6), layout="constrained")
    axes = figure.subplots()
    height = 0.8 / len(methods)
    for i, (method, colour) in enumerate(zip(methods, cycle(COLOURS), strict=False)):
        rows = [(row, group[method]) for row, group in enumerate(settings.values()) if method in group]
        at = np.array([row for row, _ in rows]) + (i - (len(methods) - 1) / 2) * height
        mean, low, high = np.array([estimate for _, estimate in rows], np.float64).T
        axes.barh(at, mean, height * 0.92, color=colour, label=method)
        axes.errorbar(mean, at, xerr=[mean - low, high - mean], fmt="none", ecolor="black", elinewidth=1, capsize=2)
    axes.set_yticks(range(len(settings)), list(settings))
    axes.invert_yaxis()
    axes.set(xlabel=xlabel)
    axes.grid(axis="x", alpha=0.25, lw=0.6)
    axes.set_axisbelow(True)
    if len(methods) > 1:
        figure.legend(*axes.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=len(methods))
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure


def accuracy_differences(sizes: Sequence[float], lines: Mapping[str, Estimate], simulated: bool) -> Figure:
    """Accuracy from readings less accuracy from contact positions, for each pose error (mm and degrees)."""
    figure, axes = _wide("Paper's rules: readings minus contact positions, bars: 95 %", simulated)
    for i, ((name, (mean, low, high)), style) in enumerate(zip(lines.items(), _styles(), strict=False)):
        x = np.array(sizes) + 0.03 * (i - (len(lines) - 1) / 2)  # bars next to each other
        axes.errorbar(x, mean, [mean - low, high - mean], label=name, markersize=4, elinewidth=1, **style)
    axes.axhline(0, color=GREY, lw=0.8)
    axes.set(xlabel="pose error (mm and degrees)", ylabel="difference in accuracy")
    _finish(axes)
    return figure


def _wide(title: str, simulated: bool) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    axes = figure.subplots()
    axes.set_title(titled(title, simulated), fontsize=11)
    return figure, axes


def _finish(axes: Axes) -> None:
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    axes.grid(alpha=0.25, lw=0.6)
    axes.legend(fontsize=8, framealpha=0.8)


def _styles() -> Iterator[dict[str, Any]]:
    """Colour, marker and line of the first, second, ... method."""
    for i, (colour, marker) in enumerate(zip(cycle(COLOURS), cycle(METHOD_MARKERS), strict=False)):
        yield {"color": colour, "marker": marker, "linestyle": LINES[i % len(LINES)]}
