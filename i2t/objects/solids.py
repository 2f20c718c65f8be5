"""Meshes and objects, and how they are moved. The object frame rests on z = 0, z up, centred in x and y."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from i2t.types import in_one_line

MM_PER_M = 1e3  # primitives take metres, solids are drawn in millimetres
STAMP_RELIEF_MM = 3.5  # height of a stamp above its base
STAMP_BASE_MM = (20.0, 5.0)  # edge and height of the base


@in_one_line
class Mesh(NamedTuple):
    """A triangle mesh, as every function of i2t takes it: anything with `vertices` and `faces` serves, such as a
    `trimesh.Trimesh`. Seen from outside, the corners of a face run counter-clockwise.

    Example:
        mesh = i2t.make_object("hammer").mesh
        larger = i2t.Mesh(1.1 * mesh.vertices, mesh.faces)
    """

    vertices: NDArray[np.float64]  # (vertices, 3) m
    faces: NDArray[np.int32]  # (faces, 3) rows of `vertices`


@in_one_line
class Object(NamedTuple):
    """Something to touch, in its own frame: z up, and unless a file was read otherwise standing on z = 0, centred in x
    and y.
    """

    name: str
    mesh: Mesh
    family: str  # "primitive", "stamp", "tool" or "file"


def transform_mesh(mesh: Mesh, T: NDArray) -> Mesh:
    """Move a mesh.

    Args:
        mesh: A mesh in b.
        T: The (4, 4) transform T_a_b; a reflection turns the winding too.

    Returns:
        The mesh in a.
    """
    T = np.asarray(T, np.float64)
    faces = mesh.faces[:, ::-1] if np.linalg.det(T[:3, :3]) < 0 else mesh.faces
    return Mesh(mesh.vertices @ T[:3, :3].T + T[:3, 3], faces)


def centre_box(mesh: Mesh) -> Mesh:
    """Shift a mesh, without turning it.

    Args:
        mesh: Any mesh.

    Returns:
        The mesh with the middle of its box at the origin.
    """
    return Mesh(mesh.vertices - 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0)), mesh.faces)


def place_on_table(mesh: Mesh) -> Mesh:
    """Shift a mesh, without turning it.

    Args:
        mesh: Any mesh.

    Returns:
        The mesh whose box is centred in x and y and stands on z = 0.
    """
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return Mesh(mesh.vertices - [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]], mesh.faces)
