"""Figures for people: they draw what they are given and say where it comes from, and the core does without them."""

import subprocess
import sys

import numpy as np
import pytest

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


def test_a_common_scale_is_above_nearly_all_fields_and_round():
    readings = np.zeros((20, 15))
    readings[:, 0] = 37.2
    assert skins.common_scale(readings) in (37.0, 38.0)
    assert skins.common_scale(np.zeros((3, 15))) == 1


@pytest.mark.parametrize("simulated", [True, False])
def test_field_vectors_have_one_scale_and_the_length_it_says(simulated):
    felt = np.zeros((2, 15))
    felt[0, 2], felt[1, 2] = 40.0, 20.0  # z of chip 0, whose axes are the tool's
    figure = viz.plot_readings(BOARD, {"felt": felt, "imagined": felt / 2}, ["one", "two"], "Touches", simulated)
    assert len(figure.axes) == 2
    assert ("simulated" in titles(figure)) == simulated
    assert "µT" in titles(figure)
    scale = skins.common_scale(np.stack([felt, felt / 2]))
    for row, axes in enumerate(figure.axes):
        arrows = axes.collections[0]._segments3d  # the felt ones; shafts come first
        assert np.ptp(np.asarray(arrows[0])[:, 2]) == pytest.approx(felt[row, 2] * skins.ARROW_MM / scale, rel=1e-6)


@pytest.mark.parametrize("side", [2, 4])
def test_every_chip_of_any_board_has_its_arrow(side):
    board, chips = grid_board(side, side), side**2
    readings = np.random.default_rng(0).normal(size=(2, 3 * chips))
    figure = viz.plot_readings(board, {"measured": readings}, ["one", "two"], "Touches", True)
    assert f"the {chips} chips" in titles(figure)
    assert [len(axes.collections[0]._segments3d) for axes in figure.axes] == [3 * chips] * 2  # a shaft and two barbs
    patches = np.zeros((2, 48, 48))
    pair = {"measured": readings, "predicted": 0.5 * readings}
    figure = viz.plot_predicted_touches(patches, pair, ["one", "two"], board, "Touches", True)
    arrows = [artist.N for axes in figure.axes for artist in axes.collections if hasattr(artist, "U")]
    assert arrows == [chips] * 4  # two touches, measured and predicted
    errors = viz.plot_channel_errors({"a": np.ones(3 * chips)}, np.ones(3 * chips), "Errors", True)
    assert [label.get_text() for label in errors.axes[0].get_xticklabels()][-1] == f"{chips - 1}z"
    pressure = np.ones((9, 9))
    press = viz.plot_press(pressure, 1e-4 * pressure, board, readings[0], "A press", True)
    assert len(press.axes[2].collections[0]._segments3d) == 3 * chips
    touch_map = TouchMap(
        np.random.default_rng(1).normal(size=(4, 2)), np.arange(4) % 2, np.eye(2), np.eye(2, 1, dtype=int)
    )
    views = viz.TouchViews(np.zeros((4, 3, 3)), 17e-3, "mask")
    clusters = viz.plot_clusters(touch_map, views, np.ones((4, 3 * chips)), "wxyz", board, title="C", simulated=True)
    assert [a.N for axes in clusters.axes for a in axes.collections if hasattr(a, "U")] == [chips] * 4


def test_masks_are_what_lies_within_the_tolerance():
    depth = np.full((1, 48, 48), 4e-3)
    depth[0, :10] = 0.0
    depth[0, 10:20] = 1.4e-3
    figure = viz.plot_patches(depth, ["edge"], "Patch", True)
    assert figure.axes[1].images[0].get_array().sum() == 20 * 48
    assert "mm" in figure.axes[-1].get_ylabel()  # the colour bar


def test_confusions_show_shares_of_what_was_there():
    figure = viz.plot_confusions({"method": np.array([[8, 2], [5, 15]])}, ["a", "b"], "Which?", False)
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts == ["0.80", "0.20", "0.25", "0.75"]
    assert "76.7% right" in figure.axes[0].get_title()


def test_press_maps_are_in_kilopascals_and_millimetres():
    pressure, pushed = np.full((20, 20), 3e3), np.full((20, 20), 2e-4)
    figure = viz.plot_press(pressure, pushed, BOARD, np.ones(15), "A press", True)
    assert figure.axes[0].images[0].get_array().max() == pytest.approx(3.0)
    assert figure.axes[1].images[0].get_array().max() == pytest.approx(0.2)


@pytest.mark.full
def test_every_other_figure_can_be_written(tmp_path):
    rng = np.random.default_rng(0)
    label = np.arange(40) % 5
    at, felt = rng.normal(size=(40, 2)), rng.normal(size=(40, 15))
    touch_map = TouchMap(at, label, at[:5], np.arange(5)[:, None])
    views = viz.TouchViews(rng.uniform(size=(40, 8, 8)), 17e-3, "mask")
    clusters = viz.plot_clusters(touch_map, views, felt, ["x"] * 40, BOARD, title="Clusters", simulated=True)
    rows = np.array([[0.5, 0.9, 0.8, 1.0], [1.0, 0.7, 0.6, 0.8]])
    groups = {"random": {"a": [0.5, 0.4, 0.6], "b": [0.7, np.nan, np.nan]}, "angle": {"a": [0.3, 0.2, 0.4]}}
    made = [
        clusters,
        viz.plot_rates_by_size({"a": rows}, "Noise", "noise", "right", True),
        viz.plot_rates(groups, "Which?", "right", 0.2, True),
        viz.plot_predictions(felt[:, 0], felt[:, 1], np.ones(40), "Chip 0, x", False),
        viz.plot_skin_map(rng.normal(size=(9, 9)), 20e-3, "field (µT)", "Map", False),
    ]
    for i, figure in enumerate(made):
        assert viz.save_figure(figure, tmp_path / f"{i}.png").stat().st_size > 5000
    assert "simulated" in titles(clusters)
    assert "simulated" not in titles(made[-1])


def test_without_gl_a_picture_says_what_to_install(monkeypatch):
    monkeypatch.setattr(scene, "why_no_scene", lambda: scene.NO_GL)
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    figure = viz.plot_object(vertices, faces, np.eye(4)[None], "An object", True)
    assert "libegl1" in figure.axes[0].texts[0].get_text()
    with pytest.raises(RuntimeError, match="libegl1"):
        viz.object_plotter(vertices, faces, np.eye(4)[None])
    still = viz.interactive(lambda: pytest.fail("no plotter without GL"), lambda: figure)
    assert still._repr_png_().startswith(b"\x89PNG")


@pytest.mark.full
def test_a_scene_shows_the_object_and_the_skin():
    if scene.why_no_scene():
        pytest.skip(scene.why_no_scene())
    corners = np.array([[0, 0, 0], [30e-3, 0, 0], [0, 30e-3, 0], [30e-3, 30e-3, 0]])
    T = np.diag([1.0, -1, -1, 1])
    T[:3, 3] = [15e-3, 15e-3, 0]
    figure = viz.plot_object(corners, np.array([[0, 1, 2], [1, 3, 2]]), T[None], "A sheet", False)
    picture = figure.axes[0].images[0].get_array()
    grey = np.ptp(picture[..., :3].astype(int), axis=-1) < 12
    assert 0.05 < (~grey).mean() < 0.9  # the skin's square is coloured, the object grey


def test_an_interactive_page_is_quoted():
    shown = scene.InteractiveScene('<p class="x">&</p>', "A scene (simulated)")._repr_html_()
    assert "A scene (simulated)" in shown
    assert 'srcdoc="&lt;p class=&quot;x&quot;&gt;&amp;&lt;/p&gt;"' in shown
