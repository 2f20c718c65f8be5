"""Point clouds: both formats in every encoding, missing points, bad files, and disks against known surfaces."""

import struct

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from i2t.objects import load_point_cloud, make_object, surface_from_points
from i2t.objects.point_clouds import suggest_radius
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_patch, stack_surfaces
from i2t.simulation.sites import collect_sites
from i2t.windows import REACH

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-0.05, 0.05, (50, 3)).astype(np.float32)
NORMALS = (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).astype(np.float32)


def pcd(data: str, rows: np.ndarray, fields="x y z normal_x normal_y normal_z", counts=None) -> bytes:
    n = len(fields.split())
    head = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {'4 ' * n}\nTYPE {'F ' * n}\nCOUNT {counts or '1 ' * n}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA {data}\n"
    )
    return head.encode() + body(rows, "" if data == "ascii" else "<")


def ply(form: str, rows: np.ndarray, fields="x y z nx ny nz", tail="") -> bytes:
    properties = "".join(f"property float {name}\n" for name in fields.split())
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    head = f"ply\nformat {form} 1.0\ncomment by hand\nelement vertex {len(rows)}\n{properties}{tail}end_header\n"
    return head.encode() + body(rows, order)


def body(rows: np.ndarray, order: str) -> bytes:
    if order:
        return rows.astype(order + "f4").tobytes()
    return "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in rows).encode()


BOTH = np.concatenate([POINTS, NORMALS], 1)


def test_points_and_normals_come_back(tmp_path):
    for name, data in (
        ("a.pcd", pcd("ascii", BOTH)),
        ("b.pcd", pcd("binary", BOTH)),
        ("a.ply", ply("ascii", BOTH)),
        ("b.ply", ply("binary_little_endian", BOTH)),
        ("a.PLY", ply("binary_big_endian", BOTH)),
    ):
        (tmp_path / name).write_bytes(data)
        points, normals = load_point_cloud(tmp_path / name, "m")
        np.testing.assert_array_equal(points, POINTS.astype(np.float64))  # every format carries float32 without loss
        np.testing.assert_allclose(normals, NORMALS, atol=2**-23)  # scaled to length one again
        points, _ = load_point_cloud(tmp_path / name, "inch")
        np.testing.assert_array_equal(points, POINTS.astype(np.float64) * 0.0254)


