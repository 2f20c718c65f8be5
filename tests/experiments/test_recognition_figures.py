"""What figures of recognition draw, read back from them: curves, bands, bars, counts, titles."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from experiments.recognize import figures
from i2t.recognition import metrics
from i2t.recognition.intervals import Estimate


def estimate(mean: np.ndarray, half: float = 0.05) -> Estimate:
    return Estimate(mean, mean - half, mean + half)


METHODS = {"votes": estimate(np.array([0.3, 0.5, 0.6])), "belief": estimate(np.array([0.4, 0.8, 0.9]), 0.02)}


def every_figure(simulated: bool) -> list[Figure]:
    p = np.random.default_rng(0).dirichlet(np.ones(3), (40, 1))
    truth = np.arange(40) % 3
    reliable = metrics.reliability(metrics.confidence(p), metrics.hits(p, truth), 5)
    return [
        figures.accuracy(METHODS, "five objects", simulated, {"paper": 0.58}, 0.2),
        figures.reliability({"belief": reliable}, "five objects", simulated),
        figures.confusion(np.eye(3), ["a", "b", "c"], "five objects", simulated),
        figures.not_yet_confident(METHODS, "five objects", simulated),
        figures.sensitivity({"default": {"belief": (0.9, 0.8, 1.0)}}, "five objects", "R", simulated),
    ]


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text"))]


@pytest.mark.parametrize("simulated", [True, False])
def test_a_title_says_where_the_touches_come_from(simulated):
    for figure in every_figure(simulated):
        assert ("five objects (simulated)" in texts(figure)) == simulated
        assert ("five objects" in texts(figure)) != simulated


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


def test_reliability_leaves_out_empty_bins():
    sure, hit = np.array([0.3, 0.5, 0.5, 0.95, 0.95]), np.array([0.0, 1, 0, 1, 1])
    reliable = metrics.reliability(sure, hit, 10)
    above, below = figures.reliability({"belief": reliable}, "", True).axes
    dots, *_ = above.containers[0]
    np.testing.assert_allclose(dots.get_xdata(), [0.3, 0.5, 0.95])
    np.testing.assert_allclose(dots.get_ydata(), [0, 0.5, 1])
    bars = np.array([part.vertices for part in above.containers[0][2][0].get_paths()])
    np.testing.assert_allclose(bars[1, :, 1], [reliable.frequency.low[5], reliable.frequency.high[5]])
    np.testing.assert_array_equal(below.lines[0].get_ydata(), [1, 2, 2])
