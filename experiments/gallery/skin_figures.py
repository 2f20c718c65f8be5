"""Figures of one skin: pressure below objects, the field below a press, and whether predicted spreads are right."""

import json
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import i2t
from experiments.gallery.story import Story
from i2t import viz
from i2t.calibration.physics import RoundTip
from i2t.geometry import inverse
from i2t.rendering.render import render_heights
from i2t.skin.boards import grid_board
from i2t.skin.contact import MAX_HEIGHT_M
from i2t.skin.dipoles import response
from i2t.skin.elasticity import GRID
from i2t.skin.pad import press_force
from i2t.types import PAD_WINDOW, ReturnCode
from i2t.viz.skins import common_scale
from i2t.viz.style import BLUE, COLOURS, GREY, KPA_PER_PA, MARKERS, MM_PER_M, titled

PRESSED = ("stamp-T", "stamp-triangle", "pyramid", "cylinder", "screwdriver")
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])  # T_o_t of a skin over a stamp
PRESSING_FORCE_N = 2.0
FIELD_CHIPS = 15  # along an edge of the board that shows the field
FIELD_SPAN = 0.9  # of the skin's edge, which that board covers
FIELD_BALL = RoundTip("sphere", 4e-3)  # that presses there
FIELD_PLACE_M = (3e-3, -2e-3)
FIELD_DEPTH_M = 3e-4
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)  # of values, which an interval should hold


def pressures(story: Story) -> Figure:
    """Five objects pressed on the skin with 2 N each, and the pressure below them."""
    pad = i2t.nominal_pad()
    figure = Figure(figsize=(13, 5.4), layout="constrained")
    figure.suptitle(titled(f"Patch and pressure of five objects, {PRESSING_FORCE_N:g} N each", True))
    panels = figure.subplots(2, len(PRESSED))
    for number, (name, column) in enumerate(zip(PRESSED, panels.T, strict=True)):
        mesh = i2t.make_object(name).mesh
        surface = i2t.prepare_surface(mesh)
        T_o_t = LOOKING_DOWN if name.startswith("stamp") else i2t.sample_touch_sites(mesh, 1, seed=number).T_o_t[0]
        patch = i2t.render_patch(surface, T_o_t)
        heights = render_heights(surface, jnp.asarray(inverse(T_o_t), jnp.float32), PAD_WINDOW, GRID.cells)
        pressed = press_force(pad, jnp.minimum(heights - heights.min(), MAX_HEIGHT_M), PRESSING_FORCE_N)
        depth = viz.draw_patch(column[0], patch.depth)
        below = viz.draw_map(column[1], np.asarray(pressed.pressure) * KPA_PER_PA, PAD_WINDOW, low=0)
        column[0].set_title(f"{name}\n{MM_PER_M * float(pressed.indentation):.2f} mm deep", fontsize=10)
        column[1].set_xlabel("x (mm)")
        figure.colorbar(below, ax=column[1], shrink=0.8, location="bottom", label="kPa")
    figure.colorbar(depth, ax=panels[0], label="mm behind the nearest point", shrink=0.8)
    panels[0, 0].set_ylabel("patch: y (mm)")
    panels[1, 0].set_ylabel("pressure: y (mm)")
    return figure


def field(story: Story) -> Figure:
    """The field below the skin, at rest and how a ball changes it, between the five chips that measure it."""
    board = grid_board(FIELD_CHIPS, FIELD_CHIPS, FIELD_SPAN * PAD_WINDOW / FIELD_CHIPS)
    pad = i2t.nominal_pad(board=board)
    pressed = i2t.press(i2t.nominal_pad(), FIELD_BALL.height(np.array(FIELD_PLACE_M), GRID), FIELD_DEPTH_M)

    def row(chips: jax.Array) -> jax.Array:
        """The change at the chips of one row of the board."""
        part = i2t.Board(chips, jnp.asarray(pad.board.rotations)[: len(chips)])
        return response(pad._replace(board=part, gains=jnp.ones(part.num_readings)), pressed.pressure)

    rows = jnp.asarray(pad.board.chips).reshape(FIELD_CHIPS, FIELD_CHIPS, 3)
    change = np.asarray(jax.lax.map(row, rows)).reshape(-1, 3)
    x, y = np.asarray(pad.board.chips)[:, :2].T * MM_PER_M
    chips = np.asarray(i2t.reskin_board().chips)[:, :2].T * MM_PER_M
    figure = Figure(figsize=(6.6, 5.4), layout="constrained")
    axes = figure.subplots()
    top = float(np.abs(change[:, 2]).max())
    span = FIELD_SPAN * PAD_WINDOW
    image = viz.draw_map(axes, change[:, 2].reshape(FIELD_CHIPS, FIELD_CHIPS), span, cmap="PuOr", low=-top, high=top)
    figure.colorbar(image, ax=axes, label="change of the field out of the skin (µT)", shrink=0.9)
    scale = common_scale(change)
    arrows = axes.quiver(x, y, *change[:, :2].T, angles="xy", scale_units="xy", scale=scale / 1.5, width=0.004)
    axes.quiverkey(arrows, 0.8, 1.03, scale, f"{scale:g} µT along the skin", labelpos="W")
    axes.plot(*chips, "o", mfc="none", mec="black", ms=11, mew=1.5, ls="", label="chips of a ReSkin board")
    axes.plot(
        *(MM_PER_M * np.array(FIELD_PLACE_M)),
        "+",
        color="black",
        ms=12,
        mew=1.5,
        ls="",
        label="lowest point of the ball",
    )
    axes.set(xlabel="x (mm)", ylabel="y (mm)", xlim=(-500 * span, 500 * span), ylim=(-500 * span, 500 * span))
    axes.legend(loc="upper left", fontsize=8, bbox_to_anchor=(0, -0.1), ncols=2, frameon=False)
    axes.set_title(titled("The field below a ball, 0.3 mm deep", True) + "\n", fontsize=11)
    return figure


def reliability(story: Story) -> Figure:
    """Share of felt values within the intervals that the predictor states, on objects it was not trained on."""
    dataset, trained_on = story.run.dataset, json.loads((story.folder / "config.json").read_text())
    test = [dataset.objects.index(name) for name in trained_on["experiment"]["simulation"]["test"]]
    unseen = dataset.select(np.isin(dataset.touches.object, test) & (dataset.touches.code != ReturnCode.AIR))
    imagined = story.imagine(unseen.touches)
    away = np.abs(unseen.touches.reading - imagined.mean) / imagined.std
    widths = np.array([NormalDist().inv_cdf((1 + share) / 2) for share in SHARES])
    inside = away[..., None] < widths
    figure = Figure(figsize=(6.5, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=GREY, lw=1, ls="--", label="as stated")
    for number, index in enumerate(test):
        measured = inside[unseen.touches.object == index].mean((0, 1))
        colour, marker = COLOURS[1 + number % (len(COLOURS) - 1)], MARKERS[number % len(MARKERS)]
        axes.plot(SHARES, measured, ms=3, lw=0.8, color=colour, marker=marker, label=dataset.objects[index])
    axes.plot(SHARES, inside.mean((0, 1)), color=BLUE, lw=2.5, label="all")
    axes.set(
        xlabel="share of values that an interval should hold", ylabel="share that it holds", xlim=(0, 1), ylim=(0, 1)
    )
    axes.legend(fontsize=8, loc="lower right")
    axes.set_title(titled("Reliability of predicted readings on unseen objects", True), fontsize=11)
    return figure
