"""Interactive scenes of objects with their touches, for notebooks.

Scenes need pyvista (extra `notebooks`) and a machine that can draw off screen. Drawing is first tried in a separate
process, because VTK ends with a segmentation fault without EGL or OSMesa. Still pictures (`i2t.viz.scene`) need none of
this.
"""

import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from i2t.errors import explain_missing_extra
from i2t.patches.dimensions import PAD_WINDOW
from i2t.types import Array
from i2t.viz.scene import touch_colours
from i2t.viz.style import MM_PER_M

# Python program that fails if this machine cannot draw off screen.
PROBE = "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(64, 64)); p.add_mesh(pv.Cube()); p.show()"
# Note if this machine cannot draw off screen.
NO_GL = (
    "An interactive scene cannot be drawn off screen on this machine: install the system package libegl1 "
    "(apt-get install libegl1) or libosmesa6"
)


@cache
def explain_no_scene() -> str:
    """Explain in one sentence why this environment cannot draw scenes; an empty string if it can."""
    if find_spec("pyvista") is None:
        return explain_missing_extra("pyvista", "an interactive scene")
    try:
        attempt = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=120)
    except subprocess.TimeoutExpired:
        return NO_GL
    return "" if attempt.returncode == 0 else NO_GL


def object_plotter(vertices: Float[Array, "v 3"], faces: Int[Array, "f 3"], T_o_t: Float[Array, "n 4 4"]) -> Any:
    """Make a pyvista plotter with an object and the numbered square of the skin at each touch.

    Args:
        vertices: Vertices (m) of the object.
        faces: Vertex numbers of each face.
        T_o_t: Tool poses of the touches in the object's frame.

    Returns:
        The pyvista plotter in millimetres, whose `show()` opens the scene in a notebook.

    Raises:
        RuntimeError: No scene can be drawn here.

    Example:
        mug = i2t.load_mesh("mug.stl", unit="mm")
        i2t.viz.object_plotter(mug.vertices, mug.faces, dataset.touches.T_w_t).show()
    """
    if explain_no_scene():
        raise RuntimeError(explain_no_scene())
    import pyvista as pv

    T_o_t = np.asarray(T_o_t, np.float64)
    body = pv.PolyData(np.asarray(vertices, np.float64) * MM_PER_M, np.insert(faces, 0, 3, axis=1).ravel())
    half = PAD_WINDOW * MM_PER_M / 2
    corners = np.array([[-half, -half, -0.5], [half, -half, -0.5], [half, half, -0.5], [-half, half, -0.5]])
    with pv.vtk_verbosity("error"):  # VTK warns about a missing display, which it does not need
        plotter: Any = pv.Plotter(off_screen=True, window_size=[900, 700], lighting="three lights")
        plotter.add_mesh(body, color="#d9d9d9", split_sharp_edges=True, smooth_shading=True)
        for number, (T, colour) in enumerate(zip(T_o_t, touch_colours(len(T_o_t)), strict=True), 1):
            origin = T[:3, 3] * MM_PER_M
            square = pv.PolyData(corners @ T[:3, :3].T + origin, [4, 3, 2, 1, 0])  # lifted off the surface
            plotter.add_mesh(square, color=colour, opacity=0.55, lighting=False)
            plotter.add_mesh(square.extract_feature_edges(), color=colour, line_width=3)
            pin = origin - 9.0 * T[:3, 2]
            plotter.add_mesh(pv.Line(origin, pin), color="black", line_width=2)
            plotter.add_point_labels([pin], [str(number)], font_size=20, always_visible=True, show_points=False)
        plotter.enable_parallel_projection()
        plotter.view_vector((-0.6, -1.0, 1.0), viewup=(0, 0, 1))
    return plotter
