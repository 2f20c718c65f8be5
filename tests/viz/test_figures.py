"""Figures: they draw the given data and state its origin, and the core works without them."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from matplotlib.patches import Circle

from i2t import viz
from i2t.skin.boards import grid_board, reskin_board
from i2t.viz import scene, skins
from i2t.viz.clusters import TouchMap

BOARD = reskin_board()


def titles(figure) -> str:
    return " ".join([figure.get_suptitle(), *(axes.get_title() for axes in figure.axes)])


def test_the_core_imports_without_matplotlib_and_pyvista():
    code = """
import sys
for name in ("matplotlib", "pyvista", "sklearn"):
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
    assert "µT" in titles(figure)
    scale = skins.common_scale(np.stack([felt, felt / 2]))
    for row, axes in enumerate(figure.axes):
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


def test_a_missing_gl_is_reported_with_what_to_install(monkeypatch):
    monkeypatch.setattr(scene, "explain_no_scene", lambda: scene.NO_GL)
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    figure = viz.plot_object(vertices, faces, np.eye(4)[None], "An object", True)
    assert "libegl1" in figure.axes[0].texts[0].get_text()
    with pytest.raises(RuntimeError, match="libegl1"):
        viz.object_plotter(vertices, faces, np.eye(4)[None])
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.full
def test_a_scene_shows_object_and_skin_and_an_unknown_surface():
    """Before any touch there may be no surface at all; nothing is drawn then."""
    if scene.explain_no_scene():
        pytest.skip(scene.explain_no_scene())
    ball, T = trimesh.creation.icosphere(2, 30e-3), np.diag([1.0, -1, -1, 1])
    T[2, 3] = 30e-3
    figure = viz.plot_object(ball.vertices, ball.faces, T[None], "A ball", False)
    grey = np.ptp(figure.axes[0].images[0].get_array()[..., :3].astype(int), axis=-1) < 12
    assert 0.05 < grey.mean() < 1  # the skin's square is coloured, the object grey
    none, no_poses = np.zeros((0, 3)), np.zeros((0, 4, 4))
    stages = [
        viz.ShownSurface("0 touches", none, none.astype(int), np.zeros(0), no_poses),
        viz.ShownSurface("1 touch", ball.vertices, ball.faces, np.full(len(ball.vertices), 1e-3), np.eye(4)[None]),
    ]
    figure = viz.plot_growing_surface(stages, (ball.vertices, ball.faces), "A ball", True)
    assert "(simulated)" in figure.get_suptitle()
    drawn = [np.asarray(axes.images[0].get_array()) for axes in figure.axes[:2]]
    assert (drawn[0] >= 250).all()
    assert (drawn[1] < 250).any()


def test_every_training_has_its_curve_however_many_there_are():
    figure = viz.plot_training_curves(
        {f"network {i}": np.linspace(1, 0.5, 4) for i in range(9)}, "Training", "error", True
    )
    assert len(figure.axes[0].lines) == 9
    assert len(figure.axes[0].get_legend().texts) == 9
