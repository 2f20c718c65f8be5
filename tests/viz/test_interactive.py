"""Interactive scenes: pyvista draws the object and each touch, and reports what a machine lacks."""

import numpy as np
import pytest
import trimesh

from i2t import viz
from i2t.viz import interactive

BALL = trimesh.creation.icosphere(2, 30e-3)
TOUCH = np.diag([1.0, -1, -1, 1])
TOUCH[2, 3] = 30e-3


def test_drawing_is_probed_in_another_process(monkeypatch):
    interactive.explain_no_scene.cache_clear()
    with monkeypatch.context() as broken:
        broken.setattr(interactive, "PROBE", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
        assert "libegl1" in interactive.explain_no_scene()
        with pytest.raises(RuntimeError, match="libegl1"):
            viz.object_plotter(BALL.vertices, BALL.faces, TOUCH[None])
        interactive.explain_no_scene.cache_clear()
        broken.setattr(interactive, "find_spec", lambda name: None)
        broken.setattr("i2t.errors.find_spec", lambda name: None)
        assert "pip install" in interactive.explain_no_scene()
    interactive.explain_no_scene.cache_clear()


@pytest.mark.full
def test_a_scene_shows_the_object_and_a_coloured_square():
    if reason := interactive.explain_no_scene():
        pytest.skip(reason)
    plotter = viz.object_plotter(BALL.vertices, BALL.faces, TOUCH[None])
    low, high = np.reshape(plotter.bounds, (3, 2)).T
    assert np.allclose(high - low, [60, 60, 60 + 9], atol=1)  # mm: the ball, and the pin above it
    picture = np.asarray(plotter.screenshot(return_img=True)).astype(int)
    plotter.close()
    coloured = np.ptp(picture, axis=-1) > 40
    assert 0.002 < coloured.mean() < 0.2
    assert (np.ptp(picture, axis=-1)[(picture < 245).all(-1)] < 12).any()  # the ball is grey
