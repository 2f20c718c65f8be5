"""Figures of training and calibration: measured and predicted touches and values, and curves over epochs."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.axes import Axes

from i2t.leave_one_out import STDS_WITHIN_90
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import PAD_WINDOW, PATCH_WINDOW, REACH
from i2t.types import Array, Board
from i2t.viz.patches import draw_length, draw_patch, draw_view
from i2t.viz.scene import draw_number, draw_object, touch_colours
from i2t.viz.skins import common_scale, draw_chip_numbers, draw_key, draw_reading, draw_skin, key_layout, margin_mm
from i2t.viz.style import CURVE_COLOURS, MM_PER_M, Colour, Picture, titled


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
    views: Float[Array, "n w w"] | None = None,
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
        views: Patches with their surroundings (m), which are drawn in place of the patches (`draw_view`).
        window: Edge (m) of a patch.
        reach: Largest depth (m) of a patch.

    Returns:
        The figure, which `save_figure` can write.
    """
    n, std = len(patches), std or {}
    columns = min(n, 6)
    rows = -(-n // columns)
    scale = common_scale(next(iter(sets.values())))
    margin = max(margin_mm(board, readings, scale, std=std.get(name)) for name, readings in sets.items())
    edge = 1.27 if columns > 3 else 1.6  # inches, of a patch
    scene = 0.0 if mesh is None else 1.75 * edge
    width, row_height = max(scene + 0.55 + columns * (edge + 0.1) + 0.9, 3.6), 2 * edge + 0.65  # of the key at least
    per_row, bottom = key_layout(width, tuple(sets), std=bool(std))
    height = bottom + rows * row_height + 0.35
    figure = Picture(figsize=(width, height))

    def place(x: float, y: float, w: float, h: float) -> Axes:
        return figure.add_axes((x / width, y / height, w / width, h / height))

    figure.text(0.5, 1 - 0.1 / height, titled(title, simulated), ha="center", va="top", fontsize=11)
    if mesh is not None:
        room = rows * row_height - 0.2
        draw_object(place(0, bottom + 0.2, scene, room), mesh.vertices, mesh.faces, T_o_t, aspect=scene / room)
    for i in range(n):
        x, y = scene + 0.55 + i % columns * (edge + 0.1), height - 0.35 - (i // columns + 1) * row_height
        above, below = place(x, y + edge + 0.35, edge, edge), place(x, y + 0.28, edge, edge)
        if views is None:
            image = draw_patch(above, patches[i], window, reach)
        else:
            image = draw_view(above, views[i], window * len(views[i]) / len(patches[i]), window, reach)
        above.set(xticks=[], yticks=[])
        above.set_title(labels[i], fontsize=10)
        if mesh is not None:
            draw_number(above, 0.08, 1.1, i + 1, touch_colours(n)[i], transform=above.transAxes)
        draw_skin(below, margin)
        below.set(xticks=[], yticks=[], frame_on=False)
        draw_chip_numbers(below, board)
        for (name, readings), colour in zip(sets.items(), cycle(CURVE_COLOURS), strict=False):
            spread = std[name][i] if name in std else None
            draw_reading(below, board, readings[i], scale, std=spread, colour=colour)
        if i % columns == 0:
            above.set_ylabel("depth patch" if views is None else "patch and\nsurroundings", fontsize=10)
            below.set_ylabel("reading" if len(sets) > 1 else f"{name}\nreading", fontsize=10)
            below.set_xlabel(f"skin, {PAD_WINDOW * MM_PER_M:g} mm", fontsize=10, labelpad=1)
            draw_length(above)
            bar = figure.colorbar(image, cax=place(width - 0.85, y + edge + 0.35, 0.12, edge))
            bar.set_label("depth behind\nnearest (mm)", fontsize=10)
    draw_key(place(0, 0, width, bottom), below, board, scale, sets=tuple(sets), std=bool(std), columns=per_row)
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
        "label": "values, 90 % bars",
    }
    axes.errorbar(measured, predicted, STDS_WITHIN_90 * np.asarray(std), fmt="o", **bars)
    ends = [min(np.min(measured), np.min(predicted)), max(np.max(measured), np.max(predicted))]
    axes.plot(ends, ends, color=Colour.GREY, lw=1, label="predicted as measured")
    axes.set(xlabel="measured (µT)", ylabel="predicted (µT)")
    axes.legend(fontsize=8)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure
