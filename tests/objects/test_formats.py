"""Mesh files as programs write them: each dialect is read completely, or refused for the true reason."""

import base64
import json
import struct

import numpy as np
import pytest
from helpers.hostile_files import SCENE, glb
from scipy.spatial.transform import Rotation

from i2t.errors import DataError
from i2t.objects import read_mesh
from i2t.objects.formats.parse import parse_mesh

SIZE = np.array([40.0, 30.0, 20.5])
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * SIZE
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
TRIANGLES = QUADS[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def parse(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return parse_mesh(path, path.read_bytes())


def volume_and_area(mesh):
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return (np.cross(a, b) * c).sum() / 6, np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def is_box(mesh, size=SIZE, times=1):
    """Whether a mesh is the box, closed and turned outward, once or several times."""
    x, y, z = size
    volume, area = volume_and_area(mesh)
    assert volume == pytest.approx(times * x * y * z, rel=1e-6)
    assert area == pytest.approx(times * 2 * (x * y + y * z + x * z), rel=1e-6)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0)[: 3 if times == 1 else 0], size[: 3 if times == 1 else 0])
    return True


def refused(tmp_path, name, data, words):
    with pytest.raises(DataError, match=words) as caught:
        parse(tmp_path, name, data)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert "\n" not in str(caught.value)
    assert "; " in str(caught.value)


# STL


def stl(title="part", corners=CORNERS, end="endsolid part"):
    facets = "".join(
        "facet normal 0 0 0\n outer loop\n"
        + "".join("  vertex {:e} {:e} {:e}\n".format(*v) for v in corners[face])
        + " endloop\nendfacet\n"
        for face in TRIANGLES
    )
    return f"solid {title}\n{facets}{end}\n"


def binary_stl(count=12, header=b"exported", tail=b"", room=12):
    facets = np.zeros(room, [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    facets["v"] = CORNERS[TRIANGLES[:room]]
    return header.ljust(80) + struct.pack("<I", count) + facets.tobytes() + tail


@pytest.mark.parametrize(
    "data",
    [
        stl(),
        stl(end="end solid part"),
        stl(end="endsolid"),
        stl(end="endsolid part\n\n\n"),
        stl("a solid part of two facets"),
        stl("").replace("solid \n", "solid\n"),
        stl().upper(),
        stl().replace("\n", "\r\n"),
        stl().replace("\n", "\r"),
        stl().replace(" ", "\t"),
        stl().replace("\n", " "),
        "\n  " + stl(),
        stl().replace("endloop", "end loop").replace("endfacet", "end facet"),
        stl().replace("normal 0 0 0", "normal -nan(ind) 1.#QNAN nan"),
        stl("größe").encode("cp1252"),
        b"\xef\xbb\xbf" + stl().encode(),
        stl().encode("utf-16"),
        binary_stl(),
        binary_stl(header=b"solid part"),
        binary_stl(header=b"solid part", tail=bytes(16)),
        binary_stl(header=b"ply\nformat"),
        binary_stl(tail=bytes(500)),
        binary_stl(tail=b"\r\n"),
        binary_stl(0),
        binary_stl(2**32 - 1, b"solid streamed"),
        binary_stl(2**31 - 1),
    ],
)
def test_dialects_of_stl_are_read(tmp_path, data):
    assert is_box(parse(tmp_path, "a.stl", data))


def test_all_solids_of_an_stl_are_read(tmp_path):
    assert is_box(parse(tmp_path, "a.stl", stl("a") + "\n" + stl("b", CORNERS + 100)), times=2)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (stl(end=""), "cut off .*after 12 facets, without 'endsolid'"),
        (stl()[:-200], "cut off .*without 'endsolid'"),
        (stl(end="") + stl(), "one of its solids has no 'endsolid'"),
        (stl().replace(" endloop", "  vertex 0 0 0\n endloop", 1), "facet 1 is not written as"),
        (stl().replace("  vertex 0.000000e+00 0.000000e+00 0.000000e+00\n", "", 1), "facet 1 is not written as"),
        (stl().replace(".", ","), r"decimal commas \(0,000000e\+00\)"),
        (stl().replace("4.000000e+01", "4.0x"), "'4.0x' where a number belongs"),
        ("solid nothing\nendsolid nothing\n", "holds no faces"),
        (binary_stl(0, room=0), "holds no faces"),
        (binary_stl()[:-1], "cut off .*holds 11 facets where its header announces 12"),
        (binary_stl(13), "cut off .*holds 12 facets where its header announces 13"),
        (binary_stl(0)[:-1], "holds no faces|bytes after the 0 facets"),
        (binary_stl(2**32 - 1)[:-1], "cut off"),
        (binary_stl() + binary_stl(), "684 bytes after the 12 facets .*another body"),
        (binary_stl(10), "100 bytes after the 10 facets"),
        ("hello", "cut off or not an STL file"),
    ],
)
def test_a_wrong_stl_is_refused_with_the_reason(tmp_path, data, words):
    refused(tmp_path, "a.stl", data, words)


