"""Figures of reconstructed surfaces, coloured by their uncertainty.

Scenes are drawn like those of `i2t.viz.scene`, by pyvista off screen. If that is not possible, the figure states why.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize

from i2t.types import Array
from i2t.viz.scene import body_of, explain_no_scene, image_of, set_view, skin_square
from i2t.viz.style import MM_PER_M, Colour, Picture, titled


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
        The figure. It states the reason if no scene can be drawn.
    """
    figure = Picture(figsize=(2.5 * (len(stages) + (truth is not None)), 2.9), layout="constrained")
    figure.suptitle(titled(title, simulated), fontsize=11)
    if explain_no_scene():
        figure.text(0.5, 0.5, explain_no_scene(), ha="center", va="center", wrap=True)
        return figure
    high = max((float(np.quantile(stage.std, 0.98)) for stage in stages if len(stage.std)), default=1e-3)
    scale = ScalarMappable(Normalize(0, MM_PER_M * high), "plasma")
    panels = figure.subplots(1, len(stages) + (truth is not None), squeeze=False)[0]
    for axes, stage in zip(panels, stages, strict=False):
        _show(axes, _plotter(stage, high, scale.cmap), stage.label)
    if truth is not None:
        surface = ShownSurface("truth", *truth, np.zeros(0), np.zeros((0, 4, 4)))
        _show(panels[-1], _plotter(surface, high, scale.cmap), "truth")
    figure.colorbar(scale, ax=list(panels), label="standard deviation, mm", shrink=0.75, aspect=15)
    return figure


def _plotter(stage: ShownSurface, high: float, cmap: Colormap) -> Any:
    import pyvista as pv

    with pv.vtk_verbosity("error"):  # VTK warns about a missing display, which it does not need
        plotter: Any = pv.Plotter(off_screen=True, window_size=[520, 440], lighting="three lights")
        if len(stage.faces):
            body = body_of(pv, stage.vertices, stage.faces)
            if len(stage.std):
                colours = cmap(np.clip(np.asarray(stage.std) / high, 0, 1))[:, :3]
                body["colours"] = (255 * colours).astype(np.uint8)
                plotter.add_mesh(body, scalars="colours", rgb=True, smooth_shading=True)
            else:
                plotter.add_mesh(body, color="#d9d9d9", split_sharp_edges=True, smooth_shading=True)
        for T in np.asarray(stage.T_o_t, np.float64):
            plotter.add_mesh(skin_square(pv, T).extract_feature_edges(), color=Colour.GREEN, line_width=2)
        set_view(plotter)
    return plotter


def _show(axes: Any, plotter: Any, label: str) -> None:
    axes.imshow(image_of(plotter))  # before the first touch, the surface may be empty
    axes.set_axis_off()
    axes.set_title(label, fontsize=10)
