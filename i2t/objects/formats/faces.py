"""Triangles from the polygons in a mesh file."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError
from i2t.objects.polygons import triangulate


class ParsedMesh(NamedTuple):
    """Triangles of a mesh file as read, in the file's unit and not yet cleaned, and counts of the ignored elements."""

    vertices: NDArray[np.float64]  # (n, 3) vertices in the file's unit; all are finite and used
    faces: NDArray[np.int64]  # (m, 3) indices of the faces' corners
    ignored: tuple[str, ...]  # counts of elements that are not faces, such as "2 lines"


class MeshReader(Protocol):
    """Type of a function that reads one format of mesh files."""

    def __call__(self, path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
        """Read the triangles of a mesh file.

        Args:
            path: The file's path, for messages.
            data: The file's bytes.

        Returns:
            `(n, 3)` vertices in the file's unit, `(m, 3)` triangles, and texts, some of them empty, that name what was
            left out.

        Raises:
            DataError: The file is cut off or does not follow its format.
        """
        ...


def triangulate_polygons(
    path: Path, vertices: NDArray, corners: NDArray, sizes: NDArray, name: Callable[[int], str] = "face {}".format
) -> tuple[NDArray, NDArray, str]:
    """Cut the polygons of a file into triangles.

    Args:
        path: The file's path, for messages.
        vertices: `(n, 3)` vertices in the file's unit.
        corners: Vertex indices of all polygons, polygon after polygon.
        sizes: `(m,)` numbers of corners of the polygons.
        name: Names the polygon of a given number, counted from 1, in an error.

    Returns:
        The vertices, `(k, 3)` triangles, and a text with the number of polygons that were left out because they have
        fewer than three corners; empty if there are none.

    Raises:
        DataError: A polygon refers to a vertex that does not exist or cannot be triangulated.
    """
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
