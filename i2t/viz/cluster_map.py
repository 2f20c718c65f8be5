"""Map of a set of touches with their clusters, the mean view and reading of each cluster, and examples."""

from collections.abc import Sequence
from string import ascii_lowercase
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped
from matplotlib.axes import Axes

from i2t.types import Array, Board
from i2t.viz.clusters import TouchMap
from i2t.viz.patches import draw_map
from i2t.viz.skins import ARROW_MM, common_scale, draw_reading, draw_skin
from i2t.viz.style import CURVE_COLOURS, CURVE_MARKERS, MM_PER_M, Picture, titled


class TouchViews(NamedTuple):
    """Images of n touches to be plotted, such as contact masks, with values in [0, 1], and the edge (m) of an image."""

    values: Array  # (n, rows, columns) in [0, 1]
    window: float  # m, edge of a view
    name: str  # kind of view, such as "contact mask"


def plot_clusters(
    touch_map: TouchMap,
    views: TouchViews,
    readings: Shaped[Array, "n c"],
    names: Sequence[str],
    board: Board,
    *,
    title: str,
    simulated: bool,
) -> Picture:
    """Plot the map of touches with its clusters, and a row for each cluster: the mean view and reading, then examples.

    Args:
        touch_map: Map of the n touches and their clusters (`i2t.viz.clusters.map_touches`).
        views: Views of the n touches.
        readings: Readings (uT) of the n touches.
        names: Name of each touch, such as its object, with which examples are labelled.
        board: Board with c / 3 chips.
        title: Title of the figure.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    readings, label, examples = np.asarray(readings), touch_map.label, np.asarray(touch_map.examples)
    k, e = examples.shape
    mean_readings = np.stack([readings[label == i].mean(0) for i in range(k)])
    scale = common_scale(np.concatenate([mean_readings, readings[examples.ravel()]]))
    figure = Picture(figsize=(7.0 + 1.7 * 2 * (1 + e), 1.75 * k + 1.0), layout="constrained")
    grid = figure.add_gridspec(k, 2 * (1 + e) + 4, width_ratios=[1.6] * 4 + [1.0] * (2 * (1 + e)))
    _draw_touch_map(figure.add_subplot(grid[:, :4]), touch_map)
    for i in range(k):
        own = label == i
        rows = [(views.values[own].mean(0), mean_readings[i], f"{i + 1}: mean of {int(own.sum())}")]
        rows += [
            (views.values[row], readings[row], f"{i + 1}{letter}: {names[row]}")
            for letter, row in zip(ascii_lowercase, examples[i], strict=False)
        ]
        for j, (view, reading, name) in enumerate(rows):
            left, right = (figure.add_subplot(grid[i, 4 + 2 * j + side]) for side in (0, 1))
            draw_map(left, view, views.window, low=0, high=1)
            draw_skin(right, 1.0)
            draw_reading(right, board, reading, scale, colour=CURVE_COLOURS[i % len(CURVE_COLOURS)], width=0.02)
            left.set_title(name, fontsize=8.5, loc="left", fontweight="normal" if j else "bold")
            for panel in (left, right):
                panel.set(xticks=[], yticks=[])
                for side in panel.spines.values():
                    side.set_color("#bbbbbb")
            right.set_axis_off()
    figure.suptitle(
        f"{titled(title, simulated)}\n"
        f"left of each pair: {views.name}, bright is 1, {views.window * MM_PER_M:g} mm wide; right: change of field "
        f"over the 20 mm of the skin, arrows in its plane ({ARROW_MM:g} mm = {scale:g} µT), discs normal to it, filled "
        "if it points outwards",
        fontsize=10,
    )
    return figure


def _draw_touch_map(axes: Axes, touch_map: TouchMap) -> None:
    """Draw the touches by cluster, with the clusters' means as crosses and the examples as circles."""
    number: dict[str, Any] = {"fontsize": 10, "fontweight": "bold", "textcoords": "offset points"}
    for i, mean in enumerate(touch_map.means):
        own = touch_map.at[touch_map.label == i]
        colour = CURVE_COLOURS[i % len(CURVE_COLOURS)]
        axes.scatter(
            own[:, 0], own[:, 1], s=9, color=colour, marker=CURVE_MARKERS[i % len(CURVE_MARKERS)], lw=0, alpha=0.7
        )
        axes.plot(*mean, "X", color=colour, mec="black", ms=14)
        box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": colour, "alpha": 0.85}
        axes.annotate(f"{i + 1}", mean, xytext=(9, 7), bbox=box, **number)
        for letter, row in zip(ascii_lowercase, touch_map.examples[i], strict=False):
            axes.plot(*touch_map.at[row], "o", mfc="none", mec="black", ms=7, mew=1.2)
            axes.annotate(f"{i + 1}{letter}", touch_map.at[row], xytext=(5, -10), **(number | {"fontsize": 8}))
    axes.set(xticks=[], yticks=[], xlabel="t-SNE 1", ylabel="t-SNE 2")
    axes.set_title("X: means of the clusters; circles: the examples", fontsize=10)
