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


IDENTITY = np.eye(4)
IDENTITY.flags.writeable = False


@in_one_line
class Object(NamedTuple):
    """Something to touch, in its own frame: z up, and unless a file was read otherwise standing on z = 0, centred in x
    and y.
    """

    name: str
    mesh: Mesh
    family: str  # "primitive", "stamp", "tool" or "file"
    T_file_object: NDArray[np.float64] = IDENTITY  # (4, 4) to the frame of the mesh file, m
    left_out: Mesh | None = None  # pieces of the file that are not to be touched, but are in an arm's way


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
    return transform_mesh(mesh, table_transform(mesh))


def table_transform(mesh: Mesh) -> NDArray[np.float64]:
    """The shift that places a mesh on the table.

    Args:
        mesh: A mesh in its frame m (m).

    Returns:
        T_o_m (4, 4), whose frame o has the middle of the mesh's box on its z axis and the box's bottom on z = 0.
    """
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    T_o_m = np.eye(4)
    T_o_m[:3, 3] = -(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]
    return T_o_m


def highest_point(target: Object, T_w_o: NDArray) -> float:
    """Height that the tool has to clear above an object, with what of it is not to be touched.

    Args:
        target: The object.
        T_w_o: (4, 4) where it stands.

    Returns:
        The largest z of any of its corners in W (m).
    """
    meshes = [target.mesh] if target.left_out is None else [target.mesh, target.left_out]
    return max(float(transform_mesh(mesh, np.asarray(T_w_o)).vertices[:, 2].max()) for mesh in meshes)
