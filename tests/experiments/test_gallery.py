"""The figures of the documents: each is drawn, none is empty, and the page shows them all."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import i2t
from experiments.gallery.arguments import FIGURE_NAMES, OF_A_RUN, GalleryArgs
from experiments.gallery.figures import FIGURES
from experiments.gallery.story import Story
from experiments.recognize.config import PRESETS
from i2t.recognition.recognizer import RecognizerConfig

PAGE = Path(__file__).parents[2] / "docs" / "gallery.md"


@pytest.fixture(scope="module")
def story(trained_run):
    config = RecognizerConfig(num_sites=8, num_particles=16, max_touches=2)
    return Story(trained_run, world=PRESETS["debug"], config=config)


@pytest.mark.full
@pytest.mark.parametrize("name", FIGURE_NAMES)
def test_a_figure_is_drawn(name, story):
    canvas = FigureCanvasAgg(FIGURES[name](story))
    canvas.draw()
    colours = np.unique(np.asarray(canvas.buffer_rgba()).reshape(-1, 4), axis=0)
    assert len(colours) > 30


def test_a_force_that_a_noisy_wrench_sensor_takes_for_a_pull_is_imagined_too():
    """Touches of a run are drawn as they were measured."""
    drawn = Story(Path())
    drawn.__dict__["run"] = SimpleNamespace(predictor=i2t.load_predictor("nominal"))
    touches = SimpleNamespace(
        patch=np.zeros((1, 48, 48), np.float32), wide=np.zeros((1, 72, 72), np.float32),
        force=np.array([-0.08]), nearest=np.zeros(1), depth=np.full(1, 1e-4),
    )  # fmt: skip
    assert np.isfinite(drawn.imagine(touches).mean).all()


def test_the_page_shows_every_figure_with_words_for_who_cannot_see_it():
    text = PAGE.read_text()
    for name in FIGURE_NAMES:
        before, found, _ = text.partition(f"](figures/{name}.png)")
        assert found, f"{name} is not on the page"
        assert len(before.rpartition("![")[2]) > 40
        assert (PAGE.parent / "figures" / f"{name}.png").is_file()


def test_a_figure_without_a_trained_run_needs_none(tmp_path):
    nowhere = tmp_path / "none"
    GalleryArgs(trained_run=nowhere, only=tuple(set(FIGURE_NAMES) - OF_A_RUN)).check()
    for name in OF_A_RUN:
        with pytest.raises(ValueError, match="no finished run"):
            GalleryArgs(trained_run=nowhere, only=(name,)).check()
