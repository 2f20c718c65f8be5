"""Figures of `experiments.reconstruct_patch`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.reconstruct_patch.scores import LEVELS, MM
from i2t import viz
from i2t.reconstruction.local_shape import PatchPosterior
from i2t.reconstruction.press_curves import PressCurve
from i2t.types import CONTACT_TOLERANCE_M, PATCH_WINDOW, REACH
from i2t.viz import style

SHIFT_OF_METHODS = 6e-3  # of the predicted share, between methods: markers stand next to each other


def draw_posteriors(presses: Sequence[PressCurve], found: Sequence[PatchPosterior], true: np.ndarray) -> Figure:
    """Of each press: its readings, what was met, the posterior's mean, two samples, and the mask's probability."""
    titles = ("readings (uT)", "met", "mean", "a sample", "another", "mask probability")
    figure = Figure(figsize=(11.5, 1.85 * len(presses) + 0.9), layout="constrained")
    axes = figure.subplots(len(presses), len(titles), squeeze=False)
    for row, press, posterior, patch in zip(axes, presses, found, true, strict=True):
        channels = np.arange(press.reading.shape[-1])
        for stop, colour in zip(press.reading, (style.BLUE, style.ORANGE), strict=False):
            row[0].plot(channels, stop, color=colour, lw=1, marker=".", ms=4)
        row[0].set_xticks([])
        row[0].tick_params(labelsize=7)
        some = np.asarray(posterior.patch, np.float32)[[len(posterior.patch) // 3, 2 * len(posterior.patch) // 3]]
        for axis, depth in zip(row[1:5], (patch, posterior.mean, *some), strict=True):
            image = viz.draw_patch(axis, np.asarray(depth, np.float32), PATCH_WINDOW, REACH)
        extent = image.get_extent()
        mask = row[5].imshow(posterior.mask_probability, origin="lower", extent=extent, cmap="Greys", vmin=0, vmax=1)
        at = np.linspace(extent[0], extent[1], len(patch))
        if (patch <= CONTACT_TOLERANCE_M).any() and not (patch <= CONTACT_TOLERANCE_M).all():
            row[5].contour(at, at, patch, levels=[CONTACT_TOLERANCE_M], colors=style.RED, linewidths=1)
        for axis in row[1:]:
            axis.set(xticks=[], yticks=[], xlabel="", ylabel="")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
    figure.colorbar(image, ax=axes[:, 1:5], label="depth beyond first contact (mm)", location="bottom", aspect=60)
    figure.colorbar(mask, ax=axes[:, 5], label="line: true outline", location="bottom", aspect=14)
    figure.suptitle("What one press says of the surface: 17 x 17 mm, objects never seen (simulated)")
    return figure


def draw_reliability(found: dict[str, Any], names: Sequence[str]) -> Figure:
    """Share of the pixels in contact that lie in intervals of the posterior, by the share that is predicted."""
    figure = Figure(figsize=(4.6, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.plot([0.4, 1], [0.4, 1], color=style.GREY, lw=1, ls="--", label="measured as predicted")
    apart = SHIFT_OF_METHODS * (np.arange(len(names)) - (len(names) - 1) / 2)
    for name, colour, marker, shift in zip(names, style.COLOURS, style.MARKERS, apart, strict=False):
        values = np.array([found[name][f"coverage_{round(100 * level)}"] for level in LEVELS])
        axes.errorbar(
            np.array(LEVELS) + shift, values[:, 0], np.abs(values[:, 1:] - values[:, :1]).T,
            color=colour, marker=marker, ms=4, lw=1.2, capsize=2, label=name,
        )  # fmt: skip
    axes.set(xlim=(0.45, 0.95), ylim=(0.3, 1.02), xlabel="predicted share of pixels in the interval")
    axes.set_ylabel("measured share (pixels in contact)")
    axes.set_title("Intervals of a pixel's depth (simulated)", fontsize=11)
    axes.legend(fontsize=7, loc="lower right")
    return figure


def draw_tips(places: np.ndarray, weights: np.ndarray, true: np.ndarray, report: dict[str, Any]) -> Figure:
    """Draw likely places of the tip at a few presses, by their readings, and the true one.

    Args:
        places: (p, 2) m.
        weights: (k, p) of each place, for each of k presses.
        true: (k, 2) m.
        report: Whose recording is named.
    """
    columns = -(-len(weights) // 2)
    figure = Figure(figsize=(2.4 * columns + 1, 5.2), layout="constrained")
    shape = tuple(len(np.unique(places[:, i])) for i in range(2))
    x, y = (MM * np.unique(places[:, i]) for i in range(2))
    for axes, weight, at in zip(figure.subplots(2, columns).ravel(), weights, true, strict=False):
        most = np.sqrt(weight.reshape(shape).T / weight.max())  # square roots: what is less probable shows too
        image = axes.pcolormesh(x, y, most, cmap="Blues", vmin=0, vmax=1, shading="nearest", rasterized=True)
        axes.plot(*(MM * at), "+", color=style.RED, ms=9, mew=1.5)
        axes.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
        axes.label_outer()
        axes.tick_params(labelsize=7)
    figure.colorbar(image, ax=figure.axes, label="root of the share of\nthe most probable place", shrink=0.7)
    figure.suptitle(f"Where the tip was, by one reading ({report['source']}); cross: where it was", fontsize=11)
    return figure
