"""A surface from touches: distances against closed forms, carving that is exact, a regression as in the textbooks."""

from functools import partial

import numpy as np
import pytest
import trimesh
from helpers.balls import ball_model, from_above

from i2t.objects.solids import Mesh
from i2t.reconstruction.signed_distances import (
    extract_mesh,
    grid_around,
    interpolate,
    signed_distance_grid,
)
from i2t.reconstruction.surface import (
    SurfaceConfig,
    condition_on,
    contact_evidence,
    estimate_surface,
    init,
    posterior_covariance,
    posterior_evidence,
    predict,
    regress,
    surface_model,
    swept_distance,
    update,
)
from i2t.windows import PAD_WINDOW

HALF = np.full(3, 40e-3)
GRID = grid_around(-HALF, HALF, across=14, margin=4e-3)
RADII = np.linspace(15e-3, 35e-3, 9)
_balls = partial(ball_model, GRID, RADII, np.zeros(3))


def _ball(radius, centre=(0.0, 0.0, 0.0), subdivisions=2):
    ball = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(ball.vertices + centre, ball.faces)


def _smooth(**changes):
    model = _balls(**changes)
    return model._replace(library=model.library[:, :0])


def test_the_signed_distance_of_a_ball_is_its_closed_form_and_its_mesh_has_its_volume():
    found = signed_distance_grid(_ball(30e-3, subdivisions=3), GRID)
    true = np.linalg.norm(GRID.points(), axis=-1) - 30e-3
    assert np.abs(found - true)[np.abs(true) < 8e-3].max() < 0.25e-3  # chords lie 0.16 mm within the ball
    assert np.abs(found - true).max() < 0.8e-3
    assert ((found < 0) == (true < 0))[np.abs(true) > 0.3e-3].all()
    mesh = extract_mesh(GRID, true.astype(np.float32))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(4 / 3 * np.pi * 30e-3**3, rel=0.05)  # it looks outward
    assert extract_mesh(GRID, 1 + 0 * found).faces.shape == (0, 3)  # where nothing is inside
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=-1), 30e-3, atol=0.6e-3)


def test_a_turned_shape_of_the_library_is_that_of_the_turned_mesh():
    box = trimesh.creation.box((30e-3, 10e-3, 10e-3)).apply_translation([10e-3, 5e-3, 10e-3])
    model = surface_model([Mesh(box.vertices, box.faces)], config=SurfaceConfig(across=14))
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])  # a quarter, counter-clockwise from above
    for quarters in range(4):
        turned = box.vertices @ np.linalg.matrix_power(turn, quarters).T
        wanted = signed_distance_grid(Mesh(turned, box.faces), model.grid)
        near = np.abs(wanted) < 6e-3
        assert np.abs(model.library[near, quarters] - wanted[near]).max() < 0.1e-3


def test_what_a_pad_swept_is_free_and_nothing_else_is_carved():
    model = _balls()
    state, _ = init(model)
    state, _ = update(model, state, contact_evidence(from_above(0.0), hit=False, swept=0.1))  # down to the middle
    estimate = estimate_surface(model, state)
    x, y, z = model.points.T
    swept = (np.abs(x) < PAD_WINDOW / 2) & (np.abs(y) < PAD_WINDOW / 2) & (z > 0)
    assert (estimate.distance[swept] > 0).all()
    assert np.isneginf(swept_distance(state, model.points)[~swept]).all()
    assert swept_distance(state, np.array([[0, 0, 4e-3]]))[0] == pytest.approx(4e-3)
    assert swept_distance(state, np.array([[8e-3, 0, 40e-3]]))[0] == pytest.approx(2e-3)


def test_a_contact_chooses_among_known_shapes_and_narrows_the_band():
    model = _balls()
    state, before = init(model)
    first = estimate_surface(model, state)
    state, info = update(model, state, contact_evidence(from_above(32.5e-3), swept=0.1))
    assert RADII[info.log_likelihood.argmax()] == 32.5e-3
    assert info.effective_shapes < before.effective_shapes
    for axis in np.eye(3)[:2]:
        state, info = update(model, state, contact_evidence(_turned(axis, 32.5e-3), swept=0.1))
    last = estimate_surface(model, state)
    there = np.array([[0, 0, 32.5e-3], [0, -23e-3, -23e-3]])
    assert (np.abs(interpolate(GRID, last.distance, there)) < [1.5e-3, 3e-3]).all()
    assert (interpolate(GRID, last.std, there) < 0.7 * interpolate(GRID, first.std, there)).all()