# OBJ

V = "".join("v {} {} {}\n".format(*v) for v in CORNERS)
F = "".join("f {} {} {} {}\n".format(*(q + 1)) for q in QUADS)


def replaced(pattern, text=F):
    """Faces whose corner i is written by a pattern."""
    return "".join(
        "f " + " ".join(pattern.format(i=int(i)) for i in line.split()[1:]) + "\n" for line in text.split("\n")[:-1]
    )


@pytest.mark.parametrize(
    "data",
    [
        V + F,
        F + V,
        (V + F).replace("\n", "\r\n"),
        (V + F).replace("\n", "\r"),
        (V + F).replace(" ", "\t"),
        (V + F).replace(" ", "   ").replace("\n", "  \n"),
        "  " + (V + F).replace("\n", "\n  "),
        V + F.replace(" ", " \\\n", 2).replace(" 7", " \\\r\n 7"),
        (V + F).replace(" ", " \\\n"),
        V + replaced("{i}/{i}") + "vt 0 0\n",
        V + replaced("{i}//{i}"),
        V + replaced("{i}/{i}/{i}"),
        V + replaced("{i}/1/", F[: len(F) // 2]) + F[len(F) // 2 :],
        V + "".join("f {} {} {} {}\n".format(*(q - 8)) for q in QUADS),
        V + F.replace("f ", "fo "),
        V.replace("\n", " 1.0\n") + F,
        V.replace("\n", " 0.5 0.25 0.125\n") + F,
        V.replace("\n", " 0.5 0.25 0.125 1\n", 3) + F,
        V.replace("\n", "  # a remark\n") + F.replace("\n", " # 1 2 3\n"),
        "# C:\\models\\\nmtllib größe.mtl\\\no part\n".encode("cp1252")
        + (V + "g one\nusemtl red\ns off\n" + F).encode(),
        b"\xef\xbb\xbf" + (V + F).encode(),
        (V + F).encode("utf-16"),
        (V + F).upper(),
        V + F[:-1],
        V + F + "\x1a",
        V.replace("20.5", "2.05E+01") + F,
        "v nan nan nan\n"
        + V
        + "v 1.#QNAN -nan(ind) inf\n"
        + "".join("f {} {} {} {}\n".format(*(q + 2)) for q in QUADS),
        "vp 0 1\ncstype bezier\n" + V + F,
    ],
)
def test_dialects_of_obj_are_read(tmp_path, data):
    assert is_box(parse(tmp_path, "a.obj", data))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (V.replace(".", ",") + F, r"its numbers have decimal commas \(0,0\)"),
        ((V + F).replace("40.0", "1.040,5"), r"decimal commas \(1.040,5\)"),
        (V.replace(" ", ", ").replace("v,", "v") + F, "'0.0,' where a number belongs"),
        (V, "holds no faces"),
        (V + "l 1 2 3\nl 3 4\np 1\n", "holds no faces but 2 lines and 1 points"),
        (V + F + "cstype bezier\nsurf 0 1 0 1 1 2 3\n", "parametric surfaces .line 16."),
        (V + F + "call other.obj\n", "calls another file"),
        (V + "f 1 2 9\n", r"face 1 \(line 9\) refers to a vertex that is not there"),
        (V + "f 1 2 -9\n", "a vertex that is not there"),
        (V + "f 0 1 2\n", "counts vertices from 1"),
        (V + "f 1 2 x\n", "'x' where a number belongs"),
        (V + "f 1.5 2 3\n", "'1.5' where a number belongs"),
        ("v 1 2\n" + V + F, "vertex 1 has 2 numbers"),
        (V.replace("\n", " 2\n") + F, "a fourth number w that is not 1"),
        (V.replace("40.0 0.0 0.0", "40.0 nan 0.0") + F, "1 vertices are not finite"),
        ((V + F).encode() + bytes(9), "it is not text"),
    ],
)
def test_a_wrong_obj_is_refused_with_the_reason(tmp_path, data, words):
    refused(tmp_path, "a.obj", data, words)


