"""The report of an episode: contents of its page and its scene, read back from the figures and from files."""

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from i2t import viz
from i2t.objects import catalogue
from i2t.patches.dimensions import REACH
from i2t.skin.boards import grid_board, reskin_board

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


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text"))]


def test_a_page_shows_what_was_touched_and_believed(meshes):
    """The page shows the patch of each candidate at the touch, the true patch, and the belief."""
    page = viz.plot_episode(record(meshes))
    patches = [axes for axes in page.axes if axes.images and axes.get_label() != "<colorbar>"]
    depth = np.array([axes.images[0].get_array() for axes in patches]).reshape(3, 2, 48, 48)
    np.testing.assert_allclose(depth[0], 0, atol=1e-4)  # mm, flat tops
    x = ((np.arange(48) + 0.5) / 48 - 0.5) * 17 + 26  # mm, tool x is world x
    for which, edge in ((0, 25), (1, 30)):  # of the hexagon it is 29.9 mm next to the corner
        np.testing.assert_allclose(depth[1, which, 24], np.where(x < edge, 0, REACH * 1e3), atol=1e-4)
    shown = texts(page)
    assert {"square (true)", "hexagon", "unknown", "touch 1", "touch 3", "90%", "5%", "no surface here"} <= set(shown)
    assert any(text.startswith("One episode: square (simulated)") for text in shown)


def test_many_touches_and_candidates_of_any_board_fit_on_a_page(meshes):
    p = np.full((20, 8), 0.05)
    p[:, 5] = 0.3
    many = record(
        [meshes[0]] * 8, names=[f"o{i}" for i in range(8)], T_w_t=np.tile(poses()[:1], (20, 1, 1)),
        board=grid_board(2, 2), readings=np.ones((20, 12)), p=p, truth=-1, simulated=False,
    )  # fmt: skip
    shown = texts(viz.plot_episode(many))
    assert [text for text in shown if text.startswith("touch")] == [f"touch {i}" for i in (1, 5, 9, 12, 16, 20)]
    assert {"o5", "unknown"} <= set(shown)  # 0.35 is left
    assert any(text.startswith("One episode: an unknown object, drawn on the o5") for text in shown)
    assert not any("(true)" in text for text in shown)


def test_the_evidence_is_stacked_by_source_from_zero_to_either_side(meshes, tmp_path):
    """Bars of the weights of evidence for the most probable object against the next one, and their sums."""
    evidence = np.zeros((3, 2, 4))
    evidence[:, 0] = [(2, 1, 0, 0), (3, -1, 0.5, -1), (0, 0, -4, 0)]
    evidence[:, 1] = [(1, 0, 0, 0), (0, 0, 0, 0), (0, 0, 0, 0)]
    page = viz.plot_episode(record(meshes, evidence=evidence))
    (axes,) = [axes for axes in page.axes if axes.get_title().startswith("evidence")]
    assert axes.get_title() == "evidence for square against hexagon"
    spans = {}
    for bars in axes.containers:
        spans[bars.get_label()] = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars]
    assert spans == {
        "reading": [(0, 1), (0, 3), (0, 0)],
        "position": [(1, 2), (0, -1), (0, 0)],
        "presence": [(2, 2), (3, 3.5), (0, -4)],
        "calibration": [(2, 2), (-1, -2), (0, 0)],
    }
    assert [text.get_text().strip() for text in axes.texts] == ["+2.0", "+1.5", "-4.0"]
    with pytest.raises(ValueError, match="must have 4 sources for each of the 3 touches and 2 candidates"):
        viz.write_episode_report(record(meshes, evidence=evidence[:, :1]), tmp_path)


@pytest.mark.full
def test_a_written_page_shows_the_object_and_its_touches(meshes, tmp_path):
    (written,) = viz.write_episode_report(record(meshes), tmp_path / "a")
    assert list((tmp_path / "a").iterdir()) == [written] == [tmp_path / "a" / "story.png"]
    page = viz.plot_episode(record(meshes), scene=True)
    scene = next(axes for axes in page.axes if [text.get_text() for text in axes.texts] == ["1", "2", "3"])
    colours = np.unique(scene.images[0].get_array().reshape(-1, 3)[::7], axis=0)
    assert len(colours) > 50  # shaded faces and coloured squares
    with pytest.raises(ValueError, match="same number of touches"):
        viz.write_episode_report(record(meshes, readings=np.ones((2, 15))), tmp_path)
