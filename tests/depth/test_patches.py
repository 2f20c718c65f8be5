"""Depth images made by Embree, from rays through the pixels' centres, against patches rendered directly.

The camera is the paper's: 640 x 360, 322 pixels of focal length, 104 mm from the tool, where a pixel is 0.32 mm wide.
Pixels whose neighbours within two pixels differ by more than 1 mm lie at edges and are left out, because
the surface seen there depends on the side of the edge on which a pixel's ray passes.
"""

import math

import jax
import numpy as np
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from PIL import Image
from scipy.spatial.transform import Rotation

from i2t.depth.camera import Camera
from i2t.depth.distortion import pixel_rays
from i2t.depth.patches import patch_from_depth
from i2t.objects.catalogue import make_object
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH
from i2t.rendering.render import contact_mask, prepare_surface, render_patch

CAMERA = Camera(640, 360, 322.4, 322.1, 319.5, 179.5)
ERROR = 1e-4  # m, RMS that is allowed away from edges
FLAT = 3e-6  # m: float32 holds 0.2 m to 1.5e-8 m; a grazing ray (10 degrees) multiplies ten such roundings by six
DOWN = np.diag([1.0, -1.0, -1.0])
# The outline of a hammer bends: halfway to its side the window holds but its handle's flank. So its head is looked at.
HAMMER_HEAD = (0.121, 0.005, 0.025)

STATIC = ("camera", "window", "pixels", "reach", "fill")
extract = jax.jit(patch_from_depth, static_argnames=STATIC)
LOOKING_DISTANCE_M = 104e-3  # from the camera to the tool's origin when the paper's arm looks
render = jax.jit(render_patch, static_argnames=("window", "pixels", "reach"))


def pose(rotation, position) -> np.ndarray:
    T = np.eye(4, dtype=np.float32)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def views(tilt: float, at, distance: float = LOOKING_DISTANCE_M) -> tuple[np.ndarray, np.ndarray]:
    """T_w_c and T_w_t of a tool that points down at a point and a camera that looks at it, tilted by some degrees."""
    look = DOWN @ Rotation.from_euler("yx", [tilt, tilt / 3], degrees=True).as_matrix()
    return pose(look, np.asarray(at) - distance * look[:, 2]), pose(DOWN, at)


