"""The figures of the documents: each is drawn, none is empty, and the page shows them all."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import i2t
from experiments.gallery.arguments import FIGURE_NAMES, OF_A_RUN, GalleryArgs
from experiments.gallery.story import Story


def test_a_force_that_a_noisy_wrench_sensor_takes_for_a_pull_is_imagined_too():
    """Touches of a run are drawn as they were measured."""
    drawn = Story(Path())
    drawn.__dict__["run"] = SimpleNamespace(predictor=i2t.load_predictor("nominal"))
    touches = SimpleNamespace(
        patch=np.zeros((1, 48, 48), np.float32), wide=np.zeros((1, 72, 72), np.float32),
        force=np.array([-0.08]), nearest=np.zeros(1), depth=np.full(1, 1e-4),
    )  # fmt: skip
    drawn.__dict__["unseen"] = touches
    assert np.isfinite(drawn.imagined.mean).all()


def test_a_figure_without_a_trained_run_needs_none(tmp_path):
    nowhere = tmp_path / "none"
    GalleryArgs(trained_run=nowhere, only=tuple(set(FIGURE_NAMES) - OF_A_RUN)).check()
    for name in OF_A_RUN:
        with pytest.raises(ValueError, match="no finished run"):
            GalleryArgs(trained_run=nowhere, only=(name,)).check()
