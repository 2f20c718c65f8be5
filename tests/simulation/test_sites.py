"""Touch sites against closed forms, exact clipping in float64 and Embree rays."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers.clipping import BELOW, DELTA, HALF, clipped_nearest, of_hammer_s_size, pose, turned
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from manifold3d import Manifold
from scipy import stats
from scipy.spatial.transform import Rotation

from i2t.geometry import contact_frame, transform
from i2t.objects import make_object, transform_mesh
from i2t.objects.drawing import mesh_from_solid
from i2t.rendering.render import prepare_surface
from i2t.runtime.batching import map_batches
from i2t.simulation import sites as touch_sites
from i2t.simulation.sites import SiteLimits, collect_sites, sample_points, sample_sites
from i2t.types import Surface

RARE = 1e-6  # chance of a false alarm in each statistical test, were its key drawn anew
SEEDS = st.integers(0, 2**32 - 1)

sites_of = jax.jit(sample_sites, static_argnums=(2, 3, 4))
points_of = jax.jit(sample_points, static_argnums=2)
frame = jax.jit(contact_frame)
is_open = jax.jit(touch_sites.is_unoccluded, static_argnums=2)


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
    for empty in points_of(jax.random.key(0), surface, 1000, jnp.zeros(8, bool)):
        assert np.isnan(empty).all()  # of no face there are no points


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


def test_missing_sites_are_nan_and_too_few_sites_are_refused():
    # Beside the stamp's relief, 3.5 mm above its base, most of the base is unsafe; nothing else is.
    stamp = make_object("stamp-triangle").mesh
    sites = sites_of(jax.random.key(0), of_hammer_s_size(stamp), 40, SiteLimits(), 8)
    count = int(sites.safe.sum())
    assert 0 < count < 40
    np.testing.assert_array_equal(sites.safe, np.arange(40) < count)
    assert np.isnan(sites.T_w_t[count:]).all()  # no arm goes there
    for T in np.asarray(sites.T_w_t[:count], np.float64):
        assert clipped_nearest(stamp, T, HALF - DELTA, 10.0) >= -3e-3 - DELTA
    few = collect_sites(jax.random.key(0), of_hammer_s_size(stamp), 40, rounds=1, enough=1)
    assert 0 < len(few) < 40  # a wanted number that the object lacks is no error if fewer suffice
    assert np.isfinite(few).all()
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
    expected = all_candidates_checked(keys, surface, n, SiteLimits(), obstacles)
    assert (expected[1].sum() == 4 * n) == (name == "star")
    assert expected[1].any()
    sample = jax.jit(jax.vmap(lambda key: sample_sites(key, surface, n, SiteLimits(), 8, obstacles)))
    jax.tree.map(np.testing.assert_array_equal, tuple(sample(jax.random.clone(keys))), expected)


def test_touch_sites_of_a_mesh_are_safe_contacts_on_its_surface():
    solid = mesh_from_solid(Manifold.cube((60, 50, 60), True))
    sites = touch_sites.sample_touch_sites(solid, 12, seed=4)
    np.testing.assert_allclose(sites.points[:, 2], 0.06, atol=1e-6)  # sides look sideways and the bottom down
    np.testing.assert_allclose(sites.normals, np.broadcast_to([0, 0, 1], (12, 3)), atol=1e-6)
    np.testing.assert_allclose(sites.T_o_t[:, :3, 2], -sites.normals, atol=1e-6)
    again = touch_sites.sample_touch_sites(prepare_surface(solid), 12, seed=4)
    np.testing.assert_array_equal(again.T_o_t, sites.T_o_t)
    assert np.abs(touch_sites.sample_touch_sites(solid, 12, seed=5).points - sites.points).max() > 1e-3


def test_the_reasons_of_an_unsafe_site_are_those_that_is_safe_checks():
    limits, surface, passes = SiteLimits(), prepare_surface(make_object("hammer").mesh), jax.jit(touch_sites.is_safe)
    points, normals = points_of(jax.random.key(0), surface, 60)
    safe = 0
    for point, normal in zip(np.asarray(points), np.asarray(normals), strict=True):
        T = frame(point, normal)
        why = touch_sites.explain_unsafe(surface, T, limits)
        assert (why == "") == bool(passes(surface, T, limits))
        assert ("degrees from up" in why) == (not touch_sites.is_upward(T, limits))
        assert ("table" in why) == (not touch_sites.is_above_table(T, limits))
        safe += why == ""
    assert 5 < safe < 55