def test_an_obj_cut_off_within_its_last_face_is_refused(tmp_path):
    assert is_box(parse(tmp_path, "a.obj", (V + F).rstrip("\n")))
    last = V + F.rstrip("\n")
    for cut in (last[: last.rindex(" ")], last[: last.rindex(" ")].rpartition(" ")[0], last[: last.rindex("f") + 1]):
        refused(tmp_path, "a.obj", cut, "cut off within its last face, which no line break ends")
    for corners in ("1//1 2//1 3/", "1/1 2/2 3"):
        refused(tmp_path, "a.obj", f"{V}f 1//1 2//1 4//1\nf {corners}", "cut off within its last face")


# PLY and OFF


def ply(
    form="ascii", count="uchar", index="int", name="vertex_indices", before=(), after=(), real="float", quads=QUADS
):
    """The box, with colours of faces before and after the list of corners."""
    order = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    types = {"uchar": "u1", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8", "int8": "i1",
             "uint8": "u1", "int32": "i4", "short": "i2", "float32": "f4", "float64": "f8"}  # fmt: skip
    header = f"ply\nformat {form} 1.0\ncomment of ours\nobj_info none\nelement vertex 8\n"
    header += f"property {real} x\nproperty {real} y\nproperty {real} z\nproperty uchar red\n"
    header += f"element face {len(quads)}\n" + "".join(f"property uchar {colour}\n" for colour in before)
    header += f"property list {count} {index} {name}\n" + "".join(f"property uchar {colour}\n" for colour in after)
    header += "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    if form == "ascii":
        rows = ["{} {} {} 255".format(*v) for v in CORNERS]
        rows += [" ".join(map(str, [*[7] * len(before), len(q), *q, *[9] * len(after)])) for q in quads]
        return (header + "\n".join([*rows, "0 1"]) + "\n").encode()
    vertices = np.zeros(8, [("v", order + types[real], 3), ("c", "u1")])
    vertices["v"] = CORNERS
    body = vertices.tobytes()
    for q in quads:
        body += bytes([7] * len(before)) + np.array(len(q), order + types[count]).tobytes()
        body += np.array(q, order + types[index]).tobytes() + bytes([9] * len(after))
    return header.encode() + body + np.array([0, 1], order + "i4").tobytes()


MIXED = [QUADS[0], *TRIANGLES[2:6], *QUADS[3:]]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"count": "int", "index": "uint", "name": "vertex_index"},
        {"count": "uint8", "index": "int32", "real": "float64"},
        {"count": "ushort", "index": "short", "real": "double"},
        {"count": "int8", "index": "uint8"},
        {"before": ("red", "green")},
        {"after": ("red", "green")},
        {"quads": MIXED},
        {"quads": MIXED, "before": ("red",), "after": ("blue",), "count": "uint"},
        {"quads": [*QUADS, [0, 1]]},
    ],
)
def test_dialects_of_ply_are_read(tmp_path, form, options):
    mesh = parse(tmp_path, "a.ply", ply(form, **options))
    assert is_box(mesh)
    assert mesh.ignored == (("1 faces of fewer than three corners",) if len(options.get("quads", ())) == 7 else ())


def test_a_ply_in_utf_16_is_read(tmp_path):
    assert is_box(parse(tmp_path, "a.ply", ply().decode().encode("utf-16")))


def test_a_ply_with_line_ends_of_other_systems_is_read(tmp_path):
    assert is_box(parse(tmp_path, "a.ply", ply().replace(b"\n", b"\r\n")))
    assert is_box(parse(tmp_path, "a.ply", ply().replace(b"\n", b"\r")))
    header, mark, body = ply("binary_little_endian").partition(b"end_header\n")
    assert is_box(parse(tmp_path, "a.ply", (header + mark).replace(b"\n", b"\r\n") + body))
    assert is_box(parse(tmp_path, "a.ply", (header + mark).replace(b"\n", b"\r") + body))
    assert is_box(parse(tmp_path, "a.ply", ply("binary_little_endian") + b"\n"))


def test_other_lists_next_to_the_faces_are_ignored(tmp_path):
    text = ply().decode().replace("element edge", "property list uchar float texcoord\nelement edge")
    lines = text.split("\n")
    lines[-8:-2] = [f"{line} 2 0.5 0.25" for line in lines[-8:-2]]
    assert is_box(parse(tmp_path, "a.ply", "\n".join(lines)))


@pytest.mark.parametrize("faces", [0, 2])
def test_strips_of_triangles_in_ply_are_read_and_faces_with_them(tmp_path, faces):
    strips = [" ".join(str(q[i]) for i in (0, 1, 3, 2)) for q in QUADS[faces:]]
    header = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    header += f"element tristrips 1\nproperty list int int vertex_indices\nelement face {faces}\n"
    header += "property list uchar int vertex_indices\nend_header\n" + "".join("{} {} {}\n".format(*v) for v in CORNERS)
    rows = f"{5 * len(strips)} {' -1 '.join(strips)} -1\n" + "".join(
        "4 {} {} {} {}\n".format(*q) for q in QUADS[:faces]
    )
    assert is_box(parse(tmp_path, "a.ply", header + rows))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (ply()[:-20], "cut off|numbers"),
        (
            ply("binary_little_endian")[:-9],
            "cut off: its header announces 6 entries of element 'face', but only 5 are present",
        ),
        (ply("binary_big_endian", quads=MIXED)[:-9], "cut off"),
        (ply()[:60], "no PLY header, or is cut off within it"),
        (ply().replace(b"face 6", b"face 5"), "1 lines more than its header announces|numbers"),
        (ply("binary_little_endian").replace(b"face 6", b"face 5"), "bytes more than its header announces"),
        (ply().replace(b" 255\n", b"\n"), "vertex 1 has 3 numbers"),
        (ply().replace(b"vertex_indices", b"corners"), "no list vertex_indices, but corners"),
        (ply().replace(b"float x", b"half x"), "the type 'half'"),
        (ply().replace(b"float y", b"float u"), "no vertices with x, y and z"),
        (ply().replace(b"\n4 0 1 3 2\n", b"\n4 0 1 3 8\n"), "face 1 refers to a vertex that is not there"),
        (ply().replace(b"\n4 0 1 3 2\n", b"\n4 0 1 3 -1\n"), "face 1 refers to a vertex that is not there"),
        (ply().replace(b"\n4 0 1 3 2\n", b"\n4 0 1 3 1.5\n"), "not a whole number"),
        (ply(quads=[QUADS[0][[0, 2, 1, 3]]]), "face 1 has 4 corners and crosses itself"),
        (ply().replace(b"20.5", b"20,5"), "decimal commas"),
        (ply(quads=[]), "holds no faces"),
    ],
)
def test_a_wrong_ply_is_refused_with_the_reason(tmp_path, data, words):
    refused(tmp_path, "a.ply", data, words)


OFF_ROWS = "".join("{} {} {}\n".format(*v) for v in CORNERS) + "".join("4 {} {} {} {}\n".format(*q) for q in QUADS)


@pytest.mark.parametrize(
    "data",
    [
        f"OFF\n8 6 12\n{OFF_ROWS}",
        f"OFF\n8 6 0\n{OFF_ROWS}".replace("\n", "\r\n"),
        f"OFF 8 6 12\n{OFF_ROWS}",
        f"OFF8 6 12\n{OFF_ROWS}",
        f"off\n8 6 12\n{OFF_ROWS}",
        f"OFF\n8 6 12\n{OFF_ROWS}".encode("utf-16"),
        f"OFF 8 6 12\n{OFF_ROWS}".replace("\n", " "),
        f"OFF\n8\n6\n12\n{OFF_ROWS}".replace(" ", "\n"),
        f"OFF\n8 6\n{OFF_ROWS}".replace(".0\n", ".0 ").replace(".5\n", ".5 "),
        f"NOFF 8 6 12\n{OFF_ROWS}".replace(".0\n", ".0 0 0 1\n").replace(".5\n", ".5 0 0 1\n").replace("\n", " "),
        f"# of ours\nOFF # so\n\n8 6\n# corners\n{OFF_ROWS}\n\n",
        f"8 6 12\n{OFF_ROWS}",
        f"COFF\n8 6 12\n{OFF_ROWS}".replace(".0\n", ".0 255 0 0 255\n").replace(".5\n", ".5 255 0 0 255\n"),
        f"NOFF\n8 6 12\n{OFF_ROWS}".replace(".0\n", ".0 0 0 1\n").replace(".5\n", ".5 0 0 1\n"),
        f"OFF\n8 6 12\n{OFF_ROWS}".replace(" 2\n", " 2 255 0 0\n", 1).replace(" 4\n", " 4 0.5 0.5 0.5 1\n"),
    ],
)
def test_dialects_of_off_are_read(tmp_path, data):
    assert is_box(parse(tmp_path, "a.off", data))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (f"OFF\n8 6 12\n{OFF_ROWS}"[:-12], "cut off: its header announces 8 vertices and 6 faces, but only 13 lines"),
        (f"OFF\n8 5 12\n{OFF_ROWS}", "1 lines more than its header announces"),
        (f"OFF\n8 6 12\n{OFF_ROWS}"[:-3], "face 6 has too few corners"),
        (f"OFF\n8 6 12\n{OFF_ROWS}".replace(".", ","), "decimal commas"),
        (f"OFF\n8 6 12\n{OFF_ROWS}"[:-4].replace("\n", " "), "'0.0' where a number belongs"),
        (f"4OFF\n8 6 12\n{OFF_ROWS}", "not in three dimensions"),
        (f"noff\n8 6 12\n{OFF_ROWS}", "not in three dimensions"),
        ("OFF BINARY\n\0\0\0\1", "it is binary"),
        ("OFF\n", "no counts"),
        ("OFF\n8 0 0\n" + OFF_ROWS.partition("4 0")[0], "holds no faces"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "face 1 refers to a vertex that is not there"),
    ],
)
def test_a_wrong_off_is_refused_with_the_reason(tmp_path, data, words):
    refused(tmp_path, "a.off", data, words)


# A channel, whose caps are polygons of eight corners


@pytest.mark.parametrize("first", [0, 2, 4, 5])
@pytest.mark.parametrize("suffix", ["obj", "ply", "off"])
def test_the_caps_of_a_channel_are_not_filled(tmp_path, suffix, first):
    section = np.array([(0, 0), (30, 0), (30, 30), (21, 30), (21, 9), (9, 9), (9, 30), (0, 30)])
    vertices = np.concatenate([np.c_[section, np.zeros(8)], np.c_[section, np.full(8, 12.0)]])
    cap = np.roll(np.arange(8), first)
    faces = [cap[::-1], cap + 8, *([i, (i + 1) % 8, (i + 1) % 8 + 8, i + 8] for i in range(8))]
    rows = "".join("{} {} {}\n".format(*v) for v in vertices)
    body = rows + "".join(" ".join(map(str, [len(f), *f])) + "\n" for f in faces)
    xyz = "property float x\nproperty float y\nproperty float z\n"
    text = {
        "obj": "".join(f"v {row}\n" for row in rows.split("\n")[:-1])
        + "".join("f " + " ".join(str(i + 1) for i in f) + "\n" for f in faces),
        "ply": f"ply\nformat ascii 1.0\nelement vertex 16\n{xyz}element face 10\nproperty list uchar int vertex_index\n"
        f"end_header\n{body}",
        "off": f"OFF\n16 10 0\n{body}",
    }[suffix]
    volume, area = volume_and_area(parse(tmp_path, f"a.{suffix}", text))
    assert area == pytest.approx(2 * 648 + 162 * 12)
    assert volume == pytest.approx(648 * 12)
    _, report = read_mesh(tmp_path / f"a.{suffix}", "mm")
    assert report.watertight
    assert "nothing to clean" in str(report)


# glTF

BOX = {"componentType": 5126, "count": 8, "type": "VEC3", "min": [0, 0, 0], "max": SIZE.tolist()}


def scene(positions=None, indices=None, extra=b"", views=(), accessor=None, primitive=None, node=None, **changes):
    """A box as GLB: view 0 holds its corners, view 1 its triangles and view 2 the extra data."""
    corners = CORNERS.astype("<f4").tobytes() if positions is None else positions
    faces = TRIANGLES.astype("<u2").tobytes() if indices is None else indices
    parts = [corners, faces, extra]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    default = [{"buffer": 0, "byteOffset": s, "byteLength": len(p)} for s, p in zip(starts, parts, strict=False)]
    for view, more in zip(default, views, strict=False):
        view.update(more)
    whole = {
        "nodes": [{"mesh": 0} | (node or {})],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1} | (primitive or {})]}],
        "accessors": [
            {key: value for key, value in ({"bufferView": 0} | BOX | (accessor or {})).items() if value is not None},
            {"bufferView": 1, "componentType": 5123, "count": len(faces) // 2, "type": "SCALAR"},
        ],
        "bufferViews": default,
        "buffers": [{"byteLength": starts[-1]}],
    }
    document = {key: value for key, value in (SCENE | whole | changes).items() if value is not None}
    return glb(json.dumps(document), b"".join(parts))


def test_numbers_of_every_kind_in_glb_are_read(tmp_path):
    assert is_box(parse(tmp_path, "a.glb", scene()))
    spaced = np.zeros((8, 20), np.uint8)
    spaced[:, 4:16] = CORNERS.astype("<f4").view(np.uint8)
    views = [{"byteStride": 20}]
    assert is_box(parse(tmp_path, "a.glb", scene(spaced.tobytes(), views=views, accessor={"byteOffset": 4})))
    for code, dtype in ((5121, "u1"), (5125, "<u4")):
        accessors = [{"bufferView": 0} | BOX, {"bufferView": 1, "componentType": code, "count": 36, "type": "SCALAR"}]
        assert is_box(parse(tmp_path, "a.glb", scene(indices=TRIANGLES.astype(dtype).tobytes(), accessors=accessors)))


@pytest.mark.parametrize(("code", "dtype"), [(5120, "i1"), (5121, "u1"), (5122, "<i2"), (5123, "<u2")])
def test_normalized_integers_are_fractions_and_other_integers_are_not(tmp_path, code, dtype):
    largest = np.iinfo(dtype).max
    corners = (CORNERS / SIZE * largest).astype(dtype)
    low, high = [0, 0, 0], [int(largest)] * 3
    quantized = {"componentType": code, "normalized": True, "min": low, "max": high}
    options = {"extensionsRequired": ["KHR_mesh_quantization"], "node": {"scale": SIZE.tolist()}}
    assert is_box(parse(tmp_path, "a.glb", scene(corners.tobytes(), accessor=quantized, **options)))
    after = quantized | {"max": [1, 1, 1]}  # as some programs count
    assert is_box(parse(tmp_path, "a.glb", scene(corners.tobytes(), accessor=after, **options)))
    plain = quantized | {"normalized": False}
    mesh = parse(tmp_path, "a.glb", scene(corners.tobytes(), accessor=plain, **options))
    assert is_box(mesh, SIZE * float(largest))


def sparse(base, code=5123):
    dtype = {5121: "u1", 5123: "<u2", 5125: "<u4"}[code]
    wrong = CORNERS.copy()
    wrong[4:] *= 0.5 if base else 0
    places = np.arange(8 if not base else 4) + (4 if base else 0)
    extra = places.astype(dtype).tobytes()
    accessor = {
        "sparse": {
            "count": len(places),
            "indices": {"bufferView": 2, "componentType": code},
            "values": {"bufferView": 2, "byteOffset": len(extra)},
        }
    }
    if not base:
        accessor["bufferView"] = None
    return scene(
        wrong.astype("<f4").tobytes(), extra=extra + CORNERS[places].astype("<f4").tobytes(), accessor=accessor
    )


@pytest.mark.parametrize("code", [5121, 5123, 5125])
@pytest.mark.parametrize("base", [True, False])
def test_sparse_values_replace_those_below(tmp_path, base, code):
    assert is_box(parse(tmp_path, "a.glb", sparse(base, code)))


def test_strips_and_fans_in_glb_are_read_and_lines_left_out(tmp_path):
    strips = [np.array(q)[[0, 1, 3, 2]] for q in QUADS]
    for mode, rows in ((5, strips), (6, QUADS)):
        indices = np.concatenate([np.array(row) for row in rows]).astype("<u2").tobytes()
        primitives = [{"attributes": {"POSITION": 0}, "indices": i + 1, "mode": mode} for i in range(6)]
        accessors = [{"bufferView": 0} | BOX] + [
            {"bufferView": 1, "byteOffset": 8 * i, "componentType": 5123, "count": 4, "type": "SCALAR"}
            for i in range(6)
        ]
        lines = {"attributes": {"POSITION": 0}, "mode": 1}
        data = scene(indices=indices, accessors=accessors, meshes=[{"primitives": [*primitives, lines]}])
        mesh = parse(tmp_path, "a.glb", data)
        assert is_box(mesh)
        assert mesh.ignored == ("1 primitives of lines",)
        with pytest.warns(match="glTF"), pytest.warns(match="left out 1 primitives of lines; faces"):
            read_mesh(tmp_path / "a.glb", "mm")
    with pytest.raises(DataError, match="holds no faces but 1 primitives of points"):
        parse(tmp_path, "a.glb", scene(primitive={"mode": 0}))


def test_nodes_place_turn_scale_and_mirror(tmp_path):
    turn = Rotation.from_euler("z", 90, degrees=True)
    child = {"mesh": 0, "scale": [2, 1, -1], "rotation": turn.as_quat().tolist(), "translation": [100, 0, 0]}
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 10 * np.eye(3), [0, 0, 7]
    parent = {"matrix": matrix.T.reshape(-1).tolist(), "children": [0]}
    mesh = parse(tmp_path, "a.glb", scene(nodes=[child, parent], scenes=[{"nodes": [1]}]))
    assert is_box(mesh, np.array([30, 80, 20.5]) * 10)
    np.testing.assert_allclose(mesh.vertices.max(0), [1000, 800, 7], rtol=1e-6)
    twice = [{"mesh": 0}, {"mesh": 0, "translation": [100, 0, 0], "scale": [-1, 1, 1]}]
    assert is_box(parse(tmp_path, "a.glb", scene(nodes=twice, scenes=[{"nodes": [0, 1]}])), times=2)


def test_the_default_of_several_scenes_is_read(tmp_path):
    nodes, scenes = [{"mesh": 0}, {"mesh": 0, "scale": [2, 2, 2]}], [{"nodes": [0]}, {"nodes": [1]}]
    mesh = parse(tmp_path, "a.glb", scene(nodes=nodes, scenes=scenes, scene=1))
    assert is_box(mesh, 2 * SIZE)
    assert mesh.ignored == ("1 scenes that are not the default one",)
    data = scene(nodes=nodes, scenes=scenes, scene=None)
    refused(tmp_path, "a.glb", data, "2 scenes, none of which is the default")


DRACO = "KHR_draco_mesh_compression"
MESHOPT = "EXT_meshopt_compression"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (scene(extensionsRequired=[DRACO]), f"needs the glTF extension {DRACO}, which is not read; export it again"),
        (scene(extensionsRequired=[MESHOPT]), f"needs the glTF extension {MESHOPT}"),
        (scene(extensionsRequired=["ACME_voxels"]), "needs the glTF extension ACME_voxels"),
        (
            scene(primitive={"extensions": {DRACO: {}}}, accessors=[BOX, {**BOX, "type": "SCALAR"}]),
            f"is compressed .{DRACO}",
        ),
        (
            scene(
                views=[{"extensions": {MESHOPT: {}}, "buffer": 1}], buffers=[{"byteLength": 168}, {"byteLength": 96}]
            ),
            f"is compressed .{MESHOPT}",
        ),
        (
            scene(node={"extensions": {"EXT_mesh_gpu_instancing": {}}}),
            "uses the glTF extension EXT_mesh_gpu_instancing",
        ),
        (scene(node={"skin": 0}), "is a skinned mesh"),
        (scene(node={"weights": [0.5]}), "morph targets"),
        (scene(accessor={"max": [40, 30, 41]}), r"spans \(0, 0, 0\) to \(40, 30, 41\), and its numbers span .*20.5\)"),
        (scene(accessor={"min": [0.01, 0, 0]}), "accessor 0 says that it spans"),
        (scene(accessor={"count": 9}), "cut off or wrong"),
        (scene(accessor={"count": 10**12}), "entries, which no file holds"),
        (scene(buffers=[{"byteLength": 10**6}]), "buffer 0 should have 1000000 bytes"),
        (scene()[:-9], "is cut off: it announces"),
        (b"rubbish", "is not a glTF file"),
        (scene(asset={"version": "1.0"}), "is glTF 1.0"),
        (scene(primitive={"mode": 9}), "mode 9"),
        (scene(indices=TRIANGLES.astype("<u2").tobytes()[:-2]), "35 corners of triangles"),
        (scene(indices=TRIANGLES.astype("<u2").tobytes()[:-2] + b"\x08\0"), "a vertex that is not there"),
        (scene(meshes=[{}]), "cannot be read as GLB .KeyError 'primitives'"),
    ],
)
def test_unsupported_features_of_a_glb_are_refused_by_name(tmp_path, data, words):
    refused(tmp_path, "a.glb", data, words)


def gltf(uri):
    data = scene()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    document["buffers"][0]["uri"] = uri
    return json.dumps(document)


def test_gltf_is_read_with_its_data_in_another_file_or_embedded(tmp_path):
    blob = CORNERS.astype("<f4").tobytes() + TRIANGLES.astype("<u2").tobytes()
    (tmp_path / "my box.bin").write_bytes(blob)
    for uri in ("my box.bin", "my%20box.bin", "./my%20box.bin"):
        assert is_box(parse(tmp_path, "a.gltf", gltf(uri)))
    for kind in ("application/octet-stream", "application/gltf-buffer"):
        assert is_box(parse(tmp_path, "a.gltf", gltf(f"data:{kind};base64,{base64.b64encode(blob).decode()}")))
    assert is_box(parse(tmp_path, "a.gltf", "\ufeff" + gltf("my box.bin")))
    assert is_box(parse(tmp_path, "a.gltf", gltf("my box.bin").encode("utf-16")))
    (tmp_path / "my box.bin").write_bytes(blob[:-1])
    refused(tmp_path, "a.gltf", gltf("my box.bin"), "is cut off: buffer 0 should have 168 bytes and has 167")


