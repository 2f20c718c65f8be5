"""Readings as field vectors at the chips of any board; presses: pressure and displacement of the skin; maps over it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from i2t.types import PAD_WINDOW, Array, Board
from i2t.viz.patches import draw_map
from i2t.viz.style import BLUE, COLOURS, GREY, KPA_PER_PA, MM_PER_M, Picture, titled

ARROW_MM = 5.0  # of the field that a figure's scale names


def common_scale(readings: Shaped[Array, "..."]) -> float:
    """The field that nearly all chips of some readings stay below, rounded to two digits: the scale of a figure.

    Args:
        readings: (..., c) uT.

    Returns:
        uT; 1 where nothing was felt.
    """
    norms = np.linalg.norm(np.asarray(readings, np.float64).reshape(-1, 3), axis=-1)
    top = float(np.percentile(norms, 95))
    if not top > 0:
        return 1.0
    digit = 10.0 ** (np.floor(np.log10(top)) - 1)
    return float(np.ceil(top / digit) * digit)


def draw_field(
    axes: Any,
    board: Board,
    reading: Shaped[Array, " c"],
    scale: float,
    *,
    colour: str = BLUE,
    label: str | None = None,
    width: float = 2.0,
) -> None:
    """Draw a reading into 3-D axes as field vectors at the chips, seen through the skin.

    Args:
        axes: Where to draw.
        board: Of n chips.
        reading: (3 n,) uT.
        scale: uT that are drawn `ARROW_MM` long.
        colour: Of the arrows.
        label: Their name in a legend.
        width: Of the arrows, in points.
    """
    chips = np.asarray(board.chips, np.float64)[:, :2] * MM_PER_M
    field = np.asarray(board.to_tool(np.asarray(reading, np.float64))) * ARROW_MM / scale
    flat = np.zeros(len(chips))
    axes.quiver(*chips.T, flat, *field.T, color=colour, lw=width, arrow_length_ratio=0.25, label=label)
    axes.scatter(*chips.T, flat, color="black", s=8, depthshade=False)


def draw_reading(
    axes: Axes,
    board: Board,
    reading: Shaped[Array, " c"],
    scale: float,
    *,
    colour: str = BLUE,
    label: str | None = None,
    width: float = 0.012,
) -> None:
    """Draw a reading flat: arrows for the field in the skin's plane, discs for the normal field, filled where it points
    out of the skin.

    Args:
        axes: Where to draw.
        board: Of n chips.
        reading: (3 n,) uT.
        scale: uT that are drawn `ARROW_MM` long. Give every panel of a figure the same.
        colour: Of arrows and discs.
        label: Their name in a legend.
        width: Of the arrows, relative to the axes.
    """
    chips = np.asarray(board.chips)[:, :2] * MM_PER_M
    field = np.asarray(board.to_tool(np.asarray(reading))) * ARROW_MM / scale
    x, y, normal = field.T
    arrows: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "color": colour, "width": width}
    axes.quiver(*chips.T, x, y, label=label, **arrows)
    for centre, z in zip(chips, normal, strict=True):
        face, alpha = (colour, 0.45) if z > 0 else ("none", 0.9)
        axes.add_artist(Circle(centre, abs(z) / 2, facecolor=face, edgecolor=colour, alpha=alpha, lw=1.2))


def draw_skin(axes: Axes, margin_mm: float = 3.0) -> None:
    """Draw the skin's outline.

    Args:
        axes: Where to draw.
        margin_mm: mm of the axes around it.
    """
    half = PAD_WINDOW * MM_PER_M / 2
    axes.add_artist(Rectangle((-half, -half), 2 * half, 2 * half, fill=False, color=GREY, lw=0.8))
    limits = (-half - margin_mm, half + margin_mm)
    axes.set(xlim=limits, ylim=limits, aspect="equal")


def plot_readings(
    board: Board,
    sets: Mapping[str, Shaped[Array, "n c"]],
    labels: Sequence[str],
    title: str,
    simulated: bool,
    *,
    columns: int = 5,
) -> Picture:
    """A panel per touch with the field at the chips, on one scale.

    Args:
        board: Of n chips.
        sets: Readings (touches, 3 n) uT by name, such as measured and predicted; a colour for each.
        labels: One for each touch.
        title: What is shown.
        simulated: Whether it was simulated.
        columns: Panels in a row.

    Returns:
        The figure.
    """
    values = [np.asarray(part) for part in sets.values()]
    n = len(labels)
    columns = min(columns, n)
    rows = -(-n // columns)
    scale = common_scale(np.stack(values))
    figure = Picture(figsize=(2.6 * columns, 2.5 * rows + 0.9), layout="constrained")
    for i in range(n):
        axes: Any = figure.add_subplot(rows, columns, i + 1, projection="3d")
        _set_skin_axes(axes)
        for j, (name, part) in enumerate(zip(sets, values, strict=True)):
            width = 1.6 if j else 3.2 if len(sets) > 1 else 2.0  # thinner ones over wider ones, so that both are seen
            draw_field(axes, board, part[i], scale, colour=COLOURS[j % len(COLOURS)], label=name, width=width)
        axes.set_title(labels[i], fontsize=9, pad=0)
    if len(sets) > 1:
        figure.legend(*axes.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=len(sets))
    below = "\n" * max(label.count("\n") for label in labels)  # room that the layout does not give to 3-D axes
    figure.suptitle(
        f"{titled(title, simulated)}\nchange of field at the {len(board.chips)} chips (dots) under the skin (square); "
        f"an arrow of {ARROW_MM:g} mm is {scale:g} µT, up is out of the skin{below}",
        fontsize=10,
    )
    return figure


def plot_press(
    pressure: Float[Array, "n n"],
    displacement: Float[Array, "n n"],
    board: Board,
    reading: Shaped[Array, " c"],
    title: str,
    simulated: bool,
) -> Picture:
    """One press: pressure on the skin, displacement of its surface, and change of field at the chips below it.

    Args:
        pressure: Pa.
        displacement: m, downwards.
        board: Of n chips.
        reading: (3 n,) uT.
        title: What is shown.
        simulated: Whether it was simulated.

    Returns:
        The figure.
    """
    figure = Picture(figsize=(11, 3.9), layout="constrained")
    left, middle = figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2)
    right: Any = figure.add_subplot(1, 3, 3, projection="3d")
    image = draw_map(left, np.asarray(pressure) * KPA_PER_PA, PAD_WINDOW, low=0)
    figure.colorbar(image, ax=left, label="pressure (kPa)", shrink=0.8)
    image = draw_map(middle, np.asarray(displacement) * MM_PER_M, PAD_WINDOW)
    figure.colorbar(image, ax=middle, label="displacement (mm)", shrink=0.8)
    for axes in (left, middle):
        axes.plot(*(np.asarray(board.chips)[:, :2] * MM_PER_M).T, ".", color="white", mec="black", ms=7)
        axes.set(xlabel="x (mm)", ylabel="y (mm)")
    left.set_title("pressure on the skin", fontsize=10)
    middle.set_title("displacement of its surface", fontsize=10)
    scale = common_scale(reading)
    _set_skin_axes(right)
    draw_field(right, board, reading, scale)
    right.set_title(f"field at the chips: {ARROW_MM:g} mm is {scale:g} µT", fontsize=10)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure


def plot_skin_map(
    values: Shaped[Array, "rows columns"], window: float, label: str, title: str, simulated: bool
) -> Picture:
    """Any values over a square, with a scale about zero where they have both signs.

    Args:
        values: Row i along y, column j along x.
        window: m, edge of the square.
        label: Of the colour bar, with the unit.
        title: What is shown.
        simulated: Whether it was simulated.

    Returns:
        The figure.
    """
    figure = Picture(figsize=(5, 4.2), layout="constrained")
    axes = figure.subplots()
    low, high, cmap = colour_range(values)
    image = draw_map(axes, values, window, cmap=cmap, low=low, high=high)
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    figure.colorbar(image, ax=axes, label=label)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure


def colour_range(values: Shaped[Array, "..."]) -> tuple[float, float, str]:
    """Lower end, upper end and name of a colour map: about zero where values have both signs.

    Args:
        values: What is drawn.

    Returns:
        Lower end, upper end, and the map's name.
    """
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if low < 0 < high:
        top = max(-low, high)
        return -top, top, "PuOr"
    return low, high, "cividis"


def _set_skin_axes(axes: Any) -> None:
    """The skin's square in 3-D axes."""
    half = PAD_WINDOW * MM_PER_M / 2
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
