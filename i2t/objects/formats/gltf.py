"""Reader of glTF 2.0 scenes, in one file (GLB) or in JSON with its buffers next to it.

It supports what the standard defines for a static surface: buffers, views with a stride, sparse accessors, normalized
integers (KHR_mesh_quantization), triangle strips and fans, and the tree of nodes. It refuses anything else by name,
because a compressed or skinned mesh would have another size if that were ignored. Source: Khronos Group, "glTF 2.0
Specification" (2021), and the registry of its extensions.
"""

import base64
import urllib.parse
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError
from i2t.files.limits import READ_LIMITS
from i2t.files.reading import parse_json, read_bytes
from i2t.files.writing import file_in
from i2t.objects.polygons import strip_triangles

# NumPy types of the component types of glTF 2.0 (section 3.6.2.2), by number.
COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
# glTF extensions that compress meshes, which are not read
COMPRESSION_EXTENSIONS = ("EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_draco_mesh_compression")
# remedy for a compressed glTF file
DECOMPRESS_ADVICE = "export it again without compression, or decompress it, for instance with gltf-transform"

# Kinds of primitives (glTF 2.0, 3.7.2.1)
_Mode = IntEnum("_Mode", "POINTS LINES LINE_LOOP LINE_STRIP TRIANGLES TRIANGLE_STRIP TRIANGLE_FAN", start=0)


@dataclass(frozen=True)
class SceneLimits:
    """Largest glTF scene that is read: numbers of nodes, and of faces over all instances of meshes (a small file may
    repeat a mesh many times), and the tolerance of a mesh's stated bounding box.
    """

    max_nodes: int = 10_000
    max_faces: int = 2**23  # largest number of faces over all instances of all meshes, and likewise of vertices
    box_tolerance: float = 1e-4  # largest error of a mesh's stated bounding box, relative to its longest side


def read_scene(
    path: Path, data: bytes, *, limits: SceneLimits = SceneLimits()
) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    """Read the triangles of a glTF file's default scene, with the meshes of all nodes in the scene's frame.

    Args:
        path: The file's path, for messages and for the buffers next to it.
        data: The file's bytes, GLB or JSON.
        limits: Bounds on the scene.

    Returns:
        `(n, 3)` vertices in the scene's frame, in the file's unit, which is metres by the standard; `(m, 3)` triangles;
        and counts of what has no triangles, such as "2 primitives of lines".

    Raises:
        DataError: The file is cut off, is too large, or uses a feature that is not supported.
        Exception: A field of the JSON is missing or has another type.
    """
    document = _Document(path, data, limits)
    document.check_extensions()
    vertices, faces, start, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0, 0
    for mesh, matrix in document.placed_meshes():
        for corners, triangles in document.primitives(mesh):
            mirrored = np.linalg.det(matrix[:3, :3]) < 0
            vertices.append(corners @ matrix[:3, :3].T + matrix[:3, 3])
            faces.append((triangles[:, ::-1] if mirrored else triangles) + start)
            start, count = start + len(corners), count + len(triangles)
            if max(start, count) > limits.max_faces:
                raise DataError(
                    f"{path}: its scene has more than {limits.max_faces} faces, all instances counted; simplify it"
                )
    ignored = [f"{count} primitives of {kind}" for kind, count in document.skipped.items()]
    if len(document.scenes) > 1:
        ignored.append(f"{len(document.scenes) - 1} scenes that are not the default one")
    return np.concatenate(vertices), np.concatenate(faces), tuple(ignored)


