"""Pictures of objects with their touches, in three dimensions.

The object is seen from above at an angle, without perspective, by the renderer of the depth patches. The pictures need
neither a display nor a graphics library.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from i2t.objects.solids import Mesh
from i2t.patches.dimensions import PAD_WINDOW
from i2t.rendering.render import prepare_surface, render_heights
from i2t.runtime.compiling import jit_quickly
from i2t.types import Array, Surface
from i2t.viz.style import Colour, Picture, titled

PIXELS = 640  # pixels along the edge of a picture
PIN = 0.1  # length of a pin and least distance of numbers, relative to the picture


def touch_colours(touches: int) -> Float[np.ndarray, "touches 3"]:
    """Choose a colour for each touch, from dark to light.

    Args:
        touches: Number of touches.

    Returns:
        `(touches, 3)` RGB values between 0 and 1.
    """
    return colormaps["viridis"](np.linspace(0.0, 0.9, touches))[:, :3]


def draw_number(axes: Axes, x: float, y: float, number: int, colour: Float[Array, "3"], **options: Any) -> None:
    """Draw the number of a touch in a disc of the touch's colour.

    Args:
        axes: Axes to draw into.
        x: Horizontal position of the number's middle.
        y: Vertical position of the number's middle.
        number: Number of the touch.
        colour: RGB values of the touch.
        options: Further arguments of `Axes.text`, such as `transform`.
    """
    disc = {"boxstyle": "circle,pad=0.25", "facecolor": tuple(colour), "edgecolor": "white", "linewidth": 0.8}
    axes.text(
        x, y, str(number), ha="center", va="center", fontsize=10, fontweight="bold",
        color="white" if np.mean(colour) < 0.5 else "black", bbox=disc, **options,
    )  # fmt: skip


def plot_object(
    vertices: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    T_o_t: Float[Array, "n 4 4"],
    title: str,
    simulated: bool,
) -> Picture:
    """Plot a still picture of an object with its touches.

    Args:
        vertices: Vertices (m) of the object.
        faces: Vertex numbers of each face.
        T_o_t: Tool poses of the touches in the object's frame.
        title: Title of the figure.
        simulated: Whether any of the data are simulated.

    Returns:
        The figure, which `save_figure` can write.
    """
    figure = Picture(figsize=(6.5, 5.4), layout="constrained")
    draw_object(figure.subplots(), vertices, faces, T_o_t)
    figure.suptitle(f"{titled(title, simulated)}\nsquares: the skin, 20 mm wide, at each touch", fontsize=11)
    return figure


def draw_object(
    axes: Axes,
    vertices: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    T_o_t: Float[Array, "n 4 4"],
    *,
    numbers: bool = True,
    colours: Float[Array, "v 3"] | None = None,
    directions: int = 8,
    aspect: float = 1.0,
) -> None:
    """Draw an object, the skin's square at each touch and the number of each touch, counted from 1.

    Of several directions, the one that best shows the squares, and the object large, is drawn.

    Args:
        axes: Axes to draw into.
        vertices: Vertices (m) of the object.
        faces: Vertex numbers of each face.
        T_o_t: Tool poses of the touches in the object's frame; there may be none.
        numbers: Whether to number the touches.
        colours: RGB values of the vertices, grey by default. The squares are then outlines.
        directions: Number of directions that are tried, evenly spaced around z.
        aspect: Width of the room for the picture, relative to its height.
    """
    T_o_t, vertices = np.asarray(T_o_t, np.float64), np.asarray(vertices, np.float64)
    axes.set_axis_off()
    if not len(vertices):
        return  # a surface may be empty before the first touch
    turns = 2 * np.pi * np.arange(directions if len(T_o_t) else 1) / directions
    views = [_View.around(vertices, T_o_t, turn) for turn in turns]
    surface = prepare_surface(Mesh(vertices, faces))
    heights = [view.heights(surface) for view in views]
    shares = [_seen_shares(view, z, T_o_t) for view, z in zip(views, heights, strict=True)]
    sizes = np.array([view.size(vertices, aspect) for view in views])
    seen = np.array([share.min(initial=1) + share.sum() / max(len(share), 1) for share in shares])
    best = int(np.argmax(seen + sizes / sizes.max()))
    view, z = views[best], heights[best]
    picture = _shade(z)
    if colours is not None:
        hit = np.isfinite(z)
        picture[hit] *= np.asarray(colours)[KDTree(vertices).query(view.seen_points(z)[hit])[1]]
    touched = touch_colours(len(T_o_t))
    for T, colour in zip(T_o_t, touched, strict=True):
        visible, edge = _square(view, z, T)
        if colours is None:
            picture[visible] += 0.6 * (colour - picture[visible])
        else:
            colour = np.array(to_rgb(Colour.GREEN))
        picture[edge & visible] = colour
        picture[edge & ~visible] += 0.3 * (colour - picture[edge & ~visible])
    rows, columns = np.nonzero((picture < 1).any(-1))
    axes.imshow(picture, interpolation="antialiased")
    if numbers and len(T_o_t):
        points = view.to_pixels(T_o_t[:, :3, 3])
        places = _apart(view.to_pixels(T_o_t[:, :3, 3] - PIN * PIXELS * view.pixel_m * T_o_t[:, :3, 2]))
        for i, (point, place, colour) in enumerate(zip(points, places, touched, strict=True)):
            axes.plot(*np.stack([point, place]).T, color="black", lw=1)
            draw_number(axes, float(place[0]), float(place[1]), i + 1, colour)
        columns, rows = np.append(columns, places[:, 0]), np.append(rows, places[:, 1])
    margin = PIN * PIXELS / 2
    axes.set(xlim=(columns.min() - margin, columns.max() + margin), ylim=(rows.max() + margin, rows.min() - margin))


# --- pieces ---


_render = jit_quickly(partial(render_heights, window=1.0, pixels=PIXELS))  # of an object scaled to the unit square


class _View(NamedTuple):
    """Map from the object's frame (m) to the picture: x to the right, y down, z away from the observer."""

    rotation: Float[np.ndarray, "3 3"]
    scale: float  # picture widths for each metre
    shift: Float[np.ndarray, "3"]

    @classmethod
    def around(cls, vertices: np.ndarray, T_o_t: np.ndarray, turn: float) -> "_View":
        """Look at the object and its squares from the front, the left and above, turned about z (rad)."""
        forward = Rotation.from_rotvec([0, 0, turn]).apply(np.array([0.6, 1.0, -1.0]) / np.sqrt(2.36))
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        corners = PAD_WINDOW / 2 * np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)])
        squares = [corners @ T[:3, :3].T + T[:3, 3] for T in T_o_t]
        shown = np.concatenate([vertices, *squares]) @ rotation.T
        low, high = shown.min(0), shown.max(0)
        scale = 0.96 / max(float(np.max(high - low)), 1e-9)
        return cls(rotation, scale, np.array([0, 0, 1.0]) - scale * (low + high) / 2)

    @property
    def pixel_m(self) -> float:
        """Edge (m) of a pixel."""
        return 1 / (PIXELS * self.scale)

    def heights(self, surface: Surface) -> np.ndarray:
        """Depth of the object in picture widths, infinite next to it."""
        A = np.eye(4)
        A[:3, :3], A[:3, 3] = self.scale * self.rotation, self.shift
        return np.asarray(_render(surface, jnp.asarray(A, jnp.float32)), np.float64)

    def size(self, vertices: np.ndarray, aspect: float) -> float:
        """Largest scale at which the vertices (m) fit into a room of unit height."""
        width, height = np.ptp(vertices @ self.rotation.T, axis=0)[:2]
        return float(min(aspect / max(width, 1e-9), 1 / max(height, 1e-9)))

    def seen_points(self, heights: np.ndarray) -> np.ndarray:
        """Points (m) in the object's frame that the pixels show, at a finite depth where they show none."""
        at = (np.arange(PIXELS) + 0.5) / PIXELS - 0.5
        seen = np.stack([*np.meshgrid(at, at), np.where(np.isfinite(heights), heights, 0)], axis=-1)
        return (seen - self.shift) / self.scale @ self.rotation

    def to_pixels(self, points: np.ndarray) -> np.ndarray:
        """Column and row of points (m)."""
        seen = self.scale * points @ self.rotation.T + self.shift
        return (seen[:, :2] + 0.5) * PIXELS - 0.5


