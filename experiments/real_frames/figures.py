"""Figures of real patches next to imagined ones."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from experiments.real_frames.frames import Compared, heights
from i2t import viz
from i2t.depth.patches import DepthPatch
from i2t.types import PATCH_WINDOW, REACH
from i2t.viz import style

NOT_SEEN_COLOUR = "#DDDDDD"


def figure(name: str, by_window: dict[float, Compared], count: int = 4) -> Figure:
    """Rows of sites; for the smallest and the largest window the real patch, the imagined one and the difference."""
    windows = (min(by_window), max(by_window))
    sites = np.flatnonzero(np.isfinite(by_window[windows[0]].bias[0]) & np.isfinite(by_window[windows[1]].bias[0]))[
        :count
    ]
    result = Figure(figsize=(14, 2.4 * len(sites) + 1.0), layout="constrained")
    axes = result.subplots(len(sites), 6, squeeze=False)
    for row, site in zip(axes, sites, strict=True):
        for half, window in enumerate(windows):
            part, reach = by_window[window], REACH * window / PATCH_WINDOW
            near = part.imagined.nearest[0, site] + part.bias[0, site]
            known = part.real.valid_mask[0, site] | part.real.inpainted_mask[0, site]
            real = np.clip(heights(part.real.patch)[0, site] - near, 0, reach)
            left, middle, right = row[3 * half : 3 * half + 3]
            image = draw(left, np.where(known, real, np.nan), window, reach)
            draw(middle, part.imagined.depth[0, site], window, reach)
            rest = part.difference[0, site] - part.bias[0, site]
            extent = np.array([-1, 1, -1, 1]) * 1e3 * window / 2
            change = right.imshow(1e3 * rest, origin="lower", extent=extent, cmap="PuOr", vmin=-4, vmax=4)
            right.set_facecolor(NOT_SEEN_COLOUR)
            left.set_title(f"real, {1e3 * window:g} mm", fontsize=9)
            middle.set_title("imagined", fontsize=9)
            right.set_title(f"difference, bias {1e3 * part.bias[0, site]:+.1f} mm", fontsize=9)
            if site == sites[-1]:
                first = 3 * half
                for axis in row[first : first + 3]:
                    axis.set_xlabel("tool x (mm)")
                result.colorbar(
                    image,
                    ax=axes[:, first : first + 2],
                    label="depth behind nearest (mm)",
                    location="bottom",
                    shrink=0.6,
                )
                result.colorbar(
                    change, ax=axes[:, first + 2], label="difference, bias taken off (mm)", location="bottom"
                )
        row[0].set_ylabel(f"site {site}\ntool y (mm)")
    result.suptitle(
        f"{name}: real depth (Xtion, first frame) against the posed scan; grey was not seen or not compared"
    )
    return result


def figure_f200(name: str, depth: np.ndarray, pixels: list[tuple[int, int]], patches: DepthPatch) -> Figure:
    """The depth image with the points, and their patches."""
    result = Figure(figsize=(3.6 + 2.4 * len(pixels), 3.2), layout="constrained")
    axes = result.subplots(1, 1 + len(pixels), width_ratios=[1.6] + [1.0] * len(pixels))
    low, high = np.nanpercentile(depth, [2, 98])
    axes[0].set_facecolor(NOT_SEEN_COLOUR)
    image = axes[0].imshow(depth, cmap="cividis_r", vmin=low, vmax=high)
    result.colorbar(image, ax=axes[0], label="depth (m)", location="left")
    axes[0].set(xlabel="column", ylabel="row", title="real")
    for i, (column, row) in enumerate(pixels):
        axes[0].plot(column, row, "o", color=style.RED, ms=4)
        axes[0].annotate(str(i), (column, row), color=style.RED, xytext=(4, 4), textcoords="offset points")
        known = patches.valid_mask[i] | patches.inpainted_mask[i]
        image = draw(axes[i + 1], np.where(known, patches.patch.depth[i], np.nan), PATCH_WINDOW, REACH)
        axes[i + 1].set_title(f"real, point {i}", fontsize=9)
        axes[i + 1].set_xlabel("tool x (mm)")
    axes[1].set_ylabel("tool y (mm)")
    result.colorbar(image, ax=axes[-1], label="depth behind nearest (mm)")
    result.suptitle(f"RealSense F200, {name}: patches along normals of the depth; grey was not measured or not seen")
    return result


def draw(axes: Axes, patch: np.ndarray, window: float, reach: float) -> AxesImage:
    """Draw a patch, with unknown pixels in grey."""
    axes.set_facecolor(NOT_SEEN_COLOUR)
    return viz.draw_patch(axes, patch, window, reach)
