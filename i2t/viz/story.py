"""The picture story of one episode: where an object was touched, what was felt, what each candidate would have shown
there, and what was believed after each touch.

    paths = story(meshes, names, T_w_t, readings, board, p, truth, Path("runs/episode"), simulated=True)

writes `story.png`, a page with a row per touch, and, where the machine can draw in three dimensions off screen,
`scene.png` and `scene.gltf`, the object with its touches (glTF opens in Blender and in viewers that run in a browser).
The scene needs pyvista (`pip install "i2t[notebooks]"`).
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from i2t.objects.solids import Mesh
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_patch, stack_surfaces
from i2t.types import PAD_WINDOW, PATCH_WINDOW, REACH, Board
from i2t.viz.touches import BLUE, GREY, ORANGE, draw_patch, draw_reading, draw_skin, no_scene, save

ROWS = 6  # touches on a page
COLUMNS = 5  # candidates on a page
LIFT = 1.5e-3  # m that a square is drawn above the end of its press, clear of the surface
PIN = 12e-3  # m from there to its number
_render = jax.jit(render_patch)


def can_render() -> bool:
    """Whether scenes can be drawn on this machine."""
    return not no_scene()


def story(
    meshes: Sequence[Mesh],
    names: Sequence[str],
    T_w_t: np.ndarray,
    readings: np.ndarray,
    board: Board,
    p: np.ndarray,
    truth: int,
    out: Path,
    simulated: bool,
) -> list[Path]:
    """Tell an episode of t touches in the folder `out`; returns the files written.

    `meshes` of the candidates stand where they are believed, in W; `T_w_t` (t, 4, 4) are the tool's measured poses at
    the end of each press, `readings` (t, 15) uT, `p` (t, candidates) the posterior after each touch; what it lacks to 1
    is "none of these". `truth` is the candidate that was there, -1 for none of them; then the scene shows the one
    believed in last. Where no scene can be drawn the reason is printed to stderr, and the page comes without it.
    """
    T_w_t, readings, p = np.asarray(T_w_t), np.asarray(readings), np.asarray(p)
    if not len(T_w_t) == len(readings) == len(p) > 0 or p.shape[1:] != (len(meshes),) or len(names) != len(meshes):
        raise ValueError(
            f"story: poses {T_w_t.shape}, readings {readings.shape} and beliefs {p.shape} must be of the same touches, "
            f"one at least, and of the {len(meshes)} meshes and {len(names)} names"
        )
    out.mkdir(parents=True, exist_ok=True)
    views: list[np.ndarray] = []
    written: list[Path] = []
    if can_render():
        views, written = _scene(meshes[_drawn(p, truth)], T_w_t, out, _headline(names, p, truth, simulated))
    else:
        print(no_scene(), file=sys.stderr)
    figure = page(meshes, names, T_w_t, readings, board, p, truth, views, simulated)
    return [save(figure, out / "story.png"), *written]


def page(
    meshes: Sequence[Mesh],
    names: Sequence[str],
    T_w_t: np.ndarray,
    readings: np.ndarray,
    board: Board,
    p: np.ndarray,
    truth: int,
    views: Sequence[np.ndarray],
    simulated: bool,
) -> Figure:
    """A row per touch: what was felt, the patches of the candidates there, the belief after it; `views` of the scene
    to the left. Of many touches `ROWS` are shown, evenly spaced with the first and the last; of many candidates the
    true one and the most believed.
    """
    rows = np.unique(np.linspace(0, len(p) - 1, ROWS).round().astype(int))
    shown = _candidates(p, truth)
    depth, nearest = _imagined([meshes[i] for i in shown], T_w_t[rows])
    labels = [names[i] + (" (true)" if i == truth else "") for i in shown]

    views = views[: 1 if len(rows) < 4 else 2]
    left = 2.2 * bool(len(views))
    widths = [left] * bool(len(views)) + [1.15] + [1.0] * len(shown) + [1.0, 0.75]
    figure = Figure(figsize=(1.55 * sum(widths) + 0.6, 1.55 * len(rows) + 1.3), layout="constrained")
    grid = figure.add_gridspec(len(rows) * max(len(views), 1), len(widths), width_ratios=widths)
    for i, view in enumerate(views):
        axes = figure.add_subplot(grid[i * len(rows) : (i + 1) * len(rows), 0])
        axes.imshow(view)
        axes.set_axis_off()
    first, step = len(widths) - len(shown) - 3, max(len(views), 1)
    colours = _colours(len(p))
    scale = float(np.percentile(np.linalg.norm(readings.reshape(-1, 5, 3), axis=-1), 95)) or 1.0
    patches = []
    for row, touch in enumerate(rows):
        band = slice(row * step, (row + 1) * step)
        felt = figure.add_subplot(grid[band, first])
        draw_skin(felt)
        draw_reading(felt, board, readings[touch], scale, BLUE)
        felt.set_ylabel(
            f"touch {touch + 1}", fontsize=10, fontweight="bold", labelpad=8,
            color="white" if colours[touch].mean() < 0.5 else "black",
            bbox={"facecolor": colours[touch], "edgecolor": "none", "alpha": 0.8, "pad": 2.5},
        )  # fmt: skip
        for i in range(len(shown)):
            axes = figure.add_subplot(grid[band, first + 1 + i])
            image = draw_patch(axes, depth[row, i], PATCH_WINDOW, REACH)
            axes.set_xlabel(_where(nearest[row, i]), fontsize=7.5, labelpad=2)
            if not row:
                axes.set_title(labels[i], fontsize=8.5, fontweight="bold" if shown[i] == truth else "normal")
            patches.append(axes)
        axes = figure.add_subplot(grid[band, first + 1 + len(shown) : first + 3 + len(shown)])
        _bars(axes, p[touch], names, shown, truth)
        if not row:
            felt.set_title("felt", fontsize=8.5)
            axes.set_title("believed", fontsize=8.5)
        if touch < rows[-1]:
            axes.set_xticklabels([])
        for panel in (felt, *patches):
            panel.set(xticks=[], yticks=[])
    bar = figure.colorbar(image, ax=patches, location="bottom", shrink=0.5, aspect=40, pad=0.01)
    bar.set_label("imagined depth behind the nearest point (mm)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    figure.suptitle(
        f"{_headline(names, p, truth, simulated)}\n"
        f"felt: arrows in the skin's plane, 5 mm = {scale:.0f} µT; discs normal field, filled outwards",
        fontsize=10,
    )
    return figure


def _headline(names: Sequence[str], p: np.ndarray, truth: int, simulated: bool) -> str:
    there = names[truth] if truth >= 0 else f"none of the candidates, drawn on the {names[_drawn(p, truth)]}"
    return f"One episode: {there}{' (simulated)' if simulated else ''}"


def _drawn(p: np.ndarray, truth: int) -> int:
    """The true candidate, or else the one believed in last."""
    return truth if truth >= 0 else int(p[-1].argmax())


def _candidates(p: np.ndarray, truth: int) -> list[int]:
    """The true candidate and the most believed ones, in their own order."""
    most = [int(i) for i in np.argsort(-p.max(0), kind="stable") if i != truth]
    return sorted(([truth] if truth >= 0 else []) + most[: COLUMNS - (truth >= 0)])


def _imagined(meshes: Sequence[Mesh], T_w_t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (touches, candidates, n, n) m, and nearest points (touches, candidates) m."""
    surfaces = stack_surfaces([prepare_surface(mesh) for mesh in meshes])  # of one size class, so that one compilation serves all
    patches = [[_render(element(surfaces, i), T) for i in range(len(meshes))] for T in np.asarray(T_w_t, np.float32)]
    depth = np.array([[patch.depth for patch in row] for row in patches])
    return depth, np.array([[patch.nearest for patch in row] for row in patches])


