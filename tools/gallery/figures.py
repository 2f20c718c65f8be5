"""Figures of the documents, one function each, here and in the imported modules; simulated data are labelled."""

import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import i2t
from experiments.recognize import live
from experiments.recognize.arguments import LiveArgs
from i2t import viz
from i2t.patches.dimensions import PATCH_WINDOW
from i2t.rendering.render import contact_mask
from i2t.skin.elasticity import GRID, interior, load
from i2t.viz.episode_report import EpisodeRecord
from i2t.viz.skins import common_scale, margin_mm
from i2t.viz.style import MM_PER_M, Colour, titled
from tools.gallery.arguments import FigureName
from tools.gallery.lab_figures import monitor, registration, rig
from tools.gallery.page_figures import from_depth, stamps
from tools.gallery.story import HIDDEN_OBJECT, Draw, Story

PATCH_OBJECTS = ("star", "pyramid", "cylinder", "screwdriver", "hammer")
DOCS = Path(__file__).parents[2] / "docs"


def overview(story: Story) -> Figure:
    """From an object to a belief: patch, predicted and measured reading, and the belief after each touch."""
    record, touches, row = story.episode, story.unseen, story.typical
    width, height, low, edge = 9.4, 3.4, 1.05, 1.5  # inches; the panels are squares
    figure = Figure(figsize=(width, height))
    figure.text(0.5, 0.97, titled("i2t: imagine a touch before making it", True), ha="center", va="top", fontsize=12)
    left, patch, bar, *readings, belief = (
        figure.add_axes((x / width, low / height, w / width, edge / height))
        for x, w in ((0.0, 1.75), (1.95, edge), (3.52, 0.1), (4.15, edge), (5.75, edge), (7.85, 0.75))
    )
    mesh = record.meshes[record.truth]
    viz.draw_object(left, mesh.vertices, mesh.faces, story.typical_pose[None], numbers=False)
    image = viz.draw_patch(patch, touches.patch[row])
    figure.colorbar(image, cax=bar).set_label("depth (mm)", fontsize=10)
    _outline(patch, np.asarray(contact_mask(jnp.asarray(touches.patch[row]))))
    patch.set(xticks=[], yticks=[])
    viz.draw_length(patch)
    _draw_readings(readings, figure.add_axes((0, 0.02, 0.9, 0.18)), story)
    _draw_beliefs(belief, record)
    titles = (
        f"1  {HIDDEN_OBJECT}, not\nin the training set", "2  depth patch\nunder the skin", "3  predicted\nreading",
        "4  measured\nreading", "5  which\nobject?",
    )  # fmt: skip
    for axes, title in zip((left, patch, *readings, belief), titles, strict=True):
        axes.set_title(title, fontsize=10)
    chosen = f"touch {row + 1} of {len(story.cosines)}, the median by cosine similarity ({story.cosines[row]:.2f})"
    figure.text(5.7 / width, 0.8 / height, chosen, ha="center", fontsize=9)
    return figure


def patches(story: Story) -> Figure:
    """Patches of five objects, and the contact of a skin with them."""
    depth = []
    for number, name in enumerate(PATCH_OBJECTS):
        mesh = i2t.make_object(name).mesh
        T_o_t = i2t.sample_touch_sites(mesh, 1, seed=number).T_o_t[0]
        depth.append(i2t.render_patch(i2t.prepare_surface(mesh), T_o_t).depth)
    return viz.plot_patches(np.stack(depth), PATCH_OBJECTS, "Patches at random safe sites", True)


def press(story: Story) -> Figure:
    """A ball pressed into the skin: pressure, displacement, reading."""
    pad = i2t.nominal_pad()
    squared = (GRID.centres[None, :] - 3e-3) ** 2 + GRID.centres[:, None] ** 2
    pressed = i2t.press(pad, squared / (2 * 4e-3), 0.4e-3)
    moved, _ = interior(pad, load(pad, pressed.pressure), 0.0)
    return viz.plot_press(
        np.asarray(pressed.pressure), -np.asarray(moved[2]), pad.board, np.asarray(pressed.reading),
        "A ball of 4 mm radius, 0.4 mm deep", True,
    )  # fmt: skip


def episode(story: Story) -> Figure:
    """Episode of `python -m experiments.recognize live`: touches, patches of the candidates, belief and evidence."""
    with TemporaryDirectory() as folder:
        _, record = live.play(LiveArgs(out=Path(folder), pad_model=Path("nominal")))
    return viz.plot_episode(record, scene=True)


