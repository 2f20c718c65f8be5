"""Large meshes are cut down to what a touch of a site can meet, which changes nothing of what is met."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from i2t.geometry import contact_frame, from_twist, inverse
from i2t.recognition import local_surfaces, outcomes, site_pool
from i2t.recognition.local_surfaces import cut_surfaces, is_large, reached_boxes, reached_clusters, size_class
from i2t.recognition.outcomes import LOADS_N, PRESSURE_GRID, LinearReadingModel
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_heights
from i2t.simulation.press import PressLimits
from i2t.simulation.sites import press_along
from i2t.types import PAD_WINDOW, STANDOFF

OVERTRAVEL = PressLimits.overtravel


@pytest.fixture(scope="module")
def surface():
    """A bumpy ball of 5120 faces, as large as a mug."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=45e-3)
    ball.vertices *= 1 + 0.03 * np.sin(ball.vertices @ np.array([[400.0, 100, 0], [0, 350, 90], [80, 0, 420]])).prod(
        1, keepdims=True
    )
    return prepare_surface(ball)


@pytest.fixture(scope="module")
def twist():
    return jnp.float32(np.random.default_rng(0).normal(0, 1.5e-3, (6, 6)))


@pytest.fixture(scope="module")
def sites():
    turns = Rotation.random(5, random_state=0).as_matrix()
    frames = [
        contact_frame(jnp.float32(45e-3 * turn[:, 2]), jnp.float32(turn[:, 2]), 0.4 * i) for i, turn in enumerate(turns)
    ]
    return np.stack([np.asarray(frame) for frame in frames])


def test_only_large_meshes_are_cut(surface):
    assert is_large([surface])
    assert not is_large([prepare_surface(trimesh.creation.icosphere(subdivisions=3))])


def test_what_is_met_and_seen_is_that_of_the_whole_mesh(surface, twist, sites):
    reached = reached_clusters(reached_boxes([surface], twist), sites, OVERTRAVEL)
    groups = size_class(reached)
    parts = cut_surfaces(surface, reached[0], groups)
    assert parts.triangles.shape[1] < len(surface.triangles) / 2

    @jax.jit
    def touch(surface, T_w_site, twist):
        start = inverse(from_twist(twist)) @ T_w_site @ jnp.eye(4).at[2, 3].set(-STANDOFF)
        T, hit = press_along(surface, start, start[:3, 2], max_distance=STANDOFF + OVERTRAVEL)
        return T, hit, render_heights(surface, inverse(T), PAD_WINDOW, PRESSURE_GRID.cells)

    met = 0
    for i, site in enumerate(sites):
        for one in twist:
            T, hit, heights = touch(element(parts, i), site, one)
            T_whole, hit_whole, whole = touch(surface, site, one)
            assert hit == hit_whole
            if hit:
                met += 1
                np.testing.assert_array_equal(T, T_whole)
                near = np.asarray(whole) < local_surfaces.PRESSED_DEPTH_M
                np.testing.assert_array_equal(np.asarray(heights)[near], np.asarray(whole)[near])
                assert (np.asarray(heights)[~near] >= local_surfaces.PRESSED_DEPTH_M).all()
    assert met > len(sites) * len(twist) / 2


def test_a_site_that_reaches_nothing_meets_nothing(surface, twist):
    away = np.eye(4)[None].repeat(2, 0)
    away[:, 0, 3] = 1.0
    reached = reached_clusters(reached_boxes([surface], twist), away, OVERTRAVEL)
    assert not reached.any()
    parts = cut_surfaces(surface, reached[0], size_class(reached))
    assert np.isinf(render_heights(element(parts, 0), jnp.eye(4), PAD_WINDOW, PRESSURE_GRID.cells)).all()


@pytest.mark.full
def test_predictions_are_those_of_the_whole_mesh(surface, twist, sites, monkeypatch):
    cells, channels = PRESSURE_GRID.cells**2, 6
    mean = np.random.default_rng(1).normal(size=(len(LOADS_N), cells, channels))
    model = LinearReadingModel(
        jnp.float32(LOADS_N), jnp.float32(mean), jnp.zeros((len(LOADS_N), cells, 1)), jnp.ones(channels), jnp.float32(1)
    )

    monkeypatch.setattr(site_pool, "BATCH_TOUCHES", 2 * len(twist))  # two sites at a time, of two objects
    other = surface._replace(triangles=np.asarray(surface.triangles)[:, ::-1])

    def predict():
        return site_pool.predict_outcomes([surface, other], twist, sites, [model], overtravel=OVERTRAVEL)[0]

    cut = predict()
    monkeypatch.setattr(site_pool, "is_large", lambda surfaces: False)
    whole = predict()
    assert isinstance(cut, outcomes.PredictedTouch)
    assert cut.hit.shape == (len(sites), 2, len(twist))
    for name in cut._fields:
        np.testing.assert_allclose(getattr(cut, name), getattr(whole, name), rtol=1e-4, atol=1e-7, err_msg=name)
