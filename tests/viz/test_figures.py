"""Figures: they draw the given data and state its origin, and the core works without them."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, FancyArrow
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from scipy.spatial.transform import Rotation

from i2t import viz
from i2t.skin.boards import grid_board, reskin_board
from i2t.types import Board
from i2t.viz import skins
from i2t.viz.clusters import TouchMap

BOARD = reskin_board()


def titles(figure) -> str:
    return " ".join([figure.get_suptitle(), *(axes.get_title() for axes in figure.axes)])


def test_the_core_imports_without_matplotlib():
    code = """
import sys
for name in ("matplotlib", "sklearn"):
    sys.modules[name] = None
import i2t, i2t.viz.clusters, i2t.viz.agreement, i2t.types, i2t.dataset
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize("simulated", [True, False])
def test_field_vectors_share_one_round_scale_and_have_its_length(simulated):
    felt = np.zeros((2, 15))
    felt[0, 2], felt[1, 2] = 40.0, 20.0  # z of chip 0, whose axes are the tool's
    figure = viz.plot_readings(BOARD, {"felt": felt, "imagined": felt / 2}, ["one", "two"], "Touches", simulated)
    assert ("simulated" in titles(figure)) == simulated
    *panels, key = figure.axes
    assert any("µT along skin" in text.get_text() for text in key.findobj(Text))
    scale = skins.common_scale(np.stack([felt, felt / 2]))
    for row, axes in enumerate(panels):
        disc = next(part for part in axes.patches if isinstance(part, Circle))  # of the felt reading, at chip 0
        assert 2 * disc.radius == pytest.approx(felt[row, 2] * skins.ARROW_MM / scale, rel=1e-6)
    readings = np.zeros((20, 15))
    readings[:, 0] = 37.2
    assert skins.common_scale(readings) in (37.0, 38.0)
    assert skins.common_scale(np.zeros((3, 15))) == 1


@pytest.mark.parametrize("side", [2, 4])
def test_every_chip_of_any_board_has_its_arrow(side):
    board, chips = grid_board(side, side), side**2
    readings = np.random.default_rng(0).normal(size=(2, 3 * chips))
    figure = viz.plot_readings(board, {"measured": readings}, ["one", "two"], "Touches", True)
    assert [part.N for axes in figure.axes for part in axes.collections if hasattr(part, "U")] == [chips] * 2
    pair = {"measured": readings, "predicted": 0.5 * readings}
    figure = viz.plot_predicted_touches(np.zeros((2, 48, 48)), pair, ["one", "two"], board, "Touches", True)
    assert [part.N for axes in figure.axes for part in axes.collections if hasattr(part, "U")] == [chips] * 4


@pytest.mark.full
def test_every_other_figure_can_be_written(tmp_path):
    rng = np.random.default_rng(0)
    at, felt = rng.normal(size=(40, 2)), rng.normal(size=(40, 15))
    touch_map = TouchMap(at, np.arange(40) % 5, at[:5], np.arange(5)[:, None])
    views = viz.TouchViews(rng.uniform(size=(40, 8, 8)), 17e-3, "mask")
    groups = {"random": {"a": [0.5, 0.4, 0.6], "b": [0.7, np.nan, np.nan]}, "angle": {"a": [0.3, 0.2, 0.4]}}
    made = [
        viz.plot_clusters(touch_map, views, felt, ["x"] * 40, BOARD, title="Clusters", simulated=True),
        viz.plot_press(np.full((20, 20), 3e3), np.full((20, 20), 2e-4), BOARD, np.ones(15), "A press", True),
        viz.plot_patches(rng.uniform(0, 4e-3, (1, 48, 48)), ["edge"], "Patch", True),
        viz.plot_rates(groups, "Which?", "right", 0.2, True),
        viz.plot_predictions(felt[:, 0], felt[:, 1], np.ones(40), "Chip 0, x", False),
        viz.plot_confusions({"method": np.array([[8, 2], [5, 15]])}, ["a", "b"], "Which?", False),
        viz.plot_skin_map(felt[:9, :9], 20e-3, "field (µT)", "Map", False),
    ]
    for i, figure in enumerate(made):
        assert viz.save_figure(figure, tmp_path / f"{i}.png").stat().st_size > 5000
    assert ["simulated" in titles(figure) for figure in made] == 4 * [True] + 3 * [False]


