"""Mesh files: units, frames, what cleaning counts, and one clear sentence for each kind of bad file."""

import numpy as np
import pytest
import trimesh

from i2t.objects import clean_mesh, load_object, make_object, read_mesh
from i2t.objects.mesh_files import METRES_PER_UNIT
from i2t.objects.solids import Mesh

BOX = (0.06, 0.04, 0.02)  # m


def box(scale: float = 1.0) -> trimesh.Trimesh:
    return trimesh.creation.box(np.array(BOX) * scale)


def joined(*parts: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(p.vertices) for p in parts)])
    faces = [p.faces + s for p, s in zip(parts, starts, strict=False)]
    return Mesh(np.concatenate([p.vertices for p in parts]), np.concatenate(faces).astype(np.int32))


def plain(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int32))


def whole(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("unit", list(METRES_PER_UNIT))
def test_units_and_formats(tmp_path, unit):
    for suffix in ("stl", "obj", "ply", "glb", "STL"):
        path = tmp_path / f"part.{suffix}"
        box(1 / METRES_PER_UNIT[unit]).export(path, file_type=suffix.lower())
        thing, report = read_mesh(path, unit)
        assert (thing.name, thing.family) == ("part", "file")
        # STL and GLB store float32: 2^-24 of each coordinate.
        np.testing.assert_allclose(thing.mesh.vertices.max(0), [0.03, 0.02, 0.02], rtol=2**-23)
        np.testing.assert_allclose(report.size, BOX, rtol=2**-23)
        assert whole(thing.mesh).volume == pytest.approx(np.prod(BOX), rel=3 * 2**-23)
        assert report.watertight
        assert report.faces == report.faces_read == 12
        assert len(thing.mesh.vertices) == 8


def test_frames(tmp_path):
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


def test_cleaning_counts_what_it_does():
    rng = np.random.default_rng(0)
    good = plain(trimesh.creation.icosphere(2, 0.03))
    speck = plain(trimesh.creation.box((1e-3, 1e-3, 1e-3)))
    soup = Mesh(good.vertices[good.faces.ravel()], np.arange(3 * len(good.faces), dtype=np.int32).reshape(-1, 3))
    turned = rng.permutation(len(good.faces))[:70]
    soup.faces[turned] = soup.faces[turned][:, ::-1]
    extra = np.array([[0, 0, 1], [0, 1, 2], [3, 4, 5], [3, 5, 4]], np.int32)  # one of no area, three repeated
    dirty = joined(Mesh(soup.vertices, np.concatenate([soup.faces, extra])), speck)
    mesh, report = clean_mesh(dirty, "dirty.stl")
    area = trimesh.creation.icosphere(2, 0.03).area
    assert report.area_dropped == pytest.approx(6e-6 / (6e-6 + area))
    assert (report.faces_read, report.faces, report.watertight) == (320 + 4 + 12, 320, True)
    assert (report.degenerate, report.repeated, report.pieces_dropped) == (1, 3, 1)
    assert report.vertices_merged == 3 * 320 - len(good.vertices)
    assert report.turned in (70, 71)  # 71 where the second repeat was the one turned round
    assert whole(mesh).volume == pytest.approx(whole(good).volume, rel=1e-6)  # vertices merge within 1e-8 of 0.03 m
    assert "dirty.stl: 320 of 336 faces" in str(report)
    both, report = clean_mesh(dirty, largest=False)
    assert (len(both.faces), report.pieces_dropped) == (332, 0)
    assert whole(both).volume == pytest.approx(whole(good).volume + 1e-9, rel=1e-6)


def test_cleaning_leaves_a_clean_mesh_and_turns_an_inverted_one():
    star = make_object("star").mesh
    mesh, report = clean_mesh(star, "star")
    np.testing.assert_array_equal(mesh.faces, star.faces)
    np.testing.assert_array_equal(mesh.vertices, star.vertices)
    assert "nothing to clean" in str(report)
    mesh, report = clean_mesh(Mesh(star.vertices, star.faces[:, ::-1]))
    assert report.turned == len(star.faces)
    assert whole(mesh).volume == pytest.approx(whole(star).volume)


def test_holes_stay_fins_go_and_two_sided_sheets_keep_one_side():
    thing = plain(box())
    mesh, report = clean_mesh(Mesh(thing.vertices, thing.faces[1:]))
    assert (len(mesh.faces), report.open_edges, report.watertight) == (11, 3, False)
    assert "open at 3 edges" in str(report)
    thing = plain(trimesh.creation.icosphere(2, 0.03))
    a, b = thing.faces[0, :2]
    tip = len(thing.vertices)
    vertices = np.concatenate([thing.vertices, thing.vertices[[a]] * 1.01])
    fin = np.array([[a, b, tip], [b, a, tip]], np.int32)
    mesh, report = clean_mesh(Mesh(vertices, np.concatenate([thing.faces, fin])))
    assert (len(mesh.faces), report.repeated, report.watertight) == (len(thing.faces), 2, True)
    sheet = Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]]), np.array([[0, 1, 2], [2, 1, 0]], np.int32))
    mesh, report = clean_mesh(sheet)
    assert (len(mesh.faces), report.repeated) == (1, 1)


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
        ("a.ply", _bytes(trimesh.PointCloud(np.eye(3)), "ply"), "m", "point cloud is made one first"),
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


def test_a_second_body_is_not_left_out_silently_but_a_stray_facet_is(tmp_path):
    body, other = trimesh.creation.box((30, 30, 30)), trimesh.creation.box((30, 30, 29))
    facet = trimesh.Trimesh([[0, 0, 50], [0.1, 0, 50], [0, 0.1, 50]], [[0, 1, 2]])
    other.apply_translation((60, 0, 0))
    trimesh.util.concatenate([body, facet]).export(tmp_path / "scan.stl")
    trimesh.util.concatenate([body, other]).export(tmp_path / "two.stl")
    assert load_object(tmp_path / "scan.stl", "mm").name == "scan"
    with pytest.warns(UserWarning, match="only the largest piece is touched"):
        load_object(tmp_path / "two.stl", "mm")
