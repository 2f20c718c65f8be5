"""Scenes in three dimensions: objects with their touches, the skin's surface, maps as landscapes.

Scenes need pyvista (`pip install "imagine2touch[notebooks]"`) and a machine that can draw off screen. That is tried out
first in a process of its own, because without EGL or OSMesa VTK ends with a segmentation fault.
"""

import html
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped
from matplotlib import colormaps

from i2t.types import PAD_WINDOW, Array
from i2t.viz.skins import colour_range
from i2t.viz.style import KPA_PER_PA, MM_PER_M, Picture, titled

SKIN_LIFT_MM = 0.5  # by which the skin's square is drawn off the surface
NUMBER_DISTANCE_MM = 9.0  # of a touch's number behind the skin, where a person stands
LANDSCAPE_HEIGHT = 0.3  # of a map's largest value, relative to the map's width
VIEW_DIRECTION = (-0.6, -1.0, 1.0)
PROBE = "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(64, 64)); p.add_mesh(pv.Cube()); p.show()"
PROBE_TIMEOUT_S = 120
NO_PYVISTA = 'There is no 3-D picture, because pyvista is missing: pip install "imagine2touch[notebooks]".'
NO_GL = (
    "There is no 3-D picture, because this machine cannot draw off screen: install the system package libegl1 "
    "(apt-get install libegl1) or libosmesa6."
)


class InteractiveScene:
    """A scene that can be turned with the mouse, in a notebook and in its exported HTML.

    Args:
        page: The scene as an HTML page.
        title: Of the scene, which says whether it was simulated.
        width: In pixels.
        height: In pixels.
    """

    def __init__(self, page: str, title: str, width: int = 780, height: int = 520) -> None:
        self.page, self.title, self.size = page, title, (width, height)

    def _repr_html_(self) -> str:
        width, height = self.size
        frame = f'width="{width}" height="{height}" style="border: 0"'
        return f'<p>{html.escape(self.title)}</p><iframe srcdoc="{html.escape(self.page)}" {frame}></iframe>'


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
    corners = np.column_stack([np.full(len(faces), 3), faces]).ravel()
    body = pv.PolyData(np.asarray(vertices, np.float64) * MM_PER_M, corners)
    with pv.vtk_verbosity("error"):  # VTK warns of the missing display before it goes on without
        plotter: Any = pv.Plotter(off_screen=True, window_size=[900, 700], lighting="three lights")
        plotter.add_mesh(body, color="#d9d9d9", split_sharp_edges=True, smooth_shading=True)
        edges = body.extract_feature_edges(30, boundary_edges=True, manifold_edges=False, non_manifold_edges=False)
        if edges.n_points:
            plotter.add_mesh(edges, color="#555555", line_width=1.5)
        colours = colormaps["viridis"](np.linspace(0.0, 0.9, len(T_o_t)))[:, :3]
        for i, (T, colour) in enumerate(zip(T_o_t, colours, strict=True)):
            _add_touch(pv, plotter, T, colour, str(i + 1) if numbers else "")
        _set_view(plotter)
    return plotter


