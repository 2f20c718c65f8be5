"""The report of an episode: what its page and its scene show, read back from the figures and from files."""

from typing import Any

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from i2t import viz
from i2t.objects import catalogue
from i2t.skin.boards import grid_board, reskin_board
from i2t.types import PAD_WINDOW, REACH
from i2t.viz import episode_report, scene

NAMES = ("square", "hexagon")  # prisms 30 mm high: +-25 mm wide, and of circumradius 30 mm with flat sides at +-y
PRESSED = 0.4e-3
POSTERIOR = np.array([[0.3, 0.4], [0.7, 0.2], [0.9, 0.05]])


def poses() -> np.ndarray:
    """Three presses of 0.4 mm: on top, in the middle, and at x = 26 and y = 25 mm, where only one has a top."""
    T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (3, 1, 1))
    T[:, :3, 3] = [(0, 0, 0.03 - PRESSED), (26e-3, 0, 0.03 - PRESSED), (0, 60e-3, 0.03 - PRESSED)]
    return T


@pytest.fixture(scope="module")
def meshes():
    return [catalogue.make_object(name).mesh for name in NAMES]


def record(meshes: Any, **changes: Any) -> viz.EpisodeRecord:
    readings = np.random.default_rng(0).normal(size=(3, 15))
    usual = viz.EpisodeRecord(meshes, NAMES, poses(), readings, reskin_board(), POSTERIOR, 0, True)
    return usual._replace(**changes)


@pytest.fixture(scope="module")
def page(meshes) -> Figure:
    return viz.plot_episode(record(meshes))


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text"))]


def test_a_page_shows_the_patch_of_each_candidate_where_it_was_touched(page):
    patches = [axes for axes in page.axes if axes.images and axes.get_label() != "<colorbar>"]
    assert len(patches) == 6
    depth = np.array([axes.images[0].get_array() for axes in patches]).reshape(3, 2, 48, 48)
    np.testing.assert_allclose(depth[0], 0, atol=1e-4)  # mm, flat tops
    assert [axes.get_xlabel() for axes in patches[:2]] == ["0.4 mm deep"] * 2
    x = ((np.arange(48) + 0.5) / 48 - 0.5) * 17 + 26  # mm, tool x is world x
    np.testing.assert_allclose(depth[1, 0, 24], np.where(x < 25, 0, REACH * 1e3), atol=1e-4)
    expected = np.where(x < 30, 0, REACH * 1e3)  # 29.9 mm next to the corner
    np.testing.assert_allclose(depth[1, 1, 24], expected, atol=1e-4)
    assert [axes.get_xlabel() for axes in patches[4:]] == ["nothing here"] * 2


def test_a_page_shows_what_was_believed_after_each_touch(page):
    believed = [axes for axes in page.axes if axes.patches and axes.yaxis_inverted()]
    for axes, p in zip(believed, POSTERIOR, strict=True):
        np.testing.assert_allclose([bar.get_width() for bar in axes.patches], [*p, 1 - p.sum()])
        assert [label.get_text() for label in axes.get_yticklabels()] == [*NAMES, "unknown"]
    shown = texts(page)
    assert {"square (true)", "hexagon", "touch 1", "touch 3", "90%", "5%"} <= set(shown)
    assert any(text.startswith("One episode: square (simulated)") for text in shown)


def test_many_touches_and_candidates_fit_on_a_page(meshes):
    p = np.full((20, 8), 0.05)
    p[:, 5] = 0.3
    many = record(
        [meshes[0]] * 8, names=[f"o{i}" for i in range(8)], T_w_t=np.tile(poses()[:1], (20, 1, 1)),
        readings=np.ones((20, 15)), p=p, truth=6, simulated=False,
    )  # fmt: skip
    shown = texts(viz.plot_episode(many))
    assert [text for text in shown if text.startswith("touch")] == [f"touch {i}" for i in (1, 5, 9, 12, 16, 20)]
    assert {"o5", "o6 (true)", "3 others", "15%"} <= set(shown)
    assert "unknown" in shown  # 0.35 is left


def test_an_unknown_object_is_said_to_be_unknown(meshes):
    shown = texts(viz.plot_episode(record(meshes, p=POSTERIOR[:, ::-1], truth=-1, simulated=False)))
    assert any(text.startswith("One episode: an unknown object, drawn on the hexagon\n") for text in shown)
    assert not any("(true)" in text for text in shown)


def test_a_page_shows_the_readings_of_any_board(meshes):
    board = grid_board(2, 2)
    figure = viz.plot_episode(record(meshes, board=board, readings=np.ones((3, 12))))
    arrows = [artist for axes in figure.axes for artist in axes.collections if hasattr(artist, "U")]
    assert [artist.N for artist in arrows] == [4, 4, 4]


def test_a_machine_that_cannot_draw_is_asked_in_another_process(monkeypatch):
    scene.why_no_scene.cache_clear()
    with monkeypatch.context() as broken:
        broken.setattr(scene, "PROBE", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
        assert "libegl1" in scene.why_no_scene()
        scene.why_no_scene.cache_clear()
        broken.setattr(scene, "find_spec", lambda name: None)
        assert "pip install" in scene.why_no_scene()
    scene.why_no_scene.cache_clear()


def test_without_a_scene_the_page_is_written_all_the_same(meshes, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(episode_report, "why_no_scene", lambda: scene.NO_GL)
    written = viz.write_episode_report(record(meshes), tmp_path / "a")
    assert written == [tmp_path / "a" / "story.png"] == list((tmp_path / "a").iterdir())
    assert capsys.readouterr().err == scene.NO_GL + "\n"


def test_an_episode_of_unequal_lengths_is_refused(meshes, tmp_path):
    with pytest.raises(ValueError, match="same touches"):
        viz.write_episode_report(record(meshes, readings=np.ones((2, 15))), tmp_path)


@pytest.mark.full
def test_a_scene_holds_the_object_and_its_touches(meshes, tmp_path):
    if scene.why_no_scene():
        pytest.skip(scene.why_no_scene())
    written = viz.write_episode_report(record(meshes), tmp_path)
    assert [path.name for path in written] == ["story.png", "scene.png", "scene.gltf"]
    with Image.open(written[1]) as picture:
        colours = {tuple(pixel) for pixel in np.asarray(picture.convert("RGB")).reshape(-1, 3)[::7]}
    assert len(colours) > 100  # shaded faces and coloured squares, not an empty window

    # glTF has y up and looks along z: (y, z, x).
    found = [part for part in trimesh.load(written[2]).dump() if isinstance(part, trimesh.Trimesh)]
    body = max(found, key=lambda part: part.area)
    np.testing.assert_allclose(body.bounds, [[-25e-3, 0, -25e-3], [25e-3, 30e-3, 25e-3]], atol=1e-6)
    squares = [part for part in found if abs(part.area - PAD_WINDOW**2) < 1e-8]
    middles = sorted(tuple(part.bounds.mean(0).round(9) + 0.0) for part in squares)
    top = 0.03 - PRESSED + episode_report.SKIN_LIFT_M
    np.testing.assert_allclose(middles, [(0, top, 0), (0, top, 26e-3), (60e-3, top, 0)], atol=1e-6)
    assert len(found) == 1 + 3 * 3  # a body; squares, pins, digits
