"""Reader of PLY, binary or text."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from i2t.objects.formats.faces import triangulate_polygons
from i2t.objects.formats.text import (
    TRAILING_PADDING,
    number_rows,
    plain_text,
    ranges,
    to_utf8,
    truncated_file,
    unreadable_file,
)
from i2t.objects.polygons import strip_triangles

# NumPy types of PLY's types of values.
PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
             "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
             "float32": "f4", "float64": "f8"}  # fmt: skip
# NumPy's byte orders of PLY's formats
PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    name: str
    dtype: np.dtype
    size_dtype: np.dtype | None  # type of a list's length; None if the property is not a list


class _Element(NamedTuple):
    """Columns of an element: numbers `(rows,)`, or for a list the entries of all rows and the length of each row."""

    rows: int
    columns: dict[str, NDArray | tuple[NDArray, NDArray]]


def read_ply(path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    """Read PLY, binary or text, as in `i2t.objects.formats.faces.MeshReader`."""
    form, schema, body = _ply_header(path, data)
    elements = _ply_text(path, schema, body) if form == "ascii" else _ply_binary(path, schema, body)
    if "vertex" not in elements or not {"x", "y", "z"} <= set(elements["vertex"].columns):
        raise unreadable_file(path, "it has no vertices with x, y and z", "export it again")
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
    vertices, faces, few = triangulate_polygons(path, vertices, corners, sizes)
    return vertices, faces, (few, "a range grid" if "range_grid" in elements else "")


def _ply_corners(path: Path, name: str, element: _Element) -> tuple[NDArray, NDArray]:
    """Read the vertex indices of all faces or strips, and the number of corners of each."""
    indices = element.columns.get("vertex_indices", element.columns.get("vertex_index"))
    if not isinstance(indices, tuple):
        reason = f"its element {name!r} has no list vertex_indices, but {', '.join(element.columns)}"
        raise unreadable_file(path, reason, "export it again")
    corners, sizes = indices[0].astype(np.int64), indices[1]
    if not np.array_equal(corners, indices[0]):
        raise unreadable_file(path, "a corner of a face is not a whole number", "export it again")
    return corners, sizes


def _ply_header(path: Path, data: bytes) -> tuple[str, list[tuple[str, int, list[_Property]]], bytes]:
    """Read the format, each element's name, count and properties, and the bytes after the header."""
    data = to_utf8(data)
    end = re.search(rb"\nend_header *(\r\n|\n)|\rend_header *\r", data[: 2**16])
    if not data.startswith(b"ply") or not end:
        raise unreadable_file(path, "it has no PLY header, or is cut off within it", "export or copy it again")
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
                raise unreadable_file(path, f"its header has the type {unknown[0]!r}", "export it again")
            *count, dtype = (np.dtype(PLY_ORDERS.get(form, "=") + PLY_TYPES[name]) for name in types)
            schema[-1][2].append(_Property(words[-1], dtype, count[0] if count else None))
    if form not in PLY_ORDERS or any(count < 0 for _, count, _ in schema):
        raise unreadable_file(path, f"its header has the format {form!r}, or a negative number", "export it again")
    return form, schema, data[end.end() :]


def _ply_text(path: Path, schema: list[tuple[str, int, list[_Property]]], body: bytes) -> dict[str, _Element]:
    """Read the elements of PLY as text, with one row on each line."""
    lines = [line for line in plain_text(path, body).split(b"\n") if line and not line.isspace()]
    elements, start = {}, 0
    for name, count, properties in schema:
        if not properties:
            continue
        rows = lines[start : start + count]
        if len(rows) < count:
            raise truncated_file(path, f"{count} entries of element {name!r}", len(rows))
        start += count
        elements[name] = _text_element(path, name, rows, properties)
    if start < len(lines):
        raise unreadable_file(
            path, f"it has {len(lines) - start} lines more than its header announces", "export it again"
        )
    return elements


def _text_element(path: Path, name: str, rows: list[bytes], properties: list[_Property]) -> _Element:
    values, counts = number_rows(path, rows)
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
        columns[prop.name] = values[place] if prop.size_dtype is None else (values[ranges(place + 1, size)], size)
        place = place + 1 + size
    else:
        short = place != ends
    if short.any():
        number = int(short.argmax())
        reason = f"{name} {number + 1} has {counts[number]} numbers, but its header announces another number"
        raise unreadable_file(path, reason, "export or copy it again")
    return _Element(len(rows), columns)


def _ply_binary(path: Path, schema: list[tuple[str, int, list[_Property]]], body: bytes) -> dict[str, _Element]:
    """Read the elements of binary PLY."""
    elements, start = {}, 0
    for name, count, properties in schema:
        if not properties:
            continue
        first = _row_sizes(body, start, properties) if count else None
        element = _equal_rows(count, properties, first, body, start) if first is not None else None
        if element is None:
            element, start = _unequal_rows(path, name, count, properties, body, start)
        else:
            start += count * _row_type(properties, first or ()).itemsize
        elements[name] = element
    if body[start:].strip(TRAILING_PADDING):
        reason = f"it has {len(body) - start} bytes more than its header announces"
        raise unreadable_file(path, reason, "export it again, or copy it as a binary file")
    return elements


def _row_sizes(body: bytes, start: int, properties: list[_Property]) -> tuple[int, ...] | None:
    """Read the lengths of the lists in the row that begins here; return None if the row is cut off."""
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


def _equal_rows(
    count: int, properties: list[_Property], sizes: tuple[int, ...], body: bytes, start: int
) -> _Element | None:
    """Read an element whose rows all have lists as long as those of the first; return None if they differ."""
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


def _unequal_rows(
    path: Path, name: str, count: int, properties: list[_Property], body: bytes, start: int
) -> tuple[_Element, int]:
    """Read an element whose rows differ in length, and return where it ends."""
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
                raise truncated_file(path, f"{count} entries of element {name!r}", number)
    columns: dict[str, NDArray | tuple[NDArray, NDArray]] = {}
    for prop, begins, lengths in zip(properties, places, sizes, strict=True):
        length = np.array(lengths, np.int64)
        values = raw[ranges(np.array(begins, np.int64), length * prop.dtype.itemsize)].view(prop.dtype)
        columns[prop.name] = values if prop.size_dtype is None else (values, length)
    return _Element(count, columns), start


def _integer(body: bytes, start: int, dtype: np.dtype) -> int:
    data = body[start : start + dtype.itemsize]
    return int.from_bytes(data, "big" if dtype.str[0] == ">" else "little", signed=dtype.kind == "i")