def _add_touch(pv: Any, plotter: Any, T_o_t: np.ndarray, colour: np.ndarray, number: str) -> None:
    """The skin's square of one touch, and a pin with its number."""
    half = PAD_WINDOW * MM_PER_M / 2
    corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    lifted = corners - [0, 0, SKIN_LIFT_MM]
    square = pv.PolyData(lifted @ T_o_t[:3, :3].T + T_o_t[:3, 3] * MM_PER_M, [4, 3, 2, 1, 0])
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
    *,
    numbers: bool = True,
) -> Picture:
    """A still picture of an object with its touches; where none can be drawn the figure says why.

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
    plotter = None if why_no_scene() else object_plotter(vertices, faces, T_o_t, numbers)
    return _still(plotter, f"{titled(title, simulated)}\nsquares: the skin, 20 mm wide, where it touched")


def object_image(vertices: Float[Array, "v 3"], faces: Int[Array, "f 3"], T_o_t: Float[Array, "n 4 4"]) -> Array | None:
    """The pixels of `plot_object`, without margins, to be drawn next to something else.

    Args:
        vertices: m, of the object.
        faces: Vertex numbers.
        T_o_t: Tool poses in the object's frame; there may be none.

    Returns:
        Colours (rows, columns, 3) of 8 bits; None where no scene can be drawn.
    """
    return None if why_no_scene() else _image(object_plotter(vertices, faces, T_o_t, numbers=False))


def skin_plotter(pressure: Float[Array, "n n"], displacement: Float[Array, "n n"], exaggerate: float = 5.0) -> Any:
    """A pyvista plotter with the skin's surface as it is pushed in, coloured by pressure.

    Args:
        pressure: Pa.
        displacement: m, downwards.
        exaggerate: Factor on the displacement.

    Returns:
        The plotter.

    Raises:
        RuntimeError: No scene can be drawn here.
    """
    pv = _pyvista()
    n = len(pressure)
    at = ((np.arange(n) + 0.5) / n - 0.5) * PAD_WINDOW * MM_PER_M
    x, y = np.meshgrid(at, at)
    with pv.vtk_verbosity("error"):
        plotter: Any = pv.Plotter(off_screen=True, window_size=[900, 700])
        surface = pv.StructuredGrid(x, y, -exaggerate * np.asarray(displacement, np.float64) * MM_PER_M)
        surface["pressure (kPa)"] = np.asarray(pressure, np.float64).ravel(order="F") * KPA_PER_PA
        top = max(float(np.max(pressure)) * KPA_PER_PA, 1e-3)
        plotter.add_mesh(
            surface, scalars="pressure (kPa)", cmap="cividis", clim=[0, top], show_edges=True, edge_color="#888888",
            line_width=0.4, scalar_bar_args={"title": "pressure (kPa)", "color": "black", "fmt": "%.3g"},
        )  # fmt: skip
        _set_view(plotter)
    return plotter


def plot_skin_surface(
    pressure: Float[Array, "n n"],
    displacement: Float[Array, "n n"],
    title: str,
    simulated: bool,
    *,
    exaggerate: float = 5.0,
) -> Picture:
    """A still picture of the skin's surface under a press; where none can be drawn the figure says why.

    Args:
        pressure: Pa.
        displacement: m, downwards.
        title: What is shown.
        simulated: Whether it was simulated.
        exaggerate: Factor on the displacement.

    Returns:
        The figure.
    """
    plotter = None if why_no_scene() else skin_plotter(pressure, displacement, exaggerate)
    return _still(plotter, f"{titled(title, simulated)}\ndepth drawn {exaggerate:g} times as large")


def map_plotter(values: Shaped[Array, "n n"], window: float, label: str) -> Any:
    """A pyvista plotter with values over a square as a landscape.

    Args:
        values: Row i along y, column j along x.
        window: m, edge of the square.
        label: Of the colour bar, with the unit.

    Returns:
        The plotter.

    Raises:
        RuntimeError: No scene can be drawn here.
    """
    pv = _pyvista()
    values = np.asarray(values, np.float64)
    low, high, cmap = colour_range(values)
    x, y = np.meshgrid(*2 * [np.linspace(-0.5, 0.5, len(values)) * window * MM_PER_M])
    with pv.vtk_verbosity("error"):
        plotter: Any = pv.Plotter(off_screen=True, window_size=[900, 700])
        height = values / max(-low, high, 1e-9) * LANDSCAPE_HEIGHT * window * MM_PER_M
        surface = pv.StructuredGrid(x, y, height)
        surface[label] = values.ravel(order="F")
        bar = {"title": label, "color": "black", "fmt": "%.3g"}
        plotter.add_mesh(surface, scalars=label, cmap=cmap, clim=[low, high], scalar_bar_args=bar)
        _set_view(plotter)
    return plotter


def interactive(make_plotter: Callable[[], Any], still: Callable[[], Picture]) -> InteractiveScene | Picture:
    """A scene to be turned with the mouse where that can be had (trame, of the extra `notebooks`), else a picture.

    Args:
        make_plotter: Gives the pyvista plotter of the scene.
        still: Gives the picture, whose title the scene takes.

    Returns:
        The scene, or the picture.
    """
    picture = still()
    if why_no_scene() or find_spec("trame_vtk") is None:
        return picture
    plotter = make_plotter()
    # trame's renderer in web assembly, which this page does not use, would be fetched from the internet.
    modules: dict[str, Any] = sys.modules
    hidden = "trame.widgets.vtklocal"
    absent = hidden not in modules
    modules.setdefault(hidden, None)
    try:
        # `trame` from pyvista 0.49 on.
        page = (plotter.trame if hasattr(plotter, "trame") else plotter).export_html(None)
    finally:
        if absent:
            del modules[hidden]
    plotter.close()
    return InteractiveScene(page.read() if hasattr(page, "read") else str(page), picture.get_suptitle())


def trimmed(picture: Shaped[Array, "rows columns rgb"]) -> Array:
    """A picture without its white margins.

    Args:
        picture: Of 8-bit colours.

    Returns:
        The part of it that is not white.
    """
    rows, columns = np.nonzero((picture < 250).any(-1))
    return picture[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]


def _pyvista() -> Any:
    """pyvista, or RuntimeError where no scene can be drawn."""
    if why_no_scene():
        raise RuntimeError(why_no_scene())
    import pyvista

    return pyvista


def _set_view(plotter: Any) -> None:
    plotter.enable_parallel_projection()
    plotter.view_vector(VIEW_DIRECTION, viewup=(0, 0, 1))


def _still(plotter: Any, title: str) -> Picture:
    """A scene as a figure, or the reason why there is none."""
    figure = Picture(figsize=(6.5, 5.4), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    if plotter is None:
        axes.text(0.5, 0.5, why_no_scene(), ha="center", va="center", wrap=True, transform=axes.transAxes)
    else:
        axes.imshow(_image(plotter))
    figure.suptitle(title, fontsize=11)
    return figure


def _image(plotter: Any) -> Array:
    """Image of a plotter, without margins; the plotter is closed."""
    picture = trimmed(np.asarray(plotter.screenshot(return_img=True)))
    plotter.close()
    return picture
