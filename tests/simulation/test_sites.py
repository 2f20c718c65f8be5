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
from scipy import stats
from scipy.spatial.transform import Rotation

from i2t.geometry import contact_frame, inverse
from i2t.objects import make_object, transform_mesh
from i2t.objects.solids import Mesh, ball, box, mesh_from_solid
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.simulation import sites as touch_sites
from i2t.simulation.sites import SiteLimits, collect_sites, nearest_in_square, press_along, sample_points, sample_sites
from i2t.types import PAD_WINDOW, STANDOFF, Surface

DELTA = 3e-7
HALF = PAD_WINDOW / 2
RARE = 1e-6  # chance of a false alarm in each statistical test, were its key drawn anew

sites_of = jax.jit(sample_sites, static_argnums=(2, 3, 4))
press = jax.jit(press_along)
nearest = jax.jit(nearest_in_square)
points_of = jax.jit(sample_points, static_argnums=2)
frame = jax.jit(contact_frame)
is_open = jax.jit(touch_sites.is_unoccluded, static_argnums=2)


def pose(rotation, position) -> jnp.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return jnp.asarray(T, jnp.float32)


DOWN = np.diag([1.0, -1.0, -1.0])  # the tool looks straight down


def placed(thing: Mesh, rotation=None, position=(0.0, 0.0, 0.0)) -> Mesh:
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if rotation is None else rotation
    T[:3, 3] = position
    return transform_mesh(thing, T)


def clipped_nearest(thing: Mesh, T_w_t, half: float, behind: float) -> float:
    """The same question answered in float64 by cutting the mesh with the four planes of the square prism."""
    T_t_w = np.linalg.inv(np.asarray(T_w_t, np.float64))
    moved = transform_mesh(thing, T_t_w)
    planes = [
        ([1, 0, 0], [-half, 0, 0]),
        ([-1, 0, 0], [half, 0, 0]),
        ([0, 1, 0], [0, -half, 0]),
        ([0, -1, 0], [0, half, 0]),
    ]
    planes.append(([0, 0, 1], [0, 0, -behind]))
    cut = trimesh.Trimesh(moved.vertices, moved.faces, process=False)
    for normal, origin in planes:
        cut = cut.slice_plane(origin, normal, cap=False)
        if not len(cut.faces):
            return np.inf
    return cut.triangles.reshape(-1, 3)[:, 2].min()


def bracketed(value: float, reference, half: float, error: float = DELTA) -> bool:
    """Whether `value` lies between reference(half + error) and reference(half - error), within `error`."""
    return bool(reference(half + error) - error <= value <= reference(half - error) + error)


# --- sampling ---------------------------------------------------------------------------------------------------------


def test_points_are_uniform_over_area_and_never_on_empty_faces():
    star = prepare_surface(make_object("wedge").mesh)
    faces = np.asarray(star.triangles)[:12]
    empty = np.broadcast_to(faces[0, 0], (5, 3, 3))
    line = np.stack([faces[0, 0], faces[0, 1], faces[0, 1]])[None]  # no area either, though not a point
    mixed = np.concatenate([empty, faces[:6], line, empty, faces[6:], empty])
    n = 40_000
    points, normals = points_of(jax.random.key(3), Surface(mixed), n)
    cross = np.cross(mixed[:, 1] - mixed[:, 0], mixed[:, 2] - mixed[:, 0]).astype(np.float64)
    area = np.linalg.norm(cross, axis=1) / 2

    # Which face each point lies on: the one of its normal in whose plane and sides it lies best.
    weights, misfit = [], []
    for triangle, unit in zip(faces, cross[area > 0] / (2 * area[area > 0])[:, None], strict=True):
        basis = np.stack([triangle[1] - triangle[0], triangle[2] - triangle[0], unit], -1).astype(np.float64)
        b, c, height = np.linalg.solve(basis, (np.asarray(points, np.float64) - triangle[0]).T)
        weights.append(np.stack([1 - b - c, b, c]))
        wrong = np.abs(np.asarray(normals) @ unit - 1) > 1e-6
        misfit.append(np.maximum(np.abs(height), -PAD_WINDOW * weights[-1].min(0)) + wrong)
    face = np.argmin(misfit, 0)
    assert np.min(misfit, 0).max() < DELTA  # each point is on a real face, and has its normal
    inside = np.stack(weights)[face, :, np.arange(n)]
    # Cut each face at the middles of its sides: four parts of equal area, so places inside a face are tested as well.
    part = np.where(inside.max(1) >= 0.5, inside.argmax(1), 3)
    counts = np.bincount(4 * face + part, minlength=4 * len(faces))
    expected = np.repeat(area[area > 0] / area.sum(), 4) / 4 * n
    assert ((counts - expected) ** 2 / expected).sum() < stats.chi2.isf(RARE, len(counts) - 1)


