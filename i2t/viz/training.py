"""Figures of training and calibration: measured and predicted touches and values, and curves over epochs."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from i2t.leave_one_out import STDS_WITHIN_90
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import PATCH_WINDOW, REACH
from i2t.types import Array, Board
from i2t.viz.patches import draw_length, draw_patch
from i2t.viz.scene import draw_object, number_style, touch_colours
from i2t.viz.skins import KEY_SHARE, common_scale, draw_chip_numbers, draw_key, draw_reading, draw_skin
from i2t.viz.style import CURVE_COLOURS, Colour, Picture, titled

MAX_COLUMNS = 6  # touches side by side


def plot_predicted_touches(
    patches: Float[Array, "n rows columns"],
    sets: Mapping[str, Float[Array, "n c"]],
    labels: Sequence[str],
    board: Board,
    title: str,
    simulated: bool,
    *,
    std: Mapping[str, Float[Array, "n c"]] | None = None,
    mesh: Mesh | None = None,
    T_o_t: Float[Array, "n 4 4"] | None = None,
    window: float = PATCH_WINDOW,
    reach: float = REACH,
) -> Picture:
    """Plot a column for each touch: its depth patch, and below it the field vectors of its readings.

    With a mesh, the object is drawn on the left with the skin's square at each touch.

    Args:
        patches: Depth (m) behind the nearest surface point.
        sets: `(n, c)` readings (uT) by name. The first set, usually the measured one, fixes the scale.
        labels: Label of each touch.
        board: Board with c / 3 chips.
        title: Title of the figure.
        simulated: Whether any of the data are simulated.
        std: `(n, c)` standard deviations (uT) of the sets that have some, by name.
        mesh: The touched object.
        T_o_t: Tool poses of the touches in the object's frame; required with a mesh.
        window: Edge (m) of a patch.
        reach: Largest depth (m) of a patch.

    Returns:
        The figure, which `save_figure` can write.
    """
    n, std = len(patches), std or {}
    columns = min(n, MAX_COLUMNS)
    rows = -(-n // columns)
    scale = common_scale(next(iter(sets.values())))
    left = 1.7 if mesh is not None else 0.0
    figure = Picture(figsize=(1.75 * (columns + left + KEY_SHARE), 3.6 * rows + 0.4), layout="constrained")
    figure.suptitle(titled(title, simulated), fontsize=12)
    widths = [left] * (mesh is not None) + [1.0] * columns + [KEY_SHARE]
    grid = figure.add_gridspec(2 * rows, len(widths), width_ratios=widths)
    if mesh is not None:
        draw_object(figure.add_subplot(grid[:, 0]), mesh.vertices, mesh.faces, T_o_t, aspect=left / 2 / rows)
    for i in range(n):
        row, column = 2 * (i // columns), i % columns + (mesh is not None)
        above, below = (figure.add_subplot(grid[row + k, column]) for k in range(2))
        image = draw_patch(above, patches[i], window, reach)
        above.set_title(labels[i], fontsize=10)
        if mesh is not None:
            style = number_style(touch_colours(n)[i])
            above.text(0.06, 1.08, str(i + 1), transform=above.transAxes, ha="center", va="center", **style)
        draw_skin(below)
        draw_chip_numbers(below, board)
        for (name, readings), colour in zip(sets.items(), cycle(CURVE_COLOURS), strict=False):
            spread = std[name][i] if name in std else None
            draw_reading(below, board, readings[i], scale, std=spread, colour=colour, label=name)
        above.set(xticks=[], yticks=[])
        below.set(xticks=[], yticks=[], frame_on=False)
        if i % columns == 0:
            above.set_ylabel("depth patch", fontsize=10)
            below.set_ylabel(" and ".join(sets), fontsize=10)
            draw_length(above)
            draw_length(below)
    bar, key = (figure.add_subplot(grid[k, -1]) for k in range(2))
    bar.set_axis_off()
    figure.colorbar(image, cax=bar.inset_axes((0.02, 0.0, 0.1, 1.0)), label="depth behind nearest\npoint (mm)")
    draw_key(key, board, scale, std=bool(std))
    if len(sets) > 1:
        figure.legend(*below.get_legend_handles_labels(), fontsize=10, loc="outside lower center", ncols=len(sets))
    return figure


def plot_training_curves(
    series: Mapping[str, Shaped[Array, "..."]], title: str, ylabel: str, simulated: bool
) -> Picture:
    """Plot curves over epochs on a logarithmic axis, as mean and range (minimum to maximum) over seeds.

    Args:
        series: Values `(epochs,)` or `(seeds, epochs)` by name.
        title: Title of the figure.
        ylabel: Name of the values, with their unit.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    figure = Picture(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    for (name, values), colour in zip(series.items(), cycle(CURVE_COLOURS), strict=False):
        values = np.atleast_2d(values)
        x = np.arange(1, values.shape[1] + 1)
        axes.plot(x, values.mean(0), color=colour, label=name)
        if len(values) > 1:
            axes.fill_between(x, values.min(0), values.max(0), color=colour, alpha=0.2, lw=0)
    axes.set(xlabel="epoch", ylabel=ylabel, yscale="log", title=titled(title, simulated))
    axes.legend(fontsize=8)
    return figure


def plot_predictions(
    measured: Shaped[Array, " n"],
    predicted: Shaped[Array, " n"],
    std: Shaped[Array, " n"],
    title: str,
    simulated: bool,
) -> Picture:
    """Plot predicted against measured values, with error bars that should cover nine in ten.

    Args:
        measured: Measured values (uT).
        predicted: Predicted values (uT).
        std: Predicted standard deviations (uT).
        title: Title of the figure.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    figure = Picture(figsize=(4.8, 4.4), layout="constrained")
    axes = figure.subplots()
    bars: dict[str, Any] = {
        "elinewidth": 0.6,
        "alpha": 0.5,
        "color": Colour.BLUE,
        "ms": 3,
        "label": "presses, 90 % bars",
    }
    axes.errorbar(measured, predicted, STDS_WITHIN_90 * np.asarray(std), fmt="o", **bars)
    ends = [min(np.min(measured), np.min(predicted)), max(np.max(measured), np.max(predicted))]
    axes.plot(ends, ends, color=Colour.GREY, lw=1, label="predicted as measured")
    axes.set(xlabel="measured (µT)", ylabel="predicted (µT)")
    axes.legend(fontsize=8)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure
