"""Large meshes are cut down to what a touch of a site can meet, which changes nothing of what is met."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from i2t.geometry import contact_frame
from i2t.recognition import site_pool
from i2t.recognition.local_surfaces import cut_surfaces, is_large, reached_boxes, reached_clusters, size_class
from i2t.recognition.outcomes import LOADS_N, PRESSURE_GRID, LinearReadingModel
from i2t.rendering.render import prepare_surface
from i2t.simulation.press import PressLimits

OVERTRAVEL = PressLimits.overtravel
TWIST = jnp.float32(np.random.default_rng(0).normal(0, 1.5e-3, (6, 6)))


@pytest.fixture(scope="module")
def surface():
    """A bumpy ball of 5120 faces, as large as a mug."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=45e-3)
    ball.vertices *= 1 + 0.03 * np.sin(ball.vertices @ np.array([[400.0, 100, 0], [0, 350, 90], [80, 0, 420]])).prod(
        1, keepdims=True
    )
    return prepare_surface(ball)


@pytest.fixture(scope="module")
def sites():
    """Three around the ball, and one that reaches nothing."""
    outward = np.float32(Rotation.random(3, random_state=0).as_matrix()[:, :, 2])
    frames = [np.asarray(contact_frame(45e-3 * z, z, np.float32(0.4 * i))) for i, z in enumerate(outward)]
    away = np.eye(4)
    away[0, 3] = 1.0
    return np.stack([*frames, away])


def test_only_large_meshes_are_cut_down_to_what_a_touch_can_meet(surface, sites):
    assert is_large([surface])
    assert not is_large([prepare_surface(trimesh.creation.icosphere(subdivisions=3))])
    reached = reached_clusters(reached_boxes([surface], TWIST), sites, OVERTRAVEL)
    np.testing.assert_array_equal(reached[0].any(1), [True, True, True, False])
    assert cut_surfaces(surface, reached[0], size_class(reached)).triangles.shape[1] < len(surface.triangles) / 2


@pytest.mark.full
def test_predictions_are_those_of_the_whole_mesh(surface, sites, monkeypatch):
    shape = len(LOADS_N), PRESSURE_GRID.cells**2
    mean = np.random.default_rng(1).normal(size=(*shape, 6))
    parts = (jnp.float32(part) for part in (LOADS_N, mean, np.zeros((*shape, 1)), np.ones(6), 1))
    model = LinearReadingModel(*parts)
    monkeypatch.setattr(site_pool, "BATCH_TOUCHES", 2 * len(TWIST))  # two sites at a time, of two objects
    other = surface._replace(triangles=np.asarray(surface.triangles)[:, ::-1])

    def predict():
        return site_pool.predict_outcomes([surface, other], TWIST, sites, [model], overtravel=OVERTRAVEL)[0]

    cut = predict()
    monkeypatch.setattr(site_pool, "is_large", lambda surfaces: False)
    whole = predict()
    np.testing.assert_array_equal(cut.hit, whole.hit)
    assert cut.hit[:-1].mean() > 0.5
    assert not cut.hit[-1].any()
    for name in cut._fields:
        np.testing.assert_allclose(getattr(cut, name), getattr(whole, name), rtol=1e-4, atol=1e-7, err_msg=name)