def test_points_of_wanted_faces_only():
    surface = prepare_surface(make_object("stairs").mesh)
    up = touch_sites.face_normals(surface)[:, 2] > 0.5
    points, normals = points_of(jax.random.key(0), surface, 1000, up)
    assert (normals[:, 2] > 0.999).all()
    heights = np.unique(np.asarray(points)[:, 2].round(5))
    np.testing.assert_allclose(heights, [12e-3, 24e-3, 36e-3], atol=1e-6)


# --- the exact search -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["star", "hammer"])
def test_nearest_agrees_with_clipping_and_bounds_rays(name):
    thing = make_object(name).mesh
    surface = Surface(
        stack_surfaces([prepare_surface(thing), prepare_surface(make_object("hammer").mesh)]).triangles[0]
    )  # one size, one compilation
    rng = np.random.default_rng(5)
    rays = trimesh.ray.ray_pyembree.RayMeshIntersector(trimesh.Trimesh(thing.vertices, thing.faces, process=False))
    met = 0
    for _ in range(40):
        low, high = thing.vertices.min(0), thing.vertices.max(0)
        T = pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(low, high) + 0.01)
        half, behind = rng.uniform(2e-3, 15e-3), (STANDOFF, np.inf, 5e-3)[rng.integers(3)]
        value = float(nearest(surface, inverse(T), half, behind))
        reference = partial(clipped_nearest, thing, T, behind=min(behind, 10.0))
        if behind == np.inf:
            assert bracketed(value, reference, half)
        else:  # the cut at `behind` moves by DELTA as well, and what it cuts off may be anywhere nearer
            low_cut = clipped_nearest(thing, T, half + DELTA, behind + DELTA)
            high_cut = clipped_nearest(thing, T, half - DELTA, behind - DELTA)
            assert low_cut - DELTA <= value <= high_cut + DELTA
        grid = (np.arange(24) + 0.5) / 24 * 2 * half - half
        x, y = np.meshgrid(grid, grid)
        origins = np.stack([x, y, np.full_like(x, -min(behind, 1.0))], -1).reshape(-1, 3)
        R, p = np.asarray(T[:3, :3], np.float64), np.asarray(T[:3, 3], np.float64)
        starts = origins @ R.T + p
        spots, _, _ = rays.intersects_location(starts, np.broadcast_to(R[:, 2], starts.shape), multiple_hits=False)
        if len(spots):
            met += 1
            # Embree works in float32 at metres from its origin: 1e-6 m covers its distance of up to 1 m.
            assert value <= ((spots - p) @ R[:, 2]).min() + 1e-6
    assert met >= 10


def test_nearest_by_hand():
    roof = Surface(np.array([[[-1, -1, 0.3], [1, -1, 0.3], [0, 2, 0.6]]], np.float32))  # z = 0.4 + 0.1 y
    A = jnp.eye(4)
    # Only corners of the square are involved: y from -0.1 to 0.1.
    assert nearest(roof, A, 0.1, STANDOFF) == pytest.approx(0.39, abs=1e-7)
    # The lower side of the triangle, inside a square that reaches beyond.
    assert nearest(roof, A, 1.5, STANDOFF) == pytest.approx(0.3, abs=1e-7)
    # A wall seen edge on: x = 0, from z = 0.2 at y = -1 to z = 0 at y = 1.
    wall = Surface(np.array([[[0, -1, 0.2], [0, 1, 0.0], [0, 1, 0.5]]], np.float32))
    assert nearest(wall, A, 0.5, STANDOFF) == pytest.approx(0.05, abs=1e-7)
    assert nearest(wall, A.at[0, 3].set(0.6), 0.5, STANDOFF) == np.inf
    # A face through the plane where rays begin starts there; one wholly behind does not count.
    steep = Surface(np.array([[[-1, 0, -1], [1, -1, 1], [1, 1, 1]]], np.float32))  # z = x
    assert nearest(steep, A, 0.5, 0.25) == pytest.approx(-0.25, abs=1e-7)
    assert nearest(steep, A, 0.5, np.inf) == pytest.approx(-0.5, abs=1e-7)
    assert nearest(steep, A.at[2, 3].set(-0.6), 0.5, 0.05) == np.inf
    # Nothing but empty faces.
    assert nearest(Surface(np.zeros((4, 3, 3), np.float32)), A, 0.5, np.inf) == np.inf


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_nearest_does_not_depend_on_the_world_frame(seed):
    rng = np.random.default_rng(seed)
    thing = make_object("pyramid").mesh
    T = pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.03, 0.03, 3))
    g = np.eye(4)
    g[:3, :3], g[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3)
    there = nearest(
        prepare_surface(transform_mesh(thing, g)), inverse(jnp.asarray(g @ np.asarray(T), jnp.float32)), HALF, np.inf
    )
    surface = prepare_surface(thing)
    # Two evaluations, each wrong by DELTA.
    assert bracketed(float(there), lambda half: float(nearest(surface, inverse(T), half, np.inf)), HALF, 2 * DELTA)


# --- first contact ----------------------------------------------------------------------------------------------------

RADIUS = 25e-3
# Its centre lies RADIUS above the table: the lowest corner of an octahedral sphere is a pole
SPHERE = mesh_from_solid(ball(25.0))
CENTRE = np.array([0, 0, RADIUS])


def sagitta(thing: Mesh) -> float:
    """How far the flat faces of a sphere's mesh lie below the sphere."""
    t = thing.vertices[thing.faces] - CENTRE
    n = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    return float((RADIUS - np.abs((n * t[:, 0]).sum(1)) / np.linalg.norm(n, axis=1)).max())


def test_press_on_a_sphere_straight_and_slanted():
    surface, gap = prepare_surface(SPHERE), sagitta(SPHERE)
    rng = np.random.default_rng(1)
    for _ in range(30):
        R = Rotation.random(random_state=rng).as_matrix()
        tilt = np.array([*rng.uniform(-0.5, 0.5, 2), 1.0])
        direction = R @ tilt / np.linalg.norm(tilt)
        touched = CENTRE - RADIUS * R[:, 2]  # the point of the sphere that faces the skin
        aside = R[:, :2] @ rng.uniform(-9e-3, 9e-3, 2)  # and where it will lie on the skin, seen from the centre
        moved = rng.uniform(10e-3, 50e-3)
        T, hit = press(surface, pose(R, touched - aside - moved * direction), jnp.asarray(direction, jnp.float32))
        assert hit
        moved = (np.asarray(T[:3, 3]) - (touched - aside)) @ direction
        # A corner of the mesh is on the sphere, its faces up to the sagitta below: that much later along the normal.
        assert -DELTA <= moved <= (gap + DELTA) / (direction @ R[:, 2])
        np.testing.assert_array_equal(T[:3, :3], jnp.asarray(R, jnp.float32))


