"""Figures of recognition: accuracy against touches, and confusion.

Functions take scores (`i2t.recognition.metrics`) and return a matplotlib figure, which `i2t.viz.save_figure`
writes. Methods keep their colour, from the colour-blind safe set of Okabe and Ito (2008), their marker and their line
through all figures that name them in the same order; every figure made from simulated touches says so in its title.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from i2t.recognition.intervals import Estimate
from i2t.viz.style import COLOURS, titled

METHOD_MARKERS = "osD^vPX"
LINES = ("-", "--", "-.", ":")


def accuracy(methods: Mapping[str, Estimate], title: str, simulated: bool) -> Figure:
    """Accuracy (t,) after touches 1 to t of each method, shaded over its interval."""
    figure = Figure(figsize=(6.4, 4), layout="constrained")
    axes = figure.subplots()
    axes.set_title(titled(title, simulated), fontsize=11)
    for (name, (mean, low, high)), style in zip(methods.items(), _styles(), strict=False):
        x = np.arange(1, len(mean) + 1)
        axes.fill_between(x, low, high, color=style["color"], alpha=0.18, lw=0)
        axes.plot(x, mean, label=name, markersize=4, **style)
    axes.set(xlabel="touches", ylabel="accuracy", ylim=(0, 1.02))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    axes.grid(alpha=0.25, lw=0.6)
    axes.legend(fontsize=8, framealpha=0.8)
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


def _styles() -> Iterator[dict[str, Any]]:
    """Colour, marker and line of the first, second, ... method."""
    for i, (colour, marker) in enumerate(zip(cycle(COLOURS), cycle(METHOD_MARKERS), strict=False)):
        yield {"color": colour, "marker": marker, "linestyle": LINES[i % len(LINES)]}
