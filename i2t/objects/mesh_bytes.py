"""The bytes of a mesh file, reduced to its geometry before a parser takes them.

Parsers believe a file: they walk a hundred thousand nodes one by one, make a mesh for every material that is named, and
unpack textures that nobody asked for. What is left here is vertices and faces, and a scene of bounded size. Nothing is
read but the bytes themselves: a GLB file whose geometry lies in other files is refused.
"""

import json
import re
import struct
from pathlib import Path
from typing import Any

from i2t.errors import DataError
from i2t.files import parse_json

MAX_NODES = 1000  # of a scene, and meshes and parts of meshes in it
MAX_FILE_FACES = 4_000_000  # of all nodes of a scene together
GLB_HEADER, GLB_CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
# Parts of a scene that say nothing of its shape, some of which would be unpacked.
LOOKS = ("materials", "textures", "images", "samplers", "animations", "skins", "cameras", "extras")


def geometry_of(path: Path, data: bytes) -> bytes:
    """The same mesh file without what is no geometry.

    Args:
        path: Of the file, for its ending and for messages.
        data: Its bytes.

    Returns:
        Bytes of the same format.

    Raises:
        DataError: A scene is larger or deeper than it may be, or announces more than it has.
    """
    suffix = path.suffix.lower()
    if suffix == ".glb" and data[:4] == b"glTF":
        return _glb(path, data)
    if suffix == ".obj":
        return _obj(path, data)
    if suffix == ".stl" and data.lower().count(b"endsolid") > 1:
        # A parser would make a mesh of each solid; they are one object here.
        inside = re.sub(rb"(?im)^[ \t]*(end)?solid\b[^\n]*$", b"", data)
        return b"solid\n" + inside + b"\nendsolid\n"
    return data


def _obj(path: Path, data: bytes) -> bytes:
    """Vertices and triangles alone: a parser would begin a new mesh at each material."""
    kept, faces = [], 0
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        words = line.split()
        if words and words[0] == b"v":
            kept.append(b" ".join(words[:4]))
        elif words and words[0] == b"f":
            corners = [word.partition(b"/")[0] for word in words[1:]]
            faces += max(0, len(corners) - 2)
            if faces > MAX_FILE_FACES:
                raise DataError(f"{path}: has more than {MAX_FILE_FACES} faces; export it with fewer")
            kept += [b"f %b %b %b" % (corners[0], *corners[i : i + 2]) for i in range(1, len(corners) - 1)]
    return b"\n".join(kept) + b"\n"


def _glb(path: Path, data: bytes) -> bytes:
    """A scene's nodes and meshes, once their number is known to be bounded."""
    try:
        size, kind = GLB_CHUNK.unpack_from(data, GLB_HEADER.size)
        begin = GLB_HEADER.size + GLB_CHUNK.size
        if kind != b"JSON" or begin + size > len(data):
            raise ValueError("it has no scene")
        scene = parse_json(data[begin : begin + size].decode("utf-8"), path)
        _check_scene(path, scene, len(data))
        plain = {name: part for name, part in scene.items() if name not in LOOKS}
        for primitive in _primitives(scene):
            primitive.pop("material", None)
    except DataError:
        raise
    except (struct.error, ValueError, LookupError, TypeError, AttributeError) as error:
        reason = f"misses {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise DataError(f"{path}: cannot be read as GLB ({reason}); export it again") from error
    text = json.dumps(plain).encode()
    text += b" " * (-len(text) % 4)
    rest = data[begin + size :]
    whole = GLB_HEADER.size + GLB_CHUNK.size + len(text) + len(rest)
    return GLB_HEADER.pack(b"glTF", 2, whole) + GLB_CHUNK.pack(len(text), b"JSON") + text + rest


def _primitives(scene: dict[str, Any]) -> list[dict[str, Any]]:
    return [primitive for mesh in scene.get("meshes", []) for primitive in mesh["primitives"]]


def _check_scene(path: Path, scene: dict[str, Any], size: int) -> None:
    nodes, meshes, accessors = (scene.get(name, []) for name in ("nodes", "meshes", "accessors"))
    most = max(len(nodes), len(meshes), len(_primitives(scene)))
    if most > MAX_NODES:
        raise DataError(f"{path}: is a scene of {most} parts, and at most {MAX_NODES} are read; join them to one mesh")
    if any("uri" in buffer for buffer in scene.get("buffers", [])):
        raise DataError(f"{path}: keeps its geometry in another file, which is not read; export it as one GLB file")
    counts = [int(accessor["count"]) for accessor in accessors]
    if max(counts, default=0) > size or min(counts, default=0) < 0:
        raise DataError(f"{path}: announces {max(counts)} values in {size} bytes; export it again")
    corners = [sum(_corners(primitive, counts) for primitive in mesh["primitives"]) for mesh in meshes]
    if any("mesh" in node and not 0 <= node["mesh"] < len(meshes) for node in nodes):
        raise DataError(f"{path}: a node refers to a mesh that is not there; export it again")
    faces = sum(corners[node["mesh"]] for node in nodes if "mesh" in node) // 3
    if faces > MAX_FILE_FACES:
        raise DataError(f"{path}: has {faces} faces, and at most {MAX_FILE_FACES} are read; export it with fewer")


def _corners(primitive: dict[str, Any], counts: list[int]) -> int:
    return counts[primitive["indices"]] if "indices" in primitive else counts[primitive["attributes"]["POSITION"]]