def test_press_on_a_sphere_with_an_edge_and_with_a_corner_of_the_skin():
    surface, gap = prepare_surface(SPHERE), sagitta(SPHERE)
    for a, b in ((17e-3, 3e-3), (16e-3, 18e-3)):  # the sphere's axis lies beyond x = 10 mm, and beyond the corner
        beyond = np.maximum(np.array([a, b]) - HALF, 0)
        below = RADIUS - np.sqrt(
            RADIUS**2 - (beyond**2).sum()
        )  # top of the sphere's part above the square, below its pole
        start = pose(DOWN, [-a, b, 2 * RADIUS + 20e-3])  # y of the tool is -y of the world
        T, hit = press(surface, start, jnp.array([0.0, 0.0, -1.0]))
        assert hit
        slope = np.hypot(*beyond) / np.sqrt(RADIUS**2 - (beyond**2).sum())
        late = 2 * RADIUS - below - float(T[2, 3])
        # A gap along the normal is gap / cos = gap sqrt(1 + slope^2) along z.
        assert -DELTA <= late <= (gap + DELTA) * np.sqrt(1 + slope**2) + DELTA


def test_press_on_an_edge_and_on_a_corner():
    cube = placed(mesh_from_solid(box((30, 30, 30))), position=(0, 0, -15e-3))  # centred on the origin
    on_edge = placed(cube, Rotation.from_euler("x", 45, degrees=True).as_matrix())
    diagonal = np.array([1, 1, 1]) / np.sqrt(3)
    turn = Rotation.align_vectors([[0, 0, 1]], [diagonal])[0].as_matrix()
    on_corner = placed(cube, turn)
    for thing, top in ((on_edge, 15e-3 * np.sqrt(2)), (on_corner, 15e-3 * np.sqrt(3))):
        T, hit = press(prepare_surface(thing), pose(DOWN, [2e-3, 1e-3, 60e-3]), jnp.array([0.0, 0.0, -1.0]))
        assert hit
        np.testing.assert_allclose(T[:3, 3], [2e-3, 1e-3, top], atol=DELTA)


def test_press_with_a_tilted_skin_on_a_flat_top():
    surface = prepare_surface(make_object("square").mesh)  # top at 30 mm, 50 mm wide
    for tilt in (0.05, 0.3):
        R = Rotation.from_euler("xyz", [tilt, -0.7 * tilt, 1.0]).as_matrix() @ DOWN
        T, hit = press(surface, pose(R, [0, 0, 60e-3]), jnp.array([0.0, 0.0, -1.0]))
        assert hit
        # The lowest corner of the square face arrives first.
        assert float(T[2, 3]) == pytest.approx(30e-3 + HALF * np.abs(R[2, :2]).sum(), abs=DELTA)
        # Coming in from the side, the face stops at the same height.
        d = np.array([0.3, -0.2, -1]) / np.linalg.norm([0.3, -0.2, -1])
        start = np.array([0, 0, 60e-3]) - 20e-3 * d * [1, 1, 0]
        S, hit = press(surface, pose(R, start), jnp.asarray(d, jnp.float32))
        assert hit
        assert float(S[2, 3]) == pytest.approx(float(T[2, 3]), abs=2 * DELTA)