def test_gltf_data_may_be_in_a_subfolder_but_not_behind_a_link(tmp_path):
    blob = CORNERS.astype("<f4").tobytes() + TRIANGLES.astype("<u2").tobytes()
    inside, outside = tmp_path / "scene", tmp_path / "elsewhere"
    for folder in (inside / "parts", outside):
        folder.mkdir(parents=True)
        (folder / "x.bin").write_bytes(blob)
    (inside / "link").symlink_to(outside)
    (inside / "link.bin").symlink_to(outside / "x.bin")
    for uri in ("parts/x.bin", "./parts/x.bin", "parts\\x.bin", "parts%2Fx.bin"):
        assert is_box(parse(inside, "a.gltf", gltf(uri)))
    for uri in (
        "link/x.bin",
        "link.bin",
        "parts/../../elsewhere/x.bin",
        str(outside / "x.bin"),
        "..\\elsewhere\\x.bin",
    ):
        refused(inside, "a.gltf", gltf(uri), "lies outside of")


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("gone.bin", "its data are in 'gone.bin', which is not next to it"),
        ("../a.bin", "lies outside of"),
        ("%2e%2e/a.bin", "lies outside of"),
        ("/etc/passwd", "lies outside of"),
        ("https://example.org/a.bin", "its data are at https://example.org/a.bin; download that"),
        ("data:application/octet-stream;base64,&&&", "cannot be read as GLTF"),
        ("data:application/octet-stream;base64,AAAA", "is cut off: buffer 0"),
    ],
)
def test_gltf_data_come_from_its_own_folder_only(tmp_path, uri, words):
    refused(tmp_path, "a.gltf", gltf(uri), words)


# Endings and contents


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.stl", V + F, "is OBJ by its contents and STL by its ending; rename it to a.obj"),
        ("a.stl", "# of ours\n" + V * 200 + F, "is OBJ by its contents"),
        ("a.stl", ply(), "is PLY by its contents"),
        ("a.obj", stl(), "is STL by its contents and OBJ by its ending"),
        ("a.ply", f"OFF\n8 6 12\n{OFF_ROWS}", "is OFF by its contents"),
        ("a.obj", scene(), "is GLB by its contents"),
        ("a.stl", gltf("a.bin"), "is GLTF by its contents"),
        (
            "a.stl",
            "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n",
            "Git LFS pointer.*git lfs pull",
        ),
        ("a.obj", "\n<!DOCTYPE html>\n<html></html>", "a web page, not the mesh itself"),
        ("a.stl", "ISO-10303-21;\nHEADER;", "is a STEP file; export it as STL"),
        ("a.stl", "x" * 72 + "S      1\n", "is an IGES file"),
        ("a.stl", b"PK\x03\x04" + bytes(26) + b"3D/3dmodel.model", "is a 3MF file"),
        ("a.ply", b"PK\x03\x04" + bytes(26) + b"a.ply", "is an archive; unpack it"),
        ("a.stl", b"\x1f\x8b\x08" + bytes(30), "is an archive"),
        ("a.obj", '<?xml version="1.0"?>\n<COLLADA xmlns="">', "a Collada file"),
        ("a.stl", b"Kaydara FBX Binary  \0", "an FBX file"),
        ("a.glb", b"BLENDER-v300", "a Blender file"),
        ("a.obj", "#usda 1.0\n", "a USD file"),
        ("a.glb", b"3D Geometry File Format ", "a Rhino file"),
        ("a.ply", "# .PCD v0.7\n", "a point cloud .PCD"),
        ("a.stl", b"\x89PNG\r\n", "an image or a document"),
    ],
)
def test_a_wrong_suffix_is_refused_by_the_kind_of_the_contents(tmp_path, name, data, words):
    refused(tmp_path, name, data, words)


@pytest.mark.parametrize(
    ("suffix", "words"),
    [
        *((suffix, "is a CAD model: .*export it as STL") for suffix in ("step", "STP", "igs", "iges", "3dm", "sldprt")),
        *((suffix, "of another format: .*convert it to STL") for suffix in ("3mf", "dae", "fbx", "usdz", "blend")),
        ("pcd", "is a point cloud: .*Open3D"),
        ("zip", "is an archive: .*unpack it"),
        ("doc", "its ending '.doc' is none of .stl, .obj, .ply, .off, .glb, .gltf; convert it to one of them"),
    ],
)
def test_other_formats_are_refused_by_name(tmp_path, suffix, words):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"anything")
    with pytest.raises(ValueError, match=words) as caught:
        read_mesh(path, "mm")
    assert ".stl, .obj, .ply, .off, .glb, .gltf" in str(caught.value)


def test_vertices_that_no_face_uses_may_be_nan(tmp_path):
    data = ply("binary_little_endian").replace(b"vertex 8", b"vertex 9")
    header, mark, body = data.partition(b"end_header\n")
    unused = np.full(3, np.nan, "<f4").tobytes() + b"\0"
    mesh = parse(tmp_path, "a.ply", header + mark + body[: 8 * 13] + unused + body[8 * 13 :])
    assert is_box(mesh)
    assert len(mesh.vertices) == 8
