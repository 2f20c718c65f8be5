"""Triangles of mesh files in STL, OBJ, PLY, OFF and glTF: what is there, all of it, or the reason why not.

The readers are strict about what changes a shape and lenient about the rest. Counts that a file announces are compared
with what is there; polygons are cut into triangles (`i2t.objects.polygons`); what has no surface, such as lines, is
left out and said. A file whose contents are of another kind than its ending is refused by the name of that kind.
"""

import codecs
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError
from i2t.objects.gltf import read_scene
from i2t.objects.polygons import strip_triangles, triangulate

STL_HEADER, FACET_BYTES = 84, 50  # of binary STL
PLACEHOLDER_COUNTS = (0, 2**31 - 1, 2**32 - 1)  # that programs write which stream the facets and never go back
FACET = ((0, b"facet"), (1, b"normal"), (5, b"outer"), (6, b"loop"), (7, b"vertex"), (11, b"vertex"),
         (15, b"vertex"), (19, b"endloop"), (20, b"endfacet"))  # fmt: skip
FACET_WORDS = 21
PADDING = b"\0\n\r\t \x1a"
PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
             "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
             "float32": "f4", "float64": "f8"}  # fmt: skip
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_PLY_HEADER = 2**16  # bytes
OBJ_VERTEX_WORDS = (3, 4, 6, 7)  # x y z, then w, or r g b, or r g b a
OBJ_SURFACES = (b"surf", b"bzp", b"bsp", b"cdp", b"cdc", b"res")  # free-form ones; some of an old version
OBJ_CURVES = {b"l": "lines", b"p": "points", b"curv": "curves"}

CONVERT = "convert it to STL, for instance with Blender"
FROM_CAD = "export it as STL from a CAD program"
FOREIGN_SUFFIXES = {
    **dict.fromkeys((".step", ".stp", ".iges", ".igs", ".brep", ".3dm", ".sldprt", ".sldasm", ".ipt", ".x_t", ".x_b",
                     ".f3d", ".fcstd", ".catpart", ".prt", ".sat", ".scad", ".dxf", ".dwg"), ("a CAD model", FROM_CAD)),
    **dict.fromkeys((".3mf", ".amf", ".dae", ".fbx", ".usd", ".usda", ".usdc", ".usdz", ".blend", ".3ds", ".max",
                     ".ma", ".mb", ".c4d", ".wrl", ".x3d", ".vtk", ".vtp", ".vtu", ".msh", ".abc"),
                    ("a mesh or scene of another format", CONVERT)),
    **dict.fromkeys((".pcd", ".xyz", ".las", ".laz", ".e57", ".pts"),
                    ("a point cloud", "make it a mesh first, for instance with Open3D")),
    **dict.fromkeys((".zip", ".gz", ".7z", ".rar", ".tar"), ("an archive", "unpack it, and name the mesh in it")),
}  # fmt: skip
FOREIGN_MARKS = (  # how files begin that are no mesh of ours, whatever their ending says
    (rb"version https://git-lfs", "a Git LFS pointer, not the mesh itself", "run git lfs pull"),
    (rb"(?:\.\./)*\.git/annex|/annex/objects", "a git-annex pointer, not the mesh itself", "run git annex get"),
    (rb"<!doctype html|<html", "a web page, not the mesh itself", "download the file behind it"),
    (rb"iso-10303-21", "a STEP file", FROM_CAD),
    (rb"[^\r\n]{72}s[ 0]{6}1\b", "an IGES file", FROM_CAD),
    (rb"dbrep_drawableshape|cascade topology", "a BREP file", FROM_CAD),
    (rb"3d geometry file format", "a Rhino file (3DM)", FROM_CAD),
    (rb"kaydara fbx|; fbx", "an FBX file", CONVERT),
    (rb"blender|\x28\xb5\x2f\xfd", "a Blender file", "export it as STL from Blender"),
    (rb"pxr-usd|#usda", "a USD file", CONVERT),
    (rb"#vrml|# vtk", "a VRML or VTK file", CONVERT),
    (rb"# \.pcd", "a point cloud (PCD)", "make it a mesh first, for instance with Open3D"),
    (rb"(?:<\?xml[^>]*>\s*)?(?:<!--.*?-->\s*)*<(?:\w+:)?collada", "a Collada file (DAE)", CONVERT),
    (rb"<\?xml|<x3d|<amf|<vtkfile", "a file in XML", CONVERT),
    (rb"pk\x03\x04.{,4096}3d/", "a 3MF file", CONVERT),
    (rb"pk\x03\x04|\x1f\x8b|7z\xbc\xaf|rar!", "an archive", "unpack it, and name the mesh in it"),
    (rb"\x89png|\xff\xd8\xff|%pdf|gif8", "an image or a document, not a mesh", "name the mesh"),
)  # fmt: skip
OWN_MARKS = (  # how files of the formats begin that are read
    (".ply", rb"ply\s"),
    (".glb", rb"gltf"),
    (".off", rb"(?:st)?c?n?4?n?off\b"),
    (".gltf", rb"\{.*\"asset\""),
    (".stl", rb"solid\b.*?facet\s+normal"),
    (".obj", rb"(?:.*\n)?[ \t]*v(?:[ \t]+[-+.,\de]+){3}"),
)


