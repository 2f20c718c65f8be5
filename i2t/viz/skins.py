"""Drawings of readings as field vectors at the chips, of presses, and of maps over the skin."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.offsetbox import AnchoredOffsetbox, AuxTransformBox, HPacker, TextArea, VPacker
from matplotlib.patches import Circle, Ellipse, FancyArrow, Patch, Rectangle
from matplotlib.patheffects import withStroke

from i2t.patches.dimensions import PAD_WINDOW
from i2t.types import Array, Board
from i2t.viz.patches import draw_map
from i2t.viz.style import CURVE_COLOURS, MM_PER_M, Colour, Picture, titled

ARROW_MM = 5.0  # mm, length of the arrow of a field as large as the figure's scale; less on boards of closer chips


def common_scale(readings: Shaped[Array, "..."]) -> float:
    """Compute a figure's scale: the 95th percentile of the field's magnitude over all chips, rounded up to two digits.

    Args:
        readings: `(..., c)` readings (uT).

    Returns:
        The scale (uT), or 1 if the field is zero.
    """
    norms = np.linalg.norm(np.asarray(readings, np.float64).reshape(-1, 3), axis=-1)
    top = float(np.percentile(norms, 95))
    if not top > 0:
        return 1.0
    digit = 10.0 ** (np.floor(np.log10(top)) - 1)
    return float(np.ceil(top / digit) * digit)


def arrow_mm(board: Board) -> float:
    """Compute the length of the arrow of a field as large as the figure's scale.

    Args:
        board: The board whose chips are drawn.

    Returns:
        `ARROW_MM`, or the distance (mm) of the two nearest chips if that is less.
    """
    chips = np.asarray(board.chips)[:, :2] * MM_PER_M
    apart = np.linalg.norm(chips[:, None] - chips[None], axis=-1)
    return float(min([ARROW_MM, *apart[apart > 1e-3]]))


def draw_reading(
    axes: Axes,
    board: Board,
    reading: Shaped[Array, " c"],
    scale: float,
    *,
    std: Shaped[Array, " c"] | None = None,
    colour: str = Colour.BLUE,
    label: str | None = None,
    width: float = 0.012,
) -> None:
    """Draw a reading flat: arrows for the field in the skin's plane, discs for the normal field, filled where it points
    out of the skin.

    Args:
        axes: Axes to draw into.
        board: Board with n chips.
        reading: `(3 n,)` reading (uT).
        scale: Field (uT) that is drawn `arrow_mm(board)` long. All panels of a figure should share it.
        std: `(3 n,)` standard deviations (uT): a hatched ellipse at the tip of each arrow has them as its half axes,
            and a dashed ring around each disc is wider than the disc by one standard deviation.
        colour: Colour of arrows and discs.
        label: Entry in the legend.
        width: Width of the arrows, relative to the axes.
    """
    chips = np.asarray(board.chips)[:, :2] * MM_PER_M
    mm_per_ut = arrow_mm(board) / scale
    field, covariances = drawn_field(board, reading, std, mm_per_ut)
    x, y, normal = field.T
    arrows: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "color": colour, "width": width}
    axes.quiver(*chips.T, x, y, label=label, **arrows)
    for centre, z in zip(chips, normal, strict=True):
        face, alpha = (colour, 0.45) if z > 0 else ("none", 0.9)
        axes.add_artist(Circle(centre, abs(z) / 2, facecolor=face, edgecolor=colour, alpha=alpha, lw=1.2))
    if std is None:
        return
    for chip, vector, covariance in zip(chips, field, covariances, strict=True):
        _draw_std(axes, chip, vector, covariance, colour)


def margin_mm(
    board: Board,
    readings: Shaped[Array, "n c"],
    scale: float,
    *,
    std: Shaped[Array, "n c"] | None = None,
    least: float = 2.5,
) -> float:
    """Compute the margin around the skin that holds all that `draw_reading` draws.

    Args:
        board: Board with c / 3 chips.
        readings: `(n, c)` readings (uT).
        scale: Field (uT) that is drawn `arrow_mm(board)` long.
        std: `(n, c)` standard deviations (uT).
        least: Least margin (mm).

    Returns:
        The margin (mm) for `draw_skin`.
    """
    chips = np.asarray(board.chips)[:, :2] * MM_PER_M
    reach = [least + PAD_WINDOW * MM_PER_M / 2]
    for i, reading in enumerate(np.asarray(readings)):
        drawn = drawn_field(board, reading, None if std is None else np.asarray(std)[i], arrow_mm(board) / scale)
        for chip, vector, covariance in zip(chips, *drawn, strict=True):
            deviations = np.sqrt(np.diag(covariance))
            reach.append(float(np.max(abs(chip + vector[:2]) + deviations[:2])))
            reach.append(float(np.max(abs(chip)) + (abs(vector[2]) + deviations[2]) / 2))
    return 1.02 * max(reach) - PAD_WINDOW * MM_PER_M / 2


def drawn_field(
    board: Board, reading: Shaped[Array, " c"], std: Shaped[Array, " c"] | None, mm_per_ut: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the field at each chip as it is drawn, in tool axes.

    Args:
        board: Board with n chips.
        reading: `(3 n,)` reading (uT).
        std: `(3 n,)` standard deviations (uT), or None.
        mm_per_ut: Length (mm) of the arrow of a field of 1 uT.

    Returns:
        `(n, 3)` vectors (mm), and their `(n, 3, 3)` covariances (mm^2), which are zero without standard deviations.
    """
    field = np.asarray(board.to_tool(np.asarray(reading)), np.float64) * mm_per_ut
    # The values of a reading have independent errors in the axes of the chips, so that these turn as a covariance.
    deviations = np.zeros(3 * len(field)) if std is None else np.asarray(std, np.float64)
    rotations = np.asarray(board.rotations, np.float64)
    return field, rotations * (deviations * mm_per_ut).reshape(-1, 1, 3) ** 2 @ rotations.swapaxes(1, 2)


