"""The figures of the documents; that each is drawn is tested with the trained run of recognition."""

import pytest

from tools.gallery.arguments import FIGURE_NAMES, FIGURES_OF_RUN, GalleryArgs


def test_only_figures_of_a_trained_run_require_one(tmp_path):
    nowhere = tmp_path / "none"
    GalleryArgs(pad_model=nowhere, only=tuple(set(FIGURE_NAMES) - FIGURES_OF_RUN)).check()
    for name in FIGURES_OF_RUN:
        with pytest.raises(ValueError, match="no finished run"):
            GalleryArgs(pad_model=nowhere, only=(name,)).check()
