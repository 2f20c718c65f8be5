"""Triangles made of the polygons in a mesh file."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError
from i2t.objects.polygons import triangulate


class ParsedMesh(NamedTuple):
    """The triangles of a file, as it has them."""

    vertices: NDArray[np.float64]  # (n, 3), in the file's unit; all finite, and all used
    faces: NDArray[np.int64]  # (m, 3)
    left_out: tuple[str, ...]  # what is no face, with its number


class MeshReader(Protocol):
    """Reader of one format."""

    def __call__(self, path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
        """Read a file.

        Args:
            path: The file, named in errors.
            data: Its bytes.

        Returns:
            `(n, 3)` vertices in the file's unit, `(m, 3)` triangles, and what was left out, as texts that may be empty.

        Raises:
            DataError: The file is cut off or does not follow its format.
        """
        ...


def triangulated(
    path: Path, vertices: NDArray, corners: NDArray, sizes: NDArray, name: Callable[[int], str] = "face {}".format
) -> tuple[NDArray, NDArray, str]:
    """Cut the polygons of a file into triangles.

    Args:
        path: The file, named in errors.
        vertices: `(n, 3)` vertices in the file's unit.
        corners: Vertex indices of all polygons, polygon after polygon.
        sizes: `(m,)` number of corners of each polygon.
        name: What to call the polygon of a given number, from 1 on, in an error.

    Returns:
        The vertices, `(k, 3)` triangles, and how many polygons were left out because they have fewer than three
        corners, as text; empty if none were.

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
