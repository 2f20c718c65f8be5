"""Three-dimensional scenes: objects with their touches.

Scenes need pyvista (extra `notebooks`) and a machine that can draw off screen. Drawing is first
tried in a separate process, because VTK ends with a segmentation fault without EGL or OSMesa.
"""

import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps

from i2t.installation import extra_advice
from i2t.patches.dimensions import PAD_WINDOW
from i2t.types import Array
from i2t.viz.style import MM_PER_M, Picture, titled

# Python program that fails if this machine cannot draw off screen.
PROBE = "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(64, 64)); p.add_mesh(pv.Cube()); p.show()"
# Note if this machine cannot draw off screen.
NO_GL = (
    "There is no 3-D picture, because this machine cannot draw off screen: install the system package libegl1 "
    "(apt-get install libegl1) or libosmesa6."
)


@cache
def explain_no_scene() -> str:
    """Explain in one sentence why 3D scenes cannot be drawn in this environment; an empty string if they can."""
    if find_spec("pyvista") is None:
        advice = extra_advice("notebooks", "pyvista")
        return f"There is no 3-D picture, because pyvista is missing: {advice}."
    try:
        attempt = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=120)
    except subprocess.TimeoutExpired:
        return NO_GL
    return "" if attempt.returncode == 0 else NO_GL


def object_plotter(
    vertices: Float[Array, "v 3"], faces: Int[Array, "f 3"], T_o_t: Float[Array, "n 4 4"], numbers: bool = True
) -> Any:
    """Make a pyvista plotter with an object and the skin's square at each touch, ready to `show()`.

    Args:
        vertices: Vertices (m) of the object.
        faces: Vertex numbers of each face.
        T_o_t: Tool poses of the touches in the object's frame.
        numbers: Whether to number the touches.

    Returns:
        The pyvista plotter, which renders off screen.

    Raises:
        RuntimeError: No scene can be drawn here.
    """
    pv = _pyvista()
    T_o_t = np.asarray(T_o_t, np.float64)
    body = body_of(pv, vertices, faces)
    with pv.vtk_verbosity("error"):  # VTK warns about a missing display, which it does not need
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
    """Draw the skin's square of one touch, and a pin with the touch's number."""
    square = skin_square(pv, T_o_t, lift_mm=0.5)
    plotter.add_mesh(square, color=colour, opacity=0.55, lighting=False)
    plotter.add_mesh(square.extract_feature_edges(), color=colour, line_width=3)
    if number:
        end = T_o_t[:3, 3] * MM_PER_M - 9.0 * T_o_t[:3, 2]
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
    """Plot a still picture of an object with its touches. If none can be drawn, the figure states why.

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
    axes = figure.subplots()
    axes.set_axis_off()
    picture = object_image(vertices, faces, T_o_t, numbers=True)
    if picture is None:
        axes.text(0.5, 0.5, explain_no_scene(), ha="center", va="center", wrap=True, transform=axes.transAxes)
    else:
        axes.imshow(picture)
    figure.suptitle(f"{titled(title, simulated)}\nsquares: the skin, 20 mm wide, where it touched", fontsize=11)
    return figure


def object_image(
    vertices: Float[Array, "v 3"], faces: Int[Array, "f 3"], T_o_t: Float[Array, "n 4 4"], *, numbers: bool = False
) -> Array | None:
    """Render the picture of `plot_object` without margins.

    Args:
        vertices: Vertices (m) of the object.
        faces: Vertex numbers of each face.
        T_o_t: Tool poses of the touches in the object's frame; there may be none.
        numbers: Whether to number the touches.

    Returns:
        `(rows, columns, 3)` 8-bit colours, or None if no scene can be drawn.
    """
    return None if explain_no_scene() else image_of(object_plotter(vertices, faces, T_o_t, numbers))


def image_of(plotter: Any) -> Array:
    """Render a plotter's picture without its white margins, and close the plotter.

    Args:
        plotter: The pyvista plotter.

    Returns:
        `(rows, columns, 3)` 8-bit colours. An empty scene keeps its margins.
    """
    picture = np.asarray(plotter.screenshot(return_img=True))
    plotter.close()
    rows, columns = np.nonzero((picture < 250).any(-1))
    return picture[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] if len(rows) else picture


def body_of(pv: Any, vertices: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> Any:
    """Convert a mesh to pyvista's format, in millimetres.

    Args:
        pv: The module pyvista.
        vertices: Vertices (m) of the mesh.
        faces: Vertex numbers of each face.

    Returns:
        The mesh as a pyvista PolyData.
    """
    corners = np.column_stack([np.full(len(faces), 3), faces]).ravel()
    return pv.PolyData(np.asarray(vertices, np.float64) * MM_PER_M, corners)


def skin_square(pv: Any, T_o_t: Float[Array, "4 4"], lift_mm: float = 0.0) -> Any:
    """Build the square of the skin's face at a touch, for drawing.

    Args:
        pv: The module pyvista.
        T_o_t: Tool pose of the touch in the object's frame.
        lift_mm: Distance (mm) by which the square is drawn off the surface.

    Returns:
        The square in millimetres, as a pyvista PolyData.
    """
    half = PAD_WINDOW * MM_PER_M / 2
    corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    corners[:, 2] = -lift_mm
    return pv.PolyData(corners @ T_o_t[:3, :3].T + T_o_t[:3, 3] * MM_PER_M, [4, 3, 2, 1, 0])


def set_view(plotter: Any) -> None:
    """Look at a scene from above and the side, without perspective.

    Args:
        plotter: The pyvista plotter.
    """
    plotter.enable_parallel_projection()
    plotter.view_vector((-0.6, -1.0, 1.0), viewup=(0, 0, 1))


def _pyvista() -> Any:
    """Import pyvista, or raise RuntimeError if no scene can be drawn here."""
    if explain_no_scene():
        raise RuntimeError(explain_no_scene())
    import pyvista

    return pyvista
