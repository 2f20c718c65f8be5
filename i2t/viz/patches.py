"""Drawings of maps over the skin, of depth patches, and of the paper's contact masks."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from i2t.patches.dimensions import CONTACT_TOLERANCE_M, PAD_WINDOW, PATCH_WINDOW, REACH
from i2t.types import Array
from i2t.viz.style import MM_PER_M, Colour, Picture, titled


def draw_map(
    axes: Axes,
    values: Shaped[Array, "rows columns"],
    window: float,
    *,
    cmap: str | Colormap = "cividis",
    low: float | int | None = None,
    high: float | int | None = None,
) -> AxesImage:
    """Draw an array over a square, x to the right and y up.

    Args:
        axes: Axes to draw into.
        values: Values of the pixels, with rows along y and columns along x.
        window: Edge (m) of the square.
        cmap: Colour map, or its name.
        low: Value at the lower end of the colour map; the minimum by default.
        high: Value at the upper end of the colour map; the maximum by default.

    Returns:
        The drawn image, from which a colour bar can be made.
    """
    half = window * MM_PER_M / 2
    axes.set_aspect("equal")
    return axes.imshow(
        np.asarray(values), origin="lower", extent=(-half, half, -half, half), cmap=cmap, vmin=low, vmax=high
    )


def draw_patch(
    axes: Axes, patch: Float[Array, "rows columns"], window: float = PATCH_WINDOW, reach: float = REACH
) -> AxesImage:
    """Draw a depth patch, bright where the surface is near.

    Args:
        axes: Axes to draw into.
        patch: Depth (m) behind the nearest surface point.
        window: m, edge of the patch.
        reach: Largest depth (m) of a patch.

    Returns:
        The drawn image, from which a colour bar can be made.
    """
    return draw_map(axes, np.asarray(patch) * MM_PER_M, window, cmap="cividis_r", low=0, high=reach * MM_PER_M)


def draw_view(
    axes: Axes, view: Float[Array, "rows columns"], window: float, patch: float = PATCH_WINDOW, reach: float = REACH
) -> AxesImage:
    """Draw a patch with its surroundings, red where they stand out in front of it, and outline patch and skin.

    Args:
        axes: Axes to draw into.
        view: Depth (m) behind the patch's nearest point, negative where something stands out in front of it.
        window: Edge (m) of the view.
        patch: Edge (m) of the patch.
        reach: Largest depth (m) of a patch.

    Returns:
        The drawn image, from which a colour bar can be made.
    """
    image = draw_patch(axes, np.clip(view, 0, reach), window, reach)
    draw_map(axes, np.where(np.asarray(view) < -1e-5, 1.0, np.nan), window, cmap=ListedColormap([Colour.RED]))
    for edge, colour, style in ((patch, "white", "-"), (PAD_WINDOW, "black", ":")):
        half = edge * MM_PER_M / 2
        axes.add_artist(Rectangle((-half, -half), 2 * half, 2 * half, fill=False, color=colour, lw=1.2, ls=style))
    return image


def draw_length(axes: Axes, length_mm: float = 5.0) -> None:
    """Draw a bar of known length in the lower left corner of axes in millimetres.

    Args:
        axes: Axes with their limits set.
        length_mm: Length (mm) of the bar.
    """
    start, low = axes.get_xlim()[0] + 0.8, axes.get_ylim()[0] + 0.8
    halo = [withStroke(linewidth=4, foreground="white")]
    axes.plot([start, start + length_mm], [low, low], color="black", lw=2, solid_capstyle="butt", path_effects=halo)
    axes.annotate(
        f"{length_mm:g} mm", (start, low), xytext=(0, 3), textcoords="offset points", fontsize=9, path_effects=halo
    )


def plot_patches(
    depth: Float[Array, "n rows columns"],
    labels: Sequence[str],
    title: str,
    simulated: bool,
    *,
    window: float = PATCH_WINDOW,
    reach: float = REACH,
) -> Picture:
    """Plot depth patches, and below them the paper's binary contact masks.

    Args:
        depth: Depth (m) behind the nearest surface point.
        labels: Label of each patch.
        title: Title of the figure.
        simulated: Whether any of the data are simulated.
        window: Edge (m) of a patch.
        reach: Largest depth (m) of a patch.

    Returns:
        The figure, which `save_figure` can write.
    """
    depth = np.asarray(depth)
    n = len(depth)
    figure = Picture(figsize=(1.9 * n + 1.2, 4.7), layout="constrained")
    axes = figure.subplots(2, n, squeeze=False)
    for i in range(n):
        image = draw_patch(axes[0, i], depth[i], window, reach)
        mask = depth[i] <= depth[i].min() + CONTACT_TOLERANCE_M
        draw_map(axes[1, i], mask, window, cmap="gray", low=0, high=1)
        axes[0, i].set_title(labels[i], fontsize=9)
        axes[0, i].set_xticklabels([])
        axes[1, i].set_xlabel("x (mm)")
        if i:
            axes[0, i].set_yticklabels([])
            axes[1, i].set_yticklabels([])
    axes[0, 0].set_ylabel("y (mm)")
    axes[1, 0].set_ylabel("y (mm)")
    figure.colorbar(image, ax=axes[0, -1], label="depth behind\nthe nearest point (mm)")
    figure.suptitle(
        f"{titled(title, simulated)}\ndepth (above) and contact masks: white lies within "
        f"{CONTACT_TOLERANCE_M * MM_PER_M:g} mm of the nearest point",
        fontsize=10,
    )
    return figure
