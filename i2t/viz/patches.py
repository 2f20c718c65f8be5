"""Maps over the skin, depth patches, and the paper's contact masks."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.axes import Axes
from matplotlib.image import AxesImage

from i2t.patches.dimensions import CONTACT_TOLERANCE_M, PATCH_WINDOW, REACH
from i2t.types import Array
from i2t.viz.style import MM_PER_M, Picture, titled


def draw_map(
    axes: Axes,
    values: Shaped[Array, "rows columns"],
    window: float,
    *,
    cmap: str = "cividis",
    low: float | int | None = None,
    high: float | int | None = None,
) -> AxesImage:
    """Draw an array over a square, x to the right and y up.

    Args:
        axes: Where to draw.
        values: Row i along y, column j along x.
        window: m, edge of the square.
        cmap: Name of a colour map.
        low: Value of its lower end; the least value unless given.
        high: Value of its upper end; the largest value unless given.

    Returns:
        The image, for a colour bar.
    """
    half = window * MM_PER_M / 2
    axes.set_aspect("equal")
    return axes.imshow(
        np.asarray(values), origin="lower", extent=(-half, half, -half, half), cmap=cmap, vmin=low, vmax=high
    )


def draw_patch(
    axes: Axes, patch: Float[Array, "rows columns"], window: float = PATCH_WINDOW, reach: float = REACH
) -> AxesImage:
    """Draw a depth patch, the near side bright.

    Args:
        axes: Where to draw.
        patch: m behind the nearest surface point.
        window: m, edge of the patch.
        reach: m, largest depth of a patch.

    Returns:
        The image, for a colour bar.
    """
    return draw_map(axes, np.asarray(patch) * MM_PER_M, window, cmap="cividis_r", low=0, high=reach * MM_PER_M)


def plot_patches(
    depth: Float[Array, "n rows columns"],
    labels: Sequence[str],
    title: str,
    simulated: bool,
    *,
    window: float = PATCH_WINDOW,
    reach: float = REACH,
) -> Picture:
    """Depth patches above, and below them the paper's binary contact masks.

    Args:
        depth: m behind the nearest surface point.
        labels: One for each patch.
        title: What is shown.
        simulated: Whether it was simulated.
        window: m, edge of a patch.
        reach: m, largest depth of a patch.

    Returns:
        The figure.
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
