"""What is drawn, read back from the figures: curves, bands, bars, counts, titles, patches; and scenes, from files."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from experiments.recognize import figures
from i2t.objects import catalogue
from i2t.recognition import metrics
from i2t.recognition.metrics import Estimate
from i2t.skin.boards import reskin_board
from i2t.types import PAD_WINDOW, REACH
from i2t.viz import story, touches


def estimate(mean: np.ndarray, half: float = 0.05) -> Estimate:
    return Estimate(mean, mean - half, mean + half)


METHODS = {"votes": estimate(np.array([0.3, 0.5, 0.6])), "belief": estimate(np.array([0.4, 0.8, 0.9]), 0.02)}


def every_figure(simulated: bool) -> list[Figure]:
    p = np.random.default_rng(0).dirichlet(np.ones(3), (40, 1))
    truth = np.arange(40) % 3
    told = metrics.reliability(metrics.confidence(p), metrics.hits(p, truth), 5)
    return [
        figures.accuracy(METHODS, "five objects", simulated, {"paper": 0.58}, 0.2),
        figures.reliability({"belief": told}, "five objects", simulated),
        figures.confusion(np.eye(3), ["a", "b", "c"], "five objects", simulated),
        figures.until_sure(METHODS, "five objects", simulated),
        figures.sensitivity({"default": {"belief": (0.9, 0.8, 1.0)}}, "five objects", "R", simulated),
    ]


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text"))]


@pytest.mark.parametrize("simulated", [True, False])
def test_a_title_says_where_the_touches_come_from(simulated):
    for figure in every_figure(simulated):
        assert ("five objects (simulated)" in texts(figure)) == simulated
        assert ("five objects" in texts(figure)) != simulated


def test_figures_can_be_written(tmp_path):
    for i, figure in enumerate(every_figure(True)):
        with Image.open(touches.save(figure, tmp_path / f"{i}.png")) as picture:
            assert len(np.unique(np.asarray(picture.convert("L")))) > 20  # lines, text and their edges


def test_accuracy_is_drawn_from_the_first_touch_with_its_interval():
    figure = figures.accuracy(METHODS, "", True, {"paper, tools": 0.7})
    axes = figure.axes[0]
    for (name, (mean, low, high)), line, band in zip(METHODS.items(), axes.lines, axes.collections, strict=True):
        assert line.get_label() == name
        np.testing.assert_array_equal(line.get_xdata(), [1, 2, 3])
        np.testing.assert_array_equal(line.get_ydata(), mean)
        x, y = band.get_paths()[0].vertices.T
        for touch in (1, 2, 3):
            assert (y[x == touch].min(), y[x == touch].max()) == (low[touch - 1], high[touch - 1])
    assert "paper, tools 70%" in texts(figure)


def test_unsure_starts_before_the_first_touch():
    figure = figures.until_sure({"random": estimate(np.array([1.0, 0.9, 0.5, 0.4]))}, "", True)
    axes = figure.axes[0]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [0, 1, 2, 3])
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), [1.0, 0.9, 0.5, 0.4])
    assert axes.lines[0].get_drawstyle() == "steps-post"  # sure from that touch on
    assert axes.get_xlim() == (0, 3)


def test_reliability_leaves_out_empty_bins():
    sure, hit = np.array([0.3, 0.5, 0.5, 0.95, 0.95]), np.array([0.0, 1, 0, 1, 1])
    told = metrics.reliability(sure, hit, 10)
    above, below = figures.reliability({"belief": told}, "", True).axes
    dots, *_ = above.containers[0]
    np.testing.assert_allclose(dots.get_xdata(), [0.3, 0.5, 0.95])
    np.testing.assert_allclose(dots.get_ydata(), [0, 0.5, 1])
    bars = np.array([part.vertices for part in above.containers[0][2][0].get_paths()])
    np.testing.assert_allclose(bars[1, :, 1], [told.frequency.low[5], told.frequency.high[5]])
    np.testing.assert_array_equal(below.lines[0].get_ydata(), [1, 2, 2])


def test_confusion_shows_shares_of_what_was_there():
    counts = np.array([[3, 1], [0, 2], [0, 0]])[[0, 1]]
    figure = figures.confusion(counts, ["star", "cross"], "", True)
    np.testing.assert_array_equal(figure.axes[0].images[0].get_array(), [[0.75, 0.25], [0, 1]])
    assert {"75%", "25%", "0%", "100%", "star (4)", "cross (2)"} <= set(texts(figure))
    many = figures.confusion(np.eye(25), [str(i) for i in range(25)], "", True)
    assert not many.axes[0].texts  # too small to read
    nothing = figures.confusion(np.zeros((2, 2)), ["a", "b"], "", True)
    np.testing.assert_array_equal(nothing.axes[0].images[0].get_array(), 0)


def test_bars_do_not_overlap_and_carry_their_intervals():
    settings = {
        "default": {"touch": (0.9, 0.85, 0.93), "position": (0.7, 0.6, 0.8)},
        "tilt": {"position": (0.5, 0.4, 0.6)},
    }
    axes = figures.sensitivity(settings, "", "accuracy", True).axes[0]
    edges = sorted((bar.get_y(), bar.get_y() + bar.get_height(), bar.get_width()) for bar in axes.patches)
    assert [width for *_, width in edges] == [0.9, 0.7, 0.5]
    assert all(end <= start for (_, end, _), (start, *_) in pairwise(edges))
    assert edges[0][0] > -0.5
    assert edges[1][1] < 0.5 < edges[2][0]  # each setting keeps to its own row
    spans = [path.vertices[:, 0] for part in axes.collections for path in part.get_paths()]
    np.testing.assert_allclose(sorted(map(tuple, spans)), [(0.4, 0.6), (0.6, 0.8), (0.85, 0.93)])
    assert axes.yaxis_inverted()


def test_methods_differ_without_colour():
    names = [str(i) for i in range(7)]
    figure = figures.accuracy(dict.fromkeys(names, METHODS["belief"]), "", True)
    lines = figure.axes[0].lines
    assert len({line.get_color() for line in lines}) == len({line.get_marker() for line in lines}) == len(names)


# --- the story of an episode ---

NAMES = ("square", "hexagon")  # prisms 30 mm high: +-25 mm wide, and of circumradius 30 mm with flat sides at +-y
PRESSED = 0.4e-3


def poses() -> np.ndarray:
    """Three presses of 0.4 mm: on top, in the middle, and at x = 26 and y = 25 mm, where only one has a top."""
    T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (3, 1, 1))
    T[:, :3, 3] = [(0, 0, 0.03 - PRESSED), (26e-3, 0, 0.03 - PRESSED), (0, 60e-3, 0.03 - PRESSED)]
    return T


POSTERIOR = np.array([[0.3, 0.4], [0.7, 0.2], [0.9, 0.05]])


@pytest.fixture(scope="module")
def meshes():
    return [catalogue.make_object(name).mesh for name in NAMES]


@pytest.fixture(scope="module")
def page(meshes) -> Figure:
    readings = np.random.default_rng(0).normal(size=(3, 15))
    return story.page(meshes, NAMES, poses(), readings, reskin_board(), POSTERIOR, 0, [], simulated=True)


def test_a_page_shows_the_patch_of_each_candidate_where_it_was_touched(page):
    patches = [axes for axes in page.axes if axes.images and axes.get_label() != "<colorbar>"]
    assert len(patches) == 6
    depth = np.array([axes.images[0].get_array() for axes in patches]).reshape(3, 2, 48, 48)
    np.testing.assert_allclose(depth[0], 0, atol=1e-4)  # mm, flat tops
    assert [axes.get_xlabel() for axes in patches[:2]] == ["0.4 mm deep"] * 2
    x = ((np.arange(48) + 0.5) / 48 - 0.5) * 17 + 26  # mm, tool x is world x
    np.testing.assert_allclose(depth[1, 0, 24], np.where(x < 25, 0, REACH * 1e3), atol=1e-4)
    np.testing.assert_allclose(
        depth[1, 1, 24], np.where(x < 30, 0, REACH * 1e3), atol=1e-4
    )  # 29.9 mm beside the corner
    assert [axes.get_xlabel() for axes in patches[4:]] == ["nothing here"] * 2


def test_a_page_shows_what_was_believed_after_each_touch(page):
    believed = [axes for axes in page.axes if axes.patches and axes.yaxis_inverted()]
    for axes, p in zip(believed, POSTERIOR, strict=True):
        np.testing.assert_allclose([bar.get_width() for bar in axes.patches], [*p, 1 - p.sum()])
        assert [label.get_text() for label in axes.get_yticklabels()] == [*NAMES, "none of these"]
    shown = texts(page)
    assert {"square (true)", "hexagon", "touch 1", "touch 3", "90%", "5%"} <= set(shown)
    assert any(text.startswith("One episode: square (simulated)") for text in shown)


def test_many_touches_and_candidates_fit_on_a_page(meshes):
    p = np.full((20, 8), 0.05)
    p[:, 5] = 0.3
    many = story.page(
        [meshes[0]] * 8, [f"o{i}" for i in range(8)], np.tile(poses()[:1], (20, 1, 1)), np.ones((20, 15)), reskin_board(), p,
        6, [], simulated=False,
    )  # fmt: skip
    shown = texts(many)
    assert [text for text in shown if text.startswith("touch")] == [f"touch {i}" for i in (1, 5, 9, 12, 16, 20)]
    assert {"o5", "o6 (true)", "3 others", "15%"} <= set(shown)
    assert "none of these" in shown  # 0.35 is left


def test_an_unknown_object_is_said_to_be_none_of_them(meshes):
    unknown = story.page(
        meshes, NAMES, poses(), np.ones((3, 15)), reskin_board(), POSTERIOR[:, ::-1], -1, [], simulated=False
    )
    shown = texts(unknown)
    assert any(text.startswith("One episode: none of the candidates, drawn on the hexagon\n") for text in shown)
    assert not any("(true)" in text for text in shown)


def test_a_machine_that_cannot_draw_is_asked_in_another_process(monkeypatch):
    touches.no_scene.cache_clear()
    with monkeypatch.context() as broken:
        broken.setattr(touches, "PROBE", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
        assert not story.can_render()
        assert "libegl1" in touches.no_scene()
        touches.no_scene.cache_clear()
        broken.setattr(touches, "find_spec", lambda name: None)
        assert "pip install" in touches.no_scene()
    touches.no_scene.cache_clear()


def test_without_a_scene_the_page_is_told_all_the_same(meshes, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(story, "no_scene", lambda: touches.NO_GL)
    told = story.story(meshes, NAMES, poses(), np.ones((3, 15)), reskin_board(), POSTERIOR, 0, tmp_path / "a", True)
    assert told == [tmp_path / "a" / "story.png"] == list((tmp_path / "a").iterdir())
    assert capsys.readouterr().err == touches.NO_GL + "\n"


def test_a_story_of_unequal_lengths_is_refused(meshes, tmp_path):
    with pytest.raises(ValueError, match="same touches"):
        story.story(meshes, NAMES, poses(), np.ones((2, 15)), reskin_board(), POSTERIOR, 0, tmp_path, True)


def test_a_scene_holds_the_object_and_its_touches(meshes, tmp_path):
    if story.no_scene():
        pytest.skip(story.no_scene())
    told = story.story(meshes, NAMES, poses(), np.ones((3, 15)), reskin_board(), POSTERIOR, 0, tmp_path, True)
    assert [path.name for path in told] == ["story.png", "scene.png", "scene.gltf"]
    with Image.open(told[1]) as picture:
        colours = {tuple(pixel) for pixel in np.asarray(picture.convert("RGB")).reshape(-1, 3)[::7]}
    assert len(colours) > 100  # shaded faces and coloured squares, not an empty window

    # glTF has y up and looks along z: (y, z, x).
    found = [part for part in trimesh.load(told[2]).dump() if isinstance(part, trimesh.Trimesh)]
    body = max(found, key=lambda part: part.area)
    np.testing.assert_allclose(body.bounds, [[-25e-3, 0, -25e-3], [25e-3, 30e-3, 25e-3]], atol=1e-6)
    squares = [part for part in found if abs(part.area - PAD_WINDOW**2) < 1e-8]
    middles = sorted(tuple(part.bounds.mean(0).round(9) + 0.0) for part in squares)
    top = 0.03 - PRESSED + story.LIFT
    np.testing.assert_allclose(middles, [(0, top, 0), (0, top, 26e-3), (60e-3, top, 0)], atol=1e-6)
    assert len(found) == 1 + 3 * 3  # a body; squares, pins, digits
