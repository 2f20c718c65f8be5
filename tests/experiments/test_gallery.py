"""The figures of the documents: each is drawn, none is empty, and the page shows them all."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from experiments.gallery import __main__ as gallery
from experiments.gallery.arguments import FIGURE_NAMES
from experiments.gallery.figures import FIGURES, Story
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


def test_the_page_shows_every_figure_with_words_for_who_cannot_see_it():
    text = PAGE.read_text()
    for name in FIGURE_NAMES:
        before, found, _ = text.partition(f"](figures/{name}.png)")
        assert found, f"{name} is not on the page"
        assert len(before.rpartition("![")[2]) > 40
        assert (PAGE.parent / "figures" / f"{name}.png").is_file()


def test_a_run_that_is_not_there_is_named(tmp_path, capsys):
    assert gallery.main(["--trained-run", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert "none: no finished run" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