class ParsedMesh(NamedTuple):
    """The triangles of a file, as it has them."""

    vertices: NDArray[np.float64]  # (n, 3), in the file's unit; all finite, and all used
    faces: NDArray[np.int64]  # (m, 3)
    left_out: tuple[str, ...]  # what is no face, with its number


def foreign_kind(suffix: str) -> tuple[str, str]:
    """Say what a file is that has an ending which is not read.

    Args:
        suffix: The ending, with its point.

    Returns:
        What it is ("" where that is unknown), and what to do.
    """
    return FOREIGN_SUFFIXES.get(suffix.lower(), ("", "convert it to one of them"))


def parse_mesh(path: Path, data: bytes) -> ParsedMesh:
    """The triangles in the bytes of a mesh file.

    Args:
        path: The file; its ending names the format, and glTF may name files next to it.
        data: Its bytes.

    Returns:
        Vertices that a face uses, triangles of the same area as the file's polygons, and what was left out.

    Raises:
        DataError: It is cut off, is of another kind than its ending says, holds what is not understood or no face, or
            uses vertices that are not there or not finite; one sentence that names the file and a remedy.
    """
    suffix = path.suffix.lower()
    _check_kind(path, suffix, data)
    try:
        vertices, faces, left_out = _READERS[suffix](path, data)
    except DataError:
        raise
    except Exception as error:  # whatever a parser trips over, the file is at fault
        reason = " ".join(f"{type(error).__name__} {error}".split())[:300]
        raise _unreadable(path, reason, "export it again") from error
    left_out = tuple(text for text in left_out if text)
    if not len(faces):
        beside = f" but {' and '.join(left_out)}" if left_out else ""
        raise DataError(
            f"{path}: holds no faces{beside}; export it as a mesh (a point cloud is made one first, for instance with "
            "Open3D)"
        )
    return ParsedMesh(*_used(path, vertices, faces), left_out)


def _unreadable(path: Path, reason: str, remedy: str) -> DataError:
    return DataError(f"{path}: cannot be read as {path.suffix[1:].upper()} ({reason}); {remedy}")


def _cut_off(path: Path, announced: str, there: int | str) -> DataError:
    reason = f"it is cut off: its header announces {announced}, and {there} are there"
    return _unreadable(path, reason, "export or copy it again")


