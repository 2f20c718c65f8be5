"""Figure of accuracy against the number of touches.

Methods in the same order have the same colours (the colour-blind safe set of Okabe and Ito, 2008), markers and lines in
all figures. The titles of figures of simulated touches state that.
"""

from collections.abc import Mapping
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from i2t.intervals import Estimate
from i2t.viz.style import CURVE_COLOURS, titled


def accuracy(methods: Mapping[str, Estimate], title: str, simulated: bool) -> Figure:
    """Plot the accuracy (t,) of each method after touches 1 to t, with shaded intervals."""
    figure = Figure(figsize=(8.4, 4), layout="constrained")
    axes = figure.subplots()
    axes.set_title(titled(title, simulated), fontsize=11)
    styles = zip(cycle(CURVE_COLOURS), cycle("osD^vPX"), cycle(("-", "--", "-.", ":")), strict=False)
    for (name, (mean, low, high)), (colour, marker, line) in zip(methods.items(), styles, strict=False):
        x = np.arange(1, len(mean) + 1)
        axes.fill_between(x, low, high, color=colour, alpha=0.18, lw=0)
        axes.plot(x, mean, label=name, color=colour, marker=marker, linestyle=line, markersize=4)
    axes.set(xlabel="touches", ylabel="accuracy", ylim=(0, 1.02))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    axes.grid(alpha=0.25, lw=0.6)
    figure.legend(fontsize=8, loc="outside right center", frameon=False)
    return figure
