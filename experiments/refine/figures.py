"""Figures of `experiments.refine`."""

from collections.abc import Sequence

import jax
import numpy as np
from matplotlib.figure import Figure

from experiments.refine.cases import Cases, Views
from experiments.refine.scores import MM_PER_M
from i2t import viz
from i2t.objects import Object
from i2t.rendering.ops import element
from i2t.rendering.render import render_patch
from i2t.types import PATCH_WINDOW, REACH, Surface
from i2t.viz import style

ERROR_BINS = np.logspace(-5, 0, 26)
MAX_SHOWN_MM = 0.3  # where the colours of a difference end


def draw_patches(
    objects: Sequence[Object],
    surfaces: Surface,
    *,
    views: Views,
    cases: Cases,
    found: np.ndarray,
    observable: np.ndarray,
    rows: int = 4,
) -> Figure:
    """Draw what the camera saw, the start, the found pose, and how far that is from the truth, for the objects with the
    most observable directions.
    """
    rows = min(rows, len(objects))
    figure = Figure(figsize=(9.5, 2.4 * rows + 0.9), layout="constrained")
    axes = figure.subplots(rows, 4, squeeze=False, sharex=True, sharey=True)
    look = jax.jit(jax.vmap(render_patch, (None, 0)))
    best = observable.sum(-1).argmax(1)
    chosen = np.argsort(-observable.sum(-1).max(1), kind="stable")[:rows]
    for row, i in zip(axes, chosen, strict=True):
        j = best[i]
        before, after = (element(look(element(surfaces, i), T[i]), j) for T in (cases.start, found))
        floor = views.clean[i].nearest[j] + REACH
        off = np.minimum(after.nearest + after.depth, floor) - views.clean[i].nearest[j] - views.clean[i].depth[j]
        for axis, depth in zip(row[:3], (views.noisy[i].depth[j], before.depth, after.depth), strict=True):
            image = viz.draw_patch(axis, depth, PATCH_WINDOW, REACH)
        left = row[3].imshow(
            MM_PER_M * off,
            origin="lower",
            extent=image.get_extent(),
            cmap="RdBu",
            vmin=-MAX_SHOWN_MM,
            vmax=MAX_SHOWN_MM,
        )
        row[0].set_ylabel(f"{objects[i].name}\ntool y (mm)")
    for axis, title in zip(axes[0], ("observed", "at the start", "refined", "refined - true"), strict=True):
        axis.set_title(title, fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("tool x (mm)")
    figure.colorbar(image, ax=axes[:, :3], label="depth behind nearest (mm)", location="bottom", aspect=50)
    figure.colorbar(left, ax=axes[:, 3], label="height (mm)", location="bottom", aspect=16)
    figure.suptitle("Poses sought from one noisy patch, from one start (simulated)")
    return figure


def draw_bounds(curves: dict[str, np.ndarray], bound: float) -> Figure:
    """Success against the bound on the directions that count."""
    figure = Figure(figsize=(6, 3.8), layout="constrained")
    axes = figure.subplots()
    colours = (style.BLUE, style.ORANGE, style.GREEN, style.RED)
    for (name, rate), colour in zip(curves.items(), colours, strict=False):
        axes.semilogx(ERROR_BINS, rate, color=colour, label=name)
    axes.axvline(bound, color=style.GREY, lw=1, ls="--", label="the bound that is used")
    axes.axhline(0.9, color=style.GREY, lw=1, ls=":")
    axes.set(
        ylim=(0, 1.02),
        xlabel="smallest eigenvalue that counts",
        ylabel="success",
        title="Poses found, by what counts (simulated)",
    )
    axes.legend(fontsize=8, loc="lower right")
    return figure
