"""Pictures of surfaces that grow."""

import numpy as np
import pytest
import trimesh

from i2t import viz


@pytest.mark.full
@pytest.mark.skipif(bool(viz.why_no_scene()), reason="no 3-D pictures here")
def test_a_surface_grows_from_nowhere(tmp_path):
    """Before any touch there may be no surface at all: that is drawn as nothing."""
    none, no_poses = np.zeros((0, 3)), np.zeros((0, 4, 4))
    ball = trimesh.creation.icosphere(2, 30e-3)
    stages = [
        viz.ShownSurface("0 touches", none, none.astype(int), np.zeros(0), no_poses),
        viz.ShownSurface("1 touch", ball.vertices, ball.faces, np.full(len(ball.vertices), 1e-3), np.eye(4)[None]),
    ]
    figure = viz.plot_growing_surface(stages, (ball.vertices, ball.faces), "A ball", True)
    assert "(simulated)" in figure.get_suptitle()
    assert [axes.get_title() for axes in figure.axes[:3]] == ["0 touches", "1 touch", "truth"]
    drawn = [np.asarray(axes.images[0].get_array()) for axes in figure.axes[:3]]
    assert (drawn[0] >= 250).all()
    assert (drawn[1] < 250).any()
    assert viz.write_surface_gltf(stages[1], tmp_path / "ball.gltf") == ""
    assert (tmp_path / "ball.gltf").stat().st_size > 1000
