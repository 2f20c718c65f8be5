"""Triangles of mesh files in STL, OBJ, PLY, OFF and glTF: what is there, all of it, or the reason why not.

The readers are strict about what changes a shape and lenient about the rest. Counts that a file announces are compared
with what is there; polygons are cut into triangles (`i2t.objects.polygons`); what has no surface, such as lines, is
left out and said. A file whose contents are of another kind than its ending is refused by the name of that kind.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError
from i2t.objects.formats.faces import MeshReader, ParsedMesh
from i2t.objects.formats.gltf import read_scene
from i2t.objects.formats.kinds import check_kind
from i2t.objects.formats.obj import read_obj
from i2t.objects.formats.off import read_off
from i2t.objects.formats.ply import read_ply
from i2t.objects.formats.stl import read_stl
from i2t.objects.formats.text import unreadable


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
    check_kind(path, suffix, data)
    try:
        vertices, faces, left_out = _READERS[suffix](path, data)
    except DataError:
        raise
    except Exception as error:  # whatever a parser trips over, the file is at fault
        reason = " ".join(f"{type(error).__name__} {error}".split())[:300]
        raise unreadable(path, reason, "export it again") from error
    left_out = tuple(text for text in left_out if text)
    if not len(faces):
        beside = f" but {' and '.join(left_out)}" if left_out else ""
        raise DataError(
            f"{path}: holds no faces{beside}; export it as a mesh (a point cloud is made one first, for instance with "
            "Open3D)"
        )
    return ParsedMesh(*_used(path, vertices, faces), left_out)


def _used(path: Path, vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Only the vertices that a face uses, which have to be finite: scanners mark what they did not see as NaN."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    vertices = vertices[used]
    if bad := int(np.sum(~np.isfinite(vertices).all(1))):
        raise DataError(f"{path}: {bad} vertices are not finite; repair the mesh")
    return vertices, (faces if used.all() else (np.cumsum(used) - 1)[faces])


_READERS: dict[str, MeshReader] = {
    ".stl": read_stl,
    ".obj": read_obj,
    ".ply": read_ply,
    ".off": read_off,
    ".glb": read_scene,
    ".gltf": read_scene,
}