def test_air():
    surface = prepare_surface(make_object("square").mesh)
    down = jnp.array([0.0, 0.0, -1.0])
    aside = pose(DOWN, [50e-3, 0, 60e-3])
    T, hit = press(surface, aside, down, HALF, 70e-3)
    assert not hit
    np.testing.assert_allclose(T, aside.at[2, 3].set(-10e-3), atol=1e-8)
    above = pose(DOWN, [0, 0, 60e-3])
    for max_distance, expected in ((30e-3 - 2 * DELTA, False), (30e-3 + 2 * DELTA, True)):
        T, hit = press(surface, above, down, HALF, max_distance)
        assert bool(hit) is expected
        assert float(T[2, 3]) == pytest.approx(30e-3, abs=3 * DELTA)
    for direction in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]):  # sideways and backwards: the face does not lead
        T, hit = press(surface, above, jnp.array(direction), HALF, 20e-3)
        assert not hit
        np.testing.assert_allclose(T[:3, 3], above[:3, 3] + 20e-3 * jnp.array(direction), atol=1e-8)
    # What is behind the face is not met: below the top and looking up from inside, the face meets nothing but the top.
    T, hit = press(surface, pose(np.eye(3), [0, 0, 31e-3]), -down)
    assert not hit


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_contact_agrees_with_clipping_and_does_not_depend_on_the_world_frame(seed):
    rng = np.random.default_rng(seed)
    thing = make_object("star").mesh
    R = Rotation.random(random_state=rng).as_matrix()
    tilt = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0])
    direction = R @ tilt / np.linalg.norm(tilt)
    start = np.array([*rng.uniform(-0.02, 0.02, 2), 15e-3]) - 70e-3 * direction
    surface = prepare_surface(thing)
    T, hit = press(surface, pose(R, start), jnp.asarray(direction, jnp.float32), HALF, 0.1)
    assume(bool(hit))
    distance = float((np.asarray(T[:3, 3], np.float64) - start) @ direction)

    # Shear the world in float64 so that the tool's z axis becomes the direction, and cut exactly. Places move by DELTA
    # in the pose and in the distance, and distance exceeds height by at most 1 / cos < 1.15 (tilt up to 0.57).
    A = np.eye(4)
    A[:3, :3] = np.linalg.inv(np.stack([R[:, 0], R[:, 1], direction], -1))
    A[:3, 3] = -A[:3, :3] @ start
    sheared = transform_mesh(thing, A)
    assert bracketed(distance, lambda half: clipped_nearest(sheared, np.eye(4), half, 0.0), HALF, 3 * DELTA)

    g = np.eye(4)
    g[:3, :3], g[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3)
    other = prepare_surface(transform_mesh(thing, g))
    there = jnp.asarray(g @ np.asarray(pose(R, start), np.float64), jnp.float32)
    turned = jnp.asarray(g[:3, :3] @ direction, jnp.float32)

    def moved(half):
        found, _ = press(surface, pose(R, start), jnp.asarray(direction, jnp.float32), half, 0.1)
        return float((np.asarray(found[:3, 3]) - start) @ direction)

    U, _ = press(other, there, turned, HALF, 0.1)
    distance = float((np.asarray(U[:3, 3]) - np.asarray(there[:3, 3])) @ np.asarray(turned))
    assert bracketed(distance, moved, HALF, 4 * DELTA)  # two evaluations


# --- safety -----------------------------------------------------------------------------------------------------------


def test_upward():
    for angle in (0.0, 1.0, 1.3, 1.32, 2.0, np.pi):
        normal = jnp.array([np.sin(angle), 0.0, np.cos(angle)], jnp.float32)
        T = frame(jnp.zeros(3), normal, 0.7)
        assert bool(touch_sites.is_upward(T, SiteLimits())) is bool(
            np.cos(angle) > 0.25
        )  # cos 1.3 = 0.267, cos 1.32 = 0.248
        assert bool(touch_sites.is_upward(T, touch_sites.RECOGNITION_LIMITS)) is bool(np.cos(angle) > 0.5)


@pytest.mark.parametrize(("height", "aside", "safe"), [(2.9, 5, True), (3.1, 5, False), (60, 5, False), (60, 12, True)])
def test_nothing_rises_above_the_contact_plane(height, aside, safe):
    plate = box((80, 80, 20), (0, 0, -10))
    post = box((2, 2, height + 1), (aside, 0, height / 2 - 0.5))
    surface = prepare_surface(mesh_from_solid(plate + post))
    T = frame(jnp.array([0.0, 0.0, 20e-3]), jnp.array([0.0, 0.0, 1.0]), 0.0)
    assert bool(is_open(surface, T, SiteLimits())) is safe


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1))
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
    surface, limits = prepare_surface(thing), SiteLimits()
    sites = sites_of(jax.random.key(2), surface, 40, limits, 8)
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


@pytest.mark.full
def test_sites_are_uniform_in_place_and_spin():
    # Every point of a wide flat top is safe, and nothing else looks up.
    surface = prepare_surface(make_object("square").mesh)
    sites = sites_of(jax.random.key(5), surface, 1000, SiteLimits(), 2)
    assert sites.safe.all()
    T = np.asarray(sites.T_w_t)
    np.testing.assert_allclose(T[:, 2, 3], 30e-3, atol=DELTA)
    np.testing.assert_allclose(T[:, 2, 2], -1, atol=1e-6)
    spin = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    for values, low, width in ((T[:, 0, 3], -25e-3, 50e-3), (T[:, 1, 3], -25e-3, 50e-3), (spin, -np.pi, 2 * np.pi)):
        assert stats.kstest(values, stats.uniform(low, width).cdf).pvalue > RARE


