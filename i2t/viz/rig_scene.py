"""Picture of a lab's rig: base, workspace box, table, object, and the tool where it looks and where it presses.

Errors of a calibration file are hard to see in matrices and easy to see in a picture: a tool that points up, a camera
that looks elsewhere, or an object below its table. The picture needs matplotlib alone, and neither a display nor GL.
Frames are W (world, z up, the table at z = 0), B (robot base), F (flange), T (tool) and C (camera). The axes are in
millimetres.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from i2t.patches.dimensions import PAD_WINDOW
from i2t.types import Array
from i2t.viz.style import MM_PER_M, Colour, Picture


class RigScene(NamedTuple):
    """Scene of a rig to be drawn: mesh of the object in W (m), poses of base, tool, flange and camera, and the box."""

    vertices: Float[Array, "v 3"]  # m, vertices of the object in W
    faces: Int[Array, "f 3"]
    T_w_b: Float[Array, "4 4"]
    T_w_t: Float[Array, "4 4"]  # tool pose at a touch site
    T_t_f: Float[Array, "4 4"]
    T_t_c: Float[Array, "4 4"]
    box: Float[Array, "2 3"]  # m, lowest and highest allowed position of the tool's origin in B
    looking_distance: float  # m, from the camera to the site
    view_edges: tuple[float, float]  # width and height of the image at a distance of 1 from the camera


def plot_rig(scene: RigScene, title: str) -> Picture:
    """Plot a rig: the whole lab, and a close-up of the pressing tool and the looking camera.

    Args:
        scene: The rig to draw.
        title: Title of the figure.

    Returns:
        The figure, which `save_figure` can write.
    """
    figure = Picture(figsize=(13, 6.5), layout="constrained")
    lab, close = (figure.add_subplot(1, 2, i + 1, projection="3d") for i in range(2))
    _draw_lab(lab, scene)
    _draw_close_up(close, scene)
    figure.suptitle(title)
    return figure


def look_pose(scene: RigScene) -> np.ndarray:
    """Compute the tool's pose when its camera looks at the site.

    Args:
        scene: The rig.

    Returns:
        `(4, 4)` tool pose T_w_t (m).
    """
    T_w_look = np.array(scene.T_w_t, float)
    axis, place = scene.T_t_c[:3, 2], scene.T_t_c[:3, 3]
    T_w_look[:3, 3] -= scene.T_w_t[:3, :3] @ (scene.looking_distance * axis + place)
    return T_w_look


def _draw_lab(axes: Any, scene: RigScene) -> None:
    corners = np.array([[x, y, z] for x in scene.box[:, 0] for y in scene.box[:, 1] for z in scene.box[:, 2]])
    corners = corners @ scene.T_w_b[:3, :3].T + scene.T_w_b[:3, 3]
    # Corners of a box share an edge if their numbers differ in one bit.
    edges = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
    _lines(axes, [corners[list(edge)] for edge in edges], Colour.RED, "the box of the tool")
    _frame(axes, scene.T_w_b, "robot base", length=0.1)
    _frame(axes, np.eye(4), "world", length=0.1)
    _object(axes, scene)
    T_w_look = look_pose(scene)
    _tool(axes, scene, T_w_look, Colour.BLUE, "tool where its camera looks")
    everything = np.concatenate([corners, scene.vertices, scene.T_w_b[None, :3, 3], T_w_look[None, :3, 3]])
    _frame_view(axes, (everything.min(0) + everything.max(0)) / 2, float(np.ptp(everything, axis=0).max()) / 2)
    axes.set_title("the lab")


def _draw_close_up(axes: Any, scene: RigScene) -> None:
    _object(axes, scene)
    T_w_look = look_pose(scene)
    _tool(axes, scene, T_w_look, Colour.BLUE, "tool where its camera looks")
    _tool(axes, scene, scene.T_w_t, Colour.GREEN, "tool that presses")
    T_w_c = T_w_look @ scene.T_t_c
    x, y = (scene.looking_distance * edge / 2 for edge in scene.view_edges)
    ends = np.array([[s * x, t * y, scene.looking_distance] for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    ends = ends @ T_w_c[:3, :3].T + T_w_c[:3, 3]
    cone = [np.array([T_w_c[:3, 3], end]) for end in ends]
    _lines(axes, [*cone, np.concatenate([ends, ends[:1]])], Colour.ORANGE, "what the camera sees")
    middle = (scene.T_w_t[:3, 3] + T_w_look[:3, 3]) / 2
    _frame_view(axes, middle, 0.13)
    axes.set_title("a site")


def _object(axes: Any, scene: RigScene) -> None:
    triangles = MM_PER_M * scene.vertices[scene.faces]
    axes.add_collection3d(Poly3DCollection(triangles, facecolor="0.8", edgecolor="0.55", linewidth=0.2, alpha=0.9))
    low, high = scene.vertices.min(0)[:2] - 0.03, scene.vertices.max(0)[:2] + 0.03
    table = [[(low[0], low[1], 0.0), (high[0], low[1], 0.0), (high[0], high[1], 0.0), (low[0], high[1], 0.0)]]
    axes.add_collection3d(Poly3DCollection(MM_PER_M * np.array(table), facecolor="#f3ead8", alpha=0.5))


def _tool(axes: Any, scene: RigScene, T_w_t: np.ndarray, colour: str, label: str) -> None:
    """Draw the skin's square, lines from it to the flange and the camera, and their frames."""
    half = PAD_WINDOW / 2
    square = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0], [-half, -half, 0.0]])
    flange, camera = scene.T_t_f[:3, 3], scene.T_t_c[:3, 3]
    parts = [square, np.array([np.zeros(3), flange]), np.array([np.zeros(3), camera])]
    _lines(axes, [part @ T_w_t[:3, :3].T + T_w_t[:3, 3] for part in parts], colour, label)
    _frame(axes, T_w_t @ scene.T_t_f, "flange")
    _frame(axes, T_w_t @ scene.T_t_c, "camera")
    out = np.array([np.zeros(3), [0.0, 0.0, 0.025]]) @ T_w_t[:3, :3].T + T_w_t[:3, 3]
    _lines(axes, [out], colour, "")


def _frame(axes: Any, T_w: np.ndarray, name: str, *, length: float = 0.025) -> None:
    for axis, colour in enumerate((Colour.RED, Colour.GREEN, Colour.BLUE)):
        _lines(axes, [np.array([T_w[:3, 3], T_w[:3, 3] + length * T_w[:3, axis]])], colour, "")
    axes.text(*(MM_PER_M * T_w[:3, 3]), f"   {name}", fontsize=8, color="black")


def _lines(axes: Any, lines: list[np.ndarray], colour: str, label: str) -> None:
    shown = [MM_PER_M * np.asarray(line) for line in lines]
    axes.add_collection3d(Line3DCollection(shown, colors=colour, linewidths=1.2, label=label or None))


def _frame_view(axes: Any, middle: np.ndarray, half: float) -> None:
    for axis, name in enumerate("xyz"):
        limits = MM_PER_M * (middle[axis] + half * np.array([-1, 1]))
        getattr(axes, f"set_{name}lim")(*limits)
        getattr(axes, f"set_{name}label")(f"{name} in the world (mm)")
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(elev=20, azim=-60)
    axes.legend(loc="upper left", fontsize=7)
