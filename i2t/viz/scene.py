"""Scenes in three dimensions: objects with their touches.

Scenes need pyvista (`pip install "imagine2touch[notebooks]"`) and a machine that can draw off screen. That is tried out
first in a process of its own, because without EGL or OSMesa VTK ends with a segmentation fault.
"""

import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps

from i2t.patches.dimensions import PAD_WINDOW
from i2t.types import Array
from i2t.viz.style import MM_PER_M, Picture, titled

SKIN_LIFT_MM = 0.5  # by which the skin's square is drawn off the surface
NUMBER_DISTANCE_MM = 9.0  # of a touch's number behind the skin, where a person stands
VIEW_DIRECTION = (-0.6, -1.0, 1.0)
WHITE = 250  # and above
PROBE = "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(64, 64)); p.add_mesh(pv.Cube()); p.show()"
PROBE_TIMEOUT_S = 120
NO_PYVISTA = 'There is no 3-D picture, because pyvista is missing: pip install "imagine2touch[notebooks]".'
NO_GL = (
    "There is no 3-D picture, because this machine cannot draw off screen: install the system package libegl1 "
    "(apt-get install libegl1) or libosmesa6."
)


@cache
def why_no_scene() -> str:
    """Reason why no scene can be drawn here, in one sentence; empty where it can. Another process tries, once."""
    if find_spec("pyvista") is None:
        return NO_PYVISTA
    try:
        tried = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=PROBE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return NO_GL
    return "" if tried.returncode == 0 else NO_GL


def object_plotter(
    vertices: Float[Array, "v 3"], faces: Int[Array, "f 3"], T_o_t: Float[Array, "n 4 4"], numbers: bool = True
) -> Any:
    """A pyvista plotter with an object and the skin's square at each of its touches, ready to `show()`.

    Args:
        vertices: m, of the object.
        faces: Vertex numbers.
        T_o_t: Tool poses in the object's frame.
        numbers: Whether touches carry their numbers.

    Returns:
        The plotter.

    Raises:
        RuntimeError: No scene can be drawn here.
    """
    pv = _pyvista()
    T_o_t = np.asarray(T_o_t, np.float64)
    body = body_of(pv, vertices, faces)
    with pv.vtk_verbosity("error"):  # VTK warns of the missing display before it goes on without
        plotter: Any = pv.Plotter(off_screen=True, window_size=[900, 700], lighting="three lights")
        plotter.add_mesh(body, color="#d9d9d9", split_sharp_edges=True, smooth_shading=True)
        edges = body.extract_feature_edges(30, boundary_edges=True, manifold_edges=False, non_manifold_edges=False)
        if edges.n_points:
            plotter.add_mesh(edges, color="#555555", line_width=1.5)
        colours = colormaps["viridis"](np.linspace(0.0, 0.9, len(T_o_t)))[:, :3]
        for i, (T, colour) in enumerate(zip(T_o_t, colours, strict=True)):
            _add_touch(pv, plotter, T, colour, str(i + 1) if numbers else "")
        set_view(plotter)
    return plotter


def _add_touch(pv: Any, plotter: Any, T_o_t: np.ndarray, colour: np.ndarray, number: str) -> None:
    """The skin's square of one touch, and a pin with its number."""
    square = skin_square(pv, T_o_t, SKIN_LIFT_MM)
    plotter.add_mesh(square, color=colour, opacity=0.55, lighting=False)
    plotter.add_mesh(square.extract_feature_edges(), color=colour, line_width=3)
    if number:
        end = T_o_t[:3, 3] * MM_PER_M - NUMBER_DISTANCE_MM * T_o_t[:3, 2]
        plotter.add_mesh(pv.Line(T_o_t[:3, 3] * MM_PER_M, end), color="black", line_width=2)
        plotter.add_point_labels(
            [end], [number], font_size=20, bold=True, shape_color="white", shape_opacity=0.8, always_visible=True,
            show_points=False,
        )  # fmt: skip


def plot_object(
    vertices: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    T_o_t: Float[Array, "n 4 4"],
    title: str,
    simulated: bool,
) -> Picture:
    """A still picture of an object with its touches; where none can be drawn the figure says why.

    Args:
        vertices: m, of the object.
        faces: Vertex numbers.
        T_o_t: Tool poses in the object's frame.
        title: What is shown.
        simulated: Whether it was simulated.

    Returns:
        The figure.
    """
    figure = Picture(figsize=(6.5, 5.4), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    picture = object_image(vertices, faces, T_o_t, numbers=True)
    if picture is None:
        axes.text(0.5, 0.5, why_no_scene(), ha="center", va="center", wrap=True, transform=axes.transAxes)
    else:
        axes.imshow(picture)
    figure.suptitle(f"{titled(title, simulated)}\nsquares: the skin, 20 mm wide, where it touched", fontsize=11)
    return figure


def object_image(
    vertices: Float[Array, "v 3"], faces: Int[Array, "f 3"], T_o_t: Float[Array, "n 4 4"], *, numbers: bool = False
) -> Array | None:
    """The pixels of `plot_object`, without margins, to be drawn next to something else.

    Args:
        vertices: m, of the object.
        faces: Vertex numbers.
        T_o_t: Tool poses in the object's frame; there may be none.
        numbers: Whether touches carry their numbers.

    Returns:
        Colours (rows, columns, 3) of 8 bits; None where no scene can be drawn.
    """
    return None if why_no_scene() else image_of(object_plotter(vertices, faces, T_o_t, numbers))


def image_of(plotter: Any) -> Array:
    """The picture of a plotter without its white margins; the plotter is closed.

    Args:
        plotter: Of pyvista.

    Returns:
        Colours (rows, columns, 3) of 8 bits; all of it where nothing is drawn.
    """
    picture = np.asarray(plotter.screenshot(return_img=True))
    plotter.close()
    rows, columns = np.nonzero((picture < WHITE).any(-1))
    return picture[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] if len(rows) else picture


def body_of(pv: Any, vertices: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> Any:
    """A mesh in millimetres as pyvista has them.

    Args:
        pv: pyvista.
        vertices: m.
        faces: Vertex numbers.

    Returns:
        The mesh.
    """
    corners = np.column_stack([np.full(len(faces), 3), faces]).ravel()
    return pv.PolyData(np.asarray(vertices, np.float64) * MM_PER_M, corners)


def skin_square(pv: Any, T_o_t: Float[Array, "4 4"], lift_mm: float = 0.0) -> Any:
    """The skin's square at a touch.

    Args:
        pv: pyvista.
        T_o_t: Of the tool.
        lift_mm: By which it is drawn off the surface.

    Returns:
        The square, in millimetres.
    """
    half = PAD_WINDOW * MM_PER_M / 2
    corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    corners[:, 2] = -lift_mm
    return pv.PolyData(corners @ T_o_t[:3, :3].T + T_o_t[:3, 3] * MM_PER_M, [4, 3, 2, 1, 0])


def set_view(plotter: Any) -> None:
    """Look at a scene from above and the side, without perspective.

    Args:
        plotter: Of pyvista.
    """
    plotter.enable_parallel_projection()
    plotter.view_vector(VIEW_DIRECTION, viewup=(0, 0, 1))


def _pyvista() -> Any:
    """pyvista, or RuntimeError where no scene can be drawn."""
    if why_no_scene():
        raise RuntimeError(why_no_scene())
    import pyvista

    return pyvista
