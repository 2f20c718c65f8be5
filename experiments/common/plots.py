"""Figures of training: touches felt and imagined, errors per axis, training curves, scores of methods.

Colours, titles and how readings and patches are drawn are those of `i2t.viz.touches`. Functions take NumPy arrays and
return a matplotlib figure, which `i2t.viz.touches.save` writes.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from i2t.types import Board
from i2t.viz.touches import BLUE, GREEN, GREY, ORANGE, RED, draw_patch, draw_reading, draw_skin, titled


def touches(
    patches: np.ndarray,
    truth: np.ndarray,
    predicted: np.ndarray,
    labels: Sequence[str],
    board: Board,
    window: float,
    reach: float,
    title: str,
    simulated: bool,
) -> Figure:
    """A column per touch: its depth patch above; below it what was felt and what was imagined as five field vectors."""
    n = len(patches)
    figure = Figure(figsize=(2.5 * n + 0.9, 5.6), layout="constrained")
    axes = figure.subplots(2, n, squeeze=False)
    scale = float(np.percentile(np.linalg.norm(np.asarray(truth).reshape(n, 5, 3), axis=-1), 95)) or 1.0
    for i in range(n):
        image = draw_patch(axes[0, i], patches[i], window, reach)
        axes[0, i].set_title(labels[i], fontsize=9)
        draw_skin(axes[1, i])
        draw_reading(axes[1, i], board, truth[i], scale, BLUE, "felt")
        draw_reading(axes[1, i], board, predicted[i], scale, ORANGE, "imagined")
        axes[1, i].set_xlabel("tool x (mm)")
    axes[0, 0].set_ylabel("tool y (mm)")
    axes[1, 0].set_ylabel("tool y (mm)")
    figure.colorbar(image, ax=axes[0, -1], label="depth behind nearest (mm)")
    figure.legend(*axes[1, -1].get_legend_handles_labels(), fontsize=8, loc="upper right", ncols=2)
    figure.suptitle(
        titled(title, simulated)
        + f"\narrows: field in the skin's plane, 5 mm = {scale:.0f} µT; discs: normal field, filled outwards",
        fontsize=10,
    )
    return figure


def curves(series: dict[str, np.ndarray], title: str, ylabel: str, simulated: bool) -> Figure:
    """Curves over epochs, one per name; values (epochs,) or (seeds, epochs), drawn as mean and range."""
    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    for (name, values), colour in zip(series.items(), (BLUE, ORANGE, GREEN, RED), strict=False):
        values = np.atleast_2d(values)
        x = np.arange(1, values.shape[1] + 1)
        axes.plot(x, values.mean(0), color=colour, label=name)
        if len(values) > 1:
            axes.fill_between(x, values.min(0), values.max(0), color=colour, alpha=0.2, lw=0)
    axes.set(xlabel="epoch", ylabel=ylabel, yscale="log", title=titled(title, simulated))
    axes.legend(fontsize=8)
    return figure


def errors_per_axis(errors: dict[str, np.ndarray], noise: np.ndarray | None, title: str, simulated: bool) -> Figure:
    """Bars of RMSE (15,) uT per chip and axis, one group of bars per method; `noise` (15,) is drawn as the floor where
    known.
    """
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots()
    x, width = np.arange(15), 0.8 / len(errors)
    for i, ((name, values), colour) in enumerate(zip(errors.items(), (GREY, GREEN, BLUE, ORANGE, RED), strict=False)):
        axes.bar(x + (i - (len(errors) - 1) / 2) * width, values, width, label=name, color=colour)
    if noise is not None:
        axes.step(
            np.r_[x - 0.5, 14.5],
            np.r_[noise, noise[-1]],
            where="post",
            color="black",
            lw=1,
            label="sensor noise (1 sigma)",
        )
    axes.set_xticks(x, [f"{chip}{axis}" for chip in range(5) for axis in "xyz"])
    axes.set(xlabel="chip and axis", ylabel="RMSE (µT)", title=titled(title, simulated))
    axes.legend(fontsize=8, ncols=2)
    return figure


def scores(values: dict[str, tuple[float, float, float]], title: str, xlabel: str, simulated: bool) -> Figure:
    """Horizontal dots with 95 % intervals, (mean, low, high) per method, best on top."""
    figure = Figure(figsize=(6, 0.34 * len(values) + 1.2), layout="constrained")
    axes = figure.subplots()
    for y, (_, (mean, low, high)) in enumerate(values.items()):
        axes.plot([low, high], [y, y], color=BLUE, lw=2)
        axes.plot(mean, y, "o", color=BLUE)
    axes.axvline(0, color=GREY, lw=0.8)
    axes.set_yticks(range(len(values)), list(values))
    axes.invert_yaxis()
    axes.set(xlabel=xlabel)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure
