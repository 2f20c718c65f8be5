"""Meshes and objects, and functions that move them.

An object's frame has z up and, by default, the object centred in x and y and standing on z = 0.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from i2t.types import in_one_line

MM_PER_M = 1e3  # mm per m: primitives take metres, and solids are drawn in millimetres
STAMP_RELIEF_MM = 3.5  # mm, height of a stamp's relief above its base
STAMP_BASE_MM = (20.0, 5.0)  # mm, edge and height of a stamp's base


@in_one_line
class Mesh(NamedTuple):
    """A triangle mesh. Seen from outside, the corners of a face run counter-clockwise.

    Functions of i2t also accept any other object with `vertices` and `faces`, such as a `trimesh.Trimesh`.

    Example:
        mesh = i2t.make_object("hammer").mesh
        larger = i2t.Mesh(1.1 * mesh.vertices, mesh.faces)
    """

    vertices: NDArray[np.float64]  # (vertices, 3) m
    faces: NDArray[np.int32]  # (faces, 3) rows of `vertices`


@in_one_line
class Object(NamedTuple):
    """Object to touch: name, mesh (m), kind, pose in its mesh file, and pieces that are only obstacles. In its frame, z
    is up; it is centred in x and y and stands on z = 0 unless read otherwise.
    """

    name: str
    mesh: Mesh
    family: str  # kind of the object: "primitive", "stamp", "tool" or "file"
    # (4, 4) pose of the object in the mesh file's frame, m; read-only
    T_file_object: NDArray[np.float64] = np.broadcast_to(np.eye(4), (4, 4))
    obstacles: Mesh | None = None  # pieces of the file that are not touched but obstruct the arm


def transform_mesh(mesh: Mesh, T: NDArray) -> Mesh:
    """Transform a mesh to another frame.

    Args:
        mesh: The mesh in frame b.
        T: `(4, 4)` transform T_a_b. A reflection also reverses the order of each face's corners.

    Returns:
        The mesh in frame a.
    """
    T = np.asarray(T, np.float64)
    faces = mesh.faces[:, ::-1] if np.linalg.det(T[:3, :3]) < 0 else mesh.faces
    return Mesh(mesh.vertices @ T[:3, :3].T + T[:3, 3], faces)


def centre_box(mesh: Mesh) -> Mesh:
    """Shift a mesh so that the middle of its bounding box is at the origin.

    Args:
        mesh: The mesh.

    Returns:
        The shifted mesh, which is not rotated.
    """
    return Mesh(mesh.vertices - 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0)), mesh.faces)


def place_on_table(mesh: Mesh) -> Mesh:
    """Shift a mesh so that its bounding box is centred in x and y and stands on z = 0.

    Args:
        mesh: The mesh.

    Returns:
        The shifted mesh, which is not rotated.
    """
    return transform_mesh(mesh, table_transform(mesh))


def table_transform(mesh: Mesh) -> NDArray[np.float64]:
    """Compute the shift that places a mesh on the table.

    Args:
        mesh: The mesh in its own frame m, in metres.

    Returns:
        `(4, 4)` transform T_o_m. In frame o the bounding box is centred in x and y and stands on z = 0.
    """
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    T_o_m = np.eye(4)
    T_o_m[:3, 3] = -(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]
    return T_o_m


def highest_point(target: Object, T_w_o: NDArray) -> float:
    """Compute the height of an object's highest point, including the pieces that are not touched.

    Args:
        target: The object.
        T_w_o: `(4, 4)` pose of the object.

    Returns:
        The largest z (m) of any of its vertices in W.
    """
    meshes = [target.mesh] if target.obstacles is None else [target.mesh, target.obstacles]
    return max(float(transform_mesh(mesh, np.asarray(T_w_o)).vertices[:, 2].max()) for mesh in meshes)
