"""The paper's rules against tables computed by hand, and distances from a mesh against trimesh."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from i2t.objects import catalogue
from i2t.paper import loop, rules
from i2t.rendering.render import prepare_surface

# Three touches, three objects; exp(-d) are simple fractions.
DISTANCE = jnp.log(jnp.asarray([[2.0, 4.0, 4.0], [8.0, 2.0, 8.0], [2.0, 4.0, 2.0]]))


def test_votes_averages_and_products():
    first, second, third = np.array([[2, 1, 1], [1, 4, 1], [2, 1, 2]]) / np.array([[4], [6], [5]])
    expected = {
        rules.votes: [[1, 0, 0], [1 / 2, 1 / 2, 0], [1 / 2, 1 / 3, 1 / 6]],
        rules.average: [first, (first + second) / 2, (first + second + third) / 3],
        # 1/2 1/4 1/4; 1/16 1/8 1/32; 1/32 1/32 1/64
        rules.product: [[2 / 4, 1 / 4, 1 / 4], [2 / 7, 4 / 7, 1 / 7], [2 / 5, 2 / 5, 1 / 5]],
    }
    for rule, wanted in expected.items():
        np.testing.assert_allclose(rule(DISTANCE), wanted, rtol=1e-5, atol=1e-6)


def test_many_touches_leave_a_belief_finite():
    far = 1e3 * jax.random.uniform(jax.random.key(0), (1000, 4))
    for rule in (rules.votes, rules.average, rules.product):
        belief = np.asarray(jax.jit(rule)(far))
        assert np.all(np.isfinite(belief))
        np.testing.assert_allclose(belief.sum(axis=1), 1, rtol=1e-5)


def informativeness(angles_deg: np.ndarray, safe: object = True, step: float = 5e-3, moved: float = 0.0):
    """Compute the heuristic for points on a line with normals at these angles; one of the second object may move."""
    angle = np.radians(angles_deg)
    points = np.zeros((*angle.shape, 3))
    points[..., 0] = np.arange(angle.shape[1]) * step
    points[1, 1, 0] += moved
    normals = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    safe = np.broadcast_to(np.array(safe, bool), angle.shape)
    return loop.site_informativeness(*(jnp.asarray(part) for part in (points, normals, safe)), 0)


UP = [0, 0, 0, 0]
LEANS = [UP, [0, 50, 60, 80]]  # cosines with the nearest counterparts: 1, cos 50, cos 60, cos 80


@pytest.mark.parametrize(
    ("angles", "options", "expected"),
    [
        (LEANS, {}, [0, 0, 1, 0]),  # 0 degrees is too alike, 80 too different; of two the lower score has no weight
        # An unsafe counterpart does not count: the nearest safe one of point 2 is then point 1 or 3's; both face 50
        # degrees away: equal.
        (LEANS, {"safe": [[1, 1, 1, 1], [1, 1, 0, 1]], "moved": 1e-4}, [0, 0.5, 0.5, 0]),
        ([UP, UP], {"safe": [[1, 0, 1, 0], [1, 1, 1, 1]]}, [0.5, 0, 0.5, 0]),  # none qualifies: any safe point
        (LEANS, {"safe": False}, UP),
        (LEANS, {"safe": [[0, 0, 0, 0], [1, 1, 1, 1]]}, UP),
        # The paper's limits, 0.65 for each other object and 0.2: just inside and just outside.
        ([UP, np.degrees(np.arccos([0.66, 0.64, 0.21, 0.19]))], {}, [0, 0, 1, 0]),
        # The means of the two cosines are all within bounds, but one counterpart of the second point faces 85 degrees
        # away, with a cosine below 0.2.
        ([[0, 0, 0], [60, 30, 65], [60, 85, 60]], {}, [0, 0, 1]),
        # The bound grows with the number of objects: the sum is -2.4, inside -0.65 * 4 but far outside -1.3.
        ([[0, 0], *4 * [[53, 0]]], {"step": 1e-2}, [1, 0]),
    ],
)
def test_the_next_touch_is_where_other_objects_face_elsewhere(angles, options, expected):
    np.testing.assert_allclose(informativeness(np.array(angles, float), **options), expected, atol=1e-5)


def test_distances_from_an_object_are_those_of_trimesh():
    mesh = catalogue.make_object("hammer").mesh
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    low, high = whole.bounds
    points = np.random.default_rng(0).uniform(low - 0.02, high + 0.02, (300, 3))
    surface = prepare_surface(mesh)
    distances = jax.jit(jax.vmap(loop.nearest_distance, (0, None)))(jnp.asarray(points, jnp.float32), surface)
    _, expected, _ = trimesh.proximity.closest_point_naive(whole, points)
    np.testing.assert_allclose(distances, expected, atol=1e-6)
