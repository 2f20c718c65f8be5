"""Plots of methods' results: rates and scores with 95 % intervals, and confusion matrices."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Shaped

from i2t.types import Array
from i2t.viz.style import CURVE_COLOURS, CURVE_MARKERS, Colour, Picture, titled


def plot_confusions(
    counts: Mapping[str, Shaped[Array, "c c"]], names: Sequence[str], title: str, simulated: bool
) -> Picture:
    """Plot a confusion matrix for each method, as shares of the trials of each true class.

    Args:
        counts: Confusion matrix of each method: number of trials by true class (row) and decided class (column).
        names: Names of the classes.
        title: Title of the figure.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    n = len(counts)
    figure = Picture(figsize=(3.1 * n + 0.9, 4.2), layout="constrained")
    panels = figure.subplots(1, n, squeeze=False)[0]
    for axes, (method, matrix) in zip(panels, counts.items(), strict=True):
        matrix = np.asarray(matrix, np.float64)
        share = matrix / np.maximum(matrix.sum(1, keepdims=True), 1)
        image = axes.imshow(share, cmap="cividis", vmin=0, vmax=1)
        for row, column in np.ndindex(share.shape):
            colour = "white" if share[row, column] < 0.5 else "black"
            text = f"{share[row, column]:.2f}"
            axes.text(column, row, text, ha="center", va="center", fontsize=8, color=colour)
        axes.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=8)
        axes.set_yticks(range(len(names)), names if axes is panels[0] else [], fontsize=8)
        axes.set_title(f"{method}\n{np.trace(matrix) / matrix.sum():.1%} right", fontsize=9)
        axes.set_xlabel("decided")
    panels[0].set_ylabel("true")
    figure.colorbar(image, ax=panels, label="share of row", shrink=0.8)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure


def plot_rates(
    groups: Mapping[str, Mapping[str, Sequence[float]]], title: str, ylabel: str, chance: float, simulated: bool
) -> Picture:
    """Plot rates of methods side by side, in groups.

    Args:
        groups: Mean and 95 % interval (mean, low, high) by group and method. A group may lack methods.
        title: Title of the figure.
        ylabel: Label of the rate's axis.
        chance: Rate of random guessing.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    methods = list(dict.fromkeys(method for values in groups.values() for method in values))
    figure = Picture(figsize=(1.2 * len(groups) + 4.2, 4.2), layout="constrained")
    axes = figure.subplots()
    for i, method in enumerate(methods):
        at = [j for j, values in enumerate(groups.values()) if method in values]
        mean, low, high = np.array([list(groups[list(groups)[j]][method]) for j in at], np.float64).T
        x = np.array(at) + 0.13 * (i - (len(methods) - 1) / 2)
        bars = np.nan_to_num(np.clip(np.stack([mean - low, np.minimum(high, 1) - mean]), 0, None))
        marker, colour = CURVE_MARKERS[i % len(CURVE_MARKERS)], CURVE_COLOURS[i % len(CURVE_COLOURS)]
        axes.errorbar(x, mean, bars, fmt=marker, color=colour, ms=5, lw=1.5, label=method)
    axes.axhline(chance, color=Colour.GREY, lw=0.8, ls=":")
    axes.set_xlim(-0.6, len(groups) - 0.4)
    axes.text(-0.58, chance + 0.01, "chance", fontsize=8, color=Colour.GREY)
    axes.set_xticks(range(len(groups)), [name.replace(", ", "\n") for name in groups], fontsize=9)
    axes.set(ylim=(0, 1.02), ylabel=ylabel)
    axes.grid(axis="y", color="#dddddd", lw=0.6)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.suptitle(f"{titled(title, simulated)}, bars: 95 %", fontsize=11)
    return figure


def plot_intervals(
    values: Mapping[str, tuple[float, float, float]], title: str, xlabel: str, simulated: bool
) -> Picture:
    """Plot scores with 95 % intervals, one row for each method, the first on top.

    Args:
        values: Mean and 95 % interval (mean, low, high) by method.
        title: Title of the figure.
        xlabel: Name of the score, with its unit.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    figure = Picture(figsize=(6, 0.34 * len(values) + 1.2), layout="constrained")
    axes = figure.subplots()
    for y, (mean, low, high) in enumerate(values.values()):
        axes.plot([low, high], [y, y], color=Colour.BLUE, lw=2)
        axes.plot(mean, y, "o", color=Colour.BLUE)
    axes.axvline(0, color=Colour.GREY, lw=0.8)
    axes.set_yticks(range(len(values)), list(values))
    axes.invert_yaxis()
    axes.set(xlabel=xlabel)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure
