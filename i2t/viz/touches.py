"""Figures for people: readings as field vectors over the skin, patches and masks, pressure maps, objects with their
touches, clusters of touches, rates and confusions.

Functions take NumPy or JAX arrays and return a matplotlib figure; `save` writes one, and notebooks show it as it is.
Colours are from the colour-blind safe set of Okabe and Ito (2008), and maps are drawn in cividis; lengths are drawn in
millimetres, fields in microtesla. What was simulated says so in its title.

The core does not need this module, which needs matplotlib; `scene` needs pyvista (`pip install "i2t[notebooks]"`) and a
machine that can draw off screen, which is tried out first in a process of its own: without EGL or OSMesa VTK ends with
a segmentation fault.
"""

import html
import io
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle, Rectangle

from i2t.types import PAD_WINDOW, PATCH_WINDOW, REACH, Array, Board

BLUE, ORANGE, GREEN, RED, PINK, SKY, GREY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#666666",
)  # fmt: skip
COLOURS = (BLUE, ORANGE, GREEN, RED, PINK, SKY, GREY)
MARKERS = "osD^vP*"
MILLI = 1e3
ARROW = 5.0  # mm, of the field that a figure's scale names
PROBE = "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(64, 64)); p.add_mesh(pv.Cube()); p.show()"
NO_PYVISTA = 'There is no 3-D picture, because pyvista is missing: pip install "i2t[notebooks]".'
NO_GL = (
    "There is no 3-D picture, because this machine cannot draw off screen: install the system package libegl1 "
    "(apt-get install libegl1) or libosmesa6."
)


class Picture(Figure):
    """A figure that notebooks show as it is, whatever their backend."""

    def _repr_png_(self) -> bytes:
        made = io.BytesIO()
        FigureCanvasAgg(self).figure.savefig(made, format="png", dpi=90, bbox_inches="tight")
        return made.getvalue()


class View3D:
    """A scene that can be turned with the mouse, in a notebook and in its exported HTML."""

    def __init__(self, page: str, title: str, width: int = 780, height: int = 520) -> None:
        self.page, self.title, self.size = page, title, (width, height)

    def _repr_html_(self) -> str:
        width, height = self.size
        frame = f'width="{width}" height="{height}" style="border: 0"'
        return f'<p>{html.escape(self.title)}</p><iframe srcdoc="{html.escape(self.page)}" {frame}></iframe>'


def save(figure: Figure, path: Path | str) -> Path:
    """Write a figure as PNG."""
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=150, bbox_inches="tight")
    return Path(path)


def titled(title: str, simulated: bool) -> str:
    """A title that says where its numbers come from."""
    return f"{title} (simulated)" if simulated else title


# --- readings ---


def scale_of(readings: Array) -> float:
    """A field (uT) that nearly all chips of some readings (..., 15) stay below, rounded to two digits: the common scale
    of a figure.
    """
    norms = np.linalg.norm(np.asarray(readings, np.float64).reshape(-1, 3), axis=-1)
    top = float(np.percentile(norms, 95))
    if not top > 0:
        return 1.0
    digit = 10.0 ** (np.floor(np.log10(top)) - 1)
    return float(np.ceil(top / digit) * digit)


def draw_field(
    axes: Any, board: Board, reading: Array, scale: float, colour: str, label: str | None = None, width: float = 2.0
) -> None:
    """Draw a reading (15,) uT into 3-D axes as five field vectors at the chips, seen through the skin; `scale` uT are
    `ARROW` mm long.
    """
    chips = np.asarray(board.chips, np.float64)[:, :2] * MILLI
    field = np.asarray(board.to_tool(np.asarray(reading, np.float64))) * ARROW / scale
    flat = np.zeros(len(chips))
    axes.quiver(*chips.T, flat, *field.T, color=colour, lw=width, arrow_length_ratio=0.25, label=label)
    axes.scatter(*chips.T, flat, color="black", s=8, depthshade=False)


def _skin(axes: Any) -> None:
    half = PAD_WINDOW * MILLI / 2
    x, y = np.array([-1, 1, 1, -1, -1]) * half, np.array([-1, -1, 1, 1, -1]) * half
    axes.plot(x, y, np.zeros(5), color=GREY, lw=1)
    axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(-0.7 * half, 0.7 * half))
    axes.set_xticks([-10, 0, 10])
    axes.set_yticks([0, 10])
    axes.set_zticks([])
    axes.set_box_aspect((1, 1, 0.7), zoom=1.05)
    axes.tick_params(labelsize=7, pad=-3)
    axes.set_xlabel("x (mm)", fontsize=8, labelpad=-6)
    axes.set_ylabel("y (mm)", fontsize=8, labelpad=-6)
    axes.view_init(elev=28, azim=-60)


def readings(
    board: Board, sets: Mapping[str, Array], labels: Sequence[str], title: str, simulated: bool, columns: int = 5
) -> Picture:
    """A panel per touch with the field at the five chips, one colour for each of `sets` (n, 15) uT, on one scale."""
    values = [np.asarray(part) for part in sets.values()]
    n = len(labels)
    columns = min(columns, n)
    rows = -(-n // columns)
    scale = scale_of(np.stack(values))
    figure = Picture(figsize=(2.6 * columns, 2.5 * rows + 0.9), layout="constrained")
    for i in range(n):
        axes: Any = figure.add_subplot(rows, columns, i + 1, projection="3d")
        _skin(axes)
        for j, (name, part) in enumerate(sets.items()):  # thinner ones over wider ones, so that both are seen
            width = 1.6 if j else 3.2 if len(sets) > 1 else 2.0
            draw_field(axes, board, np.asarray(part)[i], scale, COLOURS[j % len(COLOURS)], name, width)
        axes.set_title(labels[i], fontsize=9, pad=0)
    if len(sets) > 1:
        figure.legend(*axes.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=len(sets))
    below = "\n" * max(label.count("\n") for label in labels)  # room that the layout does not give to 3-D axes
    figure.suptitle(
        f"{titled(title, simulated)}\nchange of field at the five chips (dots) under the skin (square); "
        f"an arrow of {ARROW:g} mm is {scale:g} µT, up is out of the skin{below}",
        fontsize=10,
    )
    return figure


def draw_reading(
    axes: Axes, board: Board, reading: Array, scale: float, colour: str, label: str | None = None, width: float = 0.012
) -> None:
    """The flat version: arrows for the field in the skin's plane, discs for the normal field, filled where it points
    out of the skin; `scale` uT are `ARROW` mm. Give every panel of a figure the same.
    """
    chips = np.asarray(board.chips)[:, :2] * MILLI
    field = np.asarray(board.to_tool(np.asarray(reading))) * ARROW / scale
    x, y, normal = field.T
    arrows: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "color": colour, "width": width}
    axes.quiver(*chips.T, x, y, label=label, **arrows)
    for centre, z in zip(chips, normal, strict=True):
        face, alpha = (colour, 0.45) if z > 0 else ("none", 0.9)
        axes.add_artist(Circle(centre, abs(z) / 2, facecolor=face, edgecolor=colour, alpha=alpha, lw=1.2))


def draw_skin(axes: Axes, margin: float = 3.0) -> None:
    """The skin's outline, with `margin` mm around it."""
    half = PAD_WINDOW * MILLI / 2
    axes.add_artist(Rectangle((-half, -half), 2 * half, 2 * half, fill=False, color=GREY, lw=0.8))
    axes.set(xlim=(-half - margin, half + margin), ylim=(-half - margin, half + margin), aspect="equal")


# --- maps over the skin ---


def draw_map(
    axes: Axes, values: Array, window: float, cmap: str = "cividis", low: float | int | None = None,
    high: float | int | None = None,
) -> AxesImage:  # fmt: skip
    """Draw an array (n, n) over a square of edge `window` (m), x to the right and y up; returns the image for a colour
    bar.
    """
    half = window * MILLI / 2
    axes.set_aspect("equal")
    return axes.imshow(
        np.asarray(values), origin="lower", extent=(-half, half, -half, half), cmap=cmap, vmin=low, vmax=high
    )


def draw_patch(axes: Axes, patch: Array, window: float = PATCH_WINDOW, reach: float = REACH) -> AxesImage:
    """Draw a depth patch (n, n) m, the near side bright."""
    return draw_map(axes, np.asarray(patch) * MILLI, window, "cividis_r", 0, reach * MILLI)


def patches(
    depth: Array, labels: Sequence[str], title: str, simulated: bool, tolerance: float = 1.5e-3,
    window: float = PATCH_WINDOW, reach: float = REACH,
) -> Picture:  # fmt: skip
    """Depth patches (n, h, w) m above, and below them the paper's binary masks: what lies within `tolerance` (m) of the
    nearest point.
    """
    depth = np.asarray(depth)
    n = len(depth)
    figure = Picture(figsize=(1.9 * n + 1.2, 4.7), layout="constrained")
    axes = figure.subplots(2, n, squeeze=False)
    for i in range(n):
        image = draw_patch(axes[0, i], depth[i], window, reach)
        mask = depth[i] <= depth[i].min() + tolerance
        draw_map(axes[1, i], mask, window, "gray", 0, 1)
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
        f"{titled(title, simulated)}\ndepth (above) and contact masks: white lies within {tolerance * MILLI:g} mm of "
        "the nearest point",
        fontsize=10,
    )
    return figure


def press_maps(
    pressure: Array, displacement: Array, board: Board, reading: Array, title: str, simulated: bool,
    scale: float | None = None,
) -> Picture:  # fmt: skip
    """One press: pressure (n, n) Pa on the skin, its surface's displacement (n, n) m downwards, and the change of field
    (15,) uT at the chips below it.
    """
    figure = Picture(figsize=(11, 3.9), layout="constrained")
    left, middle = figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2)
    right: Any = figure.add_subplot(1, 3, 3, projection="3d")
    image = draw_map(left, np.asarray(pressure) / 1e3, PAD_WINDOW, low=0)
    figure.colorbar(image, ax=left, label="pressure (kPa)", shrink=0.8)
    image = draw_map(middle, np.asarray(displacement) * MILLI, PAD_WINDOW)
    figure.colorbar(image, ax=middle, label="pushed in by (mm)", shrink=0.8)
    for axes in (left, middle):
        axes.plot(*(np.asarray(board.chips)[:, :2] * MILLI).T, ".", color="white", mec="black", ms=7)
        axes.set(xlabel="x (mm)", ylabel="y (mm)")
    left.set_title("pressure on the skin", fontsize=10)
    middle.set_title("displacement of its surface", fontsize=10)
    scale = scale_of(reading) if scale is None else scale
    _skin(right)
    draw_field(right, board, reading, scale, BLUE)
    right.set_title(f"field at the chips: {ARROW:g} mm is {scale:g} µT", fontsize=10)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure


def skin_map(values: Array, window: float, label: str, title: str, simulated: bool) -> Picture:
    """Any values (n, n) over a square of edge `window` (m), with a scale about zero where they have both signs."""
    figure = Picture(figsize=(5, 4.2), layout="constrained")
    axes = figure.subplots()
    low, high, cmap = _range(values)
    image = draw_map(axes, values, window, cmap, low, high)
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    figure.colorbar(image, ax=axes, label=label)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure


def _range(values: Array) -> tuple[float, float, str]:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low < 0 < high:
        top = max(-low, high)
        return -top, top, "PuOr"
    return low, high, "cividis"


def against(truth: Array, mean: Array, std: Array, title: str, simulated: bool) -> Picture:
    """Predicted against measured values (n,) uT, with bars that should hold nine in ten."""
    figure = Picture(figsize=(4.8, 4.4), layout="constrained")
    axes = figure.subplots()
    bars: dict[str, Any] = {"elinewidth": 0.6, "alpha": 0.5, "color": BLUE, "ms": 3, "label": "presses, 90 % bars"}
    axes.errorbar(truth, mean, 1.645 * np.asarray(std), fmt="o", **bars)
    ends = [min(np.min(truth), np.min(mean)), max(np.max(truth), np.max(mean))]
    axes.plot(ends, ends, color=GREY, lw=1, label="as measured")
    axes.set(xlabel="measured (µT)", ylabel="predicted (µT)")
    axes.legend(fontsize=8)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure


# --- clusters of touches ---


def clusters(
    at: Array, means: Array, label: Array, views: Array, felt: Array, examples: Array,
    names: Sequence[str], board: Board, window: float, view: str, title: str, simulated: bool,
) -> Picture:  # fmt: skip
    """A map of touches (n, 2) with its clusters (`label` (n,)), their means (k, 2) as crosses, and a row for each
    cluster: mean view and mean reading, then those of its `examples` (k, e), row numbers that are named by `names`.

    `views` (n, h, w) lie between 0 and 1; `felt` (n, 15) uT.
    """
    k, e = np.shape(examples)
    mean_felt = np.stack([felt[label == i].mean(0) for i in range(k)])
    scale = scale_of(np.concatenate([mean_felt, felt[examples.ravel()]]))
    figure = Picture(figsize=(7.0 + 1.7 * 2 * (1 + e), 1.75 * k + 1.0), layout="constrained")
    grid = figure.add_gridspec(k, 2 * (1 + e) + 4, width_ratios=[1.6] * 4 + [1.0] * (2 * (1 + e)))
    axes = figure.add_subplot(grid[:, :4])
    for i in range(k):
        own = label == i
        colour = COLOURS[i % len(COLOURS)]
        axes.scatter(at[own, 0], at[own, 1], s=9, color=colour, marker=MARKERS[i % len(MARKERS)], lw=0, alpha=0.7)
        axes.plot(*means[i], "X", color=colour, mec="black", ms=14)
        place: dict[str, Any] = {"fontsize": 10, "fontweight": "bold", "textcoords": "offset points"}
        box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": colour, "alpha": 0.85}
        axes.annotate(f"{i + 1}", means[i], xytext=(9, 7), bbox=box, **place)
        for letter, row in zip("abcd", examples[i], strict=False):
            axes.plot(*at[row], "o", mfc="none", mec="black", ms=7, mew=1.2)
            axes.annotate(f"{i + 1}{letter}", at[row], xytext=(5, -10), **(place | {"fontsize": 8}))
    axes.set(xticks=[], yticks=[], xlabel="t-SNE 1", ylabel="t-SNE 2")
    axes.set_title("X: means of the clusters; circles: the examples", fontsize=10)
    for i in range(k):
        rows = [(views[label == i].mean(0), mean_felt[i], f"{i + 1}: mean of {int((label == i).sum())}")]
        rows += [
            (views[row], felt[row], f"{i + 1}{letter}: {names[row]}")
            for letter, row in zip("abcd", examples[i], strict=False)
        ]
        for j, (seen, reading, name) in enumerate(rows):
            left, right = (figure.add_subplot(grid[i, 4 + 2 * j + side]) for side in (0, 1))
            draw_map(left, seen, window, "cividis", 0, 1)
            draw_skin(right, 1.0)
            draw_reading(right, board, reading, scale, COLOURS[i % len(COLOURS)], width=0.02)
            left.set_title(name, fontsize=8.5, loc="left", fontweight="normal" if j else "bold")
            for panel in (left, right):
                panel.set(xticks=[], yticks=[])
                for side in panel.spines.values():
                    side.set_color("#bbbbbb")
            right.set_axis_off()
    figure.suptitle(
        f"{titled(title, simulated)}\n"
        f"left of each pair: {view}, bright is 1, {window * MILLI:g} mm wide; right: change of field over the skin's "
        f"20 mm, arrows in its plane ({ARROW:g} mm = {scale:g} µT), discs normal to it, filled outwards",
        fontsize=10,
    )
    return figure


# --- what methods reach ---


def confusions(counts: Mapping[str, Array], names: Sequence[str], title: str, simulated: bool) -> Picture:
    """A matrix per method: of what was there (rows), the share that was taken for each (columns)."""
    n = len(counts)
    figure = Picture(figsize=(3.1 * n + 0.9, 4.2), layout="constrained")
    panels = figure.subplots(1, n, squeeze=False)[0]
    for axes, (method, matrix) in zip(panels, counts.items(), strict=True):
        matrix = np.asarray(matrix, np.float64)
        share = matrix / np.maximum(matrix.sum(1, keepdims=True), 1)
        image = axes.imshow(share, cmap="cividis", vmin=0, vmax=1)
        for row, column in np.ndindex(share.shape):
            colour = "white" if share[row, column] < 0.5 else "black"
            text = f"{share[row, column]:.2f}"
            axes.text(column, row, text, ha="center", va="center", fontsize=8, color=colour)
        axes.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=8)
        axes.set_yticks(range(len(names)), names if axes is panels[0] else [], fontsize=8)
        axes.set_title(f"{method}\n{np.trace(matrix) / matrix.sum():.1%} right", fontsize=9)
        axes.set_xlabel("taken for")
    panels[0].set_ylabel("was")
    figure.colorbar(image, ax=panels, label="share", shrink=0.8)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure


def rates(
    groups: Mapping[str, Mapping[str, Sequence[float]]], title: str, ylabel: str, chance: float, simulated: bool
) -> Picture:
    """Rates (mean, low, high) of methods side by side in groups, with 95 % intervals."""
    methods = list(dict.fromkeys(method for values in groups.values() for method in values))
    figure = Picture(figsize=(1.2 * len(groups) + 4.2, 4.2), layout="constrained")
    axes = figure.subplots()
    for i, method in enumerate(methods):
        at = [j for j, values in enumerate(groups.values()) if method in values]
        mean, low, high = np.array([list(groups[list(groups)[j]][method]) for j in at], np.float64).T
        x = np.array(at) + 0.13 * (i - (len(methods) - 1) / 2)
        bars = np.nan_to_num(np.clip(np.stack([mean - low, np.minimum(high, 1) - mean]), 0, None))
        axes.errorbar(
            x, mean, bars, fmt=MARKERS[i % len(MARKERS)], color=COLOURS[i % len(COLOURS)], ms=5, lw=1.5, label=method
        )  # fmt: skip
    axes.axhline(chance, color=GREY, lw=0.8, ls=":")
    axes.set_xlim(-0.6, len(groups) - 0.4)
    axes.text(-0.58, chance + 0.01, "chance", fontsize=8, color=GREY)
    axes.set_xticks(range(len(groups)), [name.replace(", ", "\n") for name in groups], fontsize=9)
    axes.set(ylim=(0, 1.02), ylabel=ylabel)
    axes.grid(axis="y", color="#dddddd", lw=0.6)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.suptitle(f"{titled(title, simulated)}, bars: 95 %", fontsize=11)
    return figure


def rates_by(lines: Mapping[str, Array], title: str, xlabel: str, ylabel: str, simulated: bool) -> Picture:
    """Rates of methods against a size on a logarithmic axis; rows of an array are (size, mean, low, high)."""
    figure = Picture(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for i, (method, rows) in enumerate(lines.items()):
        x, mean, low, high = np.asarray(rows, np.float64).T
        colour = COLOURS[i % len(COLOURS)]
        axes.plot(x, mean, marker=MARKERS[i % len(MARKERS)], color=colour, label=method)
        axes.fill_between(x, low, np.minimum(high, 1), color=colour, alpha=0.15, lw=0)
    axes.set_xscale("log")
    axes.set_xticks(x, [f"{value:g}" for value in x])
    axes.minorticks_off()
    axes.set(ylim=(0, 1.02), xlabel=xlabel, ylabel=ylabel)
    axes.grid(color="#dddddd", lw=0.6)
    axes.legend(fontsize=8)
    figure.suptitle(f"{titled(title, simulated)}, bands: 95 %", fontsize=11)
    return figure


# --- in three dimensions ---


@cache
def no_scene() -> str:
    """Why no scene can be drawn here, in one sentence; empty where it can.

    Without EGL or OSMesa VTK ends the process with a segmentation fault, so another process tries first, once.
    """
    if find_spec("pyvista") is None:
        return NO_PYVISTA
    try:
        tried = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=120)
    except subprocess.TimeoutExpired:
        return NO_GL
    return "" if tried.returncode == 0 else NO_GL


