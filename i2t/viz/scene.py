"""Objects in three dimensions: the skin where it touched, and how uncertain each part of a reconstructed surface is.

They are seen from above and the side, without perspective, as the library's own renderer sees them: a depth image,
shaded by its slope. So neither a display nor another package is needed.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from scipy.spatial import cKDTree

from i2t.objects.solids import Mesh
from i2t.rendering.render import prepare_surface, render_patch
from i2t.types import Array
from i2t.viz.style import GREEN, MM_PER_M, Picture, titled
from i2t.windows import PAD_WINDOW

PIXELS = 512
SKIN_LIFT_M = 0.5e-3  # by which the skin's square is drawn off the surface
SKIN_RIM_M = 0.8e-3
SKIN_OPACITY = 0.55
NUMBER_DISTANCE_M = 9e-3  # of a touch's number behind the skin, where a person stands
BODY_COLOUR = "#d9d9d9"
COLOURS_OF_STD = "plasma"
RIGHT, AWAY = np.array([1.0, -0.6, 0]) / math.sqrt(1.36), np.array([0.6, 1.0, -1.0]) / math.sqrt(2.36)
VIEW = np.stack([RIGHT, np.cross(RIGHT, AWAY), AWAY], 1)  # the picture's axes in the object's: right, up, away
LIGHT = np.array([-0.3, 0.5, -0.8]) / math.sqrt(0.98)  # towards it, in the picture's axes


class ShownSurface(NamedTuple):
    """One stage of a surface."""

    label: str
    vertices: Float[Array, "v 3"]  # m
    faces: Int[Array, "f 3"]
    std: Float[Array, " v"]  # m, of the surface at each vertex
    T_o_t: Float[Array, "n 4 4"]  # touches made so far


class _Skin(NamedTuple):
    """The skin's square in the picture's axes, in units of the picture's edge."""

    centre: np.ndarray  # (3,)
    axes: np.ndarray  # (3, 3), the tool's as columns
    half: float
    rim: float
    colour: np.ndarray  # (3,)


def touch_colours(touches: int) -> Float[np.ndarray, "touches 3"]:
    """One colour for each touch, from dark to light.

    Args:
        touches: How many.

    Returns:
        Red, green and blue from 0 to 1.
    """
    return colormaps["viridis"](np.linspace(0.0, 0.9, touches))[:, :3]


def draw_object(
    axes: Axes,
    vertices: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    T_o_t: Float[Array, "n 4 4"],
    *,
    numbers: bool = False,
    colours: Float[Array, "v 3"] | None = None,
) -> None:
    """Draw an object with the skin's square at each of its touches; nothing where it has no faces.

    Args:
        axes: Where to draw.
        vertices: m, of the object.
        faces: Vertex numbers.
        T_o_t: Tool poses in the object's frame; there may be none.
        numbers: Whether touches carry their numbers.
        colours: Of the vertices; skins are then outlines. Without them the object is grey.
    """
    axes.set_axis_off()
    if not len(faces):
        return
    T_v_t = np.array(T_o_t, np.float64).reshape(-1, 4, 4)
    T_v_t[:, :3] = VIEW.T @ T_v_t[:, :3]
    ends = T_v_t[:, :3, 3] - NUMBER_DISTANCE_M * T_v_t[:, :3, 2]
    corners = np.asarray(vertices, np.float64) @ VIEW
    rim = PAD_WINDOW / math.sqrt(2)
    everything = np.concatenate([corners, ends, T_v_t[:, :3, 3] - rim, T_v_t[:, :3, 3] + rim])
    low, high = everything.min(0), everything.max(0)
    origin, edge = np.append((low + high)[:2] / 2, low[2]), float((high - low)[:2].max())
    corners = (corners - origin) / edge
    z = _depth_image(corners, np.asarray(faces))
    picture = _shaded(z, corners, np.tile(to_rgb(BODY_COLOUR), (len(corners), 1)) if colours is None else colours)
    shades = touch_colours(len(T_v_t)) if colours is None else [np.array(to_rgb(GREEN))] * len(T_v_t)
    for T, colour in zip(T_v_t, shades, strict=True):
        centre = (T[:3, 3] - SKIN_LIFT_M * T[:3, 2] - origin) / edge
        skin = _Skin(centre, T[:3, :3], PAD_WINDOW / 2 / edge, max(SKIN_RIM_M / edge, 2 / PIXELS), colour)
        _paint_skin(picture, z, skin, SKIN_OPACITY if colours is None else 0.0)
    axes.imshow(np.clip(picture, 0, 1), origin="lower", extent=(-0.5, 0.5, -0.5, 0.5))
    axes.set(xlim=(np.array([low, high]) - origin)[:, 0] / edge, ylim=(np.array([low, high]) - origin)[:, 1] / edge)
    if numbers:
        _draw_numbers(axes, (T_v_t[:, :2, 3] - origin[:2]) / edge, (ends - origin)[:, :2] / edge)