@pytest.mark.full
def test_sites_of_many_objects_at_once_are_those_of_each_alone():
    surfaces = stack_surfaces([prepare_surface(make_object(name).mesh) for name in ("square", "wedge", "stairs")])
    keys = jax.random.split(jax.random.key(1), 3)
    together = jax.jit(jax.vmap(lambda key, surface: sample_sites(key, surface, 5)))(keys, surfaces)
    for i, key in enumerate(jax.random.split(jax.random.key(1), 3)):
        alone = sites_of(key, Surface(surfaces.triangles[i]), 5, SiteLimits(), 8)
        # The same arithmetic in another order: one place or direction may round differently.
        np.testing.assert_allclose(together.T_w_t[i], alone.T_w_t, atol=1e-6)
        np.testing.assert_array_equal(together.safe[i], alone.safe)


def test_too_few_sites():
    pyramid, upright = make_object("pyramid").mesh, SiteLimits(min_cos=0.99)
    frames = collect_sites(jax.random.key(0), prepare_surface(pyramid), 20, upright, "pyramid")
    np.testing.assert_allclose(frames[:, 2, 3], 35e-3, atol=DELTA)  # its flat top is the only upright face
    fallen = prepare_surface(placed(pyramid, Rotation.from_euler("x", 45, degrees=True).as_matrix(), [0, 0, 50e-3]))
    with pytest.raises(ValueError, match=r"^the pyramid has too few safe sites: 0 of 20"):
        collect_sites(jax.random.key(0), fallen, 20, upright, "the pyramid", rounds=2)


def test_what_fills_up_is_no_pose():
    # Beside the stamp's relief, 3.5 mm above its base, most of the base is unsafe; nothing else is.
    stamp, hammer = make_object("stamp-triangle").mesh, make_object("hammer").mesh
    surface = Surface(
        stack_surfaces([prepare_surface(stamp), prepare_surface(hammer)]).triangles[0]
    )  # the size of another test: one compilation
    sites = sites_of(jax.random.key(0), surface, 40, SiteLimits(), 8)
    found = int(sites.safe.sum())
    assert 0 < found < 40
    np.testing.assert_array_equal(sites.safe, np.arange(40) < found)
    assert np.isnan(sites.T_w_t[found:]).all()  # no arm goes there
    for T in np.asarray(sites.T_w_t[:found], np.float64):
        assert clipped_nearest(stamp, T, HALF - DELTA, 10.0) >= -3e-3 - DELTA


def test_points_of_no_face_are_no_points():
    surface = prepare_surface(make_object("square").mesh)
    for found in points_of(jax.random.key(0), surface, 4, jnp.zeros(len(surface.triangles), bool)):
        assert np.isnan(found).all()


# --- derivatives ------------------------------------------------------------------------------------------------------

STEP = 1e-3  # of a direction: micrometres, a hundred times what the clipping in float64 takes as equal


@partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})  # compiles in half the time
def slopes(surfaces: Surface, A_t_w: jnp.ndarray, half: jnp.ndarray, along: tuple):
    """Of many scenes: the value, its gradient, and its derivative along a direction in forward mode."""

    def one(triangles, A, half, along):
        def value(triangles, A, half):
            return nearest_in_square(Surface(triangles), A, half, jnp.inf)

        at = (triangles, A, half)
        found, push = jax.linearize(value, *at)
        return found, jax.linear_transpose(push, *at)(jnp.ones(())), push(*along)

    return jax.vmap(one)(surfaces.triangles, A_t_w, half, along)


