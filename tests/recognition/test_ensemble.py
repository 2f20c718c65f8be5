"""The paper's rules against tables worked by hand, and distances from a mesh against trimesh."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from i2t.objects import catalogue
from i2t.recognition import ensemble
from i2t.rendering.render import prepare_surface

# Three touches, three objects; exp(-d) are simple fractions.
DISTANCE = jnp.log(jnp.asarray([[2.0, 4.0, 4.0], [8.0, 2.0, 8.0], [2.0, 4.0, 2.0]]))


def test_votes():
    found = ensemble.votes(DISTANCE)
    np.testing.assert_allclose(found, [[1, 0, 0], [1 / 2, 1 / 2, 0], [1 / 2, 1 / 3, 1 / 6]], atol=1e-6)


def test_average():
    first, second, third = np.array([[2, 1, 1], [1, 4, 1], [2, 1, 2]]) / np.array([[4], [6], [5]])
    expected = [first, (first + second) / 2, (first + second + third) / 3]
    np.testing.assert_allclose(ensemble.average(DISTANCE), expected, rtol=1e-5)


def test_product():
    # 1/2 1/4 1/4; 1/16 1/8 1/32; 1/32 1/32 1/64
    expected = [[2 / 4, 1 / 4, 1 / 4], [2 / 7, 4 / 7, 1 / 7], [2 / 5, 2 / 5, 1 / 5]]
    np.testing.assert_allclose(ensemble.product(DISTANCE), expected, rtol=1e-5)


def test_many_touches_leave_a_belief_finite():
    far = 1e3 * jax.random.uniform(jax.random.key(0), (1000, 4))
    for rule in (ensemble.votes, ensemble.average, ensemble.product):
        belief = np.asarray(jax.jit(rule)(far))
        assert np.all(np.isfinite(belief))
        np.testing.assert_allclose(belief.sum(axis=1), 1, rtol=1e-5)


def test_distances_are_standardised():
    readings = jnp.zeros((1, 15)).at[0, 0].set(4.0)
    imagined = jnp.zeros((1, 2, 15)).at[0, 1, 1].set(3.0)
    std = jnp.ones(15).at[0].set(2.0)
    found = ensemble.distances(readings, imagined, std)
    np.testing.assert_allclose(found, [[2, np.sqrt(4 + 9)]], rtol=1e-6)


def test_the_first_hypothesis_is_any_and_later_ones_the_believed():
    belief = jnp.asarray([0.2, 0.5, 0.3])
    first = [int(ensemble.choose_hypothesis(key, belief, 0)) for key in jax.random.split(jax.random.key(0), 60)]
    assert {0, 1, 2} == set(first)
    assert int(ensemble.choose_hypothesis(jax.random.key(1), belief, 3)) == 1


def _facing(angles_deg: list[float]) -> np.ndarray:
    angle = np.radians(angles_deg)
    return np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)


@pytest.mark.full
def test_the_next_touch_is_where_other_objects_face_elsewhere():
    # Two objects, four points on a line. Cosines with the nearest counterparts: 1, cos 50, cos 60, cos 80.
    points = np.tile(np.stack([np.arange(4), np.zeros(4), np.zeros(4)], axis=-1) * 5e-3, (2, 1, 1))
    normals = np.stack([_facing([0, 0, 0, 0]), _facing([0, 50, 60, 80])])
    safe = np.ones((2, 4), bool)
    scores = -np.cos(np.radians([50, 60]))  # 0 degrees is too alike, 80 too different (cos < 0.2)
    weight = scores - scores.min()
    found = ensemble.site_informativeness(jnp.asarray(points), jnp.asarray(normals), jnp.asarray(safe), 0)
    np.testing.assert_allclose(found, [0, *(weight / weight.sum()), 0], atol=1e-5)
    np.testing.assert_allclose(found, [0, 0, 1, 0], atol=1e-5)

    # An unsafe counterpart does not count: the nearest safe one of point 2 is then point 1 or 3's.
    safe[1, 2] = False
    moved = points.copy()
    moved[1, 1, 0] += 1e-4
    found = ensemble.site_informativeness(jnp.asarray(moved), jnp.asarray(normals), jnp.asarray(safe), 0)
    np.testing.assert_allclose(found, [0, 0.5, 0.5, 0], atol=1e-5)  # both face 50 degrees away: equal

    # None qualifies: any safe point.
    safe = np.array([[True, False, True, False], [True] * 4])
    same = np.stack([normals[0], normals[0]])
    found = ensemble.site_informativeness(jnp.asarray(points), jnp.asarray(same), jnp.asarray(safe), 0)
    np.testing.assert_allclose(found, [0.5, 0, 0.5, 0], atol=1e-6)


def test_no_point_may_be_touched_where_none_is_safe():
    points = np.tile(np.stack([np.arange(4), np.zeros(4), np.zeros(4)], axis=-1) * 5e-3, (2, 1, 1))
    normals = np.stack([_facing([0, 0, 0, 0]), _facing([0, 50, 60, 80])])
    for safe in (np.zeros((2, 4), bool), np.array([[False] * 4, [True] * 4])):
        found = ensemble.site_informativeness(jnp.asarray(points), jnp.asarray(normals), jnp.asarray(safe), 0)
        np.testing.assert_array_equal(found, 0)


def test_a_point_that_faces_too_far_from_one_other_object_does_not_qualify():
    # Three objects, three points. The means of the two cosines are all within bounds, but one counterpart of the second
    # point faces 85 degrees away, with a cosine below 0.2.
    points = np.tile(np.stack([np.arange(3), np.zeros(3), np.zeros(3)], axis=-1) * 5e-3, (3, 1, 1))
    normals = np.stack([_facing([0, 0, 0]), _facing([60, 30, 65]), _facing([60, 85, 60])])
    cosines = np.cos(np.radians([[60, 30, 65], [60, 85, 60]]))
    assert (cosines.mean(0) < ensemble.MAX_MEAN_NORMAL_COSINE).all()
    assert (cosines > ensemble.MIN_NORMAL_COSINE).all(0).tolist() == [True, False, True]
    found = ensemble.site_informativeness(jnp.asarray(points), jnp.asarray(normals), jnp.ones((3, 3), bool), 0)
    # Of the two that qualify the lower score has no weight.
    np.testing.assert_allclose(found, [0, 0, 1], atol=1e-6)


def test_the_limits_of_the_cosines_are_the_paper_s():
    """0.65 for each other object and 0.2: of points just inside and just outside, those inside qualify."""
    points = np.tile(np.stack([np.arange(4), np.zeros(4), np.zeros(4)], axis=-1) * 5e-3, (2, 1, 1))
    normals = np.stack([_facing([0, 0, 0, 0]), _facing(np.degrees(np.arccos([0.66, 0.64, 0.21, 0.19])).tolist())])
    found = ensemble.site_informativeness(jnp.asarray(points), jnp.asarray(normals), jnp.ones((2, 4), bool), 0)
    np.testing.assert_allclose(found, [0, 0, 1, 0], atol=1e-6)  # of the two that qualify the lower score has no weight


def test_the_bound_grows_with_the_number_of_objects():
    # Five objects whose counterparts all face 53 degrees away: the sum is -2.4, inside -0.65 * 4 but far outside -1.3.
    points = np.zeros((5, 2, 3))
    points[:, 1, 0] = 1e-2
    normals = np.tile(_facing([53, 0]), (5, 1, 1))
    normals[0] = _facing([0, 0])
    found = ensemble.site_informativeness(jnp.asarray(points), jnp.asarray(normals), jnp.ones((5, 2), bool), 0)
    np.testing.assert_allclose(found, [1, 0], atol=1e-6)


@pytest.mark.parametrize("name", ["star", "hammer"])
def test_distance_from_an_object(name):
    mesh = catalogue.make_object(name).mesh
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    low, high = whole.bounds
    points = np.random.default_rng(0).uniform(low - 0.02, high + 0.02, (300, 3))
    surface = prepare_surface(mesh)
    found = jax.jit(jax.vmap(ensemble.nearest_distance, (0, None)))(jnp.asarray(points, jnp.float32), surface)
    _, expected, _ = trimesh.proximity.closest_point_naive(whole, points)
    np.testing.assert_allclose(found, expected, atol=1e-6)