def plot_object(
    vertices: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    T_o_t: Float[Array, "n 4 4"],
    title: str,
    simulated: bool,
    *,
    numbers: bool = True,
) -> Picture:
    """A picture of an object with its touches.

    Args:
        vertices: m, of the object.
        faces: Vertex numbers.
        T_o_t: Tool poses in the object's frame.
        title: What is shown.
        simulated: Whether it was simulated.
        numbers: Whether touches carry their numbers.

    Returns:
        The figure.
    """
    figure = Picture(figsize=(6.5, 5.4), layout="constrained")
    draw_object(figure.subplots(), vertices, faces, T_o_t, numbers=numbers)
    figure.suptitle(f"{titled(title, simulated)}\nsquares: the skin, 20 mm wide, where it touched", fontsize=11)
    return figure


def plot_growing_surface(
    stages: Sequence[ShownSurface], truth: tuple[Array, Array] | None, title: str, simulated: bool
) -> Picture:
    """Stages of a surface side by side, coloured by its standard deviation, with the touches, and the truth at the end.

    Args:
        stages: In the order in which they were made.
        truth: Vertices (m) and faces of the true object; None where it is not known.
        title: What is shown.
        simulated: Whether it was simulated.

    Returns:
        The figure.
    """
    high = max((float(np.quantile(stage.std, 0.98)) for stage in stages if len(stage.std)), default=1e-3)
    figure = Picture(figsize=(2.5 * (len(stages) + (truth is not None)), 2.9), layout="constrained")
    figure.suptitle(titled(title, simulated), fontsize=11)
    panels = figure.subplots(1, len(stages) + (truth is not None), squeeze=False)[0]
    for axes, stage in zip(panels, stages, strict=False):
        colours = colormaps[COLOURS_OF_STD](np.clip(np.asarray(stage.std) / high, 0, 1))[:, :3]
        draw_object(axes, stage.vertices, stage.faces, stage.T_o_t, colours=colours)
        axes.set_title(stage.label, fontsize=10)
    if truth is not None:
        draw_object(panels[-1], *truth, np.zeros((0, 4, 4)))
        panels[-1].set_title("truth", fontsize=10)
    scale = ScalarMappable(Normalize(0, MM_PER_M * high), COLOURS_OF_STD)
    figure.colorbar(scale, ax=list(panels), label="standard deviation, mm", shrink=0.75, aspect=15)
    return figure


def _draw_numbers(axes: Axes, starts: np.ndarray, ends: np.ndarray) -> None:
    box = {"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.8}
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        axes.plot(*np.array([start, end]).T, color="black", lw=1)
        axes.text(*end, str(i + 1), fontsize=8, fontweight="bold", ha="center", va="center", bbox=box)


def _pixels() -> tuple[np.ndarray, np.ndarray]:
    """Where the pixels' centres lie: to the right, and upwards."""
    line = (np.arange(PIXELS) + 0.5) / PIXELS - 0.5
    x, y = np.meshgrid(line, line)
    return x, y


def _depth_image(corners: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Depth of the nearest surface (rows, columns), in units of the picture's edge; +inf where there is none."""
    seen = render_patch(prepare_surface(Mesh(corners, faces)), np.eye(4), window=1.0, pixels=PIXELS, reach=math.inf)
    return np.asarray(seen.depth, np.float64) + float(seen.nearest)


def _shaded(z: np.ndarray, corners: np.ndarray, colours: Array) -> np.ndarray:
    """Colours of the vertices nearest to what the pixels show, shaded; white where they show nothing."""
    hit = np.isfinite(z)
    picture = np.ones((*z.shape, 3))
    down, right = np.gradient(np.where(hit, z, z[hit].max(initial=0) + 1), 1 / PIXELS)
    normal = np.stack([right, down, -np.ones_like(z)], -1)
    light = np.clip(normal @ LIGHT / np.linalg.norm(normal, axis=-1), 0, 1)
    x, y = _pixels()
    _, nearest = cKDTree(corners).query(np.stack([x, y, z], -1)[hit])
    picture[hit] = np.asarray(colours)[nearest] * (0.3 + 0.75 * light[hit])[:, None]
    return picture


def _paint_skin(picture: np.ndarray, z: np.ndarray, skin: _Skin, opacity: float) -> None:
    """Paint the part of a square that nothing hides, its rim opaque."""
    x, y = _pixels()
    right, up, away = skin.axes[:, 2]
    if abs(away) < 1e-6:  # seen from its edge
        return
    depth = skin.centre[2] - (right * (x - skin.centre[0]) + up * (y - skin.centre[1])) / away
    own = np.abs((np.stack([x, y, depth], -1) - skin.centre) @ skin.axes[:, :2]).max(-1)
    share = np.where(own > skin.half - skin.rim, 1.0, opacity) * ((own <= skin.half) & (depth < z))
    picture += share[..., None] * (skin.colour - picture)
