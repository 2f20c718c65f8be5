"""The renderer against closed forms, Embree, an exact float64 ray caster, rigid motion and its own batches.

Coordinates here stay below 0.1 m (0.3 m where stated), where one step of float32 is 7e-9 m. A corner on its way to the
tool frame takes about ten roundings, so it is known to NEAR = 1e-7 m, and a height on a surface of slope s to (1 + s)
NEAR.
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from i2t.objects.catalogue import make_object
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH, STANDOFF
from i2t.rendering.bitset import pack_bits
from i2t.rendering.bvh import CLUSTER_SIZES, CLUSTERS_PER_GROUP
from i2t.rendering.raycast import PASS_SIZES
from i2t.rendering.render import contact_mask, prepare_surface, render_heights, render_patch, stack_surfaces

NEAR = 1e-7
EDGE = 1e-6  # m, a ray this near to a projected edge may see either side of it
ERROR = 1e-5  # m, the error that is allowed everywhere else

patch_of = jax.jit(render_patch, static_argnames=("window", "pixels", "reach"))
heights_of = jax.jit(render_heights, static_argnames=("window", "pixels"))
patches_of = jax.jit(jax.vmap(jax.vmap(render_patch, (None, 0))))


def centres(window: float = PATCH_WINDOW, pixels: int = PATCH_PIXELS):
    """x and y (n, n) of the pixels."""
    along = ((np.arange(pixels) + 0.5) / pixels - 0.5) * window
    return np.meshgrid(along, along)


def pose(attitude=None, position=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if attitude is None else attitude
    T[:3, 3] = position
    return T


def soup(triangles) -> SimpleNamespace:
    """A mesh whose faces share no vertices."""
    triangles = np.asarray(triangles, float)
    return SimpleNamespace(vertices=triangles.reshape(-1, 3), faces=np.arange(3 * len(triangles)).reshape(-1, 3))


def sheet(height, n: int, half: float = 0.04) -> SimpleNamespace:
    """The graph z = height(x, y) over a square, n x n cells of two faces each."""
    along = np.linspace(-half, half, n + 1)
    x, y = np.meshgrid(along, along)
    corner = np.arange(n * (n + 1)).reshape(n, n + 1)[:, :n].ravel()
    lower = np.stack([corner, corner + 1, corner + n + 2], 1)
    upper = np.stack([corner, corner + n + 2, corner + n + 1], 1)
    vertices = np.stack([x, y, height(x, y)], -1).reshape(-1, 3)
    return SimpleNamespace(vertices=vertices, faces=np.concatenate([lower, upper]))


def on_surface(thing, count: int, seed: int) -> np.ndarray:
    """Tool poses (count, 4, 4) in all attitudes around the inward normal, -10 to 5 mm off the surface along z."""
    rng = np.random.default_rng(seed)
    whole = trimesh.Trimesh(thing.vertices, thing.faces, process=False)
    points, faces = trimesh.sample.sample_surface(whole, count, seed=seed)
    tilts = Rotation.from_rotvec(rng.normal(0, 0.3, (count, 3)))
    poses = []
    for point, normal, tilt in zip(points, whole.face_normals[faces], tilts, strict=True):
        z = tilt.apply(-normal)
        x = np.cross(z, rng.normal(size=3))
        x /= np.linalg.norm(x)
        poses.append(pose(np.stack([x, np.cross(z, x), z], 1), point + z * rng.uniform(-10e-3, 5e-3)))
    return np.array(poses, np.float32)


def embree_heights(
    triangles: np.ndarray, T_w_t: np.ndarray, window: float = PATCH_WINDOW, pixels: int = PATCH_PIXELS
) -> np.ndarray:
    """Tool z (poses, n, n) of the first hits as Embree finds them."""
    scene = EmbreeScene()
    TriangleMesh(scene, triangles)
    x, y = centres(window, pixels)
    start = np.stack([x, y, np.full_like(x, -STANDOFF)], -1)
    origins = np.einsum("pij,nmj->pnmi", T_w_t[:, :3, :3].astype(float), start) + T_w_t[:, None, None, :3, 3]
    along = np.broadcast_to(T_w_t[:, None, None, :3, 2], origins.shape)
    hits = scene.run(origins.reshape(-1, 3).astype(np.float32), along.reshape(-1, 3).astype(np.float32), output=1)
    z = np.where(hits["primID"] < 0, np.inf, hits["tfar"] - STANDOFF)
    return z.reshape(len(T_w_t), *x.shape)


def exact_ray(triangles: np.ndarray, T_w_t: np.ndarray, x: float, y: float) -> tuple[float, float]:
    """First hit (tool z) of one ray in float64, and its distance from the nearest projected edge, with every face."""
    T = T_w_t.astype(float)
    a, b, c = np.moveaxis((triangles.astype(float) - T[:3, 3]) @ np.linalg.inv(T[:3, :3]).T, 1, 0) - [x, y, 0]
    corners = [a, b, c]
    distance, sides = np.inf, []
    for p, q in zip(corners, [b, c, a], strict=True):
        p2, d = p[:, :2], (q - p)[:, :2]
        t = np.clip(-(p2 * d).sum(1) / np.maximum((d * d).sum(1), 1e-30), 0, 1)
        distance = min(distance, np.linalg.norm(p2 + t[:, None] * d, axis=1).min())
        sides.append(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])  # twice the area of the ray and this edge
    sides = np.array(sides)
    area = sides.sum(0)
    hit = ((sides >= 0).all(0) | (sides <= 0).all(0)) & (area != 0)
    weights = np.roll(sides, -1, 0) / np.where(area == 0, 1, area)  # of corners a, b, c
    z = sum(w * p[:, 2] for w, p in zip(weights, corners, strict=True))
    z = z[hit & (z >= -STANDOFF)]
    return (z.min() if len(z) else np.inf), distance


def assert_like_embree(things: list, seed: int, count: int = 30) -> None:
    """Every pixel is right to ERROR; where float32 Embree disagrees, a float64 caster decides, edges excepted."""
    surfaces = stack_surfaces([prepare_surface(thing) for thing in things])
    poses = np.stack([on_surface(thing, count, seed + i) for i, thing in enumerate(things)])
    patches = jax.device_get(patches_of(surfaces, poses))
    x, y = centres()
    seen = on_edges = 0
    for triangles, T_w_t, depth, nearest in zip(surfaces.triangles, poses, *patches, strict=True):
        z = np.where(depth < REACH, depth + nearest[:, None, None], np.inf)
        floor = nearest[:, None, None] + REACH - ERROR  # what reads the reach must lie behind this
        ours, theirs = np.minimum(z, floor), np.minimum(embree_heights(triangles, T_w_t), floor)
        seen += np.isfinite(nearest).sum()
        for k, i, j in np.argwhere(~(np.abs(ours - theirs) <= ERROR) & ~(np.isinf(ours) & np.isinf(theirs))):
            height, distance = exact_ray(triangles, T_w_t[k], x[i, j], y[i, j])
            on_edges += distance <= EDGE
            assert distance <= EDGE or abs(ours[k, i, j] - min(height, floor[k, 0, 0])) <= ERROR
    assert seen > 0.9 * poses.shape[0] * poses.shape[1]  # the poses look at their objects
    # Embree and we part at silhouettes only: beside an outline 0.1 m long in each 17 mm window, where a strip of EDGE
    # on both sides holds 2 EDGE 0.1 / 17 mm^2 = 7e-4 of the rays.
    assert on_edges < 7e-4 * patches.depth.size


@pytest.mark.full
def test_catalogue_and_hostile_shapes_against_embree():
    """Primitives, stamps, tools; slivers, a 0.1 mm wall, open blades, needles and a concave part with overhangs."""
    names = (
        "star parallelogram cylinder cross dome pyramid torus wedge stairs stamp-T screwdriver spanner hammer pliers"
    )
    fan = trimesh.creation.cylinder(0.03, 0.02, sections=200)
    wall = trimesh.creation.box((0.05, 1e-4, 0.03))
    blades = soup([[[x, -0.02, 0], [x, 0.02, 0], [x + 0.004, 0, 0.02]] for x in np.linspace(-0.02, 0.02, 21)])
    feet = np.random.default_rng(5).uniform(-0.01, 0.01, (60, 2))
    needle = trimesh.creation.cone(4e-4, 0.02, sections=6)
    needles = trimesh.util.concatenate([needle.copy().apply_translation([x, y, 0]) for x, y in feet])
    hook = trimesh.creation.annulus(0.012, 0.02, 0.01)
    assert_like_embree([*(make_object(name).mesh for name in names.split()), fan, wall, blades, needles, hook], seed=0)


@pytest.mark.full
def test_dense_meshes_against_embree():
    """Faces as small as pixels, which have a way of their own: two skins 50 um apart, an overhang, slivers, holes."""
    skins = [sheet(lambda x, y, gap=gap: 2e-3 * np.sin(x / 2e-3) + gap, 60, 0.02) for gap in (0, 5e-5)]
    slivers = soup([[[x, -0.02, -2e-3], [x, 0.02, -4e-3], [x + 1e-5, 0, -3e-3]] for x in np.linspace(-0.02, 0.02, 21)])
    skins = trimesh.util.concatenate([trimesh.Trimesh(thing.vertices, thing.faces) for thing in (*skins, slivers)])
    hooks = trimesh.creation.torus(6e-3, 2e-3, major_sections=120, minor_sections=60)
    hooks.update_faces(np.random.default_rng(6).random(len(hooks.faces)) > 0.1)
    ball = trimesh.creation.icosphere(6, 8e-3)  # 81 920 faces in one window: many passes
    assert len(prepare_surface(ball).boxes) > PASS_SIZES.groups
    for thing in (skins, hooks, ball):
        surface = prepare_surface(thing)
        assert len(surface.triangles) == len(surface.boxes) * CLUSTERS_PER_GROUP * CLUSTER_SIZES.dense
    assert_like_embree([skins, hooks, ball], seed=200, count=15)


@pytest.mark.full
def test_scans_against_embree(shared_data):
    files = sorted((shared_data / "ycb_meshes").glob("*.stl"))
    assert files
    assert_like_embree([trimesh.load(file) for file in files], seed=100)


def test_thin_wall_is_never_missed():
    """A blade thinner than a pixel shows in every pixel whose centre it holds."""
    x, _ = centres()
    for thickness in (4e-4, 5e-5, 5e-6):
        middle = x[0, 20] + 0.3 * thickness  # holds the centres of column 20, not those of its neighbours
        blade = trimesh.creation.box((thickness, 0.1, 0.02)).apply_translation([middle, 0, 0.01])
        patch = patch_of(prepare_surface(blade), pose())
        expected = np.abs(x - middle) < thickness / 2
        np.testing.assert_array_equal(np.asarray(patch.depth) < REACH, expected)


@pytest.mark.parametrize("cells", [2, 60])  # faces as small as pixels have a way of their own
def test_tilted_plane_and_the_axes_of_the_image(cells):
    """Column j lies along tool x, row i along tool y, at ((k + 0.5)/n - 0.5) window, also where n is no multiple of
    8.
    """
    slope_x, slope_y, offset = 0.3, -0.15, 2e-3
    plane = prepare_surface(sheet(lambda x, y: offset + slope_x * x + slope_y * y, cells, 0.02))
    dense = len(plane.triangles) == len(plane.boxes) * CLUSTERS_PER_GROUP * CLUSTER_SIZES.dense
    assert dense == (cells == 60)
    views = (PATCH_WINDOW, PATCH_PIXELS, REACH), (0.03, 21, np.inf)
    for window, pixels, reach in views[: 1 if dense else 2]:
        x, y = centres(window, pixels)
        z = offset + slope_x * x + slope_y * y
        patch = patch_of(plane, pose(), window=window, pixels=pixels, reach=reach)
        tolerance = (1 + slope_x - slope_y) * NEAR
        assert patch.depth.dtype == jnp.float32
        np.testing.assert_allclose(patch.nearest, z.min(), rtol=0, atol=tolerance)
        np.testing.assert_allclose(patch.depth, np.minimum(z - z.min(), reach), rtol=0, atol=2 * tolerance)


ROTATIONS = st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(random_state=seed).as_matrix())
WAVE = sheet(lambda x, y: 2e-3 * np.sin(x / 7e-3) * np.cos(y / 9e-3), 5)


def moved(thing, A: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(vertices=thing.vertices @ A[:3, :3].T + A[:3, 3], faces=thing.faces)


def assert_same(patch, other, atol: float) -> None:
    np.testing.assert_allclose(patch.depth, other.depth, rtol=0, atol=atol)
    np.testing.assert_allclose(patch.nearest, other.nearest, rtol=0, atol=atol)


@settings(max_examples=30, deadline=None)
@given(ROTATIONS, st.sampled_from(["diagonal", "grid", "fan"]), st.floats(0, 0.3))
def test_no_cracks(attitude, kind, offset):
    """Rays along shared edges and through shared corners hit in every orientation of the scene."""
    x, y = centres()
    rim = 0.04 * np.array([[np.cos(k * np.pi / 12), np.sin(k * np.pi / 12), 0] for k in range(24)])
    thing = {
        "diagonal": sheet(lambda x, y: 0 * x, 1),
        "grid": sheet(lambda x, y: 0 * x, 15, 52.5 * PATCH_WINDOW / PATCH_PIXELS),  # corners on every seventh pixel
        "fan": soup([[[x[10, 30], y[10, 30], 0.002], rim[k], rim[k - 1]] for k in range(24)]),
    }[kind]
    T = pose(attitude, [offset, -offset, offset])
    patch = patch_of(prepare_surface(moved(thing, T)), T.astype(np.float32))
    assert (np.asarray(patch.depth) < REACH).all()
    assert patch.nearest > -8 * NEAR  # coordinates of 0.3 m step by 3e-8 m, on slopes of at most 0.1


@settings(max_examples=20, deadline=None)
@given(ROTATIONS, st.tuples(*[st.floats(-0.15, 0.15)] * 3))
def test_moving_scene_and_tool_together_changes_nothing(attitude, position):
    T_w_t, g = pose(Rotation.from_euler("xy", (0.1, -0.2)).as_matrix(), [1e-3, 2e-3, -5e-3]), pose(attitude, position)
    here = patch_of(prepare_surface(WAVE), T_w_t.astype(np.float32))
    there = patch_of(prepare_surface(moved(WAVE, g)), (g @ T_w_t).astype(np.float32))
    # Below 0.3 m a step of float32 is 3e-8 m: four times NEAR, in the scene and in the pose, on slopes up to 0.6.
    assert_same(here, there, 2 * 4 * 1.6 * NEAR)


def test_either_side_of_a_face_is_seen_and_an_affine_map_moves_the_surface():
    turned = SimpleNamespace(vertices=WAVE.vertices, faces=WAVE.faces[:, ::-1])
    assert_same(patch_of(prepare_surface(WAVE), pose()), patch_of(prepare_surface(turned), pose()), 2 * NEAR)
    A = np.array([[1.3, 0.2, 0, 1e-3], [0, 0.8, 0, -2e-3], [0.3, 0.1, 1.5, 4e-3], [0, 0, 0, 1]])  # stretch and shear
    here = heights_of(prepare_surface(WAVE), A.astype(np.float32))
    there = heights_of(prepare_surface(moved(WAVE, A)), np.eye(4, dtype=np.float32))
    np.testing.assert_allclose(here, there, rtol=0, atol=4 * NEAR)


def test_rays_start_at_the_standoff_and_see_nothing_where_nothing_is():
    flat = sheet(lambda x, y: 0 * x, 1)
    surface = prepare_surface(soup(np.concatenate([flat.vertices[flat.faces] + [0, 0, z] for z in (-0.045, 0.03)])))
    assert STANDOFF == 0.04
    assert patch_of(surface, pose()).nearest == pytest.approx(0.03, abs=NEAR)
    assert patch_of(surface, pose(position=[0, 0, -0.01])).nearest == pytest.approx(-0.035, abs=NEAR)
    beside = patch_of(surface, pose(position=[0.1, 0, 0]))
    assert beside.nearest == np.inf
    assert (beside.depth == np.float32(REACH)).all()
    assert jnp.isinf(heights_of(surface, pose(position=[0.1, 0, 0]))).all()


def test_contact_mask():
    depth = jnp.array([[0.0, 1.4e-3], [1.8e-3, 4e-3]])
    np.testing.assert_array_equal(contact_mask(depth), [[1, 1], [0, 0]])
    np.testing.assert_array_equal(contact_mask(depth, 2e-3), [[1, 1], [1, 0]])
    np.testing.assert_array_equal(contact_mask(depth + 1e-2, 0.1e-3), [[1, 0], [0, 0]])


def test_bits_are_packed_as_by_numpy():
    flags = np.random.default_rng(0).random((5, 32, 7)) < 0.5
    words = np.packbits(flags, axis=1, bitorder="little").swapaxes(1, 2).copy().view("<u4")[..., 0]
    np.testing.assert_array_equal(pack_bits(jnp.asarray(flags), 1), words)
    np.testing.assert_array_equal(pack_bits(jnp.ones((1, 32), bool)), [2**32 - 1])


def test_a_size_class_with_room_for_more_faces_shows_the_same():
    surface = prepare_surface(make_object("star").mesh)
    roomy = jax.tree.map(lambda field: field[0], stack_surfaces([surface], faces=300))
    assert len(surface.triangles) < 300 <= len(roomy.triangles)
    T = on_surface(make_object("star").mesh, 1, 0)[0]
    np.testing.assert_array_equal(render_heights(roomy, jnp.asarray(T)), render_heights(surface, jnp.asarray(T)))
