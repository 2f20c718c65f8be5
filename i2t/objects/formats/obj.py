"""Reader of Wavefront OBJ."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError
from i2t.objects.formats.faces import triangulate_polygons
from i2t.objects.formats.text import number_rows, plain_text, unreadable_file


def read_obj(path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    """Read Wavefront OBJ, as in `i2t.objects.formats.faces.MeshReader`."""
    text = plain_text(path, data)
    lines = text.split(b"\n")
    if re.search(rb"\\ *\n", text):
        lines = _continued([line.rstrip() for line in lines])
    vertex_rows, face_rows, before, numbers, others = _obj_rows(path, lines)
    if numbers and not text.endswith(b"\n") and numbers[-1] == len(lines):
        _check_last_face(path, face_rows)
    values, counts = number_rows(path, vertex_rows)
    unlike = ~np.isin(counts, (3, 4, 6, 7))  # x y z, then w, or r g b, or r g b a
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
    corners, sizes = number_rows(path, face_rows, np.int64)
    if (corners == 0).any():
        raise DataError(f"{path}: a face has a corner 0, and OBJ counts vertices from 1; export it again")
    corners = np.where(corners > 0, corners - 1, corners + np.repeat(np.array(before, np.int64), sizes))
    vertices, faces, few = triangulate_polygons(
        path, vertices, corners, sizes, lambda i: f"face {i} (line {numbers[i - 1]})"
    )
    return vertices, faces, (few, *(f"{count} {name}" for name, count in others.items()))


def _check_last_face(path: Path, face_rows: list[bytes]) -> None:
    """Refuse a file that is cut off within its last face.

    That is so if no line break ends the last line and it has fewer corners than all other faces, or a shorter last
    corner than its others.
    """
    *others, last = [row.split() for row in face_rows]
    sizes = {len(row) for row in others}
    fewer = len(last) < 3 or (len(others) > 1 and len(sizes) == 1 and len(last) < min(sizes))
    if fewer or len({corner.count(b"/") for corner in last}) > 1 or last[-1].endswith(b"/") > last[0].endswith(b"/"):
        raise unreadable_file(
            path, "it is cut off within its last face, which no line break ends", "export or copy it again"
        )


def _continued(lines: list[bytes]) -> list[bytes]:
    """Join lines of vertices and faces that end in a backslash with the next, without changing line numbers."""
    joined, i = [line.rstrip(b"\\") for line in lines], 0
    while i < len(lines):
        first = i
        if lines[i].lstrip()[:1].lower() in (b"v", b"f", b"l", b"p"):  # not a path or a comment that ends in one
            while lines[i].endswith(b"\\") and i + 1 < len(lines):
                i += 1
        if i > first:
            joined[first] = b" ".join(joined[first : i + 1])
            joined[first + 1 : i + 1] = [b""] * (i - first)
        i += 1
    return joined


def _obj_rows(path: Path, lines: list[bytes]) -> tuple[list[bytes], list[bytes], list[int], list[int], dict[str, int]]:
    """Find the rows of vertices and faces, the vertices before each face, its line, and the counts of other things."""
    vertices: list[bytes] = []
    faces: list[bytes] = []
    before, numbers = [], []
    surfaces = (b"surf", b"bzp", b"bsp", b"cdp", b"cdc", b"res")  # free-form surfaces, also of the old version
    curves = {b"l": "lines", b"p": "points", b"curv": "curves"}
    others = dict.fromkeys(curves.values(), 0)
    for number, line in enumerate(lines, 1):
        kind = line[:2]
        if kind not in (b"v ", b"f ", b"vn", b"vt", b"", b"# "):
            word, _, rest = line.lstrip().partition(b" ")
            word = word.lower().replace(b"fo", b"f")
            if word in surfaces:
                raise DataError(f"{path}: holds parametric surfaces (line {number}); export it as a mesh of faces")
            if word in (b"call", b"csh"):
                raise DataError(f"{path}: calls another file or program (line {number}); export it in one file")
            if word in curves:
                others[curves[word]] += 1
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