def test_other_columns_other_types_and_faces_are_passed_over(tmp_path):
    rows = np.concatenate([RNG.uniform(size=(50, 3)), POINTS], 1)
    for form in ("ascii", "binary"):
        (tmp_path / "a.pcd").write_bytes(pcd(form, rows, "descriptor x y z", "3 1 1 1"))
        points, normals = load_point_cloud(tmp_path / "a.pcd", "m")
        np.testing.assert_array_equal(points, POINTS)
        assert normals is None
    # A PLY with colour bytes and doubles, then faces.
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty uchar red\nproperty double x\n"
        "property double y\nproperty double z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    data = head.encode() + struct.pack("<B3dB3d", 7, 0.1, 0.2, 0.3, 9, 0.4, 0.5, 0.6) + b"\x03" + b"\x00" * 12
    (tmp_path / "b.ply").write_bytes(data)
    points, _ = load_point_cloud(tmp_path / "b.ply", "m")
    np.testing.assert_array_equal(points, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    trimesh.PointCloud(POINTS).export(tmp_path / "c.ply")
    points, normals = load_point_cloud(tmp_path / "c.ply", "m")
    np.testing.assert_allclose(points, POINTS, atol=1e-8)
    assert normals is None


def test_missing_points_are_left_out(tmp_path):
    rows = BOTH.copy()
    rows[[3, 7], 1] = np.nan
    rows[9, 4] = np.nan
    (tmp_path / "a.pcd").write_bytes(pcd("binary", rows))
    points, normals = load_point_cloud(tmp_path / "a.pcd", "m")
    kept = np.delete(np.arange(50), [3, 7])
    np.testing.assert_array_equal(points, POINTS[kept])
    assert (normals[list(kept).index(9)] == 0).all()  # a missing normal, not a missing point


PCD = pcd("binary", BOTH)
PLY = ply("binary_little_endian", BOTH)


@pytest.mark.parametrize(
    ("name", "data", "unit", "words"),
    [
        ("a.pcd", PCD[:-1], "m", "announces 50 points and ends after 49"),
        ("a.pcd", b"\x00\xff" * 50, "m", "cannot be read as PCD"),
        ("a.pcd", pcd("ascii", BOTH)[:-300], "m", "announces 50 points and ends after 4"),
        ("a.pcd", PCD.replace(b"DATA binary", b"DATA binary_compressed"), "m", "save it as binary"),
        ("a.pcd", pcd("binary", BOTH[:, :2], "u v"), "m", "no fields x, y, z"),
        ("a.pcd", PCD, "mm", "too small.*perhaps its unit is m"),
        ("a.ply", PLY[:-1], "m", "announces 50 points and ends after 49"),
        ("a.ply", PLY.replace(b"property float x", b"property list uchar int x"), "m", "list property"),
        ("a.ply", ply("ascii", BOTH, "x y z nx ny nz w"), "m", "6 values instead of 7"),
        ("a.xyz", b"0 0 0\n", "m", r"ending '.xyz' is none of .ply, .pcd"),
        ("", b"", "m", "a.pcd: there is no such file"),
    ],
)
def test_bad_files_get_one_sentence(tmp_path, name, data, unit, words):
    path = tmp_path / (name or "a.pcd")
    if name:
        path.write_bytes(data)
    with pytest.raises(ValueError if name else FileNotFoundError, match=words) as caught:
        load_point_cloud(path, unit)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


# --- disks ------------------------------------------------------------------------------------------------------------


def test_disks_on_a_plane_lie_in_it_cover_it_and_face_up():
    tilt = np.array([0.3, -0.2, 1]) / np.linalg.norm([0.3, -0.2, 1])
    basis = np.linalg.svd(tilt[None])[2][1:]
    flat = RNG.uniform(-0.02, 0.02, (20_000, 2))
    radius = 1e-3
    mesh = surface_from_points(flat @ basis, radius)
    disks = mesh.vertices[mesh.faces]
    cross = np.cross(disks[:, 1] - disks[:, 0], disks[:, 2] - disks[:, 0])
    normals = cross / np.linalg.norm(cross, axis=1, keepdims=True)
    # Moments are rounded at 1e-16 of themselves, so a plane fit is good to about the square root, 1e-8.
    np.testing.assert_allclose(normals @ tilt, 1, atol=1e-8)
    np.testing.assert_allclose(mesh.vertices @ tilt, 0, atol=1e-10)
    assert np.abs(mesh.vertices @ basis.T).max() <= 0.02 + radius
    # Three corners of a hexagon of 1 mm: each disk has area 3 sqrt(3) / 2 radius^2.
    assert np.linalg.norm(cross, axis=1).sum() / 2 == pytest.approx(len(mesh.faces) / 4 * 1.5 * 3**0.5 * radius**2)
    # No gaps: points of the plane are met by rays along its normal.
    inner = RNG.uniform(-0.019, 0.019, (2000, 2)) @ basis
    rays = trimesh.ray.ray_pyembree.RayMeshIntersector(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False))
    assert rays.intersects_any(inner + 0.01 * tilt, np.broadcast_to(-tilt, inner.shape)).all()


def test_disks_on_a_sphere_stay_within_their_stated_flattening_and_average_noise():
    n, R, radius, noise = 60_000, 30e-3, 1.5e-3, 0.1e-3
    i = np.arange(n) + 0.5
    z, turn = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    sphere = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)
    mesh = surface_from_points(R * sphere, radius, normals=sphere)
    centres = mesh.vertices.reshape(-1, 6, 3).mean(1)
    facing = np.cross(*np.moveaxis(np.diff(mesh.vertices.reshape(-1, 6, 3)[:, :3], axis=1), 1, 0))
    assert ((facing * centres).sum(1) > 0).all()  # outward, all around
    # The plane of neighbours within 1.5 radii lies below the sphere by the mean of r^2 / 2R over them, at most
    # (1.5 radius)^2 / 2R; a tenth is left for the uneven spread of the averaged points.
    depth = R - np.linalg.norm(centres, axis=1)
    assert depth.max() <= 1.1 * (1.5 * radius) ** 2 / (2 * R)
    assert depth.min() >= 0
    noisy = surface_from_points(R * sphere + noise * RNG.normal(size=(n, 3)), radius, normals=sphere)
    rough = np.linalg.norm(noisy.vertices.reshape(-1, 6, 3).mean(1), axis=1)
    assert np.std(rough) < noise / 2  # each centre is a mean of dozens of points


