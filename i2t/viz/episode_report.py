"""Illustrated report of one recognition episode: the touches, their readings, what each candidate would have shown
there, the belief after each touch, and the evidence by its source.

    record = EpisodeRecord(meshes, names, T_w_t, readings, board, p, truth, simulated=True, evidence=evidence)
    paths = write_episode_report(record, Path("runs/episode"))

writes `story.png`, a page with a row for each touch and the object with its touches, which is legible at a width of 390
pixels.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator

from i2t.objects.solids import Mesh
from i2t.patches.dimensions import PATCH_WINDOW, REACH
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_patch, stack_surfaces
from i2t.types import Array, Board
from i2t.viz.patches import draw_patch
from i2t.viz.scene import draw_object, touch_colours
from i2t.viz.skins import common_scale, draw_key, draw_reading, draw_skin
from i2t.viz.style import MM_PER_M, Colour, Picture, save_figure, titled

# Sources of evidence in the order of `i2t.recognition.recognizer.TouchEvidence`, with their colours.
EVIDENCE_SOURCES = {
    "reading": Colour.GREEN, "position": Colour.SKY, "presence": Colour.PINK, "calibration": Colour.GREY,
}  # fmt: skip
FONT = 8.5  # pt


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
    # (t, n, 4) evidence (nats) of each touch for each candidate: reading, position, presence, and calibration
    evidence: Array | None = None

    @property
    def leaders(self) -> tuple[int, int]:
        """Indices of the most probable candidate at the end and of the next one."""
        first, second = np.argsort(-np.asarray(self.p)[-1], kind="stable")[:2]
        return int(first), int(second)

    @property
    def weights(self) -> np.ndarray:
        """Weights of evidence `(t, 4)` in nats of each touch's sources for the first leader against the second one.

        Only a record with `evidence` has them.
        """
        evidence, (first, second) = np.asarray(self.evidence), self.leaders
        return evidence[:, first] - evidence[:, second]

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
    """Write the report of an episode.

    Args:
        record: The episode.
        out: Folder for the report. A missing folder is created.

    Returns:
        Paths of the written files.

    Raises:
        ValueError: Poses, readings, beliefs, evidence, meshes and names do not fit together.
    """
    return [save_figure(plot_episode(_checked(record), scene=True), out / "story.png")]


def _checked(record: EpisodeRecord) -> EpisodeRecord:
    T_w_t, readings, p = np.asarray(record.T_w_t), np.asarray(record.readings), np.asarray(record.p)
    n = len(record.meshes)
    if not len(T_w_t) == len(readings) == len(p) > 0 or p.shape[1:] != (n,) or len(record.names) != n:
        raise ValueError(
            f"episode report: poses {T_w_t.shape}, readings {readings.shape} and beliefs {p.shape} must have the same "
            f"number of touches, at least one, and as many candidates as there are meshes ({n}) and names "
            f"({len(record.names)})"
        )
    if record.evidence is not None and np.shape(record.evidence) != (*p.shape, len(EVIDENCE_SOURCES)):
        raise ValueError(
            f"episode report: evidence {np.shape(record.evidence)} must have {len(EVIDENCE_SOURCES)} sources for each "
            f"of the {len(p)} touches and {n} candidates"
        )
    return record._replace(T_w_t=T_w_t, readings=readings, p=p)


def plot_episode(
    record: EpisodeRecord, *, scene: bool = False, max_touches: int = 6, max_candidates: int = 5
) -> Picture:
    """Plot a row for each touch: the reading, the patches that the candidates have there, and the belief after it.

    Below, bars show the weights of evidence of each touch for the most probable candidate at the end against the next
    one, if they are known. If there are too many touches, evenly spaced ones are shown, with the first and the last. If
    there are too many candidates, the true one and the most probable ones are shown.

    Args:
        record: The episode.
        scene: Whether to draw the object with its touches below.
        max_touches: Maximum number of touches shown.
        max_candidates: Maximum number of candidates shown.

    Returns:
        The figure, which `save_figure` can write.
    """
    touches = np.unique(np.linspace(0, len(record.p) - 1, max_touches).round().astype(int)).tolist()
    candidates = _shown_candidates(record.p, record.truth, max_candidates)
    scale = common_scale(record.readings)
    below = scene or record.evidence is not None
    widths = [0.9] * (1 + len(candidates)) + [1.45]  # inch, of the panels and of the belief with its labels
    width = sum(widths) + 0.5
    heights = [1.125 * len(touches) + 0.75, *([0.22 * len(touches) + 1.35] * below), 0.5]
    figure = Picture(figsize=(width, sum(heights) + 0.3), layout="constrained")
    parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    measured = _draw_touches(parts[0], record, touches, candidates, widths, scale)
    draw_key(parts[-1].subplots(), measured, record.board, scale, numbers=False)
    if below:
        ratios = [0.9] * scene + [1.0] * (record.evidence is not None)
        columns = parts[1].subfigures(1, len(ratios), width_ratios=ratios, squeeze=False)[0]
        if scene:
            mesh = record.meshes[record.shown_candidate]
            draw_object(columns[0].subplots(), mesh.vertices, mesh.faces, record.T_w_t)
        if record.evidence is not None:
            _draw_evidence(columns[-1].subplots(), record, touches)
    figure.suptitle(record.headline, fontsize=FONT)
    return figure


def _draw_touches(
    part: SubFigure,
    record: EpisodeRecord,
    touches: Sequence[int],
    candidates: Sequence[int],
    widths: Sequence[float],
    scale: float,
) -> Axes:
    """Draw a row for each touch: the reading, the patches of the candidates, and the belief after it.

    The axes of the first reading are returned.
    """
    depth, nearest = _render_candidates([record.meshes[i] for i in candidates], record.T_w_t[touches])
    colours = touch_colours(len(record.p))
    panels = part.subplots(len(touches), len(widths), width_ratios=widths, squeeze=False)
    for row, touch in enumerate(touches):
        measured, *patches, bars = panels[row]
        _draw_measured(measured, record, touch, scale, colours[touch])
        for i, panel in enumerate(patches):
            image = _draw_candidate(panel, depth[row, i], float(nearest[row, i]))
        _draw_belief(bars, record.p[touch], record.names, candidates, record.truth)
        if touch < touches[-1]:
            bars.set_xticklabels([])
    panels[0, 0].set_title("measured", fontsize=FONT)
    panels[0, -1].set_title("belief", fontsize=FONT)
    for panel, candidate in zip(panels[0, 1:-1], candidates, strict=True):
        true = candidate == record.truth
        label = record.names[candidate] + (" (true)" if true else "")
        panel.set_title(label, fontsize=FONT, fontweight="bold" if true else "normal")
    bar = part.colorbar(image, ax=panels[:, :-1].ravel().tolist(), location="bottom", shrink=0.6, aspect=30, pad=0.02)
    bar.set_label("depth behind the nearest point (mm)", fontsize=FONT)
    bar.ax.tick_params(labelsize=FONT)
    return panels[0, 0]


def _draw_evidence(axes: Axes, record: EpisodeRecord, touches: Sequence[int]) -> None:
    """Draw the weights of evidence (nats) of each touch, stacked from zero to either side, with their sums."""
    first, second = record.leaders
    weights = record.weights[touches]
    rows = np.arange(len(touches))
    left, right = np.zeros(len(rows)), np.zeros(len(rows))
    for (name, colour), weight in zip(EVIDENCE_SOURCES.items(), weights.T, strict=True):
        axes.barh(rows, weight, 0.7, left=np.where(weight < 0, left, right), color=colour, label=name)
        left, right = left + np.minimum(weight, 0), right + np.maximum(weight, 0)
    for row, total in enumerate(weights.sum(1)):
        axes.text(right[row], row, f" {total:+.1f}", va="center", fontsize=FONT)
    axes.axvline(0, color="black", lw=0.8)
    axes.set_yticks(rows, [f"touch {touch + 1}" for touch in touches], fontsize=FONT)
    axes.invert_yaxis()
    span = right.max() - left.min()
    axes.set_xlim(left.min() - 0.03 * span, right.max() + 0.25 * span)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.tick_params(axis="x", labelsize=FONT)
    axes.set_xlabel("nats", fontsize=FONT)
    axes.set_title(f"evidence for {record.names[first]} against {record.names[second]}", fontsize=FONT, pad=34)
    axes.legend(
        loc="lower center", bbox_to_anchor=(0.45, 0.97), ncols=2, fontsize=FONT, frameon=False, handlelength=0.8,
        columnspacing=0.8, handletextpad=0.3,
    )  # fmt: skip


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
        f"touch {touch + 1}", fontsize=FONT + 0.5, fontweight="bold", labelpad=6,
        color="white" if colour.mean() < 0.5 else "black",
        bbox={"facecolor": colour, "edgecolor": "none", "alpha": 0.8, "pad": 2.5},
    )  # fmt: skip


def _draw_candidate(axes: Axes, depth: np.ndarray, nearest: float) -> AxesImage:
    """Draw a candidate's patch at a touch, with the distance to its surface if the tool is outside it."""
    image = draw_patch(axes, depth, PATCH_WINDOW, REACH)
    axes.set(xticks=[], yticks=[])
    if not np.isfinite(nearest):
        axes.set_xlabel("no surface here", fontsize=FONT - 1, labelpad=2)
    elif nearest > 0:
        axes.set_xlabel(f"{nearest * MM_PER_M:.1f} mm away", fontsize=FONT - 1, labelpad=2)
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
            value + (-0.03 if inside else 0.03), y, f"{value:.0%}", va="center", fontsize=FONT - 0.5,
            ha="right" if inside else "left", color="white" if inside else "black",
        )  # fmt: skip
    axes.set_yticks(range(len(rows)), [name for name, *_ in rows], fontsize=FONT - 0.5)
    axes.invert_yaxis()
    axes.set(xlim=(0, 1), xticks=[0, 0.5, 1])
    axes.tick_params(axis="x", labelsize=FONT - 0.5)