def _where(nearest: float) -> str:
    """How far the tool's end is from a candidate's surface."""
    if not np.isfinite(nearest):
        return "nothing here"
    return f"{abs(nearest) * 1e3:.1f} mm {'deep' if nearest < 0 else 'away'}"


def _bars(axes: Axes, p: np.ndarray, names: Sequence[str], shown: Sequence[int], truth: int) -> None:
    """Probabilities of the candidates shown, of all the others, and of none of them."""
    rows = [(names[i], float(p[i]), BLUE if i == truth else GREY) for i in shown]
    if len(shown) < len(names):
        rows.append((f"{len(names) - len(shown)} others", float(p.sum() - p[list(shown)].sum()), GREY))
    none = 1 - float(p.sum())
    if none > 1e-3:
        rows.append(("none of these", none, BLUE if truth < 0 else ORANGE))
    for y, (_, value, colour) in enumerate(rows):
        axes.barh(y, value, color=colour)
        inside = value > 0.75
        axes.text(
            value + (-0.03 if inside else 0.03), y, f"{value:.0%}", va="center", fontsize=7.5,
            ha="right" if inside else "left", color="white" if inside else "black",
        )  # fmt: skip
    axes.set_yticks(range(len(rows)), [name for name, *_ in rows], fontsize=7.5)
    axes.invert_yaxis()
    axes.set(xlim=(0, 1), xticks=[0, 0.5, 1])
    axes.tick_params(axis="x", labelsize=7.5)