def _used(path: Path, vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Only the vertices that a face uses, which have to be finite: scanners mark what they did not see as NaN."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    vertices = vertices[used]
    if bad := int(np.sum(~np.isfinite(vertices).all(1))):
        raise DataError(f"{path}: {bad} vertices are not finite; repair the mesh")
    return vertices, (faces if used.all() else (np.cumsum(used) - 1)[faces])


def _mesh(
    path: Path, vertices: NDArray, corners: NDArray, sizes: NDArray, name: Callable[[int], str] = "face {}".format
) -> tuple[NDArray, NDArray, str]:
    """Vertices, triangles of polygons, and how many polygons have fewer than three corners and were left out."""
    number = np.repeat(np.arange(len(sizes)), sizes)
    wrong = (corners < 0) | (corners >= len(vertices))
    if wrong.any():
        first = int(wrong.argmax())
        raise DataError(
            f"{path}: {name(int(number[first]) + 1)} refers to a vertex that is not there (number {corners[first]} "
            f"from 0 on, of {len(vertices)}); export it again"
        )
    enough = sizes >= 3
    order = np.flatnonzero(enough)
    if not enough.all():
        corners, sizes = corners[enough[number]], sizes[enough]
    faces = triangulate(vertices, corners, sizes, lambda i: f"{path}: {name(int(order[i]) + 1)}")
    few = int((~enough).sum())
    return vertices, faces, f"{few} faces of fewer than three corners" if few else ""


def _check_kind(path: Path, suffix: str, data: bytes) -> None:
    """Refuse contents that are of another kind than the ending says."""
    if suffix == ".stl" and len(data) == STL_HEADER + FACET_BYTES * int.from_bytes(data[80:84], "little"):
        return  # a header may begin with any words
    head = data[:8192].removeprefix(codecs.BOM_UTF8).lstrip().lower()
    for mark, kind, remedy in FOREIGN_MARKS:
        if re.match(mark, head, re.DOTALL):
            raise DataError(f"{path}: is {kind}; {remedy}")
    kinds = [own for own, mark in OWN_MARKS if re.search(rb"\A" + mark, head, re.DOTALL)]
    welcome = (".glb", ".gltf") if suffix in (".glb", ".gltf") else (suffix,)
    if kinds and not set(kinds) & set(welcome):
        raise DataError(
            f"{path}: is {kinds[0][1:].upper()} by its contents and {suffix[1:].upper()} by its ending; rename it to "
            f"{path.stem}{kinds[0]}"
        )


# Text


def _text(path: Path, data: bytes) -> bytes:
    """Text with lines that end in a line feed and words that are spaced; whatever its encoding, numbers are ASCII."""
    data = _in_utf8(data).rstrip(b"\x1a")  # the mark of the end in DOS
    if b"\0" in data:
        raise _unreadable(path, "it is no text", "export it again, or check its ending")
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\t", b" ")


def _in_utf8(data: bytes) -> bytes:
    """Bytes without a byte order mark; those of a text in UTF-16 as UTF-8."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace").encode()
    return data.removeprefix(codecs.BOM_UTF8)


def _rows(path: Path, rows: Sequence[bytes], dtype: type = np.float64) -> tuple[NDArray, NDArray]:
    """All numbers of rows of text, row after row, and how many each row has."""
    counts = np.fromiter((len(row.split()) for row in rows), np.int64, len(rows))
    return _numbers(path, b" ".join(rows), int(counts.sum()), dtype), counts


def _numbers(path: Path, text: bytes, count: int, dtype: type = np.float64) -> NDArray:
    """The numbers of a text of so many words."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # which says that a word is no number
        try:
            values: NDArray = np.fromstring(text, dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            values = np.array([], dtype)
    if len(values) == count:
        return values
    return np.array([_number(path, word, dtype) for word in text.split()], dtype)


def _number(path: Path, word: bytes, dtype: type) -> int | float:
    try:
        return int(word) if dtype is np.int64 else float(word)
    except ValueError:
        pass
    if dtype is np.float64 and re.fullmatch(rb"[-+]?(1\.#(qnan|snan|ind|inf)\d*|nan\(.*\))", word, re.IGNORECASE):
        return np.nan  # as Windows writes it
    shown = word[:40].decode("utf-8", "replace")
    if dtype is np.float64 and re.fullmatch(rb"[-+]?[\d.]*,\d+(e[-+]?\d+)?", word, re.IGNORECASE):
        raise DataError(
            f"{path}: its numbers have decimal commas ({shown}); export it with decimal points, as the format has them"
        )
    raise DataError(f"{path}: has {shown!r} where a number belongs; export it again")


def _ranges(starts: NDArray, counts: NDArray) -> NDArray:
    """The numbers `start, start + 1, ...` of each range, range after range."""
    before = np.cumsum(counts) - counts
    return np.repeat(starts - before, counts) + np.arange(counts.sum())


# STL


def _read_stl(path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    announced = int.from_bytes(data[80:84], "little")
    text = len(data) < STL_HEADER or len(data) != STL_HEADER + FACET_BYTES * announced
    if text and (data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" not in data):
        corners = _text_facets(path, _text(path, data).lower())
    else:
        corners = _binary_facets(path, data, announced)
    return corners, np.arange(len(corners)).reshape(-1, 3), ()


def _binary_facets(path: Path, data: bytes, announced: int) -> NDArray:
    """Corners `(3 n, 3)` of the n facets of binary STL."""
    room, rest = divmod(len(data) - STL_HEADER, FACET_BYTES)
    if announced in PLACEHOLDER_COUNTS and room >= 0 and rest == 0:
        announced = room
    if announced > room:
        holds = f"it holds {max(room, 0)} facets where its header announces {announced}"
        raise DataError(f"{path}: is cut off or no STL file: {holds}; export or copy it again")
    tail = data[STL_HEADER + FACET_BYTES * announced :]
    if len(tail) >= FACET_BYTES and tail.strip(PADDING):
        raise DataError(
            f"{path}: has {len(tail)} bytes after the {announced} facets that its header announces, perhaps another "
            "body; export it again, each body as a file"
        )
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.frombuffer(data, facet, announced, STL_HEADER)["corners"].reshape(-1, 3).astype(np.float64)


def _text_facets(path: Path, text: bytes) -> NDArray:
    """Corners `(3 n, 3)` of the n facets of all solids of STL as text, in small letters."""
    if re.search(rb"\bend +(loop|facet)\b", text[:8192]):
        text = re.sub(rb"\bend +(loop|facet)\b", rb"end\1", text)
    text, ends = _without_titles(text)
    words = text.split()
    whole = len(words) // FACET_WORDS
    reason = ""
    if not ends:
        reason = "it begins with no 'solid'"
    elif not ends[-1]:
        reason = f"it ends within a solid, after {whole} facets, without 'endsolid'"
    elif 2 * sum(ends) != len(ends):
        reason = "one of its solids has no 'endsolid'"
    if reason:
        raise DataError(f"{path}: is cut off or no STL file: {reason}; export or copy it again")
    wrong = [i for place, word in FACET for i in _unlike_words(words[place::FACET_WORDS], word)]
    if wrong or len(words) % FACET_WORDS:
        raise DataError(
            f"{path}: facet {min([*wrong, whole]) + 1} is not written as a normal and a loop of three vertices; export "
            "it again, as triangles"
        )
    numbers = [
        _numbers(path, b" ".join(words[first + axis :: FACET_WORDS]), whole)
        for first in (8, 12, 16)
        for axis in range(3)
    ]
    return np.stack(numbers, 1).reshape(-1, 3)


def _without_titles(text: bytes) -> tuple[bytes, list[bool]]:
    """The facets of STL as text, without the lines that begin and end a solid; and which of these lines end one."""
    first, *others = text.split(b"solid")
    facets, ends, in_title = [first], [], False
    for part in others:
        if not in_title:
            before = facets[-1].rstrip(b" ")
            ends.append(before.endswith(b"end"))
            facets[-1] = before.removesuffix(b"end")
        title, line_end, rest = part.partition(b"\n")
        _, facet, row = title.partition(b" facet normal ")  # where all is in one line
        in_title = not (facet or line_end)
        facets.append(facet + row + line_end + rest)
    return b"".join(facets), ends


def _unlike_words(words: list[bytes], word: bytes) -> list[int]:
    """The place of the first of the words that is another; none where all are alike."""
    if words.count(word) == len(words):
        return []
    return [next(i for i, other in enumerate(words) if other != word)]


# OBJ


def _read_obj(path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    text = _text(path, data)
    lines = text.split(b"\n")
    if re.search(rb"\\ *\n", text):
        lines = _continued([line.rstrip() for line in lines])
    vertex_rows, face_rows, before, numbers, others = _obj_rows(path, lines)
    if numbers and not text.endswith(b"\n") and numbers[-1] == len(lines):
        _check_last_face(path, face_rows)
    values, counts = _rows(path, vertex_rows)
    unlike = ~np.isin(counts, OBJ_VERTEX_WORDS)
    if unlike.any():
        count = counts[unlike.argmax()]
        raise DataError(
            f"{path}: vertex {unlike.argmax() + 1} has {count} numbers instead of x, y, z and perhaps a colour; "
            "export or copy it again"
        )
    starts = np.cumsum(counts) - counts
    if (values[(starts + 3)[counts == 4]] != 1).any():
        raise DataError(f"{path}: its vertices have a fourth number w that is not 1; export it with x, y and z alone")
    vertices = values[starts[:, None] + np.arange(3)] if len(starts) else np.empty((0, 3))
    if any(b"/" in row for row in face_rows):
        face_rows = re.sub(rb"/[^ \n]*", b"", b"\n".join(face_rows)).split(b"\n")
    corners, sizes = _rows(path, face_rows, np.int64)
    if (corners == 0).any():
        raise DataError(f"{path}: a face has a corner 0, and OBJ counts vertices from 1; export it again")
    corners = np.where(corners > 0, corners - 1, corners + np.repeat(np.array(before, np.int64), sizes))
    *mesh, few = _mesh(path, vertices, corners, sizes, lambda i: f"face {i} (line {numbers[i - 1]})")
    return mesh[0], mesh[1], (few, *(f"{count} {name}" for name, count in others.items()))


def _check_last_face(path: Path, face_rows: list[bytes]) -> None:
    """Refuse a file whose last line, which no line break ends, has fewer corners than all other faces, or a shorter
    last corner than its others: it is cut off there.
    """
    *others, last = [row.split() for row in face_rows]
    sizes = {len(row) for row in others}
    fewer = len(last) < 3 or (len(others) > 1 and len(sizes) == 1 and len(last) < min(sizes))
    if fewer or len({corner.count(b"/") for corner in last}) > 1 or last[-1].endswith(b"/") > last[0].endswith(b"/"):
        raise _unreadable(
            path, "it is cut off within its last face, which no line break ends", "export or copy it again"
        )


def _continued(lines: list[bytes]) -> list[bytes]:
    """Lines of which those of vertices and faces that end in a backslash go on in the next; numbers of lines stay."""
    joined, i = [line.rstrip(b"\\") for line in lines], 0
    while i < len(lines):
        first = i
        if lines[i].lstrip()[:1].lower() in (b"v", b"f", b"l", b"p"):  # not a path or a remark that ends in one
            while lines[i].endswith(b"\\") and i + 1 < len(lines):
                i += 1
        if i > first:
            joined[first] = b" ".join(joined[first : i + 1])
            joined[first + 1 : i + 1] = [b""] * (i - first)
        i += 1
    return joined


def _obj_rows(path: Path, lines: list[bytes]) -> tuple[list[bytes], list[bytes], list[int], list[int], dict[str, int]]:
    """Rows of vertices and of faces; how many vertices are before each face, its line's number; what else is there."""
    vertices: list[bytes] = []
    faces: list[bytes] = []
    before, numbers, others = [], [], dict.fromkeys(OBJ_CURVES.values(), 0)
    for number, line in enumerate(lines, 1):
        kind = line[:2]
        if kind not in (b"v ", b"f ", b"vn", b"vt", b"", b"# "):
            word, _, rest = line.lstrip().partition(b" ")
            word = word.lower().replace(b"fo", b"f")
            if word in OBJ_SURFACES:
                raise DataError(f"{path}: holds parametric surfaces (line {number}); export it as a mesh of faces")
            if word in (b"call", b"csh"):
                raise DataError(f"{path}: calls another file or program (line {number}); export it in one file")
            if word in OBJ_CURVES:
                others[OBJ_CURVES[word]] += 1
            kind, line = word + b" ", b"  " + rest
        if kind == b"v ":
            vertices.append(line[2:])
        elif kind == b"f ":
            faces.append(line[2:])
            before.append(len(vertices))
            numbers.append(number)
    if any(b"#" in row for row in vertices) or any(b"#" in row for row in faces):
        vertices, faces = ([re.sub(rb"(?<!1\.)#.*", b"", row) for row in rows] for rows in (vertices, faces))
    return vertices, faces, before, numbers, {name: count for name, count in others.items() if count}


# PLY


class _Property(NamedTuple):
    name: str
    dtype: np.dtype
    size_dtype: np.dtype | None  # of a list: the type of the number of its entries


class _Element(NamedTuple):
    """Columns of an element: numbers `(count,)`, or for a list all its entries and how many each row has."""

    rows: int
    columns: dict[str, NDArray | tuple[NDArray, NDArray]]


def _read_ply(path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    form, schema, body = _ply_header(path, data)
    elements = _ply_text(path, schema, body) if form == "ascii" else _ply_binary(path, schema, body)
    if "vertex" not in elements or not {"x", "y", "z"} <= set(elements["vertex"].columns):
        raise _unreadable(path, "it has no vertices with x, y and z", "export it again")
    vertices = np.stack([np.asarray(elements["vertex"].columns[axis], np.float64) for axis in "xyz"], 1)
    loops = [_ply_corners(path, name, elements[name]) for name in ("face", "tristrips") if name in elements]
    corners, sizes = loops[0] if "face" in elements else (np.empty(0, np.int64), np.empty(0, np.int64))
    if "tristrips" in elements:
        strips, lengths = loops[-1]
        rows = np.split(strips, np.cumsum(lengths)[:-1])
        parts = [
            part[part >= 0] for row in rows for part in np.split(row, np.flatnonzero(row == -1))
        ]  # -1 ends a strip
        triangles = np.concatenate([strip_triangles(part) for part in parts] or [np.empty((0, 3), np.int64)])
        corners = np.append(corners, triangles.reshape(-1))
        sizes = np.append(sizes, np.full(len(triangles), 3))
    vertices, faces, few = _mesh(path, vertices, corners, sizes)
    return vertices, faces, (few, "a range grid" if "range_grid" in elements else "")


def _ply_corners(path: Path, name: str, element: _Element) -> tuple[NDArray, NDArray]:
    """Indices of vertices of all faces or strips, and how many each has."""
    indices = element.columns.get("vertex_indices", element.columns.get("vertex_index"))
    if not isinstance(indices, tuple):
        reason = f"its element {name!r} has no list vertex_indices, but {', '.join(element.columns)}"
        raise _unreadable(path, reason, "export it again")
    corners, sizes = indices[0].astype(np.int64), indices[1]
    if not np.array_equal(corners, indices[0]):
        raise _unreadable(path, "a corner of a face is no whole number", "export it again")
    return corners, sizes


def _ply_header(path: Path, data: bytes) -> tuple[str, list[tuple[str, int, list[_Property]]], bytes]:
    """The format, each element's name, number and properties, and the bytes after the header."""
    data = _in_utf8(data)
    end = re.search(rb"\nend_header *(\r\n|\n)|\rend_header *\r", data[:MAX_PLY_HEADER])
    if not data.startswith(b"ply") or not end:
        raise _unreadable(path, "it has no header of PLY, or is cut off in it", "export or copy it again")
    form, schema = "", list[tuple[str, int, list[_Property]]]()
    for line in data[: end.start()].decode("utf-8", "replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            schema.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            types = words[2:4] if words[1] == "list" else words[1:2]
            if unknown := [name for name in types if name not in PLY_TYPES]:
                raise _unreadable(path, f"its header has the type {unknown[0]!r}", "export it again")
            *count, dtype = (np.dtype(PLY_ORDERS.get(form, "=") + PLY_TYPES[name]) for name in types)
            schema[-1][2].append(_Property(words[-1], dtype, count[0] if count else None))
    if form not in PLY_ORDERS or any(count < 0 for _, count, _ in schema):
        raise _unreadable(path, f"its header has the format {form!r}, or a negative number", "export it again")
    return form, schema, data[end.end() :]


def _ply_text(path: Path, schema: list[tuple[str, int, list[_Property]]], body: bytes) -> dict[str, _Element]:
    """The elements of PLY as text, one row a line."""
    lines = [line for line in _text(path, body).split(b"\n") if line and not line.isspace()]
    elements, start = {}, 0
    for name, count, properties in schema:
        if not properties:
            continue
        rows = lines[start : start + count]
        if len(rows) < count:
            raise _cut_off(path, f"{count} entries of element {name!r}", len(rows))
        start += count
        elements[name] = _text_element(path, name, rows, properties)
    if start < len(lines):
        raise _unreadable(path, f"it has {len(lines) - start} lines more than its header announces", "export it again")
    return elements


def _text_element(path: Path, name: str, rows: list[bytes], properties: list[_Property]) -> _Element:
    values, counts = _rows(path, rows)
    ends = np.cumsum(counts)
    place = ends - counts
    columns: dict[str, NDArray | tuple[NDArray, NDArray]] = {}
    for prop in properties:
        short = place >= ends
        size = (
            np.zeros(len(rows), np.int64) if short.any() or prop.size_dtype is None else values[place].astype(np.int64)
        )
        short |= (size < 0) | (place + (prop.size_dtype is not None) + size > ends)
        if short.any():
            break
        columns[prop.name] = values[place] if prop.size_dtype is None else (values[_ranges(place + 1, size)], size)
        place = place + 1 + size
    else:
        short = place != ends
    if short.any():
        number = int(short.argmax())
        reason = f"{name} {number + 1} has {counts[number]} numbers, and its header announces others"
        raise _unreadable(path, reason, "export or copy it again")
    return _Element(len(rows), columns)


def _ply_binary(path: Path, schema: list[tuple[str, int, list[_Property]]], body: bytes) -> dict[str, _Element]:
    """The elements of binary PLY."""
    elements, start = {}, 0
    for name, count, properties in schema:
        if not properties:
            continue
        first = _row_sizes(body, start, properties) if count else None
        element = _alike(count, properties, first, body, start) if first is not None else None
        if element is None:
            element, start = _unlike(path, name, count, properties, body, start)
        else:
            start += count * _row_type(properties, first or ()).itemsize
        elements[name] = element
    if body[start:].strip(PADDING):
        reason = f"it has {len(body) - start} bytes more than its header announces"
        raise _unreadable(path, reason, "export it again, or copy it as a binary file")
    return elements


def _row_sizes(body: bytes, start: int, properties: list[_Property]) -> tuple[int, ...] | None:
    """Numbers of entries of the lists of the row that begins here; None where the row is cut off."""
    sizes = []
    for prop in properties:
        size = 1
        if prop.size_dtype is not None:
            if start + prop.size_dtype.itemsize > len(body):
                return None
            size = int(np.frombuffer(body, prop.size_dtype, 1, start)[0])
            start += prop.size_dtype.itemsize
            sizes.append(size)
        start += size * prop.dtype.itemsize
        if size < 0 or start > len(body):
            return None
    return tuple(sizes)


def _row_type(properties: list[_Property], sizes: tuple[int, ...]) -> np.dtype:
    remaining = list(sizes)
    fields: list[tuple] = []
    for i, prop in enumerate(properties):
        if prop.size_dtype is None:
            fields.append((f"value {i}", prop.dtype))
        else:
            fields += [(f"count {i}", prop.size_dtype), (f"value {i}", prop.dtype, (remaining.pop(0),))]
    return np.dtype(fields)


def _alike(count: int, properties: list[_Property], sizes: tuple[int, ...], body: bytes, start: int) -> _Element | None:
    """An element of which all rows have lists as long as those of the first; None where they have not."""
    row = _row_type(properties, sizes)
    if start + count * row.itemsize > len(body):
        return None
    table = np.frombuffer(body, row, count, start)
    columns: dict[str, NDArray | tuple[NDArray, NDArray]] = {}
    for i, prop in enumerate(properties):
        values = table[f"value {i}"]
        if prop.size_dtype is None:
            columns[prop.name] = values
            continue
        size = values.shape[1]
        if (table[f"count {i}"] != size).any():
            return None
        columns[prop.name] = values.reshape(-1), np.full(count, size)
    return _Element(count, columns)


def _unlike(
    path: Path, name: str, count: int, properties: list[_Property], body: bytes, start: int
) -> tuple[_Element, int]:
    """An element whose rows differ in length, and where it ends."""
    raw = np.frombuffer(body, np.uint8)
    places: list[list[int]] = [[] for _ in properties]
    sizes: list[list[int]] = [[] for _ in properties]
    for number in range(count):
        for i, prop in enumerate(properties):
            size = 1
            if prop.size_dtype is not None:
                width = prop.size_dtype.itemsize
                plain = prop.size_dtype.kind == "u" and width == 1 and start < len(body)
                size = body[start] if plain else _integer(body, start, prop.size_dtype)
                start += width
            places[i].append(start)
            sizes[i].append(size)
            start += size * prop.dtype.itemsize
            if size < 0 or start > len(body):
                raise _cut_off(path, f"{count} entries of element {name!r}", number)
    columns: dict[str, NDArray | tuple[NDArray, NDArray]] = {}
    for prop, begins, lengths in zip(properties, places, sizes, strict=True):
        length = np.array(lengths, np.int64)
        values = raw[_ranges(np.array(begins, np.int64), length * prop.dtype.itemsize)].view(prop.dtype)
        columns[prop.name] = values if prop.size_dtype is None else (values, length)
    return _Element(count, columns), start


def _integer(body: bytes, start: int, dtype: np.dtype) -> int:
    data = body[start : start + dtype.itemsize]
    return int.from_bytes(data, "big" if dtype.str[0] == ">" else "little", signed=dtype.kind == "i")


# OFF


def _read_off(path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    data = _in_utf8(data)
    head = re.match(rb"\s*(?:#[^\n]*\s*)*((?:ST|st)?[Cc]?N?4?n?(?:OFF|off|Off))?", data)
    kind = (head[1] or b"") if head else b""
    if b"4" in kind or b"n" in kind or re.match(rb"\s*BINARY", data[head.end() :] if head else b"", re.IGNORECASE):
        raise _unreadable(path, "it is binary, or not in three dimensions", "export it as plain OFF")
    text = re.sub(rb"#[^\n]*", b"", _text(path, data))
    text = text.replace(kind, b"\n", 1) if kind else text
    rows = [row for row in text.split(b"\n") if row and not row.isspace()]
    if not rows:
        raise _unreadable(path, "it has no counts", "export or copy it again")
    try:
        vertices, corners, sizes = _off_by_lines(path, rows)
    except DataError:
        free = _off_by_words(kind, rows)
        if free is None:
            raise
        vertices, corners, sizes = free
    *mesh, few = _mesh(path, vertices, corners, sizes)
    return mesh[0], mesh[1], (few,)


def _off_by_lines(path: Path, rows: list[bytes]) -> tuple[NDArray, NDArray, NDArray]:
    """Vertices, corners and sizes of faces, each vertex and face a line, at whose end colours may stand."""
    announced = _rows(path, rows[:1], np.int64)[0]
    if len(announced) not in (2, 3) or min(announced) < 0:
        raise _unreadable(path, "its first line is not the numbers of vertices, faces and edges", "export it again")
    points, polygons = map(int, announced[:2])
    if len(rows) - 1 < points + polygons:
        raise _cut_off(path, f"{points} vertices and {polygons} faces", f"{len(rows) - 1} lines")
    if extra := len(rows) - 1 - points - polygons:
        raise _unreadable(path, f"it has {extra} lines more than its header announces", "export it again")
    values, counts = _rows(path, rows[1 : 1 + points])
    starts = np.cumsum(counts) - counts
    if points and (counts < 3).any():
        number = int((counts < 3).argmax())
        raise _unreadable(path, f"vertex {number + 1} has {counts[number]} numbers", "export or copy it again")
    vertices = values[starts[:, None] + np.arange(3)] if points else np.empty((0, 3))
    values, counts = _rows(path, rows[1 + points :])
    starts = np.cumsum(counts) - counts
    sizes = values[starts].astype(np.int64) if polygons else np.empty(0, np.int64)
    if (short := (sizes < 0) | (sizes + 1 > counts)).any():
        raise _unreadable(path, f"face {short.argmax() + 1} has too few corners", "export or copy it again")
    corners = values[_ranges(starts + 1, sizes)]
    if (corners != np.floor(corners)).any():
        raise _unreadable(path, "a corner of a face is no whole number", "export it again")
    return vertices, corners.astype(np.int64), sizes


def _off_by_words(kind: bytes, rows: list[bytes]) -> tuple[NDArray, NDArray, NDArray] | None:
    """The same of numbers that are laid out freely over lines; None where they are not as many as the counts say."""
    try:
        values = np.array(b" ".join(rows).split()).astype(np.float64)
    except ValueError:
        return None
    start = 2 if len(rows[0].split()) == 2 else 3  # the number of edges may be left out
    whole = np.isfinite(values) & (values == np.floor(values)) & (values >= 0)
    if len(values) < start or not whole[:start].all():
        return None
    points, polygons = map(int, values[:2])
    width = 3 + sum(size * (mark in kind.upper()) for mark, size in ((b"ST", 2), (b"C", 4), (b"N", 3)))
    end = start + points * width
    if end + polygons > len(values) or not whole[end:].all():
        return None
    vertices, numbers, at = values[start:end].reshape(points, width)[:, :3], values[end:].astype(np.int64), 0
    places = []
    for _ in range(polygons):
        if at >= len(numbers):
            return None
        places.append(at)
        at += 1 + int(numbers[at])
    sizes = numbers[places]
    return (vertices, numbers[_ranges(np.array(places, np.int64) + 1, sizes)], sizes) if at == len(numbers) else None


_READERS: dict[str, Callable[[Path, bytes], tuple[NDArray, NDArray, tuple[str, ...]]]] = {
    ".stl": _read_stl,
    ".obj": _read_obj,
    ".ply": _read_ply,
    ".off": _read_off,
    ".glb": read_scene,
    ".gltf": read_scene,
}
