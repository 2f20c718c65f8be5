"""Reader of OFF."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError
from i2t.objects.formats.faces import triangulate_polygons
from i2t.objects.formats.text import number_rows, plain_text, ranges, to_utf8, truncated_file, unreadable_file


def read_off(path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    """Read OFF, as in `i2t.objects.formats.faces.MeshReader`."""
    data = to_utf8(data)
    head = re.match(rb"\s*(?:#[^\n]*\s*)*((?:ST|st)?[Cc]?N?4?n?(?:OFF|off|Off))?", data)
    kind = (head[1] or b"") if head else b""
    if b"4" in kind or b"n" in kind or re.match(rb"\s*BINARY", data[head.end() :] if head else b"", re.IGNORECASE):
        raise unreadable_file(path, "it is binary, or not in three dimensions", "export it as plain OFF")
    text = re.sub(rb"#[^\n]*", b"", plain_text(path, data))
    text = text.replace(kind, b"\n", 1) if kind else text
    rows = [row for row in text.split(b"\n") if row and not row.isspace()]
    if not rows:
        raise unreadable_file(path, "it has no counts", "export or copy it again")
    try:
        vertices, corners, sizes = _off_by_lines(path, rows)
    except DataError:
        free = _off_by_words(kind, rows)
        if free is None:
            raise
        vertices, corners, sizes = free
    vertices, faces, few = triangulate_polygons(path, vertices, corners, sizes)
    return vertices, faces, (few,)


def _off_by_lines(path: Path, rows: list[bytes]) -> tuple[NDArray, NDArray, NDArray]:
    """Read vertices, corners and sizes of faces if each vertex and face is a line, which may end with a colour."""
    announced = number_rows(path, rows[:1], np.int64)[0]
    if len(announced) not in (2, 3) or min(announced) < 0:
        raise unreadable_file(path, "its first line is not the numbers of vertices, faces and edges", "export it again")
    points, polygons = map(int, announced[:2])
    if len(rows) - 1 < points + polygons:
        raise truncated_file(path, f"{points} vertices and {polygons} faces", f"{len(rows) - 1} lines")
    if extra := len(rows) - 1 - points - polygons:
        raise unreadable_file(path, f"it has {extra} lines more than its header announces", "export it again")
    values, counts = number_rows(path, rows[1 : 1 + points])
    starts = np.cumsum(counts) - counts
    if points and (counts < 3).any():
        number = int((counts < 3).argmax())
        raise unreadable_file(path, f"vertex {number + 1} has {counts[number]} numbers", "export or copy it again")
    vertices = values[starts[:, None] + np.arange(3)] if points else np.empty((0, 3))
    values, counts = number_rows(path, rows[1 + points :])
    starts = np.cumsum(counts) - counts
    sizes = values[starts].astype(np.int64) if polygons else np.empty(0, np.int64)
    if (short := (sizes < 0) | (sizes + 1 > counts)).any():
        raise unreadable_file(path, f"face {short.argmax() + 1} has too few corners", "export or copy it again")
    corners = values[ranges(starts + 1, sizes)]
    if (corners != np.floor(corners)).any():
        raise unreadable_file(path, "a corner of a face is not a whole number", "export it again")
    return vertices, corners.astype(np.int64), sizes


def _off_by_words(kind: bytes, rows: list[bytes]) -> tuple[NDArray, NDArray, NDArray] | None:
    """Read the same from numbers in any lines; return None if there are not as many as the counts require."""
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
    return (vertices, numbers[ranges(np.array(places, np.int64) + 1, sizes)], sizes) if at == len(numbers) else None