def _draw_std(axes: Axes, chip: np.ndarray, vector: np.ndarray, covariance: np.ndarray, colour: str) -> None:
    """Draw the standard deviations (mm) of a field in the skin's plane and normal to it."""
    squares, directions = np.linalg.eigh(covariance[:2, :2])
    angle = float(np.degrees(np.arctan2(directions[1, 0], directions[0, 0])))
    disc = float(abs(vector[2]) + np.sqrt(covariance[2, 2]))
    axes.add_artist(Ellipse(chip + vector[:2], *(2 * np.sqrt(squares)), angle=angle, **_hatched(colour)))
    axes.add_artist(Circle((chip[0], chip[1]), disc / 2, fill=False, edgecolor=colour, lw=0.9, linestyle=(0, (3, 2))))


def _hatched(colour: str) -> dict[str, Any]:
    """Style of a standard deviation along the skin, which has no outline, unlike the discs."""
    return {"facecolor": "none", "edgecolor": colour, "hatch": 7 * "/", "lw": 0, "alpha": 0.5, "zorder": 0.5}


def draw_chip_numbers(axes: Axes, board: Board) -> None:
    """Draw the number of each chip, counted from 0 in the order of a reading, below and left of the chip.

    Args:
        axes: Axes to draw into.
        board: Board with n chips.
    """
    many = board.num_chips > 9
    for number, chip in enumerate(np.asarray(board.chips)[:, :2] * MM_PER_M):
        axes.annotate(
            str(number), chip, xytext=(-4, -4), textcoords="offset points", ha="right", va="top",
            fontsize=6 if many else 9, color="black",
            path_effects=[withStroke(linewidth=2, foreground="white")], zorder=5,
        )  # fmt: skip


