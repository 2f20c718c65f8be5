"""Figures of training and calibration: measured and predicted touches and values, and curves over epochs."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from i2t.leave_one_out import STDS_WITHIN_90
from i2t.patches.dimensions import PATCH_WINDOW, REACH
from i2t.types import Array, Board
from i2t.viz.patches import draw_patch
from i2t.viz.skins import common_scale, draw_reading, draw_skin, scale_legend
from i2t.viz.style import CURVE_COLOURS, Colour, Picture, titled


def plot_predicted_touches(
    patches: Float[Array, "n rows columns"],
    sets: Mapping[str, Float[Array, "n c"]],
    labels: Sequence[str],
    board: Board,
    title: str,
    simulated: bool,
    *,
    window: float = PATCH_WINDOW,
    reach: float = REACH,
) -> Picture:
    """Plot a column for each touch: its depth patch, and below it the field vectors of its readings.

    Args:
        patches: Depth (m) behind the nearest surface point.
        sets: `(n, c)` readings (uT) by name. The first set, usually the measured one, fixes the scale.
        labels: Label of each touch.
        board: Board with c / 3 chips.
        title: Title of the figure.
        simulated: Whether any of the data are simulated.
        window: Edge (m) of a patch.
        reach: Largest depth (m) of a patch.

    Returns:
        The figure, which `save_figure` can write.
    """
    n = len(patches)
    figure = Picture(figsize=(2.5 * n + 0.9, 5.6), layout="constrained")
    axes = figure.subplots(2, n, squeeze=False)
    scale = common_scale(next(iter(sets.values())))
    for i in range(n):
        image = draw_patch(axes[0, i], patches[i], window, reach)
        axes[0, i].set_title(labels[i], fontsize=9)
        draw_skin(axes[1, i])
        for (name, readings), colour in zip(sets.items(), cycle(CURVE_COLOURS), strict=False):
            draw_reading(axes[1, i], board, readings[i], scale, colour=colour, label=name)
        axes[1, i].set_xlabel("tool x (mm)")
    axes[0, 0].set_ylabel("tool y (mm)")
    axes[1, 0].set_ylabel("tool y (mm)")
    figure.colorbar(image, ax=axes[0, -1], label="depth behind nearest (mm)")
    figure.legend(*axes[1, -1].get_legend_handles_labels(), fontsize=8, loc="upper right", ncols=len(sets))
    figure.suptitle(f"{titled(title, simulated)}\n{scale_legend(board, scale)}", fontsize=10)
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