@pytest.mark.full
def test_derivatives_agree_with_differences_of_exact_clipping():
    rng = np.random.default_rng(8)
    scenes, faces, empty = 60, 10, 6
    place = rng.uniform(-0.02, 0.02, (scenes, faces, 1, 3)) + np.array([0, 0, 0.03])
    triangles = (place + rng.uniform(-0.015, 0.015, (scenes, faces, 3, 3))).astype(np.float32)
    points = np.repeat(triangles[:, :1, :1], empty, 1).repeat(3, 2)  # empty faces, as near as the others
    triangles = np.concatenate([points[:, : empty // 2], triangles, points[:, empty // 2 :]], 1)
    triangles[-1, :, :, 0] += 1  # nothing in the square
    triangles[-2] = 0  # and no surface at all
    A = np.tile(np.eye(4), (scenes, 1, 1))
    A[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.3, size=(scenes, 3))).as_matrix()
    A[:, :2, 2] += rng.normal(scale=0.3, size=(scenes, 2))  # sheared, as for an approach from the side
    A[:, :3, 3] = rng.normal(scale=2e-3, size=(scenes, 3))
    half = rng.uniform(4e-3, 12e-3, scenes)
    # A direction moves corners by millimetres per unit, the map's rotation by what moves corners at 30 mm as far.
    change = np.zeros_like(A)
    change[:, :3] = rng.normal(size=(scenes, 3, 4)) * [0.03, 0.03, 0.03, 1e-3]
    along = (rng.normal(scale=1e-3, size=triangles.shape), change, rng.normal(scale=1e-3, size=scenes))
    at = tuple(np.float32(x) for x in (triangles, A, half))
    along = tuple(np.float32(x) for x in along)
    value, gradient, forward = slopes(Surface(at[0]), *at[1:], along)

    for part in gradient:
        assert np.isfinite(part).all()
    backward = sum((np.asarray(g) * d).reshape(scenes, -1).sum(1) for g, d in zip(gradient, along, strict=True))
    size = sum((np.abs(g) * np.abs(d)).reshape(scenes, -1).sum(1) for g, d in zip(gradient, along, strict=True))
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
            continue
        # A step moves corners by a micrometre, a thousandth of an edge: what bends by more than that part is a kink.
        if abs(high - 2 * middle + low) > 1e-3 * STEP * size[i]:
            continue
        compared += 1
        # In float32 places move by DELTA, less than a thousandth of a millimetre's edge.
        assert forward[i] == pytest.approx((high - low) / (2 * STEP), abs=1e-3 * float(size[i]))
        moved = np.flatnonzero(np.abs(gradient[0][i]).sum((1, 2)))
        assert len(moved) == 1  # the nearest face alone
        assert empty // 2 <= moved[0] < faces + empty // 2
    assert compared > scenes / 2


def test_touch_sites_of_a_mesh_are_safe_contacts_on_its_surface():
    box = trimesh.creation.box((0.06, 0.05, 0.06))
    box.apply_translation((0, 0, 0.03))
    mesh = Mesh(np.asarray(box.vertices), np.asarray(box.faces))
    sites = touch_sites.sample_touch_sites(mesh, 12, seed=4)
    assert (sites.T_o_t.shape, sites.points.shape, sites.normals.shape) == ((12, 4, 4), (12, 3), (12, 3))
    np.testing.assert_allclose(sites.points[:, 2], 0.06, atol=1e-6)  # sides look sideways and the bottom down
    np.testing.assert_allclose(sites.normals, np.broadcast_to([0, 0, 1], (12, 3)), atol=1e-6)
    np.testing.assert_allclose(sites.T_o_t[:, :3, 2], -sites.normals, atol=1e-6)
    again = touch_sites.sample_touch_sites(prepare_surface(mesh), 12, seed=4)
    np.testing.assert_array_equal(again.T_o_t, sites.T_o_t)
    assert np.abs(touch_sites.sample_touch_sites(mesh, 12, seed=5).points - sites.points).max() > 1e-3
    with pytest.raises(ValueError, match="the box has too few safe sites"):
        touch_sites.sample_touch_sites(mesh, 2, limits=SiteLimits(min_cos=1.1), name="the box")
