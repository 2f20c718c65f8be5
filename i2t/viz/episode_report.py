"""Illustrated report of one recognition episode: the touches, their readings, what each candidate would have shown
there, and the belief after each touch.

    record = EpisodeRecord(meshes, names, T_w_t, readings, board, p, truth, simulated=True)
    paths = write_episode_report(record, Path("runs/episode"))

writes `story.png`, a page with a row for each touch. If the machine can draw in three dimensions off screen, which
needs pyvista (extra `notebooks`), the page also shows the object with its touches.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.image import AxesImage

from i2t.objects.solids import Mesh
from i2t.patches.dimensions import PATCH_WINDOW, REACH
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_patch, stack_surfaces
from i2t.types import Array, Board
from i2t.viz.patches import draw_patch
from i2t.viz.scene import explain_no_scene, object_image
from i2t.viz.skins import common_scale, draw_reading, draw_skin, scale_legend
from i2t.viz.style import MM_PER_M, Colour, Picture, save_figure, titled

log = logging.getLogger(__name__)


class EpisodeRecord(NamedTuple):
    """One episode of t touches, at least one: meshes and names of the n candidates, tool poses, readings (uT),
    posterior after each touch, and the true candidate.
    """

    meshes: Sequence[Mesh]  # meshes of the candidates in the world frame, at their believed poses
    names: Sequence[str]  # names of the candidates
    T_w_t: Array  # (t, 4, 4) measured tool poses at the end of each press
    readings: Array  # (t, c) uT
    board: Board
    p: Array  # (t, n) posterior after each touch; the rest to 1 is the probability of an unknown object
    truth: int  # index of the true candidate, -1 for an unknown object
    simulated: bool

    @property
    def shown_candidate(self) -> int:
        """Index of the candidate that a scene shows, the true one or else the most probable one at the end."""
        return self.truth if self.truth >= 0 else int(self.p[-1].argmax())

    @property
    def headline(self) -> str:
        """Headline that names the touched object and marks simulated data."""
        if self.truth >= 0:
            touched = self.names[self.truth]
        else:
            touched = f"an unknown object, drawn on the {self.names[self.shown_candidate]}"
        return titled(f"One episode: {touched}", self.simulated)


def write_episode_report(record: EpisodeRecord, out: Path) -> list[Path]:
    """Write the report of an episode. If no scene can be drawn, the page omits it and the reason is logged.

    Args:
        record: The episode.
        out: Folder for the report. A missing folder is created.

    Returns:
        Paths of the written files.

    Raises:
        ValueError: Poses, readings, beliefs, meshes and names do not fit together.
    """
    record = _checked(record)
    mesh = record.meshes[record.shown_candidate]
    picture = object_image(mesh.vertices, mesh.faces, record.T_w_t, numbers=True)
    if picture is None:
        log.warning("%s", explain_no_scene())
    return [save_figure(plot_episode(record, picture), out / "story.png")]


def _checked(record: EpisodeRecord) -> EpisodeRecord:
    T_w_t, readings, p = np.asarray(record.T_w_t), np.asarray(record.readings), np.asarray(record.p)
    n = len(record.meshes)
    if not len(T_w_t) == len(readings) == len(p) > 0 or p.shape[1:] != (n,) or len(record.names) != n:
        raise ValueError(
            f"episode report: poses {T_w_t.shape}, readings {readings.shape} and beliefs {p.shape} must have the same "
            f"number of touches, at least one, and as many candidates as there are meshes ({n}) and names "
            f"({len(record.names)})"
        )
    return record._replace(T_w_t=T_w_t, readings=readings, p=p)


def plot_episode(
    record: EpisodeRecord, scene: Array | None = None, *, max_touches: int = 6, max_candidates: int = 5
) -> Picture:
    """Plot a row for each touch: the reading, the patches that the candidates have there, and the belief after it.

    If there are too many touches, evenly spaced ones are shown, with the first and the last. If there are too many
    candidates, the true one and the most probable ones are shown.

    Args:
        record: The episode.
        scene: `(rows, columns, 3)` picture of the object with its touches, drawn on the left.
        max_touches: Maximum number of touches shown.
        max_candidates: Maximum number of candidates shown.

    Returns:
        The figure, which `save_figure` can write.
    """
    touches = np.unique(np.linspace(0, len(record.p) - 1, max_touches).round().astype(int)).tolist()
    candidates = _shown_candidates(record.p, record.truth, max_candidates)
    depth, nearest = _render_candidates([record.meshes[i] for i in candidates], record.T_w_t[touches])
    scale = common_scale(record.readings)
    colours = _touch_colours(len(record.p))

    widths = [2.2] * (scene is not None) + [1.15] + [1.0] * len(candidates) + [1.0, 0.75]
    figure = Picture(figsize=(1.55 * sum(widths) + 0.6, 1.55 * len(touches) + 1.3), layout="constrained")
    grid = figure.add_gridspec(len(touches), len(widths), width_ratios=widths)
    if scene is not None:
        left = figure.add_subplot(grid[:, 0])
        left.imshow(scene)
        left.set_axis_off()
    first = len(widths) - len(candidates) - 3
    panels: list[Axes] = []
    for row, touch in enumerate(touches):
        top = row == 0
        measured = figure.add_subplot(grid[row, first])
        _draw_measured(measured, record, touch, scale, colours[touch])
        for i, candidate in enumerate(candidates):
            panel = figure.add_subplot(grid[row, first + 1 + i])
            image = _draw_candidate(panel, depth[row, i], float(nearest[row, i]))
            if top:
                true = candidate == record.truth
                label = record.names[candidate] + (" (true)" if true else "")
                panel.set_title(label, fontsize=8.5, fontweight="bold" if true else "normal")
            panels.append(panel)
        bars = figure.add_subplot(grid[row, first + 1 + len(candidates) : first + 3 + len(candidates)])
        _draw_belief(bars, record.p[touch], record.names, candidates, record.truth)
        if top:
            measured.set_title("measured", fontsize=8.5)
            bars.set_title("belief", fontsize=8.5)
        if touch < touches[-1]:
            bars.set_xticklabels([])
    bar = figure.colorbar(image, ax=panels, location="bottom", shrink=0.5, aspect=40, pad=0.01)
    bar.set_label("predicted depth behind the nearest point (mm)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    figure.suptitle(f"{record.headline}\nmeasured: {scale_legend(record.board, scale)}", fontsize=10)
    return figure


def _shown_candidates(p: np.ndarray, truth: int, count: int) -> list[int]:
    """Choose the true candidate and the most probable ones, in the order of their indices."""
    by_probability = [int(i) for i in np.argsort(-p.max(0), kind="stable") if i != truth]
    return sorted(([truth] if truth >= 0 else []) + by_probability[: count - (truth >= 0)])


def _render_candidates(meshes: Sequence[Mesh], T_w_t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Render depth (touches, candidates, n, n) and nearest points (touches, candidates) of the candidates, in m."""
    # Stacked surfaces have one size, so that they share one compiled renderer.
    surfaces = stack_surfaces([prepare_surface(mesh) for mesh in meshes])
    patches = [
        [render_patch(element(surfaces, i), T) for i in range(len(meshes))] for T in np.asarray(T_w_t, np.float32)
    ]
    depth = np.array([[patch.depth for patch in row] for row in patches])
    return depth, np.array([[patch.nearest for patch in row] for row in patches])