def _scene(mesh: Mesh, T_w_t: np.ndarray, out: Path, title: str) -> tuple[list[np.ndarray], list[Path]]:
    """The object with its numbered touches, seen from two sides; as pictures, and as files."""
    import pyvista as pv

    faces = np.column_stack([np.full(len(mesh.faces), 3), mesh.faces])
    body = pv.PolyData(mesh.vertices, faces.ravel())
    edges = body.extract_feature_edges(30, boundary_edges=True, manifold_edges=False, non_manifold_edges=False)
    with pv.vtk_verbosity("error"):  # VTK warns of the missing display before it goes on without
        plotter: Any = pv.Plotter(off_screen=True, window_size=[1000, 1000], lighting="three lights")
        plotter.add_mesh(body, color="#d9d9d9", split_sharp_edges=True, smooth_shading=True)
        if edges.n_points:
            plotter.add_mesh(edges, color="#555555", line_width=2)
        for T, colour in zip(T_w_t, _colours(len(T_w_t)), strict=True):
            square, pin = _square(pv, np.asarray(T, np.float64))
            plotter.add_mesh(pin, color="black", lighting=False)
            plotter.add_mesh(square.extract_feature_edges(), color=colour, line_width=4)
            plotter.add_mesh(square, color=colour, opacity=0.5, lighting=False)
        numbers = [str(i + 1) for i in range(len(T_w_t))]
        ends = T_w_t[:, :3, 3] - PIN * T_w_t[:, :3, 2]
        labels = plotter.add_point_labels(
            ends, numbers, font_size=32, bold=True, shape_color="white", shape_opacity=0.75, margin=2,
            always_visible=True, show_points=False,
        )  # fmt: skip
        plotter.enable_parallel_projection()
        views = []
        for side in ((-0.6, -1.0, 1.0), (0.6, 1.0, 1.0)):
            plotter.view_vector(side, viewup=(0, 0, 1))
            plotter.reset_camera()
            views.append(_trimmed(np.asarray(plotter.screenshot(return_img=True))))
        plotter.remove_actor(labels)  # flat ones, which glTF does not know
        for T, number in zip(T_w_t, numbers, strict=True):
            plotter.add_mesh(_digits(pv, np.asarray(T, np.float64), number), color="black", lighting=False)
        plotter.export_gltf(str(out / "scene.gltf"))
        plotter.close()
    figure = Figure(figsize=(12, 6), layout="constrained")
    figure.suptitle(
        f"{title}\nits {len(T_w_t)} touches from two sides; the squares are the skin, 20 mm wide", fontsize=11
    )
    for axes, view in zip(figure.subplots(1, len(views)), views, strict=True):
        axes.imshow(view)
        axes.set_axis_off()
    return views, [save(figure, out / "scene.png"), out / "scene.gltf"]


def _square(pv: Any, T_w_t: np.ndarray) -> tuple[Any, Any]:
    """The skin's square over the surface that it touched, and a pin from its middle to its number."""
    half = PAD_WINDOW / 2
    corners = np.array([[-half, -half, -LIFT], [half, -half, -LIFT], [half, half, -LIFT], [-half, half, -LIFT]])
    square = pv.PolyData(corners, [4, 3, 2, 1, 0]).transform(T_w_t, inplace=False)
    pin = pv.Line(T_w_t[:3, 3], T_w_t[:3, 3] - PIN * T_w_t[:3, 2]).tube(radius=3e-4)
    return square, pin


def _digits(pv: Any, T_w_t: np.ndarray, number: str) -> Any:
    """A number written on the back of the skin's square, where people see it."""
    digits = pv.Text3D(number, depth=1e-4, height=0.4 * PAD_WINDOW)
    digits.translate(-np.asarray(digits.center), inplace=True)
    back = np.diag([1.0, -1.0, -1.0, 1.0])
    back[2, 3] = -LIFT - 3e-4
    return digits.transform(T_w_t @ back, inplace=False)


def _colours(touches: int) -> np.ndarray:
    """One colour (touches, 3) for each, dark to light."""
    return colormaps["viridis"](np.linspace(0.0, 0.9, touches))[:, :3]


def _trimmed(picture: np.ndarray) -> np.ndarray:
    """Without its white margins."""
    rows, columns = np.nonzero((picture < 250).any(-1))
    return picture[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