@pytest.mark.full
def test_a_scene_shows_object_and_squares_and_an_empty_surface():
    """Before any touch there may be no surface at all; nothing is drawn then."""
    ball, T = trimesh.creation.icosphere(3, 30e-3), np.diag([1.0, -1, -1, 1])
    T[2, 3] = 30e-3
    (axes,) = viz.plot_object(ball.vertices, ball.faces, T[None], "A ball", False).axes
    picture = np.asarray(axes.images[0].get_array())
    grey = np.ptp(picture, axis=-1) < 0.05
    width = np.ptp(np.nonzero((picture < 1).any(-1))[1]) / 60  # pixels for each mm of the ball
    seen = 20**2 / np.sqrt(1 + 0.6**2 + 1)  # mm^2, the square from a direction of z 1 in (0.6, 1, 1)
    assert (~grey).sum() / width**2 == pytest.approx(seen, rel=0.05)
    assert [text.get_text() for text in axes.texts] == ["1"]
    hidden = T @ np.diag([1.0, -1, -1, 1])
    hidden[2, 3] = -30e-3  # below the ball: its edge shines through
    (axes,) = viz.plot_object(ball.vertices, ball.faces, hidden[None], "A ball", False).axes
    assert 0 < (np.ptp(axes.images[0].get_array(), axis=-1) > 0.05).sum() / width**2 < seen / 2
    none, no_poses = np.zeros((0, 3)), np.zeros((0, 4, 4))
    stages = [
        viz.ShownSurface("0 touches", none, none.astype(int), np.zeros(0), no_poses),
        viz.ShownSurface("1 touch", ball.vertices, ball.faces, np.full(len(ball.vertices), 1e-3), np.eye(4)[None]),
    ]
    figure = viz.plot_growing_surface(stages, (ball.vertices, ball.faces), "A ball", True)
    assert "(simulated)" in figure.get_suptitle()
    assert [len(axes.images) for axes in figure.axes[:3]] == [0, 1, 1]
    coloured, plain = (np.asarray(axes.images[0].get_array()) for axes in figure.axes[1:3])
    assert np.ptp(plain, axis=-1).max() < 0.01
    assert (np.ptp(coloured, axis=-1) > 0.3).mean() > 0.2


def test_deviations_are_as_long_as_the_field():
    """A chip turned by 30 degrees has an ellipse turned by 30 degrees; its normal axis stays."""
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    board = Board(np.array([[1e-3, 2e-3, -1e-3]]), turn[None])
    axes = Figure().subplots()
    skins.draw_reading(axes, board, np.array([6.0, 0, -8]), 20.0, std=np.array([3.0, 1, 2]))
    (tip,) = (part for part in axes.patches if type(part) is Ellipse)
    mm_per_ut = skins.ARROW_MM / 20
    np.testing.assert_allclose(tip.center, [1, 2] + 6 * mm_per_ut * turn[:2, 0])
    half_axes = sorted((tip.width / 2, tip.height / 2))
    np.testing.assert_allclose(half_axes, [1 * mm_per_ut, 3 * mm_per_ut])
    long = tip.angle + (90 if tip.height > tip.width else 0)
    assert long % 180 == pytest.approx(30)
    assert tip.get_hatch()
    disc, ring = (part for part in axes.patches if isinstance(part, Circle))
    assert (2 * disc.radius, 2 * ring.radius) == pytest.approx((8 * mm_per_ut, 10 * mm_per_ut))


def test_all_rings_and_arrows_are_within_the_limits():
    board = reskin_board()
    readings, std = np.tile([60.0, -5, 90], (2, 5)), np.tile([30.0, 30, 200], (2, 5))
    figure = viz.plot_predicted_touches(
        np.zeros((2, 48, 48)), {"predicted": readings}, ["flat"] * 2, board, "A box", True, std={"predicted": std}
    )
    skin = [axes for axes in figure.axes if any(isinstance(part, Circle) for part in axes.patches)]
    assert len(skin) == 2
    for axes in skin:
        box = Bbox.union([part.get_window_extent() for part in axes.patches])
        assert axes.bbox.padded(0.5).contains(*box.min)
        assert axes.bbox.padded(0.5).contains(*box.max)
    least = skins.margin_mm(board, np.zeros((1, 15)), 20.0)
    assert least == pytest.approx(2.5, abs=0.5)


def test_the_key_is_drawn_on_the_scale_of_the_readings():
    figure = Figure()
    skin, key = figure.subplots(2)
    board = grid_board(5, 5)  # chips 4 mm apart
    skins.draw_key(key, skin, board, 37.0, sets=("measured", "predicted"), std=True)
    texts = [text.get_text() for text in key.findobj(Text) if text.get_text()]
    assert texts[:3] == ["measured", "predicted", "20 µT along skin"]
    assert texts[-4:] == ["± 1 std along skin", "± 1 std out or in", "disc radius ∝ value", "0 to 24: chips"]
    arrow = next(part for part in key.findobj(FancyArrow))
    assert np.ptp(arrow.get_xy()[:, 0]) == pytest.approx(20 / 37 * 4)


@pytest.mark.full
def test_touches_of_a_box_on_a_board_of_one_chip_are_drawn(tmp_path):
    box, T = trimesh.creation.box((4e-3, 4e-3, 4e-3)), np.tile(np.diag([1.0, -1, -1, 1]), (8, 1, 1))
    T[:, 2, 3] = 2e-3
    figure = viz.plot_predicted_touches(
        np.zeros((8, 48, 48)), {"predicted": np.ones((8, 3))}, ["flat"] * 8, grid_board(1, 1), "A box", False,
        std={"predicted": np.ones((8, 3))}, mesh=box, T_o_t=T,
    )  # fmt: skip
    texts = [text.get_text() for text in figure.findobj(Text)]
    assert texts.count("8") == 2  # at the object and at the column
    assert texts.count("flat") == 8
    assert {"0: chip", "skin, 20 mm", "5 mm", "predicted\nreading"} <= set(texts)
    assert viz.save_figure(figure, tmp_path / "box.png").stat().st_size > 10_000


def test_every_training_has_its_curve_however_many_there_are():
    figure = viz.plot_training_curves(
        {f"network {i}": np.linspace(1, 0.5, 4) for i in range(9)}, "Training", "error", True
    )
    assert len(figure.axes[0].lines) == 9
    assert len(figure.axes[0].get_legend().texts) == 9
