"""Poses of a tool that touches an object at a given point."""

import numpy as np
import trimesh
from jaxtyping import Float

from i2t import validation
from i2t.geometry import contact_frame
from i2t.objects.solids import Mesh
from i2t.types import Array


def contact_pose(
    mesh: Mesh, point: Array, *, normal: Array | None = None, roll: float = 0.0, max_distance: float = 1e-3
) -> Float[np.ndarray, "4 4"]:
    """Compute the pose `T_o_t` of a tool whose skin lies on a mesh at a point.

    The tool's origin is the point, and its z axis points into the object. With roll 0, a tool that points straight down
    (z = -z of the object, x = x of the object) is turned by the smallest rotation to the surface's normal. If it has to
    point straight up, where that rotation is not unique, it is turned about x. This is the frame of
    `i2t.geometry.contact_frame`, so a roll means the same for sites drawn at random and for poses from here.

    Args:
        mesh: The object, in its own frame (m).
        point: `(3,)` point (m) that the middle of the skin touches.
        normal: `(3,)` outward unit normal of the surface at the point. None takes that of the nearest face, whose
            outside follows from the order of its corners.
        roll: Angle (rad) by which the tool is turned about its z axis.
        max_distance: The largest distance (m) of the point from the surface; a more distant point has another unit or
            frame.

    Returns:
        `(4, 4)` pose of the tool in the frame of the mesh. For an object at T_w_o, T_w_t is `T_w_o @ T_o_t`.

    Raises:
        ValueError: The point is not finite, not on the surface or inside the object, such as on a face that two
            bodies share; or the normal is not a unit vector.
        TypeError: An argument holds no real numbers.

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
    if distance > max_distance:
        raise ValueError(
            f"point: lies {1e3 * distance:.3g} mm off the surface, where at most {1e3 * max_distance:g} mm are "
            "allowed; give a point on it, in metres and in the mesh's frame (i2t.load_mesh moves a mesh to the table; "
            "table=False keeps its file's frame)"
        )
    if face_normal is None:
        raise ValueError("point: is inside the object, where no skin can touch it; give a point on its outer surface")
    hint = "a unit vector, or leave it out"
    outward = face_normal if normal is None else validation.numbers("normal", normal, hint).astype(np.float64)
    if outward.shape != (3,) or not abs(float(np.linalg.norm(outward)) - 1) <= 1e-3:
        raise ValueError(f"normal: {normal} is not a unit vector; divide it by its length, or leave it out")
    return np.asarray(contact_frame(at, outward / np.linalg.norm(outward), roll))


def point_on_ray(mesh: Mesh, origin: Array, direction: Array) -> Float[np.ndarray, "3"] | None:
    """Find the point where a ray first meets a mesh (Moeller and Trumbore, "Fast, minimum storage ray/triangle
    intersection", 1997), such as the point under a mouse.

    Args:
        mesh: The object, in its own frame (m).
        origin: `(3,)` start (m) of the ray.
        direction: `(3,)` direction of the ray, of any length.

    Returns:
        `(3,)` nearest point (m) of the mesh in front of the origin; None if the ray misses it.

    Example:
        point = point_on_ray(mesh, origin=(0.3, 0.2, 0.2), direction=(-3.0, -2.0, -1.5))
    """
    start, along = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    a, b, c = np.moveaxis(np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)], 1, 0)
    edge, other = b - a, c - a
    across = np.cross(along, other)
    determinant = (edge * across).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):  # a face parallel to the ray
        u = ((start - a) * across).sum(1) / determinant
        side = np.cross(start - a, edge)
        v = (side @ along) / determinant
        distance = (other * side).sum(1) / determinant
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return start + distance[met].min() * along if met.any() else None


def _nearest(
    mesh: Mesh, at: Float[np.ndarray, "3"], *, tie: float = 1e-7, step: float = 10e-6
) -> tuple[float, Float[np.ndarray, "3"] | None]:
    """Find the face nearest to a point, and return its distance (m) and its unit normal.

    Of faces whose distances differ by less than `tie` (m), the first one counts whose outside, a `step` (m) along its
    normal, is outside the solid. There is no normal if none is.
    """
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice_area = np.linalg.norm(cross, axis=1)
    solid = twice_area > 2 * 1e-16  # m^2; a smaller face has no accurate normal
    if not solid.any():
        raise ValueError("mesh: no face has an area; give one with a surface")
    corners, cross, twice_area = corners[solid], cross[solid], twice_area[solid]
    closest = trimesh.triangles.closest_point(corners, np.broadcast_to(at, (len(corners), 3)))
    distances = np.linalg.norm(closest - at, axis=1)
    order = np.argsort(distances, kind="stable")
    nearest = float(distances[order[0]])
    for face in order[distances[order] <= nearest + tie]:
        normal = cross[face] / twice_area[face]
        if _winding_number(corners, closest[face] + step * normal) < 0.25:
            return nearest, normal
    return nearest, None


def _winding_number(corners: Float[np.ndarray, "n 3 3"], point: Float[np.ndarray, "3"]) -> float:
    """Count how many times a surface encloses a point, from the solid angles of its faces (van Oosterom and Strackee,
    1983): 0 outside a closed surface with outward normals, 1 or more inside.
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = (a * np.cross(b, c)).sum(1)
    base = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(np.arctan2(volume, base).sum() / (2 * np.pi))