def _square(view: _View, heights: np.ndarray, T_o_t: np.ndarray, lift: float = 1e-3) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the visible part of a touch's square, and those of its edge, which may be hidden.

    The square is drawn at a lift (m) from the skin, which is in the object at the end of a press.
    """
    at = (np.arange(0, PIXELS, PIXELS // len(heights)) + 0.5) / PIXELS - 0.5
    x, y, normal = (view.rotation @ T_o_t[:3, :3]).T
    u, v = (at[None, :] - view.shift[0]) / view.scale, (at[:, None] - view.shift[1]) / view.scale
    if abs(normal[2]) < 0.03:  # edge on
        nothing = np.zeros(heights.shape, bool)
        return nothing, nothing
    middle = view.rotation @ T_o_t[:3, 3] - lift * normal
    u, v = u - middle[0], v - middle[1]
    w = -(normal[0] * u + normal[1] * v) / normal[2]
    off = PAD_WINDOW / 2 - np.maximum(*(np.abs(axis[0] * u + axis[1] * v + axis[2] * w) for axis in (x, y)))
    inside = off >= 0
    visible = inside & ((w + middle[2]) * view.scale + view.shift[2] <= heights)
    return visible, inside & (off < max(0.7e-3, 2.5 * view.pixel_m))


def _seen_shares(view: _View, heights: np.ndarray, T_o_t: np.ndarray, step: int = 5) -> np.ndarray:
    """Visible area of each square, relative to its area, from every `step`-th pixel."""
    areas = [_square(view, heights[::step, ::step], T)[0].sum() * (step * view.pixel_m) ** 2 for T in T_o_t]
    return np.array(areas) / PAD_WINDOW**2


def _shade(heights: np.ndarray, crease: float = np.radians(25.0)) -> np.ndarray:
    """Grey picture of a surface: shaded by its normals, with lines at its outlines and at its creases, where normals
    differ by more than `crease` (rad).
    """
    hit = np.isfinite(heights)
    z = np.where(hit, heights, 10.0) * PIXELS  # pixels
    slopes, jumps = zip(*(_slope(z, axis) for axis in (0, 1)), strict=True)
    normal = np.stack([slopes[1], slopes[0], -np.ones_like(z)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lights = ((-0.5, -0.7, -0.6), (0.6, -0.2, -0.7))
    bright = sum(np.clip(normal @ np.array(light) / np.linalg.norm(light), 0, 1) for light in lights)
    grey = np.where(hit, 0.42 + 0.36 * bright, 1.0)
    line = jumps[0] | jumps[1]
    for axis in (0, 1):
        sharp = (normal * np.roll(normal, 1, axis)).sum(-1) < np.cos(crease)
        line |= sharp & hit & np.roll(hit, 1, axis)
    grey = np.where(line & _grown(hit), np.minimum(grey, 0.35), grey)
    return np.repeat(grey[..., None], 3, axis=-1)


def _slope(z: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Slope along an axis, on the smoother side of each pixel, and whether the surface jumps on one side."""
    ahead = np.roll(z, -1, axis) - z
    behind = z - np.roll(z, 1, axis)
    smooth = np.where(np.abs(ahead) < np.abs(behind), ahead, behind)
    return smooth, np.abs(behind) > np.abs(smooth) + 6.0


def _grown(mask: np.ndarray) -> np.ndarray:
    return mask | np.roll(mask, 1, 0) | np.roll(mask, 1, 1)


def _apart(places: np.ndarray) -> np.ndarray:
    """Move the places (pixels) of numbers apart until they no longer overlap."""
    places, least = places + 1e-3 * np.arange(len(places))[:, None], PIN * PIXELS
    for _ in range(60):
        between = places[:, None] - places[None]
        distance = np.linalg.norm(between, axis=-1) + np.eye(len(places)) * least
        push = np.clip(least - distance, 0, None) / np.maximum(distance, 1e-6) / 2
        places = places + (push[..., None] * between).sum(1)
    return places
