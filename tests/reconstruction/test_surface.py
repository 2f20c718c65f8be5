"""A surface from touches: distances against closed forms, carving that is exact, a regression as in the textbooks."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers.balls import ball_model, from_above

from i2t.depth.camera import Camera
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import PAD_WINDOW
from i2t.reconstruction.evidence import (
    SeenThrough,
    contact_evidence,
    reading_evidence,
    view_evidence,
    with_surface_points,
)
from i2t.reconstruction.local_shape import summarize
from i2t.reconstruction.shape_library import STANCES, TURNS
from i2t.reconstruction.signed_distances import (
    extract_mesh,
    grid_around,
    interpolate,
    signed_distance_grid,
)
from i2t.reconstruction.surface import (
    SurfaceConfig,
    condition_on,
    estimate_surface,
    init,
    most_probable_shapes,
    posterior_covariance,
    predict,
    regress,
    subsample,
    surface_model,
    update,
    weighted_prior,
)
from i2t.simulation.depth_camera import render_view

HALF = np.full(3, 40e-3)
GRID = grid_around(-HALF, HALF, across=24, margin=4e-3)
RADII = np.linspace(15e-3, 35e-3, 9)
_balls = partial(ball_model, GRID, RADII, np.zeros(3))


def _ball(radius, centre=(0.0, 0.0, 0.0), subdivisions=2):
    ball = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(ball.vertices + centre, ball.faces)


def _smooth(**changes):
    model = _balls(**changes)
    return model._replace(library=model.library._replace(steps=model.library.steps[:, :0]))


def test_the_signed_distance_of_a_ball_is_its_closed_form_and_its_mesh_has_its_volume():
    distance = signed_distance_grid(_ball(30e-3, subdivisions=3), GRID)
    true = np.linalg.norm(GRID.points(), axis=-1) - 30e-3
    assert np.abs(distance - true)[np.abs(true) < 8e-3].max() < 0.25e-3  # chords lie 0.16 mm within the ball
    assert np.abs(distance - true).max() < 0.8e-3
    assert ((distance < 0) == (true < 0))[np.abs(true) > 0.3e-3].all()
    mesh = extract_mesh(GRID, true.astype(np.float32))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(4 / 3 * np.pi * 30e-3**3, rel=0.05)  # it looks outward
    assert extract_mesh(GRID, 1 + 0 * distance).faces.shape == (0, 3)  # where nothing is inside
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=-1), 30e-3, atol=0.6e-3)


@pytest.mark.parametrize("on_table", [True, False])
def test_shapes_of_the_library_are_the_meshes_on_all_sides_turned_and_mirrored(on_table):
    """There are 48, each compared with the distance of the mesh in that orientation."""
    corner = trimesh.boolean.union(
        [trimesh.creation.box(bounds=[[0, 0, 0], high]) for high in ((30e-3, 8e-3, 8e-3), (8e-3, 20e-3, 14e-3))]
    )
    config = SurfaceConfig(across=20, on_table=on_table)
    model = surface_model(
        [Mesh(corner.vertices + 5e-3, corner.faces)], config=config, low=np.zeros(3), high=np.zeros(3)
    )
    assert model.library.size == len(STANCES) * len(TURNS) == 48
    fields = model.library.fields(np.arange(48))
    vertices = corner.vertices - corner.bounds.mean(0)
    for number, field in enumerate(fields.T):
        turn, stance = TURNS[number // 6], STANCES[number % 6]
        turned = vertices @ stance @ turn
        if on_table:
            turned[:, 2] -= turned[:, 2].min()
        faces = corner.faces[:, :: int(np.sign(np.linalg.det(stance @ turn)))]
        wanted = signed_distance_grid(Mesh(turned, faces), model.grid)
        near = np.abs(wanted) < 8e-3
        assert np.abs(field - wanted)[near].max() < 1.5e-3  # where the field bends, heights are interpolated
        assert np.abs(field - wanted)[near].mean() < 0.25e-3
        rows = np.flatnonzero(near)[::50]
        values = model.library.near(model.points[rows] + 0.2e-3, number // 6)[:, number % 6]
        np.testing.assert_allclose(values, field[rows], atol=1e-6)
    assert len(np.unique(np.round(fields, 4), axis=1).T) == 48


def test_swept_space_is_free_and_nothing_else_is_carved():
    model = _balls()
    state, _ = init(model)
    state, _ = update(model, state, contact_evidence(from_above(0.0), hit=False, swept=0.1))  # down to the middle
    estimate = estimate_surface(model, state)
    x, y, z = model.points.T
    swept = (np.abs(x) < PAD_WINDOW / 2) & (np.abs(y) < PAD_WINDOW / 2) & (z > 0)
    assert (estimate.distance[swept] > 0).all()
    assert np.isneginf(state.bound[~swept]).all()
    at = np.array([[0, 0, 4e-3], [8e-3, 0, 40e-3]])
    np.testing.assert_allclose(state.evidence[0].region.lower_bound(at), [4e-3, 2e-3])


def test_only_swept_space_is_free_and_an_invalid_pose_is_refused():
    short = contact_evidence(from_above(0.0), swept=4e-3)
    assert (short.free[:, 2] < 4e-3).all()
    assert (short.free_bound > 0).all()
    lost = from_above(0.0)
    lost[0, 3] = np.nan
    for pose, swept in ((lost, 0.1), (from_above(0.0), np.nan)):
        with pytest.raises(ValueError, match=r"T_o_t: is not a rigid motion|swept: is nan; give a distance in metres"):
            contact_evidence(pose, swept=swept)
    with pytest.raises(ValueError, match="is not a rigid motion"):
        contact_evidence(np.diag([-1.0, 1, 1, 1]))
    with pytest.raises(ValueError, match="give one or more surface points of a touch"):
        with_surface_points(short, np.zeros((1, 3)), np.array([np.nan]))


def test_contacts_outside_the_box_of_the_surface_are_refused():
    model = _balls()
    with pytest.raises(ValueError, match="outside the box of the surface"):
        update(model, init(model)[0], contact_evidence(from_above(3.0)))
    with pytest.raises(ValueError, match="divide millimetres by 1000"):
        contact_evidence(from_above(30.0))
    update(model, init(model)[0], contact_evidence(from_above(0.2), hit=False))  # air may be anywhere
    with pytest.raises(ValueError, match="mesh 1 of the library is 60 m across"):
        surface_model([_ball(30e-3), _ball(30.0)])


def test_a_contact_chooses_among_known_shapes_and_narrows_the_band():
    model = _balls()
    state, before = init(model)
    first = estimate_surface(model, state)
    state, info = update(model, state, contact_evidence(from_above(32.5e-3), swept=0.1))
    assert RADII[info.log_likelihood.argmax() % len(RADII)] == 32.5e-3
    assert info.effective_shapes < before.effective_shapes
    for axis in np.eye(3)[:2]:
        state, info = update(model, state, contact_evidence(_turned(axis, 32.5e-3), swept=0.1))
    last = estimate_surface(model, state)
    there = np.array([[0, 0, 32.5e-3], [0, -23e-3, -23e-3]])
    assert (np.abs(interpolate(GRID, last.distance, there)) < [1.5e-3, 3e-3]).all()
    assert (interpolate(GRID, last.std, there) < 0.7 * interpolate(GRID, first.std, there)).all()


def _turned(axis, height):
    """A pad that faces along the negative direction of an axis."""
    z = -np.asarray(axis, float)
    x = np.roll(z, 1)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], -1)
    T[:3, 3] = -height * z
    return T


def test_the_regression_equals_the_textbook_formula():
    """Rasmussen and Williams, Gaussian Processes for Machine Learning, equations 2.23 and 2.24, in double precision."""
    model = _smooth(smooth_residual=10e-3, smooth_length=20e-3, band_floor=0.0)
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(6, 3))
    seen *= 22e-3 / np.linalg.norm(seen, axis=-1, keepdims=True)
    ball = weighted_prior(model, init(model)[0])
    posterior = condition_on(model, ball, points=seen, values=np.zeros(6), std=np.full(6, 1e-3))
    asked = rng.uniform(-30e-3, 30e-3, (5, 3))
    mean, std = predict(model, posterior, asked)

    def prior(points):
        middle = 0.5 * (model.points[0, 2] + model.points[-1, 2])
        return np.linalg.norm(points - [0, 0, middle], axis=-1) - model.config.radius

    def matern(a, b):
        r = np.sqrt(5) * np.linalg.norm(a[:, None] - b, axis=-1) / 20e-3
        return 10e-3**2 * (1 + r + r**2 / 3) * np.exp(-r)

    gain = matern(asked, seen) @ np.linalg.inv(matern(seen, seen) + 1e-6 * np.eye(6))
    np.testing.assert_allclose(mean, prior(asked) - gain @ prior(seen), atol=0.1e-3)  # the ball is interpolated
    cov = matern(asked, asked) - gain @ matern(seen, asked)
    np.testing.assert_allclose(std, np.sqrt(np.diag(cov)), rtol=0.01)
    np.testing.assert_allclose(posterior_covariance(model, posterior, asked, asked), cov, atol=0.01 * cov.max())


def test_no_touch_reduces_the_floor_of_the_band():
    top = np.array([[0.0, 0.0, 20e-3]])

    def spread(floor):
        model = _smooth(smooth_length=60e-3, band_floor=floor, pose_std=0.1e-3)
        state, _ = init(model)
        for x in np.linspace(-8e-3, 8e-3, 12):
            touch = with_surface_points(contact_evidence(from_above(20e-3, x)), np.zeros((1, 3)), np.array([0.1e-3]))
            state, _ = update(model, state, touch)
        return predict(model, regress(model, state), top)[1][0]

    bare = spread(0.0)
    assert bare < 0.5e-3
    np.testing.assert_allclose(spread(2e-3), np.hypot(bare, 2e-3), rtol=1e-5)


def test_points_of_contact_become_points_of_the_surface():
    model = _balls()
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-7e-3, 7e-3, 5)]))
    cap = np.stack([x, y, np.sqrt(25e-3**2 - x**2 - y**2)], -1)
    evidence = with_surface_points(
        contact_evidence(from_above(25e-3)), cap * (1, -1, -1) + (0, 0, 25e-3), np.full(25, 0.1e-3)
    )
    state, info = update(model, init(model)[0], evidence)
    assert RADII[info.log_likelihood.argmax() % len(RADII)] == 25e-3
    assert abs(predict(model, regress(model, state), cap[[6]])[0][0]) < 1e-3


def test_a_reading_locates_the_contact_in_the_square_and_the_free_space_in_front(library, model):
    """For tilted planes, the lowest corner is in contact and the opposite one is free."""
    posterior = summarize(jnp.zeros(24).at[0].set(1.0), jnp.float32(1.0), library=library)  # nearest where x is least
    T_o_t = from_above(20e-3)
    touch, felt = contact_evidence(T_o_t), reading_evidence(T_o_t, posterior)
    met = T_o_t[:3, :3] @ np.append(posterior.centre, 0.0) + T_o_t[:3, 3]
    np.testing.assert_allclose(felt.points[0], met, atol=1e-6)
    np.testing.assert_allclose(felt.points[1], met - [0, 0, 3e-3], atol=1e-6)
    np.testing.assert_array_equal(felt.values, [0, -3e-3])
    more = (felt.free[len(touch.free) :] - T_o_t[:3, 3]) @ T_o_t[:3, :3]
    assert len(more)
    depth = 1e-3 * (more[:, 0] / 8.5e-3 + 1)  # of the plane
    assert (more[:, 2] < depth).all()
    assert (more[:, 2] > 0.3 * depth).all()


def test_a_subsample_of_shapes_keeps_their_weights():
    rng = np.random.default_rng(0)
    for spread in (0.0, 1.0, 4.0):
        weight = np.exp(spread * rng.normal(size=2000))
        weight /= weight.sum()
        shapes, weights = subsample(weight, 100)
        assert len(set(shapes)) == len(shapes) == 100
        assert weights.sum() == pytest.approx(1)
        heavy = np.flatnonzero(weight > 0.02)
        np.testing.assert_allclose([weights[shapes == index].sum() for index in heavy], weight[heavy], rtol=1e-5)
        below = np.arange(2000) < 1000  # in number and in weight, those drawn are as the rest
        assert weights[below[shapes]].sum() == pytest.approx(weight[below].sum(), abs=0.02)
    shapes, weights = subsample(np.array([0.2, 0.5, 0.3]), 3)
    np.testing.assert_allclose(weights[np.argsort(shapes)], [0.2, 0.5, 0.3], rtol=1e-6)


def test_the_likeliest_shapes_share_all_weight():
    shapes, weights = most_probable_shapes(np.array([0.1, 0.4, 0.2, 0.3]), 2)
    np.testing.assert_allclose(weights[np.argsort(shapes)], [4 / 7, 3 / 7], rtol=1e-6)
    assert sorted(shapes) == [1, 3]


def test_a_view_gives_surface_points_and_carves_the_space_before_them():
    ball = _ball(25e-3, subdivisions=3)
    T_o_c = from_above(0.25)
    camera = Camera(80, 60, 120.0, 120.0, 39.5, 29.5)
    depth, _ = render_view(ball.vertices[ball.faces], T_o_c, camera)
    seen = view_evidence(depth, camera, T_o_c)
    np.testing.assert_allclose(np.linalg.norm(seen.points, axis=1), 25e-3, atol=0.5e-3)
    assert (seen.points[:, 2] > 0).all()
    assert isinstance(seen.region, SeenThrough)
    asked = np.array([[0, 0, 30e-3], [35e-3, 0, 0], [0, 0, 0], [0, 0, 0.3]])  # before it, beside, inside, not seen
    np.testing.assert_array_equal(seen.region.lower_bound(asked), [0, 0, -np.inf, -np.inf])
    state, info = update(_balls(), init(_balls())[0], seen)
    assert RADII[info.log_likelihood.argmax() % len(RADII)] == 25e-3
    estimate = estimate_surface(_balls(), state)
    assert abs(interpolate(GRID, estimate.distance, np.array([[0, 0, 25e-3]]))[0]) < 1e-3
    with pytest.raises(ValueError, match="shows nothing above the table"):
        view_evidence(np.full((60, 80), np.inf), camera, T_o_c)
    high = view_evidence(depth, camera, T_o_c, table=20e-3)
    assert (high.points[:, 2] > 22e-3).all()
    right = view_evidence(depth, camera, T_o_c, box=(np.array([0.0, -1, -1]), np.ones(3)))
    assert (right.points[:, 0] > 0).all()
    with pytest.raises(ValueError, match="in the box"):
        view_evidence(depth, camera, T_o_c, box=(np.full(3, 0.5), np.ones(3)))
    with pytest.raises(ValueError, match="where the camera's image is"):
        view_evidence(depth.T, camera, T_o_c)
    with pytest.raises(ValueError, match="rigid"):
        view_evidence(depth, camera, 2 * T_o_c)