def plotter(vertices: Array, faces: Array, T_o_t: Array, numbers: bool = True) -> Any:
    """A pyvista plotter with an object (vertices (v, 3) m, faces (f, 3)) and the skin's square at each of its touches
    (n, 4, 4), ready to `show()`; RuntimeError where no scene can be drawn.
    """
    if no_scene():
        raise RuntimeError(no_scene())
    import pyvista as pv

    T_o_t = np.asarray(T_o_t, np.float64)
    body = pv.PolyData(
        np.asarray(vertices, np.float64) * MILLI, np.column_stack([np.full(len(faces), 3), faces]).ravel()
    )
    with pv.vtk_verbosity("error"):  # VTK warns of the missing display before it goes on without
        drawn: Any = pv.Plotter(off_screen=True, window_size=[900, 700], lighting="three lights")
        drawn.add_mesh(body, color="#d9d9d9", split_sharp_edges=True, smooth_shading=True)
        edges = body.extract_feature_edges(30, boundary_edges=True, manifold_edges=False, non_manifold_edges=False)
        if edges.n_points:
            drawn.add_mesh(edges, color="#555555", line_width=1.5)
        half = PAD_WINDOW * MILLI / 2
        corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
        colours = colormaps["viridis"](np.linspace(0.0, 0.9, len(T_o_t)))[:, :3]
        for i, (T, colour) in enumerate(zip(T_o_t, colours, strict=True)):
            lifted = corners - [0, 0, 0.5]
            square = pv.PolyData(lifted @ T[:3, :3].T + T[:3, 3] * MILLI, [4, 3, 2, 1, 0])
            drawn.add_mesh(square, color=colour, opacity=0.55, lighting=False)
            drawn.add_mesh(square.extract_feature_edges(), color=colour, line_width=3)
            if numbers:
                # From behind the skin, where a person stands.
                end = T[:3, 3] * MILLI - 9 * T[:3, 2]
                drawn.add_mesh(pv.Line(T[:3, 3] * MILLI, end), color="black", line_width=2)
                drawn.add_point_labels(
                    [end], [str(i + 1)], font_size=20, bold=True, shape_color="white", shape_opacity=0.8,
                    always_visible=True, show_points=False,
                )  # fmt: skip
        drawn.enable_parallel_projection()
        drawn.view_vector((-0.6, -1.0, 1.0), viewup=(0, 0, 1))
    return drawn


def scene(vertices: Array, faces: Array, T_o_t: Array, title: str, simulated: bool, numbers: bool = True) -> Picture:
    """A still picture of an object with its touches (see `plotter`); where none can be drawn the figure says why."""
    drawn = None if no_scene() else plotter(vertices, faces, T_o_t, numbers)
    return _still(drawn, f"{titled(title, simulated)}\nsquares: the skin, 20 mm wide, where it touched")