def image(mesh, T_w_c: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Depth (h, w) m of a scene, NaN where nothing is hit."""
    scene = EmbreeScene()
    TriangleMesh(scene, np.asarray(mesh.vertices, np.float32)[np.asarray(mesh.faces)])
    x, y = np.asarray(pixel_rays(camera), float)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ T_w_c[:3, :3].T.astype(float)
    starts = np.broadcast_to(T_w_c[:3, 3], rays.shape)
    hits = scene.run(starts.astype(np.float32), rays.astype(np.float32), output=1)  # in units of the rays: depth
    return np.where(hits["primID"] < 0, np.nan, hits["tfar"]).reshape(x.shape).astype(np.float32)


def scene(name: str) -> trimesh.Trimesh:
    """An object on a table."""
    mesh = make_object(name.split("'")[0]).mesh
    table = trimesh.creation.box((0.6, 0.6, 0.01)).apply_translation([0, 0, -0.005])
    return trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), table])


def beside(name: str) -> np.ndarray:
    """A point on the top of an object, halfway to its side, so that the window contains some of the edge."""
    if name == "hammer's head":
        return np.array(HAMMER_HEAD)
    vertices = np.asarray(make_object(name).mesh.vertices)
    return np.array([0.5 * np.abs(vertices[:, 0]).max(), -0.002, vertices[:, 2].max()])


def heights(patch) -> np.ndarray:
    return np.asarray(patch.depth) + float(patch.nearest)


def around(image: np.ndarray) -> np.ndarray:
    """(n, n, 5, 5), the pixels within two pixels of each pixel."""
    return np.lib.stride_tricks.sliding_window_view(np.pad(image, 2, mode="edge"), (5, 5))


def away(depth: np.ndarray) -> np.ndarray:
    """A mask of the pixels away from edges."""
    return np.ptp(around(depth), axis=(2, 3)) < 1e-3


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def compared(name: str, tilt: float, camera: Camera = CAMERA):
    """A depth image, the extracted and the rendered patch, and a mask of pixels seen away from edges."""
    mesh, (T_w_c, T_w_t) = scene(name), views(tilt, beside(name))
    depth = image(mesh, T_w_c, camera)
    real, imagined = extract(depth, camera, T_w_c, T_w_t), render(prepare_surface(mesh), T_w_t)
    return depth, real, imagined, np.asarray(real.valid_mask) & away(np.asarray(imagined.depth))


@pytest.mark.full
@pytest.mark.parametrize(("name", "tilt"), [("star", 50.0), ("dome", 0.0), ("torus", 30.0), ("hammer's head", 50.0)])
def test_against_direct_rendering(name, tilt):
    _, real, imagined, inner = compared(name, tilt)
    seen = np.asarray(real.valid_mask)
    assert not (seen & np.asarray(real.inpainted_mask)).any()
    # Where the reach hides what is deeper, both read it; so depths are compared from the imagined nearest point.
    theirs = np.asarray(imagined.depth)
    ours = np.minimum(heights(real.patch) - float(imagined.nearest), REACH)
    inner &= np.asarray(real.patch.depth) < REACH
    assert inner.mean() > 0.25
    assert rms((ours - theirs)[inner]) <= (FLAT if name == "star" else ERROR)
    # What a camera says it saw is there, at edges too: no closer than the surface within a pixel and a half of 0.5 mm.
    assert (ours >= around(theirs).min((2, 3)) - ERROR)[seen].all()


def roof(left: float, right: float) -> trimesh.Trimesh:
    """A ridge at height 0 along y that falls off with two slopes."""
    vertices = [(x, y, -z) for y in (-0.05, 0.05) for x, z in ((-0.05, 0.05 * left), (0, 0), (0.05, 0.05 * right))]
    return trimesh.Trimesh(vertices, [(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4)], process=False)


@pytest.mark.full
@pytest.mark.parametrize(("left", "right"), [(1.0, 1.0), (0.4, 2.0)])
def test_sharp_ridges_are_cut_off(left, right):
    """A triangle w wide across a ridge of two slopes meets its sides, not itself, and is at most (left + right) w / 4
    too deep; w is a pixel for a ridge along rows or columns and up to the diagonal of one otherwise.
    """
    T_w_c, T_w_t = views(0.0, np.zeros(3))
    centre = 0.5 * PATCH_WINDOW / PATCH_PIXELS  # of a pixel of the patch, and of a cell of the image
    T_w_c[:2, 3] = centre
    further = 1 - PATCH_WINDOW / LOOKING_DISTANCE_M * max(left, right)  # on a side that falls off
    pixel = LOOKING_DISTANCE_M / CAMERA.fy / further
    worst = (left + right) / 4 * pixel
    for turn, shift in ((0.0, (0.0, 0.0)), (45.0, (0.0, 0.0)), (107.0, (1e-4, -2e-4)), (19.0, (-1e-4, 5e-5))):
        turned = Rotation.from_euler("z", turn, degrees=True).as_matrix()
        mesh = roof(left, right).apply_transform(pose(turned, [*(centre + np.array(shift)), 0]))
        real, imagined = extract(image(mesh, T_w_c), CAMERA, T_w_c, T_w_t), render(prepare_surface(mesh), T_w_t)
        near = np.asarray(real.valid_mask) & (np.asarray(imagined.depth) < 2e-3)
        error = (heights(real.patch) - heights(imagined))[near]
        closest = float(real.patch.nearest - imagined.nearest)
        assert near.mean() > 0.1
        assert error.min() >= -FLAT
        assert error.max() <= (1 if turn == 0 else math.sqrt(2)) * worst + FLAT
        assert -FLAT <= closest <= error.max() + FLAT
        if turn == 0:  # the worst: the ridge along the middle of its cells, and every row alike
            assert error.max() == pytest.approx((left + right) / 4 * LOOKING_DISTANCE_M / CAMERA.fx, rel=0.02)


@pytest.mark.full
def test_quantised_depth():
    """Rounding moves a pixel by at most q / 2 along its ray, and the tilt and the slope here a little more along z."""
    exact, _, imagined, _ = compared("dome", 10.0)
    T_w_c, T_w_t = views(10.0, beside("dome"))
    for q in (1e-4, 1e-3):
        real = extract(np.float32(np.round(exact / q) * q), CAMERA, T_w_c, T_w_t)
        inner = np.asarray(real.valid_mask) & away(np.asarray(imagined.depth))
        assert inner.mean() > 0.5
        assert rms((heights(real.patch) - heights(imagined))[inner]) <= 0.6 * q + 1e-5


@pytest.mark.full
def test_flying_pixels_are_not_surface():
    """At every depth edge, one pixel gets a depth between both sides, as in real cameras."""
    mesh, (T_w_c, T_w_t) = scene("hexagon"), views(0.0, beside("hexagon"))
    T_w_t[0, 3] = T_w_c[0, 3] = np.asarray(make_object("hexagon").mesh.vertices)[:, 0].max() - 3e-3
    exact = image(mesh, T_w_c)
    mixed = exact.copy()
    edge = np.abs(np.diff(exact, axis=1)) > 5e-3
    rows, columns = np.nonzero(edge)
    mixed[rows, columns] = (exact[rows, columns] + exact[rows, columns + 1]) / 2
    assert edge.sum() > 30
    clean, flying = (extract(depth, CAMERA, T_w_c, T_w_t) for depth in (exact, mixed))
    both = np.asarray(clean.valid_mask & flying.valid_mask)
    assert both.mean() > 0.5
    np.testing.assert_allclose(np.asarray(flying.patch.depth)[both], np.asarray(clean.patch.depth)[both], atol=FLAT)
    between = (np.asarray(flying.patch.depth) > 0.2e-3) & (np.asarray(flying.patch.depth) < REACH)
    assert not between[np.asarray(flying.valid_mask)].any()


@pytest.mark.full
def test_distorted_images():
    lens = Camera(640, 360, 322.4, 322.1, 310.0, 170.0, "brown_conrady", (-0.1, 0.03, 1e-3, -1e-3, 0.01))
    depth, real, imagined, inner = compared("torus", 25.0, lens)
    assert inner.mean() > 0.3
    assert rms((heights(real.patch) - heights(imagined))[inner]) <= ERROR
    straight = extract(depth, CAMERA, *views(25.0, beside("torus")))
    assert rms((heights(straight.patch) - heights(imagined))[inner]) > ERROR  # the lens matters here


def plane(depth: float = LOOKING_DISTANCE_M) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), depth, np.float32)


@pytest.mark.full
def test_small_holes_are_filled_and_large_ones_marked():
    """Small holes are bridged, large ones are marked, and both are distinguished from seen pixels."""
    T_w_t = pose(np.eye(3), [0, 0, LOOKING_DISTANCE_M])
    depth = plane()
    depth[:, 300] = np.nan  # two cells of 0.32 mm
    depth[170:200, 325:345] = 0  # 20 pixels, 6.8 mm between what is measured on its sides
    real = extract(depth, CAMERA, np.eye(4, dtype=np.float32), T_w_t)
    seen, filled, patch = np.asarray(real.valid_mask), np.asarray(real.inpainted_mask), np.asarray(real.patch.depth)
    along = ((np.arange(PATCH_PIXELS) + 0.5) / PATCH_PIXELS - 0.5) * PATCH_WINDOW
    column = CAMERA.cx + CAMERA.fx * along / LOOKING_DISTANCE_M
    row = CAMERA.cy + CAMERA.fy * along / LOOKING_DISTANCE_M
    narrow = np.broadcast_to(np.abs(column - 300) < 1, seen.shape)
    wide = ((row > 169) & (row < 200))[:, None] & ((column > 324) & (column < 345))[None, :]
    np.testing.assert_array_equal(filled & narrow, narrow)
    # At each of the hole's corners three of four pixels are measured, which is half a cell of surface.
    assert (seen != (~narrow & ~wide)).sum() <= 4
    assert (wide & ~filled).sum() > 0.9 * wide.sum()  # but for its corners, which a diagonal cuts off
    np.testing.assert_allclose(patch[~wide], 0, atol=FLAT)
    np.testing.assert_array_equal(patch[~seen & ~filled], np.float32(REACH))


IN_HOLE = slice(14, 34)  # pixels of the patch, in the middle


@pytest.mark.parametrize("marker", [0, -1, -0.3, np.nan, np.inf, -np.inf, 65.535, 6.5535, 1e10])
def test_a_hole_is_not_seen_for_every_marker(marker):
    """This also holds if the image was interpolated, with values between those of the hole and of the surface."""
    eye, T_w_t = np.eye(4, dtype=np.float32), pose(np.eye(3), [0, 0, LOOKING_DISTANCE_M])
    rows, columns = np.indices((360, 640))
    hole = np.hypot(rows - CAMERA.cy, columns - CAMERA.cx) < 16  # 5 mm at this distance
    sharp = np.where(hole, np.float32(marker), plane())
    smooth = np.asarray(Image.fromarray(sharp[::2, ::2]).resize((640, 360), Image.Resampling.BILINEAR))
    for depth in (sharp, smooth):
        real = patch_from_depth(depth, CAMERA, eye, T_w_t)
        seen = np.asarray(real.valid_mask | real.inpainted_mask)
        assert not seen[IN_HOLE, IN_HOLE].any()
        assert seen[:5].all()
        assert abs(float(real.patch.nearest)) < FLAT


def test_hidden_surface_is_not_filled_in():
    """A camera from the side does not see the table behind a block, and the space above it does not count as seen."""
    block = trimesh.creation.box((0.02, 0.04, 0.003)).apply_translation([0, 0, 0.0015])
    table = trimesh.creation.box((0.6, 0.6, 0.01)).apply_translation([0, 0, -0.005])
    mesh = trimesh.util.concatenate([block, table])
    T_w_c, T_w_t = views(50.0, [0.010, 0, 0.003])
    real = extract(image(mesh, T_w_c), CAMERA, T_w_c, T_w_t)
    x = ((np.arange(PATCH_PIXELS) + 0.5) / PATCH_PIXELS - 0.5) * PATCH_WINDOW  # tool x is world x here
    assert T_w_c[0, 3] < 0.010  # the camera is on the block's side: tan(50 degrees) of 3 mm lie in its shadow
    assert not np.asarray(real.valid_mask)[:, (x > 0.3e-3) & (x < 2.5e-3)].any()
    np.testing.assert_allclose(np.asarray(real.patch.depth)[:, x < -0.5e-3], 0, atol=FLAT)
    np.testing.assert_allclose(np.asarray(real.patch.depth)[:, x > 4.5e-3], 3e-3, atol=FLAT)
    assert np.asarray(real.valid_mask)[:, np.abs(x) > 4.5e-3].all()


def test_hostile_values():
    eye, T_w_t = np.eye(4, dtype=np.float32), pose(np.eye(3), [0, 0, LOOKING_DISTANCE_M])
    for nothing in (np.nan * plane(), 0 * plane(), -plane(), np.inf * plane()):
        real = extract(nothing, CAMERA, eye, T_w_t)
        assert not np.asarray(real.valid_mask | real.inpainted_mask).any()
        assert real.patch.nearest == np.inf
        np.testing.assert_array_equal(real.patch.depth, np.float32(REACH))
    lost = eye.copy()
    lost[1, 3] = np.nan
    for bad in (lost, 0 * eye, 2 * eye, np.diag([1, 1, -1, 1]).astype(np.float32)):
        for poses in ((bad, T_w_t), (eye, bad)):
            real = extract(plane(), CAMERA, *poses)
            assert np.isnan(real.patch.depth).all()
            assert np.isnan(real.patch.nearest)
            assert not np.asarray(real.valid_mask | real.inpainted_mask).any()
    behind = extract(plane(), CAMERA, eye, pose(np.eye(3), [0, 0, -1.0]))  # a tool there still looks forwards
    np.testing.assert_allclose(behind.patch.nearest, 1 + LOOKING_DISTANCE_M, rtol=1e-5)
    elsewhere = extract(plane(), CAMERA, eye, pose(np.eye(3), [5, 0, LOOKING_DISTANCE_M]))
    assert not np.asarray(elsewhere.valid_mask).any()
    assert elsewhere.patch.nearest == np.inf
    with pytest.raises(ValueError, match="no pixel was measured"):  # where values are known (`check_view`)
        patch_from_depth(0 * plane(), CAMERA, eye, T_w_t)
    with pytest.raises(ValueError, match="shape"):
        extract(plane().T, CAMERA, eye, T_w_t)
    with pytest.raises(ValueError, match="uint16"):
        extract(np.ones((360, 640), np.uint16), CAMERA, eye, T_w_t)


@pytest.mark.full
def test_contact_masks_agree():
    """The authors' rule, pixels within 1 to 2 mm of the nearest, gives both patches the same mask away from edges."""
    _, real, imagined, inner = compared("stamp-T", 0.0)
    for tolerance in (1e-3, 2e-3):
        ours, theirs = (np.asarray(contact_mask(patch.depth, tolerance)) for patch in (real.patch, imagined))
        assert 0.05 < theirs.mean() < 0.95
        np.testing.assert_array_equal(ours[inner], theirs[inner])
        np.testing.assert_array_equal(theirs, np.asarray(imagined.depth) <= tolerance)


def test_masked_pixels_are_holes():
    box = make_object("hexagon").mesh
    T_w_c, T_w_t = views(10.0, (0, 0, box.vertices[:, 2].max()))
    depth = image(box, T_w_c)
    hidden = np.zeros(depth.shape, bool)
    hidden[::7] = True
    by_mask = patch_from_depth(np.ma.MaskedArray(depth, hidden), CAMERA, T_w_c, T_w_t)
    by_nan = patch_from_depth(np.where(hidden, np.float32(np.nan), depth), CAMERA, T_w_c, T_w_t)
    jax.tree.map(np.testing.assert_array_equal, by_mask, by_nan)
    assert by_nan.valid_mask.mean() < patch_from_depth(depth, CAMERA, T_w_c, T_w_t).valid_mask.mean()


@pytest.mark.parametrize("reach", [-1, 0, np.nan, "x", [1e-3, 2e-3]])
def test_a_reach_is_a_length(reach):
    extract = getattr(patch_from_depth, "__wrapped__", patch_from_depth)  # without the tests' own check of types
    with pytest.raises((ValueError, TypeError), match=r"reach: .*give a length"):
        extract(np.full((360, 640), 0.3, np.float32), CAMERA, np.eye(4), np.eye(4), reach=reach)


def test_a_patch_records_its_size():
    depth = np.full((360, 640), 0.3, np.float32)
    seen = patch_from_depth(depth, CAMERA, np.eye(4), pose(np.eye(3), (0, 0, 0.3)), window=34e-3, reach=2e-3)
    assert (seen.window, seen.reach) == (34e-3, 2e-3)
    patch, valid, inpainted = seen  # three parts, as ever
    assert patch is seen.patch
    assert valid.shape == inpainted.shape == (PATCH_PIXELS, PATCH_PIXELS)
    assert jax.tree.map(np.asarray, seen).window is None