def key_layout(width: float, sets: Sequence[str] = (), *, std: bool = False) -> tuple[int, float]:
    """Choose the number of entries in a row of `draw_key`, and its height.

    Args:
        width: Width (inch) of the room for the key.
        sets: Names of the sets of readings.
        std: Whether standard deviations are drawn.

    Returns:
        The number of entries in a row, and the height (inch) of all rows.
    """
    columns = max(1, round(width / 1.75))
    return columns, 0.3 * -(-(5 + 2 * std + (len(sets) if len(sets) > 1 else 0)) // columns)


def draw_key(
    axes: Axes,
    skin: Axes,
    board: Board,
    scale: float,
    *,
    sets: Sequence[str] = (),
    std: bool = False,
    numbers: bool = True,
    columns: int = 5,
) -> None:
    """Draw what the symbols of `draw_reading` mean, as large as they are in the axes of a skin.

    Args:
        axes: Axes to draw into, which are hidden.
        skin: Axes of a skin with readings.
        board: The board whose chips are drawn.
        scale: Field (uT) that is drawn `arrow_mm(board)` long.
        sets: Names of the sets of readings in the order of their colours, if there are several.
        std: Whether standard deviations are drawn.
        numbers: Whether the chips have their numbers (`draw_chip_numbers`).
        columns: Number of entries in a row.
    """
    power = 10.0 ** np.floor(np.log10(0.75 * scale))
    value = max(step for step in (power, 2 * power, 5 * power) if step <= 0.75 * scale)
    size = value * arrow_mm(board) / scale
    grey = {"color": Colour.GREY}
    disc = {"edgecolor": Colour.GREY, "lw": 1.2}
    arrow = {"width": size / 12, "head_width": size / 3, "length_includes_head": True, **grey}
    entries: list[tuple[list[Patch], str]] = [
        ([FancyArrow(0, 0, size, 0, **arrow)], f"{value:g} µT along skin"),
        ([Circle((0, 0), size / 2, facecolor="#c0c0c0", **disc)], f"{value:g} µT out of skin"),
        ([Circle((0, 0), size / 2, fill=False, **disc)], f"{value:g} µT into skin"),
    ]
    if std:
        ring = Circle((0, 0), 0.7 * size, fill=False, edgecolor=Colour.GREY, lw=0.9, linestyle=(0, (3, 2)))
        hatched = Circle((size, 0), 0.4 * size, **_hatched(Colour.GREY))
        entries += [
            ([FancyArrow(0, 0, size, 0, **arrow), hatched], "± 1 std along skin"),
            ([Circle((0, 0), size / 2, fill=False, **disc), ring], "± 1 std out or in"),
        ]
    names = zip(sets if len(sets) > 1 else (), cycle(CURVE_COLOURS), strict=False)
    packed: list[Artist] = [
        *(TextArea(name, textprops={"color": colour, "fontweight": "bold"}) for name, colour in names),
        *(_entry(skin, patches, label) for patches, label in entries),
        TextArea("disc radius ∝ value"),
    ]
    if numbers:
        packed.append(TextArea(f"0 to {board.num_chips - 1}: chips" if board.num_chips > 1 else "0: chip"))
    parts = [packed[i : i + columns] for i in range(0, len(packed), columns)]
    rows = VPacker(children=[HPacker(children=part, sep=12, pad=0, align="center") for part in parts], sep=6)
    axes.add_artist(AnchoredOffsetbox("center", child=rows, frameon=False, pad=0, borderpad=0))
    axes.set_axis_off()


def _entry(skin: Axes, patches: Sequence[Patch], label: str) -> HPacker:
    """An entry of a key, whose patches are in the millimetres of a skin."""
    symbol = AuxTransformBox(skin.transData)
    for patch in patches:
        symbol.add_artist(patch)
    return HPacker(children=[symbol, TextArea(label)], sep=4, pad=0, align="center")


def draw_skin(axes: Axes, margin_mm: float = 2.5) -> None:
    """Draw the skin's outline.

    Args:
        axes: Axes to draw into.
        margin_mm: Margin (mm) of the axes around the skin.
    """
    half = PAD_WINDOW * MM_PER_M / 2
    axes.add_artist(Rectangle((-half, -half), 2 * half, 2 * half, fill=False, color=Colour.GREY, lw=0.8))
    limits = (-half - margin_mm, half + margin_mm)
    axes.set(xlim=limits, ylim=limits, aspect="equal")


def plot_readings(
    board: Board,
    sets: Mapping[str, Shaped[Array, "n c"]],
    labels: Sequence[str],
    title: str,
    simulated: bool,
) -> Picture:
    """Plot a panel for each touch with the field at the chips, all on one scale.

    Args:
        board: Board with n chips.
        sets: `(touches, 3 n)` readings (uT) by name, such as measured and predicted. Each set has its colour.
        labels: Label of each touch.
        title: Title of the figure.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    values = [np.asarray(part) for part in sets.values()]
    n = len(labels)
    columns = min(5, n)
    rows = -(-n // columns)
    scale = common_scale(np.stack(values))
    per_row, bottom = key_layout(2.4 * columns, tuple(sets))
    figure = Picture(figsize=(2.4 * columns, 2.6 * rows + 0.5 + bottom), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(2.6 * rows + 0.3, bottom + 0.2), squeeze=False)[:, 0]
    panels = above.subplots(rows, columns, squeeze=False).ravel()
    for i, axes in enumerate(panels):
        if i >= n:
            axes.set_axis_off()
            continue
        draw_skin(axes)
        for part, colour in zip(values, cycle(CURVE_COLOURS), strict=False):
            draw_reading(axes, board, part[i], scale, colour=colour)
        draw_chip_numbers(axes, board)
        axes.set_title(labels[i], fontsize=9)
    draw_key(below.subplots(), panels[0], board, scale, sets=tuple(sets), columns=per_row)
    figure.suptitle(titled(title, simulated), fontsize=10)
    return figure


def plot_press(
    pressure: Float[Array, "n n"],
    displacement: Float[Array, "n n"],
    board: Board,
    reading: Shaped[Array, " c"],
    title: str,
    simulated: bool,
) -> Picture:
    """Plot a press: pressure on the skin, displacement of its surface, and change of the field at the chips.

    Args:
        pressure: Pressure (Pa) on the skin.
        displacement: Downward displacement (m) of the surface.
        board: Board with n chips.
        reading: `(3 n,)` reading (uT).
        title: Title of the figure.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    figure = Picture(figsize=(11, 4.4), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(3.9, 0.5), squeeze=False)[:, 0]
    left, middle, right = above.subplots(1, 3)
    image = draw_map(left, np.asarray(pressure) * 1e-3, PAD_WINDOW, low=0)
    above.colorbar(image, ax=left, label="pressure (kPa)", shrink=0.8)
    image = draw_map(middle, np.asarray(displacement) * MM_PER_M, PAD_WINDOW)
    above.colorbar(image, ax=middle, label="displacement (mm)", shrink=0.8)
    for axes in (left, middle):
        axes.plot(*(np.asarray(board.chips)[:, :2] * MM_PER_M).T, ".", color="white", mec="black", ms=7)
        axes.set(xlabel="x (mm)", ylabel="y (mm)")
    left.set_title("pressure on the skin", fontsize=10)
    middle.set_title("displacement of its surface", fontsize=10)
    scale = common_scale(reading)
    draw_skin(right)
    draw_reading(right, board, reading, scale)
    draw_chip_numbers(right, board)
    right.set_xlabel("x (mm)")
    right.set_title("change of the field at the chips", fontsize=10)
    draw_key(below.subplots(), right, board, scale)
    figure.suptitle(titled(title, simulated), fontsize=10)
    return figure


def plot_skin_map(
    values: Shaped[Array, "rows columns"], window: float, label: str, title: str, simulated: bool
) -> Picture:
    """Plot values over a square, on a scale that is symmetric about zero if they have both signs.

    Args:
        values: Values of the pixels, with rows along y and columns along x.
        window: Edge (m) of the square.
        label: Label of the colour bar, with the unit.
        title: Title of the figure.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    figure = Picture(figsize=(5, 4.2), layout="constrained")
    axes = figure.subplots()
    low, high, cmap = float(np.nanmin(values)), float(np.nanmax(values)), "cividis"
    if low < 0 < high:
        low, high, cmap = min(low, -high), max(-low, high), "PuOr"
    image = draw_map(axes, values, window, cmap=cmap, low=low, high=high)
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    figure.colorbar(image, ax=axes, label=label)
    figure.suptitle(titled(title, simulated), fontsize=11)
    return figure