def skin_plotter(pressure: Array, displacement: Array, exaggerate: float = 5.0) -> Any:
    """A pyvista plotter with the skin's surface, pushed in by `displacement` (n, n) m and coloured by pressure (n, n)
    Pa; RuntimeError where no scene can be drawn.
    """
    if no_scene():
        raise RuntimeError(no_scene())
    import pyvista as pv

    n = len(pressure)
    at = ((np.arange(n) + 0.5) / n - 0.5) * PAD_WINDOW * MILLI
    x, y = np.meshgrid(at, at)
    with pv.vtk_verbosity("error"):
        drawn: Any = pv.Plotter(off_screen=True, window_size=[900, 700])
        surface = pv.StructuredGrid(x, y, -exaggerate * np.asarray(displacement, np.float64) * MILLI)
        surface["pressure (kPa)"] = np.asarray(pressure, np.float64).ravel(order="F") / 1e3
        top = max(float(np.max(pressure)) / 1e3, 1e-3)
        drawn.add_mesh(
            surface, scalars="pressure (kPa)", cmap="cividis", clim=[0, top], show_edges=True, edge_color="#888888",
            line_width=0.4, scalar_bar_args={"title": "pressure (kPa)", "color": "black", "fmt": "%.3g"},
        )  # fmt: skip
        drawn.enable_parallel_projection()
        drawn.view_vector((-0.6, -1.0, 1.0), viewup=(0, 0, 1))
    return drawn


def map_plotter(values: Array, window: float, label: str) -> Any:
    """A pyvista plotter with values (n, n) over a square of edge `window` (m) as a landscape; RuntimeError where no
    scene can be drawn.
    """
    if no_scene():
        raise RuntimeError(no_scene())
    import pyvista as pv

    values = np.asarray(values, np.float64)
    low, high, cmap = _range(values)
    x, y = np.meshgrid(*2 * [np.linspace(-0.5, 0.5, len(values)) * window * MILLI])
    with pv.vtk_verbosity("error"):
        drawn: Any = pv.Plotter(off_screen=True, window_size=[900, 700])
        surface = pv.StructuredGrid(x, y, values / max(-low, high, 1e-9) * 0.3 * window * MILLI)
        surface[label] = values.ravel(order="F")
        bar = {"title": label, "color": "black", "fmt": "%.3g"}
        drawn.add_mesh(surface, scalars=label, cmap=cmap, clim=[low, high], scalar_bar_args=bar)
        drawn.enable_parallel_projection()
        drawn.view_vector((-0.6, -1.0, 1.0), viewup=(0, 0, 1))
    return drawn


def skin_scene(pressure: Array, displacement: Array, title: str, simulated: bool, exaggerate: float = 5.0) -> Picture:
    """A still picture of `skin_plotter`; where none can be drawn the figure says why."""
    drawn = None if no_scene() else skin_plotter(pressure, displacement, exaggerate)
    return _still(drawn, f"{titled(title, simulated)}\ndepth drawn {exaggerate:g} times as large")


def _still(drawn: Any, title: str) -> Picture:
    figure = Picture(figsize=(6.5, 5.4), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    if drawn is None:
        axes.text(0.5, 0.5, no_scene(), ha="center", va="center", wrap=True, transform=axes.transAxes)
    else:
        picture = np.asarray(drawn.screenshot(return_img=True))
        drawn.close()
        rows, columns = np.nonzero((picture < 250).any(-1))
        axes.imshow(picture[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1])
    figure.suptitle(title, fontsize=11)
    return figure


def turnable(drawn: Callable[[], Any], still: Callable[[], Picture]) -> View3D | Picture:
    """The scene that `drawn()` plots, under the title of `still()`, to be turned with the mouse where that can be had
    (trame, of the extra `notebooks`), else the picture of `still()`.
    """
    picture = still()
    if no_scene() or find_spec("trame_vtk") is None:
        return picture
    made = drawn()
    # trame's renderer in web assembly, which this page does not use, would be fetched from the internet.
    modules: dict[str, Any] = sys.modules
    hidden = "trame.widgets.vtklocal"
    absent = hidden not in modules
    modules.setdefault(hidden, None)
    try:
        page = (made.trame if hasattr(made, "trame") else made).export_html(None)  # the former from pyvista 0.49 on
    finally:
        if absent:
            del modules[hidden]
    made.close()
    return View3D(page.read() if hasattr(page, "read") else str(page), picture.get_suptitle())