class _Document:
    """A glTF file: its JSON, and the buffers that the JSON names."""

    def __init__(self, path: Path, data: bytes, limits: SceneLimits) -> None:
        self.path, self.binary, self.limits = path, b"", limits
        if data[:4] == b"glTF":
            text, self.binary = _chunks(path, data)
        elif data.lstrip()[:1] in (b"{", b"\xef", b"\xff", b"\xfe"):  # JSON, perhaps after a byte order mark
            text = data.lstrip()
        else:
            raise DataError(
                f"{path}: is not a glTF file, neither binary nor JSON; export it again, or check its ending"
            )
        self.json: dict[str, Any] = parse_json(text, path)
        version = str(self.json["asset"]["version"])
        if version.split(".")[0] != "2":
            raise DataError(f"{path}: is glTF {version}; export it as glTF 2.0")
        self.buffers: dict[int, bytes] = {}
        self.shapes: dict[int, list[tuple[NDArray, NDArray]]] = {}
        self.skipped: dict[str, int] = {}

    def check_extensions(self) -> None:
        """Refuse a file that requires an extension that changes the shape."""
        harmless = ("KHR_mesh_quantization", "KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_",
                    "KHR_lights_", "KHR_xmp", "KHR_animation_pointer")  # fmt: skip
        for name in self.json.get("extensionsRequired", ()):
            if not name.startswith(harmless):
                remedy = (
                    DECOMPRESS_ADVICE if name in COMPRESSION_EXTENSIONS else "export it again without that extension"
                )
                raise DataError(f"{self.path}: needs the glTF extension {name}, which is not read; {remedy}")

    @cached_property
    def scenes(self) -> list[dict[str, Any]]:
        return self.json.get("scenes", [])

    def placed_meshes(self) -> Iterator[tuple[int, NDArray]]:
        """Yield each mesh of the default scene with its matrix `(4, 4)` from the mesh's frame to the scene's."""
        nodes = self.json.get("nodes", [])
        if len(nodes) > self.limits.max_nodes:
            raise DataError(
                f"{self.path}: is a scene of {len(nodes)} parts, and at most {self.limits.max_nodes} are read; join "
                "them"
            )
        if not nodes:
            yield from ((mesh, np.eye(4)) for mesh in range(len(self.json.get("meshes", []))))
            return
        waiting, reached = [(int(root), np.eye(4)) for root in self._roots(nodes)], set()
        while waiting:
            number, parent = waiting.pop()
            if number in reached or not 0 <= number < len(nodes):
                raise DataError(f"{self.path}: its nodes do not form a tree (node {number}); export it again")
            reached.add(number)
            node = nodes[number]
            matrix = parent @ _matrix(node)
            waiting.extend((int(child), matrix) for child in node.get("children", ()))
            if "mesh" in node:
                self._check_node(node)
                yield int(node["mesh"]), matrix

    def _roots(self, nodes: list[dict[str, Any]]) -> list[int]:
        if not self.scenes:
            return sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", ())})
        if "scene" not in self.json and len(self.scenes) > 1:
            raise DataError(
                f"{self.path}: has {len(self.scenes)} scenes, none of which is the default; export one of them"
            )
        return self.scenes[self.json.get("scene", 0)].get("nodes", [])

    def _check_node(self, node: dict[str, Any]) -> None:
        for name in ("EXT_mesh_gpu_instancing", "KHR_node_visibility"):  # they need not be declared as required
            if name in node.get("extensions", {}):
                raise DataError(
                    f"{self.path}: uses the glTF extension {name}, which is not read; export it again without it"
                )
        if "skin" in node:
            raise DataError(
                f"{self.path}: is a skinned mesh, whose shape depends on its bones; apply the armature and export the "
                "mesh alone"
            )
        if any(node.get("weights", self.json["meshes"][node["mesh"]].get("weights", ()))):
            raise DataError(f"{self.path}: has morph targets (shape keys) in use; apply them and export again")

    def primitives(self, mesh: int) -> list[tuple[NDArray, NDArray]]:
        """Read the vertices `(n, 3)` and triangles `(m, 3)` of each primitive of a mesh that has a surface."""
        if mesh not in self.shapes:
            primitives = self.json["meshes"][mesh]["primitives"]
            self.shapes[mesh] = [shape for shape in map(self._primitive, primitives) if shape]
        return self.shapes[mesh]

    def _primitive(self, primitive: dict[str, Any]) -> tuple[NDArray, NDArray] | None:
        mode = primitive.get("mode", _Mode.TRIANGLES)
        if mode in (_Mode.POINTS, _Mode.LINES, _Mode.LINE_LOOP, _Mode.LINE_STRIP):
            kind = "points" if mode == _Mode.POINTS else "lines"
            self.skipped[kind] = self.skipped.get(kind, 0) + 1
            return None
        positions, accessor = primitive["attributes"]["POSITION"], self.json["accessors"]
        for name in COMPRESSION_EXTENSIONS:
            numbers = [positions, *([primitive["indices"]] if "indices" in primitive else [])]
            if name in primitive.get("extensions", {}) and any(
                "bufferView" not in accessor[number] and "sparse" not in accessor[number] for number in numbers
            ):
                raise DataError(f"{self.path}: is compressed ({name}), which is not read; {DECOMPRESS_ADVICE}")
        vertices = self._values(positions, "VEC3")
        corners = np.arange(len(vertices))
        if "indices" in primitive:
            corners = self._values(primitive["indices"], "SCALAR")[:, 0]
        if not np.issubdtype(corners.dtype, np.integer):
            raise DataError(f"{self.path}: the corners of its faces are not whole numbers; export it again")
        corners = corners.astype(np.int64)
        if len(corners) and corners.max() >= len(vertices):
            raise DataError(f"{self.path}: a face refers to a vertex that is not there; export it again")
        return vertices.astype(np.float64), self._faces(mode, corners)

    def _faces(self, mode: int, corners: NDArray) -> NDArray:
        if mode == _Mode.TRIANGLE_STRIP:
            return strip_triangles(corners)
        if mode == _Mode.TRIANGLE_FAN:
            first = np.full(max(len(corners) - 2, 0), corners[0] if len(corners) else 0)
            return np.stack([corners[1:-1], corners[2:], first], 1) if len(first) else np.empty((0, 3), np.int64)
        if mode != _Mode.TRIANGLES:
            raise DataError(f"{self.path}: has a primitive of mode {mode}, which glTF does not have; export it again")
        if len(corners) % 3:
            raise DataError(
                f"{self.path}: has {len(corners)} corners of triangles, not a multiple of three; export it again"
            )
        return corners.reshape(-1, 3)

    def _values(self, number: int, kind: str) -> NDArray:
        """Read the values of an accessor `(count, width)`; normalized integers are converted to what they represent."""
        accessor = self.json["accessors"][number]
        count, dtype = int(accessor["count"]), np.dtype(COMPONENT_TYPES[accessor["componentType"]])
        width = {"SCALAR": 1, "VEC3": 3}[kind]
        if accessor["type"] != kind:
            raise DataError(f"{self.path}: accessor {number} is {accessor['type']} and not {kind}; export it again")
        if count < 0 or count * dtype.itemsize > READ_LIMITS.mesh_bytes:
            raise DataError(f"{self.path}: accessor {number} has {count} entries, which no file holds; export it again")
        values = np.zeros((count, width), dtype)
        if "bufferView" in accessor:
            values = self._array(accessor, values.shape, dtype)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            size, index_type = int(sparse["count"]), np.dtype(COMPONENT_TYPES[sparse["indices"]["componentType"]])
            indices = self._array(sparse["indices"], (size, 1), index_type)
            values = values.copy()
            values[indices[:, 0]] = self._array(sparse["values"], (size, width), dtype)
        exact = values
        if accessor.get("normalized") and dtype.kind in "iu":
            exact = np.maximum(values / np.iinfo(dtype).max, -1.0)  # glTF 2.0, 3.11
        if kind == "VEC3":
            self._check_box(number, accessor, values, exact)
        return exact

    def _array(self, place: dict[str, Any], shape: tuple[int, int], dtype: np.dtype) -> NDArray:
        """Read an array `(count, width)` from a view, which gives its beginning and the distance between its rows."""
        view = self.json["bufferViews"][place["bufferView"]]
        data = self._buffer(view)
        begin, end = int(view.get("byteOffset", 0)), int(view.get("byteOffset", 0)) + int(view["byteLength"])
        offset, row = int(place.get("byteOffset", 0)), shape[1] * dtype.itemsize
        stride = int(view.get("byteStride", row))
        last = begin + offset + stride * (shape[0] - 1) + row if shape[0] else begin
        if min(begin, offset) < 0 or stride < row or end > len(data) or last > end:
            raise DataError(
                f"{self.path}: is cut off or wrong: view {place['bufferView']} needs {max(end, last)} bytes of its "
                f"buffer, which has {len(data)}; export or copy it again"
            )
        return np.ndarray(shape, dtype, data, begin + offset, (stride, dtype.itemsize))

    def _buffer(self, view: dict[str, Any]) -> bytes:
        """Read the buffer of a view."""
        number = int(view["buffer"])
        if number not in self.buffers:
            buffer = self.json["buffers"][number]
            packed = [name for name in COMPRESSION_EXTENSIONS if name in view.get("extensions", {})]
            if "uri" in buffer:
                data = self._bytes_at(buffer["uri"])
            elif number == 0 and self.binary and not (packed and packed[0] in buffer.get("extensions", {})):
                data = self.binary
            elif packed:
                raise DataError(f"{self.path}: is compressed ({packed[0]}), which is not read; {DECOMPRESS_ADVICE}")
            else:
                raise DataError(f"{self.path}: buffer {number} is not in it; export it again")
            size = int(buffer["byteLength"])
            if len(data) < size:
                raise DataError(
                    f"{self.path}: is cut off: buffer {number} should have {size} bytes and has {len(data)}; export or "
                    "copy it again"
                )
            self.buffers[number] = data
        return self.buffers[number]

    def _bytes_at(self, uri: str) -> bytes:
        """Read data from the address itself, or from a file in this file's folder or below, and from nowhere else."""
        head, _, body = uri.partition(",")
        if head.startswith("data:"):
            plain = urllib.parse.unquote_to_bytes(body)
            return base64.b64decode(plain, validate=True) if head.endswith(";base64") else plain
        if "://" in head:
            raise DataError(f"{self.path}: its data are at {uri[:80]}; download that next to it, and name it there")
        name = urllib.parse.unquote(uri).removeprefix("./")
        if "\\" in name and not (self.path.parent / name).exists():
            name = name.replace("\\", "/")  # a folder written on Windows
        file = file_in(self.path.parent, name, self.path, below=True)
        if not file.is_file():
            raise DataError(f"{self.path}: its data are in {name!r}, which is not next to it; copy that file as well")
        data = read_bytes(file, READ_LIMITS.mesh_bytes)
        if sum(map(len, self.buffers.values())) + len(data) > READ_LIMITS.mesh_bytes:
            raise DataError(f"{self.path}: its data are more than {READ_LIMITS.mesh_bytes} bytes; simplify the mesh")
        return data

    def _check_box(self, number: int, accessor: dict[str, Any], values: NDArray, exact: NDArray) -> None:
        """Compare the bounding box of the coordinates with the one that the file states.

        By the standard the stated box is that of integers before they are normalized; some programs give it after.
        """
        if not len(values) or "min" not in accessor or "max" not in accessor:
            return
        stated = np.array([accessor["min"], accessor["max"]], np.float64)
        for coordinates in (values, exact):
            used = coordinates[np.isfinite(coordinates).all(1)]
            box = np.stack([used.min(0), used.max(0)]) if len(used) else np.zeros((2, 3))
            slack = self.limits.box_tolerance * max(
                np.ptp(stated, 0).max(), np.finfo(np.float32).eps * np.abs(stated).max()
            )
            if np.abs(box - stated).max() <= slack:
                return
        stated_text, read_text = (
            " to ".join("(" + ", ".join(f"{x:g}" for x in corner) + ")" for corner in corners)
            for corners in (stated, box)
        )
        raise DataError(
            f"{self.path}: accessor {number} says that it spans {stated_text}, and its numbers span {read_text}; "
            "export it again"
        )


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """Split a GLB file into its JSON and its binary chunk (glTF 2.0, 4.4)."""
    version, length = (int.from_bytes(data[i : i + 4], "little") for i in (4, 8))
    if version != 2:
        raise DataError(f"{path}: is glTF {version}; export it as glTF 2.0")
    if length > len(data):
        raise DataError(
            f"{path}: is cut off: it announces {length} bytes, but only {len(data)} are present; export or copy it "
            "again"
        )
    chunks: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= length:
        size, kind = int.from_bytes(data[start : start + 4], "little"), data[start + 4 : start + 8]
        if start + 8 + size > length:
            raise DataError(f"{path}: is cut off within its part {kind.decode('latin-1')!r}; export or copy it again")
        chunks.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    if b"JSON" not in chunks:
        raise DataError(f"{path}: has no description of its scene; export it again")
    return chunks[b"JSON"], chunks.get(b"BIN\0", b"")


def _matrix(node: dict[str, Any]) -> NDArray:
    """Compute the matrix `(4, 4)` from a node's frame to its parent's (glTF 2.0, 3.5.3)."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
    else:
        quat_xyzw = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
        x, y, z, w = quat_xyzw / np.linalg.norm(quat_xyzw)
        turn = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                         [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                         [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])  # fmt: skip
        matrix = np.eye(4)
        matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)
        matrix[:3, 3] = node.get("translation", (0, 0, 0))
    if not np.isfinite(matrix).all():
        raise ValueError("a node's place is not finite")
    return matrix