def test_a_scanned_object_is_where_its_mesh_is():
    thing = make_object("stairs").mesh
    whole = trimesh.Trimesh(thing.vertices, thing.faces, process=False)
    cloud, face = trimesh.sample.sample_surface(whole, 60_000, seed=0)
    radius = 1e-3
    mesh = surface_from_points(cloud, radius, normals=whole.face_normals[face])
    centres = mesh.vertices.reshape(-1, 6, 3).mean(1)
    # Averaging and fitting moves a disk by at most the 1.5 radii within which it looks, and each place has a disk.
    assert cKDTree(cloud).query(centres)[0].max() <= 1.5 * radius
    assert cKDTree(centres).query(cloud)[0].max() <= 1.5 * radius


def test_suggested_radius_is_two_spacings_outliers_are_left_out_and_sparse_clouds_refused():
    """The median of the eighth neighbour's distance has the gamma distribution's median 7.67 for 8, a few per cent
    below; the rim of the square counts for a few more.
    """
    for spacing in (0.3e-3, 1e-3):
        n = int((0.04 / spacing) ** 2)
        cloud = np.concatenate([RNG.uniform(0, 0.04, (n, 2)), np.zeros((n, 1))], 1)
        assert suggest_radius(cloud) == pytest.approx(2 * spacing, rel=0.1)
    with pytest.raises(ValueError, match="8 are too few"):
        suggest_radius(cloud[:8])
    with pytest.raises(ValueError, match="same place"):
        suggest_radius(np.repeat(cloud[:2], 50, axis=0))
    cloud = np.concatenate([RNG.uniform(-0.01, 0.01, (3000, 3)) * [1, 1, 0], [[0, 0, 0.03]]])
    assert np.abs(surface_from_points(cloud, 1e-3).vertices[:, 2]).max() < 1e-9
    with pytest.raises(ValueError, match="larger radius"):
        surface_from_points(cloud[::200], 1e-4)


@pytest.mark.full
def test_patches_of_disks_are_those_of_the_mesh():
    """Within what is promised: flattening of radius^2 / 2R and noise averaged over the dozen points of a disk."""
    mesh = make_object("dome").mesh
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(whole, int(whole.area / 0.5e-3**2), seed=0)
    radius, normals = suggest_radius(points), whole.face_normals[face]
    clouds = [points + noise * RNG.normal(size=(len(points), 1)) * normals for noise in (0.0, 0.1e-3)]
    disks = [surface_from_points(cloud, radius, normals) for cloud in clouds]
    surfaces = stack_surfaces([prepare_surface(each) for each in (mesh, *disks)])
    poses = collect_sites(jax.random.key(0), element(surfaces, 0), 8, name="dome")
    look = jax.jit(jax.vmap(render_patch, (None, 0)))
    true, clean, noisy = (jax.device_get(look(element(surfaces, i), poses)) for i in range(3))
    solid = true.depth < 3e-3
    assert (clean.depth >= REACH)[solid].mean() < (0.5 / 17) ** 2  # less than one point's own square in each patch
    flat = (1.5 * radius) ** 2 / (2 * 30e-3)  # m, on the dome's radius; disks look 1.5 radii around
    for seen, allowed in ((clean, flat), (noisy, flat + 0.1e-3)):
        off = (seen.nearest[:, None, None] + seen.depth) - (true.nearest[:, None, None] + true.depth)
        assert np.median(np.abs(off)[solid & (seen.depth < REACH)]) < allowed