def _draw_measured(axes: Axes, record: EpisodeRecord, touch: int, scale: float, colour: np.ndarray) -> None:
    """Draw the reading of a touch, with its number in its colour."""
    draw_skin(axes)
    draw_reading(axes, record.board, record.readings[touch], scale)
    axes.set(xticks=[], yticks=[])
    axes.set_ylabel(
        f"touch {touch + 1}", fontsize=10, fontweight="bold", labelpad=8,
        color="white" if colour.mean() < 0.5 else "black",
        bbox={"facecolor": colour, "edgecolor": "none", "alpha": 0.8, "pad": 2.5},
    )  # fmt: skip


def _draw_candidate(axes: Axes, depth: np.ndarray, nearest: float) -> AxesImage:
    """Draw a candidate's patch at a touch, with the distance of its surface from the tool's origin."""
    image = draw_patch(axes, depth, PATCH_WINDOW, REACH)
    axes.set(xticks=[], yticks=[])
    if np.isfinite(nearest):
        distance = f"{abs(nearest) * MM_PER_M:.1f} mm {'deep' if nearest < 0 else 'away'}"
    else:
        distance = "no surface here"
    axes.set_xlabel(distance, fontsize=7.5, labelpad=2)
    return image


def _draw_belief(axes: Axes, p: np.ndarray, names: Sequence[str], shown: Sequence[int], truth: int) -> None:
    """Draw the probabilities of the shown candidates, of all others together, and of an unknown object."""
    rows = [(names[i], float(p[i]), Colour.BLUE if i == truth else Colour.GREY) for i in shown]
    if len(shown) < len(names):
        rows.append((f"{len(names) - len(shown)} others", float(p.sum() - p[list(shown)].sum()), Colour.GREY))
    unknown = 1 - float(p.sum())
    if unknown > 1e-3:
        rows.append(("unknown", unknown, Colour.BLUE if truth < 0 else Colour.ORANGE))
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


def _touch_colours(touches: int) -> np.ndarray:
    """Choose a colour (touches, 3) for each touch, from dark to light."""
    return colormaps["viridis"](np.linspace(0.0, 0.9, touches))[:, :3]