def _turned(axis, height):
    """A pad that looks along minus an axis."""
    z = -np.asarray(axis, float)
    x = np.roll(z, 1)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], -1)
    T[:3, 3] = -height * z
    return T


def test_the_regression_is_the_textbooks():
    """Rasmussen and Williams, Gaussian Processes for Machine Learning, equations 2.23 and 2.24, in double precision."""
    model = _smooth(smooth_residual=10e-3, smooth_length=20e-3, inside_std=1e9, band_floor=0.0)
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(6, 3))
    seen *= 22e-3 / np.linalg.norm(seen, axis=-1, keepdims=True)
    none = np.zeros(0, int)
    posterior = condition_on(model, none, np.zeros(0), points=seen, values=np.zeros(6), std=np.full(6, 1e-3))
    asked = rng.uniform(-30e-3, 30e-3, (5, 3))
    mean, std = predict(model, posterior, asked)

    def prior(points):
        middle = 0.5 * (model.points[0, 2] + model.points[-1, 2])
        return np.linalg.norm(points - [0, 0, middle], axis=-1) - model.config.radius

    def matern(a, b):
        r = np.sqrt(5) * np.linalg.norm(a[:, None] - b, axis=-1) / 20e-3
        return 10e-3**2 * (1 + r + r**2 / 3) * np.exp(-r)

    gain = matern(asked, seen) @ np.linalg.inv(matern(seen, seen) + 1e-6 * np.eye(6))
    np.testing.assert_allclose(mean, prior(asked) - gain @ prior(seen), atol=0.05e-3)
    cov = matern(asked, asked) - gain @ matern(seen, asked)
    np.testing.assert_allclose(std, np.sqrt(np.diag(cov)), rtol=0.01)
    np.testing.assert_allclose(posterior_covariance(model, posterior, asked, asked), cov, atol=0.01 * cov.max())


def test_a_floor_is_what_no_touch_takes_away():
    top = np.array([[0.0, 0.0, 20e-3]])

    def spread(floor):
        model = _smooth(smooth_length=60e-3, band_floor=floor)
        state, _ = init(model)
        height = np.zeros((5, 5))
        for x in np.linspace(-8e-3, 8e-3, 12):
            touch = contact_evidence(from_above(20e-3, x))._replace(height=height, std=height + 0.1e-3)
            state, _ = update(model, state, touch)
        return predict(model, regress(model, state), top)[1][0]

    bare = spread(0.0)
    assert bare < 0.5e-3
    np.testing.assert_allclose(spread(2e-3), np.hypot(bare, 2e-3), rtol=1e-5)


def test_heights_that_a_touch_felt_are_points_of_the_surface():
    model = _balls()
    y, x = np.meshgrid(*2 * [((np.arange(5) + 0.5) / 5 - 0.5) * 17e-3], indexing="ij")
    height = 25e-3 - np.sqrt(25e-3**2 - x**2 - y**2)
    evidence = contact_evidence(from_above(25e-3))._replace(height=height, std=np.full((5, 5), 0.1e-3))
    state, info = update(model, init(model)[0], evidence)
    assert RADII[info.log_likelihood.argmax()] == 25e-3
    cap = np.array([[4e-3, 4e-3, np.sqrt(25e-3**2 - 2 * 4e-3**2)]])
    assert abs(predict(model, regress(model, state), cap)[0][0]) < 1e-3


def test_a_posterior_of_patches_knows_nothing_where_its_samples_reach_no_surface():
    patches = np.full((20, 48, 48), 1e-3)
    patches[:10, :, 30:] = 4e-3
    found = posterior_evidence(np.eye(4), patches)
    assert np.isfinite(found.std[:, :3]).all()
    assert np.isinf(found.std[:, 3:]).all()
    np.testing.assert_allclose(found.height[:, :3], 1e-3)
    assert (found.free <= 1e-3).all()
