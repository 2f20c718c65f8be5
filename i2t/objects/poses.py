"""Poses of a tool that touches an object at a chosen point."""

import numpy as np
import trimesh
from jaxtyping import Float

from i2t import validation
from i2t.geometry import contact_frame
from i2t.objects.solids import Mesh
from i2t.types import Array

MAX_OFF_SURFACE_M = 1e-3  # a point further off was meant for another place, unit or frame
UNIT_TOLERANCE = 1e-3  # by which the length of a normal may miss 1
MIN_FACE_AREA_M2 = 1e-16  # a smaller face has no normal


def contact_pose(
    mesh: Mesh, point: Array, *, normal: Array | None = None, roll: float = 0.0
) -> Float[np.ndarray, "4 4"]:
    """The pose of a tool whose skin lies on a mesh at a point: `T_o_t`, its origin there, its z into the object.

    Roll 0 turns the tool that points straight down (z = -z of the object, x = x of the object) by the smallest rotation
    to the surface's normal; pointing straight up, where that rotation is not unique, it turns about x. This is the
    frame of `i2t.geometry.contact_frame`, so that sites drawn at random and poses made by hand mean the same by a roll.

    Args:
        mesh: The object, in its own frame (m).
        point: (3,) where the middle of the skin touches (m), within 1 mm of the surface: the tool's
            origin.
        normal: (3,) the surface's outward unit normal there; None takes that of the nearest face, from whose corners'
            order outside is told.
        roll: Angle (rad) by which the tool is turned about its z.

    Returns:
        The pose, in the frame of the mesh: T_w_t of an object at T_w_o is `T_w_o @ T_o_t`.

    Raises:
        ValueError: The point is not finite or off the surface, or the normal is no unit vector.
        TypeError: One of them holds no real numbers.

    Example:
        T_o_t = contact_pose(make_object("dome").mesh, (0, 0, 30e-3))
        patch = render_patch(prepare_surface(mesh), T_o_t)
    """
    if not hasattr(mesh, "vertices") or not hasattr(mesh, "faces"):
        raise TypeError(f"mesh: a {type(mesh).__name__} has no vertices and faces; give an i2t.Mesh (i2t.load_mesh)")
    at = validation.numbers("point", point, "x, y and z in metres").astype(np.float64)
    if at.shape != (3,) or not np.isfinite(at).all():
        raise ValueError(f"point: {point} is not three finite numbers; give x, y and z in metres")
    validation.number("roll", roll, "radians")
    distance, face_normal = _nearest(mesh, at)
    if distance > MAX_OFF_SURFACE_M:
        raise ValueError(
            f"point: lies {1e3 * distance:.3g} mm off the surface, of at most {1e3 * MAX_OFF_SURFACE_M:g} mm; give a "
            "point on it, in metres and in the mesh's frame"
        )
    hint = "a unit vector, or leave it out"
    outward = face_normal if normal is None else validation.numbers("normal", normal, hint).astype(np.float64)
    if outward.shape != (3,) or not abs(float(np.linalg.norm(outward)) - 1) <= UNIT_TOLERANCE:
        raise ValueError(f"normal: {normal} is no unit vector; divide it by its length, or leave it out")
    return np.asarray(contact_frame(at, outward / np.linalg.norm(outward), roll))


def _nearest(mesh: Mesh, at: Float[np.ndarray, "3"]) -> tuple[float, Float[np.ndarray, "3"]]:
    """Distance (m) of the mesh from a point, and the unit normal of the nearest face that has an area."""
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice_area = np.linalg.norm(cross, axis=1)
    solid = twice_area > 2 * MIN_FACE_AREA_M2
    if not solid.any():
        raise ValueError("mesh: no face has an area; give one with a surface")
    corners, cross, twice_area = corners[solid], cross[solid], twice_area[solid]
    closest = trimesh.triangles.closest_point(corners, np.broadcast_to(at, (len(corners), 3)))
    distance = np.linalg.norm(closest - at, axis=1)
    face = int(np.argmin(distance))
    return float(distance[face]), cross[face] / twice_area[face]
