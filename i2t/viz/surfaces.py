"""Figures of reconstructed surfaces, coloured by their uncertainty."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from i2t.types import Array
from i2t.viz.scene import draw_object
from i2t.viz.style import MM_PER_M, Picture, titled


class ShownSurface(NamedTuple):
    """One stage of a reconstructed surface to be drawn: its mesh (m), its standard deviation (m) at each vertex, and
    the tool poses of the touches so far.
    """

    label: str
    vertices: Float[Array, "v 3"]  # m, vertices of the surface
    faces: Int[Array, "f 3"]
    std: Float[Array, " v"]  # m, standard deviation of the surface at each vertex
    T_o_t: Float[Array, "n 4 4"]  # tool poses of the touches so far


def plot_growing_surface(
    stages: Sequence[ShownSurface], truth: tuple[Array, Array] | None, title: str, simulated: bool
) -> Picture:
    """Plot stages of a surface side by side, coloured by its standard deviation, with touches and finally the truth.

    Args:
        stages: The stages in order of time.
        truth: Vertices (m) and faces of the true object; None if it is unknown.
        title: Title of the figure.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    figure = Picture(figsize=(2.5 * (len(stages) + (truth is not None)), 2.9), layout="constrained")
    figure.suptitle(titled(title, simulated), fontsize=11)
    high = MM_PER_M * max((float(np.quantile(stage.std, 0.98)) for stage in stages if len(stage.std)), default=1e-3)
    scale = ScalarMappable(Normalize(0, high), "plasma")
    panels = figure.subplots(1, len(stages) + (truth is not None), squeeze=False)[0]
    for axes, stage in zip(panels, stages, strict=False):
        _show(axes, stage, scale.to_rgba(MM_PER_M * np.asarray(stage.std))[:, :3])
    if truth is not None:
        _show(panels[-1], ShownSurface("truth", *truth, np.zeros(0), np.zeros((0, 4, 4))), None)
    figure.colorbar(scale, ax=list(panels), label="standard deviation, mm", shrink=0.75, aspect=15)
    return figure


def _show(axes: Axes, stage: ShownSurface, colours: np.ndarray | None) -> None:
    draw_object(axes, stage.vertices, stage.faces, stage.T_o_t, numbers=False, colours=colours, directions=1)
    axes.set_title(stage.label, fontsize=10)