def calibration_curve(story: Story) -> Figure:
    """Accuracy on left-out blocks of a real skin by number of calibration presses (docs/results/calibrate.json)."""
    measured = json.loads((DOCS / "results" / "calibrate.json").read_text())
    curves, with_intervals = (measured[name]["blocks of 6 mm"] for name in ("r2", "calibrate_over_blocks"))
    counts = [int(count) for count in with_intervals["r2"]]
    figure = Figure(figsize=(6.5, 4), layout="constrained")
    axes = figure.subplots()
    for name, style in {"k nearest presses": ":", "plain Gaussian process": "--", "i2t.calibrate": "-"}.items():
        colour = Colour.BLUE if name == "i2t.calibrate" else Colour.GREY
        axes.plot(
            counts,
            [interval["mean"] for interval in curves[name].values()],
            style,
            color=colour,
            marker="o",
            label=name,
        )
    low, high = np.array([[interval["low"], interval["high"]] for interval in with_intervals["r2"].values()]).T
    axes.fill_between(counts, low, high, color=Colour.BLUE, alpha=0.18, lw=0)
    axes.set_xscale("log")
    axes.set_xticks(counts, [str(count) for count in counts], minor=False)
    axes.set(xlabel="calibration presses", ylabel="R² on presses of left-out blocks", ylim=(-0.65, 1))
    axes.axhline(0, color="black", lw=0.8)
    axes.legend(loc="lower right")
    axes.set_title("Calibration of a real skin, 95 % intervals over blocks")
    return figure


def predictors(story: Story) -> Figure:
    """R² of all predictors of the run on unknown objects."""
    methods = json.loads((story.finished.folder / "metrics.json").read_text())["methods"]
    names = list(methods)
    r2 = np.array([methods[name]["r2"] for name in names])
    low, high = np.array(
        [methods[name]["r2_interval"] for name in names], float
    ).T  # missing intervals (too few sessions) become NaN
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    axes = figure.subplots()
    colours = [Colour.BLUE if "pressure" in name else Colour.GREY for name in names]
    axes.barh(names, r2, xerr=np.maximum([r2 - low, high - r2], 0), color=colours, capsize=2)
    axes.invert_yaxis()
    axes.axvline(0, color="black", lw=0.8)
    axes.set_xlabel("R² on unknown objects, 95 % intervals over sessions")
    axes.set_title(titled("Predictors", True))
    return figure


# --- pieces ---


def _outline(axes: Axes, mask: np.ndarray) -> None:
    half = MM_PER_M * PATCH_WINDOW / 2
    at = np.linspace(-half, half, len(mask))
    axes.contour(at, at, mask, levels=[0.5], colors="white", linewidths=1.2)


def _draw_readings(panels: Sequence[Axes], key: Axes, story: Story) -> None:
    """Draw the predicted and the measured reading of the typical touch on one scale, and their key."""
    board, row = story.run.dataset.board, story.typical
    predicted, measured = story.predicted.mean[row], story.unseen.reading[row]
    scale = common_scale(np.stack([predicted, measured]))
    margin = margin_mm(board, np.stack([predicted, measured]), scale, std=np.tile(story.predicted.std[row], (2, 1)))
    for axes, reading, std in zip(panels, (predicted, measured), (story.predicted.std[row], None), strict=True):
        viz.draw_skin(axes, margin)
        viz.draw_chip_numbers(axes, board)
        viz.draw_reading(axes, board, reading, scale, std=std)
        axes.set(xticks=[], yticks=[], frame_on=False)
    viz.draw_key(key, panels[0], board, scale, std=True, columns=4)


def _draw_beliefs(axes: Axes, record: EpisodeRecord) -> None:
    """Draw each object's probability after each touch."""
    n = len(record.names)
    p = np.vstack([np.full(n, 1 / n), record.p])
    for i in np.argsort(np.arange(n) == record.truth):
        true = i == record.truth
        axes.plot(
            p[:, i], color=Colour.BLUE if true else Colour.GREY, lw=2.5 if true else 1, marker="o" if true else ""
        )
    likely = [i for i in range(n) if p[-1, i] > 0.04]  # less has no room for a name
    ends = [(record.names[i], p[-1, i]) for i in likely]
    for name, end in ends if len(likely) == n else [*ends, (f"{n - len(likely)} others", 0.0)]:
        axes.annotate(name, (len(p) - 1, end), xytext=(7, 0), textcoords="offset points", fontsize=9, va="center")
    axes.set(xlabel="touches", ylabel="probability", ylim=(-0.02, 1.05), xlim=(0, len(p) - 1), xticks=range(len(p)))
    axes.set_yticks([0, 0.5, 1])
    axes.spines[["top", "right"]].set_visible(False)


FIGURES: dict[FigureName, Draw] = {
    "overview": overview, "patches": patches, "press": press, "episode": episode,
    "calibration_curve": calibration_curve, "predictors": predictors, "registration": registration, "rig": rig,
    "monitor": monitor, "from_depth": from_depth, "stamps": stamps,
}  # fmt: skip
