"""Mesh files: units, frames, bodies, and one clear sentence for each kind of bad file."""

import warnings

import numpy as np
import pytest
import trimesh

from i2t.files.kinds import METRES_PER_UNIT
from i2t.objects import load_mesh, load_object, read_mesh
from i2t.objects.named import describe_placement
from i2t.objects.solids import Mesh, transform_mesh

BOX = (0.06, 0.04, 0.02)  # m


def box(scale: float = 1.0) -> trimesh.Trimesh:
    return trimesh.creation.box(np.array(BOX) * scale)


def whole(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("unit", list(METRES_PER_UNIT))
def test_units_and_formats(tmp_path, unit):
    for suffix in ("stl", "obj", "ply", "STL", *(["glb"] if unit == "m" else [])):
        path = tmp_path / f"part.{suffix}"
        box(1 / METRES_PER_UNIT[unit]).export(path, file_type=suffix.lower())
        thing, report = read_mesh(path, unit, up="z")
        assert (thing.name, thing.family) == ("part", "file")
        # STL and GLB store float32: 2^-24 of each coordinate.
        np.testing.assert_allclose(thing.mesh.vertices.max(0), [0.03, 0.02, 0.02], rtol=2**-23)
        np.testing.assert_allclose(report.size, BOX, rtol=2**-23)
        assert whole(thing.mesh).volume == pytest.approx(np.prod(BOX), rel=3 * 2**-23)
        assert report.watertight
        assert report.faces == report.faces_read == 12
        assert len(thing.mesh.vertices) == 8


def test_meshes_keep_their_own_frame_or_stand_on_the_table(tmp_path):
    part = box()
    part.apply_translation([0.1, 0.2, 0.3])
    part.export(tmp_path / "part.ply")
    own, _ = read_mesh(tmp_path / "part.ply", "m", table=False)
    np.testing.assert_allclose(own.mesh.vertices.mean(0), [0.1, 0.2, 0.3], atol=1e-7)  # PLY in float32
    settled, _ = read_mesh(tmp_path / "part.ply", "m")
    np.testing.assert_allclose(settled.mesh.vertices.mean(0), [0, 0, 0.01], atol=1e-7)
    upright, report = read_mesh(tmp_path / "part.ply", "m", up="y")
    np.testing.assert_allclose(upright.mesh.vertices.max(0), [0.03, 0.01, 0.04], atol=1e-7)
    assert whole(upright.mesh).volume > 0
    np.testing.assert_allclose(report.size, [0.06, 0.02, 0.04], atol=1e-7)


@pytest.mark.parametrize("name", ["009_gelatin_box", "011_banana", "025_mug", "031_spoon", "048_hammer"])
def test_scans_of_real_objects_come_out_watertight(shared_data, name):
    thing, report = read_mesh(shared_data / "ycb_meshes" / f"{name}.stl", "m")
    cleaned = whole(thing.mesh)
    assert cleaned.is_watertight
    assert cleaned.is_winding_consistent
    assert cleaned.volume > 0
    assert report.watertight
    assert (report.faces < report.faces_read) is (name[:3] in ("009", "025", "031"))
    assert report.faces_read - report.faces <= 12  # stray facets only
    assert thing.mesh.vertices[:, 2].min() == 0


def _bytes(thing: trimesh.Trimesh, suffix: str) -> bytes:
    data = thing.export(file_type=suffix)
    return data.encode() if isinstance(data, str) else data


ASCII_STL = trimesh.creation.box(BOX).export(file_type="stl_ascii").encode()
CORNERS = b"v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\n"
FACE = CORNERS + b"f 1 2 3\n"


@pytest.mark.parametrize(
    ("name", "data", "unit", "words"),
    [
        ("a.stl", b"", "m", "is empty"),
        ("a.stl", _bytes(box(), "stl")[:-1], "m", "cut off"),
        ("a.stl", ASCII_STL[: len(ASCII_STL) // 2], "m", "cut off"),
        ("a.ply", _bytes(box(), "ply")[:-5], "m", "cannot be read as PLY"),
        ("a.ply", _bytes(trimesh.PointCloud(np.eye(3)), "ply"), "m", "point cloud has to be made one first"),
        ("a.glb", _bytes(box(), "glb")[:-5], "m", "cut off"),
        ("a.obj", CORNERS, "m", "holds no faces"),
        ("a.obj", FACE.replace(b"0 0.1 0", b"0 nan 0"), "m", "1 vertices are not finite"),
        ("a.obj", b"v 0 0 0\nv 0.1 0 0\nv 0.2 0 0\nf 1 2 3\nf 2 3 1\n", "m", "no face has an area"),
        ("a.obj", FACE, "mm", "too small.*perhaps its unit is m"),
        ("a.obj", FACE.replace(b"0.1", b"60"), "m", "too large.*perhaps its unit is cm or mm"),
        ("a.obj", FACE, "metre", "unit 'metre' is not known.*inch"),
        ("a.step", b"ISO-10303-21;", "m", r"ending '.step' is none of .stl"),
        ("c.stl", None, "m", "is a folder"),
    ],
)
def test_bad_files_get_one_sentence(tmp_path, name, data, unit, words):
    path = tmp_path / name
    path.mkdir() if data is None else path.write_bytes(data)
    with pytest.raises(ValueError, match=words) as caught:
        read_mesh(path, unit)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_gltf_is_in_metres_and_an_unusual_size_or_unit_is_doubted(tmp_path):
    path = tmp_path / "part.glb"
    for scale, unit, warning in (
        (1.0, None, None),
        (1.0, "m", None),
        (1e3, "mm", "is read in mm, as given, although glTF is in metres by its standard; it is 0.06 m across"),
        (25.0, None, "is 1.5 m across in metres, the unit of glTF; if that is wrong, give another unit, such as cm"),
        (0.05, None, "is 0.003 m across in metres, the unit of glTF; if that is wrong, export it again in metres"),
        (25.0, "m", None),
    ):
        box(scale).export(path)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            thing = read_mesh(path, unit)[0]
        assert [str(item.message) for item in caught] == ([f"{path}: {warning}"] if warning else [])
        longest = BOX[0] * scale * METRES_PER_UNIT[unit or "m"]
        np.testing.assert_allclose(np.ptp(thing.mesh.vertices, 0)[0], longest, rtol=1e-6)
    box(1e3).export(path)
    with pytest.raises(ValueError, match=r"too large to touch, 60 m across .*; perhaps its unit is cm or mm"):
        read_mesh(path)
    box().export(tmp_path / "part.stl")
    with pytest.raises(ValueError, match=r"part.stl: its unit is missing; give it, for instance unit='mm'"):
        read_mesh(tmp_path / "part.stl")


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_gltf_has_y_up_by_its_standard(tmp_path, suffix):
    """trimesh writes coordinates as they are, here with y up."""
    path = tmp_path / f"part.{suffix}"
    if suffix == "glb":
        trimesh.creation.box((0.01, 0.02, 0.03)).export(path)
    else:
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.creation.box((0.01, 0.02, 0.03)).scene()).items():
            (path if name == "model.gltf" else tmp_path / name).write_bytes(data)
    for options, size in (
        ({}, [0.01, 0.03, 0.02]),
        ({"up": "y"}, [0.01, 0.03, 0.02]),
        ({"up": "z"}, [0.01, 0.02, 0.03]),
        ({"table": False}, [0.01, 0.02, 0.03]),  # in the file's own frame
    ):
        thing = read_mesh(path, **options)[0]
        np.testing.assert_allclose(np.ptp(thing.mesh.vertices, axis=0), size, rtol=1e-6)
        turned = "turned from y up to z up" in describe_placement(thing)
        assert turned == (size[2] == 0.02)
    np.testing.assert_allclose(load_mesh(path).vertices.max(0), [0.005, 0.015, 0.02], rtol=1e-6)


def test_every_body_is_kept_but_a_stray_facet_is_dropped(tmp_path):
    body, other = trimesh.creation.box((30, 30, 30)), trimesh.creation.box((5, 5, 5))
    facet = trimesh.Trimesh([[0, 0, 50], [0.1, 0, 50], [0, 0.1, 50]], [[0, 1, 2]])
    other.apply_translation((60, 0, 0))
    path = tmp_path / "scan.stl"
    trimesh.util.concatenate([body, facet, other]).export(path)
    both = load_object(path, "mm")
    assert whole(both.mesh).area == pytest.approx(6e-6 * (30**2 + 5**2), rel=1e-6)
    assert both.obstacles is not None
    assert len(both.obstacles.faces) == 1
    alone = load_object(path, "mm", largest_piece=True)
    assert whole(alone.mesh).area == pytest.approx(6e-6 * 30**2, rel=1e-6)
    assert alone.obstacles is not None
    assert len(alone.obstacles.faces) == 13


@pytest.mark.parametrize("up", ["z", "y"])
@pytest.mark.parametrize("table", [True, False])
def test_the_transform_to_the_files_frame_is_returned(tmp_path, up, table):
    path = tmp_path / "part.ply"
    part = trimesh.creation.icosphere(1, 20.0)
    part.apply_translation([100, 200, 300])
    part.export(path)
    thing, _ = read_mesh(path, "mm", table=table, up=up)
    T = thing.T_file_object
    in_file = transform_mesh(thing.mesh, T)
    np.testing.assert_allclose(np.sort(in_file.vertices, 0), np.sort(1e-3 * part.vertices, 0), atol=1e-7)
    assert whole(in_file).volume == pytest.approx(1e-9 * part.volume, rel=1e-5)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
