"""Reading of the triangles in mesh files: STL, OBJ, PLY, OFF and glTF.

The readers are strict about anything that changes a shape and lenient otherwise. Counts that a file announces are
compared with its contents, and polygons are cut into triangles (`i2t.objects.polygons`). Elements without a surface,
such as lines, are left out and reported. A file whose contents are of another kind than its suffix is refused by the
name of that kind.
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
from i2t.objects.formats.text import unreadable_file


def parse_mesh(path: Path, data: bytes) -> ParsedMesh:
    """Read the triangles in the bytes of a mesh file.

    Args:
        path: The file's path. Its suffix names the format, and a glTF file may name other files in its folder.
        data: The file's bytes.

    Returns:
        Vertices that a face uses, triangles with the same area as the file's polygons, and what was left out.

    Raises:
        DataError: The file is cut off, is of another kind than its suffix indicates, holds no face or a feature that is
            not supported, or uses vertices that are missing or not finite. One sentence names the file and a remedy.
    """
    suffix = path.suffix.lower()
    check_kind(path, suffix, data)
    try:
        vertices, faces, ignored = _READERS[suffix](path, data)
    except DataError:
        raise
    except Exception as error:  # an error of a parser is caused by the file
        reason = " ".join(f"{type(error).__name__} {error}".split())[:300]
        raise unreadable_file(path, reason, "export it again") from error
    ignored = tuple(text for text in ignored if text)
    if not len(faces):
        others = f" but {' and '.join(ignored)}" if ignored else ""
        raise DataError(
            f"{path}: holds no faces{others}; export it as a mesh (a point cloud has to be made one first, for "
            "instance with Open3D)"
        )
    return ParsedMesh(*_drop_unused(path, vertices, faces), ignored)


def _drop_unused(path: Path, vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Keep only the vertices that a face uses, which have to be finite: scanners mark unseen points as NaN."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    vertices = vertices[used]
    if bad := int(np.sum(~np.isfinite(vertices).all(1))):
        raise DataError(f"{path}: {bad} vertices are not finite; repair the mesh")
    return vertices, (faces if used.all() else (np.cumsum(used) - 1)[faces])


# Functions that read meshes, by file name ending.
_READERS: dict[str, MeshReader] = {
    ".stl": read_stl,
    ".obj": read_obj,
    ".ply": read_ply,
    ".off": read_off,
    ".glb": read_scene,
    ".gltf": read_scene,
}
