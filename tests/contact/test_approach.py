"""First contact against closed forms, exact clipping in float64 and rigid motion.

Places are wrong by up to `DELTA`, so a height inside a square is only known between its values for squares larger and
smaller by `DELTA`, within `DELTA`: `bracketed` asserts that.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.clipping import BELOW, DELTA, DOWN, HALF, bracketed, clipped_nearest, of_hammer_s_size, pose, turned
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from i2t.contact.approach import first_contact, meet, move_to_contact, nearest_in_square
from i2t.geometry import inverse, transform
from i2t.objects import make_object, transform_mesh
from i2t.objects.drawing import mesh_from_solid
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import STANDOFF
from i2t.rendering.render import prepare_surface
from i2t.skin.contact import CELL_GRID, FINE_GRID, GRID
from i2t.types import Surface

SEEDS = st.integers(0, 2**32 - 1)
approach = jax.jit(first_contact)
press = jax.jit(move_to_contact)
nearest = jax.jit(nearest_in_square)


@pytest.mark.parametrize("name", ["star", "hammer"])
def test_nearest_agrees_with_clipping(name):
    thing, rng, met = make_object(name).mesh, np.random.default_rng(5), 0
    surface, low, high = of_hammer_s_size(thing), thing.vertices.min(0), thing.vertices.max(0)
    for _ in range(25):
        T = pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(low, high) + 0.01)
        half, behind = rng.uniform(2e-3, 15e-3), (STANDOFF, np.inf, 5e-3)[rng.integers(3)]
        value, far = float(nearest(surface, inverse(T), half, behind)), min(behind, 10.0)
        # The cut at `behind` moves by DELTA as well, and what it cuts off may be anywhere nearer.
        assert clipped_nearest(thing, T, half + DELTA, far + DELTA) - DELTA <= value
        assert value <= clipped_nearest(thing, T, half - DELTA, far - DELTA) + DELTA
        met += np.isfinite(value)
    assert met >= 6


@pytest.mark.parametrize("name", ["cylinder", "pliers"])
def test_groups_of_faces_give_the_nearest_of_all_faces_and_its_slope(name):
    thing, rng = make_object(name).mesh, np.random.default_rng(6)
    surface, low, high = prepare_surface(thing), thing.vertices.min(0), thing.vertices.max(0)
    poses = [transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(low, high)) for _ in range(48)]
    poses += [
        transform(DOWN, np.append(rng.uniform(low, high)[:2], high[2] + 0.01)) for _ in range(16)
    ]  # flat on flat faces
    A = np.array([np.linalg.inv(T) for T in poses], np.float32)
    half, behind = (jnp.float32(rng.choice(some, len(A))) for some in ((2e-3, HALF), (0.0, STANDOFF, np.inf)))
    slope = jax.jit(jax.vmap(jax.value_and_grad(nearest_in_square, argnums=1), (None, 0, 0, 0)))
    by_groups, of_all = (slope(some, A, half, behind) for some in (surface, Surface(surface.triangles)))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6, atol=DELTA), by_groups, of_all)
    assert 24 <= np.isfinite(by_groups[0]).sum() < len(A)


def test_contact_with_an_edge_a_corner_and_with_a_tilted_skin_on_a_flat_top():
    cube = transform_mesh(
        mesh_from_solid(Manifold.cube((30, 30, 30), True)), transform(np.eye(3), np.array([0, 0, -15e-3]))
    )
    corner_up, _ = Rotation.align_vectors([[0, 0, 1]], [np.ones(3) / np.sqrt(3)])
    for turn, top in ((Rotation.from_euler("x", 45, degrees=True), np.sqrt(2)), (corner_up, np.sqrt(3))):
        T, hit = press(prepare_surface(turned(cube, turn)), pose(DOWN, [2e-3, 1e-3, 60e-3]), BELOW)
        assert hit
        np.testing.assert_allclose(T[:3, 3], [2e-3, 1e-3, 15e-3 * top], atol=DELTA)
    surface = prepare_surface(make_object("square").mesh)  # top at 30 mm, 50 mm wide
    for tilt in (0.05, 0.3):
        R = Rotation.from_euler("xyz", [tilt, -0.7 * tilt, 1.0]).as_matrix() @ DOWN
        d = np.array([0.3, -0.2, -1]) / np.linalg.norm([0.3, -0.2, -1])
        for start, way in (([0, 0, 60e-3], [0, 0, -1]), ([0, 0, 60e-3] - 20e-3 * d * [1, 1, 0], d)):
            T, hit = press(surface, pose(R, start), jnp.asarray(way, jnp.float32))
            assert hit
            # The lowest corner of the square face arrives first, also from the side.
            assert float(T[2, 3]) == pytest.approx(30e-3 + HALF * np.abs(R[2, :2]).sum(), abs=DELTA)


def test_a_press_beyond_the_maximum_distance_misses():
    surface = prepare_surface(make_object("square").mesh)
    above = pose(DOWN, [0, 0, 60e-3])
    for max_distance, expected in ((30e-3 - 2 * DELTA, False), (30e-3 + 2 * DELTA, True)):
        T, hit = press(surface, above, BELOW, HALF, max_distance)
        assert bool(hit) is expected
        assert float(T[2, 3]) == pytest.approx(30e-3, abs=3 * DELTA)
    # Beside the object; sideways and backwards, where the face does not lead; and up to a top that lies behind.
    for start, direction, distance in (
        (pose(DOWN, [50e-3, 0, 60e-3]), BELOW, 70e-3),
        (above, jnp.array([1.0, 0, 0]), 20e-3),
        (above, -BELOW, 20e-3),
        (pose(np.eye(3), [0, 0, 31e-3]), -BELOW, 20e-3),
    ):
        T, hit = press(surface, start, direction, HALF, distance)
        assert not hit
        np.testing.assert_allclose(T, start.at[:3, 3].add(distance * direction), atol=1e-8)


@settings(deadline=None, max_examples=25)
@given(SEEDS)
def test_contact_agrees_with_clipping_and_does_not_depend_on_the_world_frame(seed):
    rng, thing = np.random.default_rng(seed), make_object("star").mesh
    R = Rotation.random(random_state=rng).as_matrix()
    tilt = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0])
    direction = R @ tilt / np.linalg.norm(tilt)
    start = np.array([*rng.uniform(-0.02, 0.02, 2), 15e-3]) - 70e-3 * direction

    def travelled(g, half):
        """The distance to contact where the world is moved by g."""
        way, T = g[:3, :3] @ direction, jnp.asarray(g @ np.asarray(pose(R, start), np.float64), jnp.float32)
        found, hit = press(prepare_surface(transform_mesh(thing, g)), T, jnp.asarray(way, jnp.float32), half, 0.1)
        return float(np.asarray(found[:3, 3] - T[:3, 3], np.float64) @ way), hit

    distance, hit = travelled(np.eye(4), HALF)
    assume(bool(hit))
    # Shear the world in float64 so that the tool's z axis becomes the direction, and cut exactly. Places move by DELTA
    # in the pose and in the distance, and distance exceeds height by at most 1 / cos < 1.15 (tilt up to 0.57).
    A = np.linalg.inv(transform(np.stack([R[:, 0], R[:, 1], direction], -1), start))
    sheared = transform_mesh(thing, A)
    assert bracketed(distance, lambda half: clipped_nearest(sheared, np.eye(4), half, 0.0), HALF, 3 * DELTA)
    g = transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3))
    there, _ = travelled(g, HALF)
    assert bracketed(there, lambda half: travelled(np.eye(4), half)[0], HALF, 4 * DELTA)  # two evaluations


@pytest.mark.parametrize("turn", [0.0, 0.05, 0.3])
def test_first_contact_is_that_on_the_line_along_tool_z(turn):
    surface = prepare_surface(make_object("star").mesh)
    T = pose(Rotation.from_euler("xyz", [turn, -0.7 * turn, 1.0]).as_matrix() @ DOWN, [3e-3, -2e-3, 40e-3])
    start = T.at[:3, 3].add(-20e-3 * T[:3, 2])
    for beyond in (50e-3, 2e-3):  # the second ends in the air
        contact = approach(surface, T, before=20e-3, beyond=beyond)
        T_w_t, hit = press(surface, start, start[:3, 2], HALF, 20e-3 + beyond)
        assert contact.hit == hit == (beyond > 2e-3)
        np.testing.assert_allclose(contact.T_w_t, T_w_t, atol=DELTA)
        assert float(contact.distance) == pytest.approx(float((T_w_t[:3, 3] - T[:3, 3]) @ T[:3, 2]), abs=DELTA)


@pytest.mark.parametrize("grid", [CELL_GRID, GRID, FINE_GRID])
def test_cells_see_a_tilted_flat_top_half_a_cell_behind_its_first_contact(grid):
    surface = prepare_surface(make_object("square").mesh)
    look = jax.jit(lambda T: meet(surface, T, grid=grid))
    for tilt in (0.0, 0.02, 0.2):
        R = Rotation.from_euler("xyz", [tilt, -0.7 * tilt, 1.0]).as_matrix() @ DOWN
        contact, facing = look(pose(R, [0, 0, 40e-3]))
        slopes = np.abs(R[2, :2] / R[2, 2])
        assert contact.hit
        assert float(facing.nearest) == pytest.approx(grid.spacing / 2 * slopes.sum(), abs=2 * DELTA)
        assert float(facing.depth.min()) == 0


@pytest.mark.parametrize("name", ["hammer", "star"])
def test_rays_meet_a_surface_behind_its_exact_contact_and_finer_ones_nearer_to_it(name):
    thing, rng = make_object(name).mesh, np.random.default_rng(7)
    surface, low, high = prepare_surface(thing), thing.vertices.min(0), thing.vertices.max(0)
    look = {grid: jax.jit(lambda T, grid=grid: meet(surface, T, grid=grid)) for grid in (CELL_GRID, FINE_GRID)}
    late = []
    for _ in range(40):
        R = Rotation.from_rotvec([*rng.normal(scale=0.1, size=2), rng.uniform(0, 6)]).as_matrix() @ DOWN
        T = pose(R, np.append(rng.uniform(low, high)[:2], high[2]))
        (coarse, seen), (fine, seen_finer) = (look[grid](T) for grid in (CELL_GRID, FINE_GRID))
        np.testing.assert_allclose(coarse.T_w_t, fine.T_w_t, atol=DELTA)
        if coarse.hit and fine.hit:
            late.append((float(seen.nearest), float(seen_finer.nearest)))
    late = np.array(late)
    assert len(late) > 10
    assert late.min() > -2 * DELTA
    assert np.median(late[:, 1]) < 0.05e-3  # a tenth of the coarse cells' half diagonal at slopes of 0.1
    assert late[:, 1].mean() < late[:, 0].mean()


STEP = 1e-3  # of a direction: micrometres, a hundred times what the clipping in float64 takes as equal


@partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})  # compiles in half the time
def slopes(surfaces: Surface, A_t_w: jnp.ndarray, half: jnp.ndarray, along: tuple):
    """Of many scenes: the value, its gradient, and its derivative along a direction in forward mode."""

    def one(triangles, A, half, along):
        at = (triangles, A, half)
        found, push = jax.linearize(lambda t, A, half: nearest_in_square(Surface(t), A, half, jnp.inf), *at)
        return found, jax.linear_transpose(push, *at)(jnp.ones(())), push(*along)

    return jax.vmap(one)(surfaces.triangles, A_t_w, half, along)


@pytest.mark.full
def test_derivatives_agree_with_differences_of_exact_clipping():
    rng = np.random.default_rng(8)
    scenes, faces, empty = 60, 10, 6
    place = rng.uniform(-0.02, 0.02, (scenes, faces, 1, 3)) + np.array([0, 0, 0.03])
    triangles = place + rng.uniform(-0.015, 0.015, (scenes, faces, 3, 3))
    points = np.repeat(triangles[:, :1, :1], empty // 2, 1).repeat(3, 2)  # empty faces, as near as the others
    triangles = np.concatenate([points, triangles, points], 1)
    triangles[-1, :, :, 0] += 1  # nothing in the square
    triangles[-2] = 0  # and no surface at all
    A = np.tile(np.eye(4), (scenes, 1, 1))
    A[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.3, size=(scenes, 3))).as_matrix()
    A[:, :2, 2] += rng.normal(scale=0.3, size=(scenes, 2))  # sheared, as for an approach from the side
    A[:, :3, 3] = rng.normal(scale=2e-3, size=(scenes, 3))
    # A direction moves corners by millimetres per unit, the map's rotation by what moves corners at 30 mm as far.
    change = np.zeros_like(A)
    change[:, :3] = rng.normal(size=(scenes, 3, 4)) * [0.03, 0.03, 0.03, 1e-3]
    along = (rng.normal(scale=1e-3, size=triangles.shape), change, rng.normal(scale=1e-3, size=scenes))
    at, along = (tuple(map(np.float32, x)) for x in ((triangles, A, rng.uniform(4e-3, 12e-3, scenes)), along))
    value, gradient, forward = slopes(Surface(at[0]), *at[1:], along)

    terms = [(np.asarray(g) * d).reshape(scenes, -1) for g, d in zip(gradient, along, strict=True)]
    assert all(np.isfinite(term).all() for term in terms)
    backward, size = (sum(f(term).sum(1) for term in terms) for f in (np.asarray, np.abs))
    # Some fifty roundings in each order of the chain rule.
    np.testing.assert_array_less(np.abs(backward - forward), 50 * np.finfo(np.float32).eps * (size + 1e-3))
    assert np.isinf(value[-2:]).all()
    np.testing.assert_array_equal(forward[-2:], 0)

    def exact(i: int, step: float) -> float:
        t, A, half = (np.float64(x[i]) + step * d[i] for x, d in zip(at, along, strict=True))
        soup = Mesh(t[empty // 2 : -(empty // 2)].reshape(-1, 3), np.arange(3 * faces).reshape(-1, 3))
        return clipped_nearest(soup, np.linalg.inv(A), half, 10.0)

    compared = 0
    for i in range(scenes - 2):
        low, middle, high = (exact(i, step) for step in (-STEP, 0.0, STEP))
        if np.isinf(middle):
            assert np.isinf(value[i])
            assert forward[i] == 0
        # A step moves corners by a micrometre, a thousandth of an edge: what bends by more than that part is a kink.
        elif abs(high - 2 * middle + low) <= 1e-3 * STEP * size[i]:
            compared += 1
            # In float32 places move by DELTA, less than a thousandth of a millimetre's edge.
            assert forward[i] == pytest.approx((high - low) / (2 * STEP), abs=1e-3 * float(size[i]))
            [moved] = np.flatnonzero(np.abs(gradient[0][i]).sum((1, 2)))  # the nearest face alone
            assert empty // 2 <= moved < faces + empty // 2
    assert compared > scenes / 2
