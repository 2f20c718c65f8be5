"""The figures of the documents: each is drawn, none is empty, and the page shows them all."""

import ast
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import i2t
from experiments.gallery import __main__ as gallery
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


def test_the_page_has_twenty_figures_and_says_how_each_is_made():
    text = PAGE.read_text()
    shown = re.findall(r"!\[([^\]]+)\]\(figures/([a-z_]+)\.png\)\n\n([^!#]*)", text)
    assert len({name for _, name, _ in shown}) >= 20
    for words, name, below in shown:
        assert len(words) > 40, name
        assert (PAGE.parent / "figures" / f"{name}.png").is_file()
        assert name in FIGURE_NAMES or "python -m " in below or "The same command" in below, name


def test_the_code_of_each_figure_stands_below_it():
    text = PAGE.read_text()
    parts = re.split(r"^(?=!\[)", text, flags=re.M)[1:]
    assert len(parts) > 25
    for part in parts:
        name = re.search(r"\(figures/(\w+)\.png\)", part)[1]
        found = re.search(r"^```\{literalinclude\} (\S+)\n:pyobject: (\w+)\n```$", part, re.M)
        assert found, f"{name} has no code"
        code = PAGE.parent / found[1]
        functions = {node.name for node in ast.parse(code.read_text()).body if isinstance(node, ast.FunctionDef)}
        assert found[2] in functions, f"{name}: {found[1]} has no function {found[2]}"
        if name in FIGURE_NAMES:
            assert (FIGURES[name].__module__, FIGURES[name].__name__) == (
                ".".join(code.resolve().relative_to(PAGE.parents[1]).with_suffix("").parts), found[2],
            )  # fmt: skip


def test_a_figure_without_a_trained_run_needs_none(tmp_path):
    nowhere = tmp_path / "none"
    GalleryArgs(trained_run=nowhere, only=tuple(set(FIGURE_NAMES) - OF_A_RUN)).check()
    for name in OF_A_RUN:
        with pytest.raises(ValueError, match="no finished run"):
            GalleryArgs(trained_run=nowhere, only=(name,)).check()


def test_a_run_that_is_not_there_is_named(tmp_path, capsys):
    assert gallery.main(["--trained-run", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert "none: no finished run" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
