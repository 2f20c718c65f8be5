"""Touch sites and first contact, against closed forms, exact clipping in float64, Embree rays and rigid motion.

Coordinates here stay below half a metre, where one step of float32 is 3e-8 m. A pose, its inverse, the shear and the
map of a corner take some ten roundings, so every place is wrong by up to DELTA = 3e-7 m. A height inside a square is
then only known between its values for squares larger and smaller by DELTA, within DELTA: `bracketed` asserts that.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from manifold3d import Manifold
from scipy import stats
from scipy.spatial.transform import Rotation

from i2t.geometry import contact_frame, inverse, transform
from i2t.objects import make_object, transform_mesh
from i2t.objects.drawing import mesh_from_solid
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import PAD_WINDOW, STANDOFF
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.runtime.batching import map_batches
from i2t.simulation import sites as touch_sites
from i2t.simulation.sites import SiteLimits, collect_sites, nearest_in_square, press_along, sample_points, sample_sites
from i2t.types import Surface

DELTA = 3e-7
HALF = PAD_WINDOW / 2
RARE = 1e-6  # chance of a false alarm in each statistical test, were its key drawn anew
DOWN = np.diag([1.0, -1.0, -1.0])  # the tool looks straight down
BELOW = jnp.array([0.0, 0.0, -1.0])
SEEDS = st.integers(0, 2**32 - 1)

sites_of = jax.jit(sample_sites, static_argnums=(2, 3, 4))
press = jax.jit(press_along)
nearest = jax.jit(nearest_in_square)
points_of = jax.jit(sample_points, static_argnums=2)
frame = jax.jit(contact_frame)
is_open = jax.jit(touch_sites.is_unoccluded, static_argnums=2)


def pose(rotation, position) -> jnp.ndarray:
    return jnp.asarray(transform(np.asarray(rotation, float), np.asarray(position, float)), jnp.float32)


def turned(thing: Mesh, rotation, position=(0.0, 0.0, 0.0)) -> Mesh:
    return transform_mesh(thing, transform(rotation.as_matrix(), np.array(position)))


def of_hammer_s_size(thing: Mesh) -> Surface:
    """In one size class: one compilation."""
    return Surface(stack_surfaces([prepare_surface(thing), prepare_surface(make_object("hammer").mesh)]).triangles[0])


def clipped_nearest(thing: Mesh, T_w_t, half: float, behind: float) -> float:
    """The same question answered in float64 by cutting the mesh with the planes of the square prism."""
    moved = transform_mesh(thing, np.linalg.inv(np.asarray(T_w_t, np.float64)))
    cut = trimesh.Trimesh(moved.vertices, moved.faces, process=False)
    for normal in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]):
        cut = cut.slice_plane(-(behind if normal[2] else half) * np.array(normal), normal, cap=False)
        if not len(cut.faces):
            return np.inf
    return cut.triangles.reshape(-1, 3)[:, 2].min()


def bracketed(value: float, reference, half: float, error: float = DELTA) -> bool:
    """Whether `value` lies between reference(half + error) and reference(half - error), within `error`."""
    return bool(reference(half + error) - error <= value <= reference(half - error) + error)


def test_points_are_uniform_over_the_wanted_area_and_never_on_empty_faces():
    corners, sides, n = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([10e-3, 15e-3, 20e-3]), 40_000
    low, middle, high = (side * np.add(corners, [0, 0, 1]) for side in sides)  # each in a plane of its own
    line = low * [1, 0, 1]
    surface = Surface(np.float32([0 * low, low, line, middle, 0 * low, 0 * low, high, line]))
    points, normals = map(np.asarray, points_of(jax.random.key(3), surface, n))
    face = np.abs(points[:, 2:] - sides).argmin(1)
    assert np.abs(points[:, 2] - sides[face]).max() < DELTA
    np.testing.assert_allclose(normals, np.tile([0, 0, 1.0], (n, 1)), atol=1e-6)
    b, c = points[:, :2].T / sides[face]
    weights = np.stack([1 - b - c, b, c])
    assert weights.min() * sides.max() > -DELTA
    # Cut each face at the middles of its sides: four parts of equal area, so places inside a face are tested as well.
    counts = np.bincount(4 * face + np.where(weights.max(0) >= 0.5, weights.argmax(0), 3), minlength=12)
    expected = np.repeat(sides**2 / (sides**2).sum(), 4) / 4 * n
    assert ((counts - expected) ** 2 / expected).sum() < stats.chi2.isf(RARE, 11)
    wanted, _ = points_of(jax.random.key(0), surface, 1000, touch_sites.face_normals(surface)[:, 2] > 0.5)
    assert np.isfinite(wanted).all()
    some, _ = points_of(jax.random.key(0), surface, 1000, jnp.arange(8) == 3)
    np.testing.assert_allclose(some[:, 2], sides[1], atol=DELTA)
    for found in points_of(jax.random.key(0), surface, 1000, jnp.zeros(8, bool)):
        assert np.isnan(found).all()  # of no face there are no points


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


def test_press_on_an_edge_a_corner_and_with_a_tilted_skin_on_a_flat_top():
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


def test_air():
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


@pytest.mark.parametrize(("height", "aside", "safe"), [(2.9, 5, True), (3.1, 5, False), (60, 5, False), (60, 12, True)])
def test_nothing_rises_above_the_contact_plane(height, aside, safe):
    block, pin = Manifold.cube((80, 80, 20), True), Manifold.cube((2, 2, height + 1), True)
    surface = prepare_surface(
        mesh_from_solid(block.translate((0, 0, -10)) + pin.translate((aside, 0, height / 2 - 0.5)))
    )
    T = frame(jnp.array([0.0, 0.0, 20e-3]), -BELOW, 0.0)
    assert bool(is_open(surface, T, SiteLimits())) is safe


@settings(deadline=None, max_examples=60)
@given(SEEDS)
def test_flange_and_mount_above_the_table(seed):
    rng = np.random.default_rng(seed)
    limits = SiteLimits(table=-0.01, clearance=2e-3, flange=0.1, mount=0.03, flange_near=0.02, flange_far=0.15)
    T = pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(0, 0.1, 3))
    corners = []
    for edge, near, far in ((0.03, 0.0, 0.02), (0.1, 0.02, 0.15)):
        corners += [(x, y, -z) for x in (-edge / 2, edge / 2) for y in (-edge / 2, edge / 2) for z in (near, far)]
    lowest = (np.array(corners) @ np.asarray(T, np.float64)[:3, :3].T + np.asarray(T)[:3, 3])[:, 2].min()
    assume(abs(lowest + 8e-3) > DELTA)
    assert bool(touch_sites.is_above_table(T, limits)) is bool(lowest >= -8e-3)


@pytest.mark.full
def test_sites_pass_an_independent_check():
    thing = make_object("hammer").mesh
    rays = trimesh.ray.ray_pyembree.RayMeshIntersector(trimesh.Trimesh(thing.vertices, thing.faces, process=False))
    sites = sites_of(jax.random.key(2), prepare_surface(thing), 40, SiteLimits(), 8)
    assert sites.safe.all()
    for T in np.asarray(sites.T_w_t, np.float64):
        R = T[:3, :3]
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-6)  # a dozen float32 roundings of values up to 1
        assert np.linalg.det(R) > 0
        # A ray from 10 um outside meets the surface at the site.
        spot, _, _ = rays.intersects_location([T[:3, 3] - 1e-5 * R[:, 2]], [R[:, 2]], multiple_hits=False)
        np.testing.assert_allclose(spot[0], T[:3, 3], atol=DELTA)
        assert -R[2, 2] > 0.25 - 1e-6
        # Rises are known up to DELTA, and so is the square.
        assert clipped_nearest(thing, T, HALF - DELTA, 10.0) >= -3e-3 - DELTA
        x, y = np.meshgrid([-37.5e-3, 37.5e-3], [-37.5e-3, 37.5e-3])
        for z in (-30e-3, -100e-3):
            assert (T[2, 3] + R[2, 0] * x + R[2, 1] * y + R[2, 2] * z >= 1e-3 - DELTA).all()


def test_what_fills_up_is_no_pose_and_too_few_sites_are_said():
    # Beside the stamp's relief, 3.5 mm above its base, most of the base is unsafe; nothing else is.
    stamp = make_object("stamp-triangle").mesh
    sites = sites_of(jax.random.key(0), of_hammer_s_size(stamp), 40, SiteLimits(), 8)
    found = int(sites.safe.sum())
    assert 0 < found < 40
    np.testing.assert_array_equal(sites.safe, np.arange(40) < found)
    assert np.isnan(sites.T_w_t[found:]).all()  # no arm goes there
    for T in np.asarray(sites.T_w_t[:found], np.float64):
        assert clipped_nearest(stamp, T, HALF - DELTA, 10.0) >= -3e-3 - DELTA
    pyramid, upright = make_object("pyramid").mesh, SiteLimits(min_cos=0.99)
    frames = collect_sites(jax.random.key(0), prepare_surface(pyramid), 20, upright, "pyramid")
    np.testing.assert_allclose(frames[:, 2, 3], 35e-3, atol=DELTA)  # its flat top is the only upright face
    fallen = prepare_surface(turned(pyramid, Rotation.from_euler("x", 45, degrees=True), [0, 0, 50e-3]))
    with pytest.raises(ValueError, match=r"^the pyramid has too few safe sites: 0 of 20"):
        collect_sites(jax.random.key(0), fallen, 20, upright, "the pyramid", rounds=2)


@partial(jax.jit, static_argnums=(2, 3))
def all_candidates_checked(keys, surface, n, limits, obstacles):
    """The sites of each key by all three checks of every candidate, batch by batch."""

    def check(T_w_t):
        free = touch_sites.is_unoccluded(obstacles, T_w_t, limits)
        return free & touch_sites.is_safe(surface, T_w_t, limits)

    def draw(key):
        key_points, key_spin = jax.random.split(key)
        wanted = touch_sites.face_normals(surface)[:, 2] > limits.min_cos
        points, normals = sample_points(key_points, surface, 8 * n, wanted)
        frames = jax.vmap(contact_frame)(points, normals, jax.random.uniform(key_spin, (8 * n,), maxval=2 * jnp.pi))
        safe = map_batches(check, frames, 64)
        first = jnp.argsort(~safe, stable=True)[:n]
        return jnp.where(safe[first][:, None, None], frames[first], jnp.nan), safe[first]

    return jax.lax.map(draw, keys)


# Batches of fewer than the sites, and candidates that run out.
@pytest.mark.parametrize(("name", "n"), [("star", 80), ("stamp-triangle", 40)])
def test_occlusion_of_fewer_candidates_is_checked_for_the_same_sites(name, n):
    rod = mesh_from_solid(Manifold.cube((6, 6, 120), True))
    obstacles = prepare_surface(transform_mesh(rod, transform(np.eye(3), np.array([18e-3, 0, 0]))))
    surface = of_hammer_s_size(make_object(name).mesh)
    keys = jax.random.split(jax.random.key(3), 4)
    wanted = all_candidates_checked(keys, surface, n, SiteLimits(), obstacles)
    assert (wanted[1].sum() == 4 * n) == (name == "star")
    assert wanted[1].any()
    made = jax.jit(jax.vmap(lambda key: sample_sites(key, surface, n, SiteLimits(), 8, obstacles)))
    jax.tree.map(np.testing.assert_array_equal, tuple(made(jax.random.clone(keys))), wanted)


def test_touch_sites_of_a_mesh_are_safe_contacts_on_its_surface():
    solid = mesh_from_solid(Manifold.cube((60, 50, 60), True))
    sites = touch_sites.sample_touch_sites(solid, 12, seed=4)
    np.testing.assert_allclose(sites.points[:, 2], 0.06, atol=1e-6)  # sides look sideways and the bottom down
    np.testing.assert_allclose(sites.normals, np.broadcast_to([0, 0, 1], (12, 3)), atol=1e-6)
    np.testing.assert_allclose(sites.T_o_t[:, :3, 2], -sites.normals, atol=1e-6)
    again = touch_sites.sample_touch_sites(prepare_surface(solid), 12, seed=4)
    np.testing.assert_array_equal(again.T_o_t, sites.T_o_t)
    assert np.abs(touch_sites.sample_touch_sites(solid, 12, seed=5).points - sites.points).max() > 1e-3


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
