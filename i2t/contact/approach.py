"""First contact of the flat skin with a surface, along tool z.

The skin's square face moves along its own z axis until it meets the surface. There are two ways to say where, and each
has its use:

  * `first_contact` asks the faces of the mesh. It is exact, at any size of a feature, and has derivatives by the pose:
    a triangle clipped to a square prism is a convex polygon whose corners are either on the triangle's edges (each edge
    clipped as in Liang and Barsky, "A new concept and method for line clipping", 1984) or where a corner line of the
    prism pierces the triangle, and height is linear on it, so its extremes lie at those corners.
  * `facing_surface` asks rays through the middles of the skin's cells. A contact is solved on cells, so what is pressed
    are these heights. Their nearest point lies behind the exact one by as much as the surface falls within half a cell:
    0 on a flat face, at most the slope times half a cell's diagonal elsewhere. A ridge or tip that is narrower than a
    cell may be missed.

`meet` is both: the tool stands where the mesh is met, and the cells see the surface from there; the distance to their
nearest point is carried along (`Patch.nearest`), so that travel and indentation agree.

Frames as in `i2t.types`: surfaces are given in W (an object frame serves as W); lengths in metres. Degenerate faces,
which pad a surface to its size class, are never met.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from i2t.geometry import full_precision, inverse
from i2t.patches.dimensions import PAD_WINDOW, STANDOFF
from i2t.rendering.render import render_patch
from i2t.rendering.tiles import ToolView, place_boxes
from i2t.skin.elasticity import GRID, Grid
from i2t.types import Patch, Surface

MIN_RUN_M = 1e-12  # of an edge along x or y; a shorter one is parallel to the sides of the square
MIN_FORWARD_COSINE = 1e-3  # closer to sideways, the skin's face would meet a surface edge-on


class FirstContact(NamedTuple):
    """End of a motion along tool z, at first contact or where it gave up."""

    T_w_t: Float[Array, "4 4"]  # the tool's pose
    distance: Float[Array, ""]  # m from the site along tool z, negative before it
    hit: Bool[Array, ""]  # whether anything was met


@full_precision
def meet(
    surface: Surface,
    T_w_site: Float[Array, "4 4"],
    *,
    before: float | Float[Array, ""] = STANDOFF,
    beyond: float | Float[Array, ""] = STANDOFF,
    grid: Grid = GRID,
) -> tuple[FirstContact, Patch]:
    """Move the skin along tool z to first contact with the faces of a mesh, and see the surface from there.

    Args:
        surface: In the world.
        T_w_site: The tool's pose at the site.
        before: m before the site where the motion starts; what lies further back is not met.
        beyond: m beyond the site after which nothing was met.
        grid: Cells of the skin.

    Returns:
        The contact, which counts only where a cell sees the surface too, and `facing_surface` from its pose.
    """
    contact = first_contact(surface, T_w_site, before=before, beyond=beyond)
    facing = facing_surface(surface, contact.T_w_t, grid)
    return contact._replace(hit=contact.hit & jnp.isfinite(facing.nearest)), facing


@full_precision
def first_contact(
    surface: Surface,
    T_w_site: Float[Array, "4 4"],
    *,
    before: float | Float[Array, ""] = STANDOFF,
    beyond: float | Float[Array, ""] = STANDOFF,
) -> FirstContact:
    """Move the skin's flat square face along tool z to first contact with the faces of a mesh.

    Args:
        surface: In the world.
        T_w_site: The tool's pose at the site, any place on its way.
        before: m before the site where the motion starts; what lies further back is not met.
        beyond: m beyond the site after which nothing was met.

    Returns:
        The tool at first contact; where nothing is met, at the end of the motion.
    """
    start = T_w_site @ jnp.eye(4).at[2, 3].set(-before)
    T_w_t, hit = move_to_contact(surface, start, start[:3, 2], max_distance=before + beyond)
    # Of the poses as they are rounded, so that distance and pose agree.
    return FirstContact(T_w_t, jnp.linalg.norm(T_w_t[:3, 3] - start[:3, 3]) - before, hit)


def facing_surface(surface: Surface, T_w_t: Float[Array, "4 4"], grid: Grid = GRID) -> Patch:
    """Surface in front of the skin at a pose, as seen by a ray through the middle of each cell.

    Args:
        surface: In the world.
        T_w_t: The tool's pose.
        grid: Cells of the skin.

    Returns:
        Patch over the cells, not clipped: m behind the nearest point, inf where there is no surface.
    """
    return render_patch(surface, T_w_t, window=grid.window, pixels=grid.cells, reach=math.inf)


@full_precision
def move_to_contact(
    surface: Surface,
    start: Float[Array, "4 4"],
    direction: Float[Array, "3"],
    half: float | Float[Array, ""] = PAD_WINDOW / 2,
    max_distance: float | Float[Array, ""] = 2 * STANDOFF,
) -> tuple[Float[Array, "4 4"], Bool[Array, ""]]:
    """Move the skin's flat square face along a line to first contact.

    Args:
        surface: In the world.
        start: T_w_t, clear of the surface; what is behind it is not met.
        direction: Unit vector in the world.
        half: m, half the edge of the face.
        max_distance: m, after which nothing was met.

    Returns:
        T_w_t at contact, and whether there was one. Where nothing is met within `max_distance`, or the face does not
        move forwards (along its own z), that is false and the pose is that at the motion's end.
    """
    # The face meets a point q of the surface after s metres if q - s d lies in the square at z = 0 (tool frame), so
    # s = z / d_z: the shear (x - s d_x, y - s d_y, s) turns any forward direction into the z axis.
    d = start[:3, :3].T @ direction
    forward = d[2] > MIN_FORWARD_COSINE
    ahead = jnp.where(forward, d[2], 1.0)
    shear = jnp.eye(4).at[:3, 2].set(jnp.stack([-d[0] / ahead, -d[1] / ahead, 1 / ahead]))
    distance = nearest_in_square(surface, shear @ inverse(start), half, behind=0.0)
    hit = forward & (distance <= max_distance)
    return start.at[:3, 3].add(jnp.where(hit, distance, max_distance) * direction), hit


def nearest_in_square(
    surface: Surface,
    A_t_w: Float[Array, "4 4"],
    half: float | Float[Array, ""],
    behind: float | Float[Array, ""] = STANDOFF,
) -> Float[Array, ""]:
    """The smallest z of the surface inside the square |x|, |y| <= half, after an affine map. Exact.

    Args:
        surface: In the world.
        A_t_w: The map, from the world.
        half: m, half the edge of the square.
        behind: m, how far behind the origin a surface still counts; may be inf.

    Returns:
        z (m); +inf where the square holds no surface.
    """
    behind = jnp.asarray(behind, A_t_w.dtype)
    return _nearest(jax.tree.map(jnp.asarray, surface), A_t_w, jnp.asarray(half, A_t_w.dtype), behind)


def lowest_in_square(
    corners: Float[Array, "3 3 faces"],
    A_t_w: Float[Array, "4 4"],
    half: float | Float[Array, ""],
    behind: float | Float[Array, ""] = STANDOFF,
) -> Float[Array, " faces"]:
    """The smallest z of each triangle inside the square, as of `nearest_in_square`, without derivatives.

    Args:
        corners: Coordinates x, y and z (m) of the first, second and third corners in the world, of triangles that have
            an area: rounding may make one that has none cover the square. A long last axis is a fast one.
        A_t_w: The map, from the world.
        half: m, half the edge of the square.
        behind: m, how far behind the origin a triangle still counts; may be inf.

    Returns:
        z (m); +inf for those of which the square holds nothing.
    """
    x, y, z = corners
    # Written out, as a matrix product may round to fewer digits on an accelerator.
    u, v, w = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in A_t_w[:3])
    low, high = _height_range(u, v, w, half)
    return jnp.where((low <= high) & (high >= -behind), jnp.maximum(low, -behind), jnp.inf)


def first_smallest(values: Float[Array, " n"]) -> Int[Array, ""]:
    """Number of the first of the smallest values, as of `argmin`, which takes a CPU five times as long.

    Args:
        values: None of which is NaN.

    Returns:
        Its number.
    """
    last = len(values) - 1
    return jnp.min(jnp.where(values <= jnp.min(values), jnp.arange(len(values)), last))


@jax.custom_jvp
def _nearest(surface: Surface, A_t_w: Array, half: Array, behind: Array) -> Float[Array, ""]:
    return _nearest_face(surface, A_t_w, half, behind)[0]


@_nearest.defjvp
@full_precision
def _nearest_jvp(at: tuple[Any, ...], along: tuple[Any, ...]) -> tuple[Array, Array]:
    """Only the face that is nearest moves the minimum, with its lowest point in the square. Written out: traced, a
    derivative through the clipping of an edge takes a compiler eight times as long.
    """
    (surface, A_t_w, half, behind), (d_surface, d_A_t_w, d_half, d_behind) = at, along
    low, face = _nearest_face(surface, A_t_w, half, behind)
    corners, d_corners = surface.triangles[face], d_surface.triangles[face]
    moved = d_corners @ A_t_w[:3, :3].T + corners @ d_A_t_w[:3, :3].T + d_A_t_w[:3, 3][None]
    change = _change_of_lowest(corners @ A_t_w[:3, :3].T + A_t_w[:3, 3][None], moved, half, d_half)
    change = jnp.where(low > -behind, change, -d_behind)
    return low, jnp.where(low < jnp.inf, change, 0.0)


def _nearest_face(
    surface: Surface, A_t_w: Array, half: Array, behind: Array
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Smallest z of a surface inside the square, and the first face that has it.

    The groups of a prepared surface whose boxes meet the square are visited from the front, until the next one begins
    behind the nearest face.
    """
    groups = 1 if surface.boxes is None else len(surface.boxes)
    triangles = surface.triangles.reshape(groups, -1, 3, 3)
    corners, has_area = jnp.moveaxis(triangles, (2, 3), (2, 1)), jax.vmap(double_areas)(triangles) > 0

    def nearest_of(group: Array | int) -> tuple[Array, Array]:
        low = jnp.where(has_area[group], lowest_in_square(corners[group], A_t_w, half, behind), jnp.inf)
        return jnp.min(low), group * low.size + first_smallest(low)

    if surface.groups is None:
        return nearest_of(0)
    box = surface.groups[:, :groups]
    centre, extent = place_boxes(box, ToolView(A_t_w[:3, :3], jnp.zeros(3), A_t_w[:3, 3]))
    met = (jnp.abs(centre[0]) - extent[0] <= half) & (jnp.abs(centre[1]) - extent[1] <= half)
    fronts = jnp.where(met & (centre[2] + extent[2] >= -behind), centre[2] - extent[2], jnp.inf)

    def may_be_nearer(state: tuple[Array, Array, Array]) -> Array:
        front = jnp.min(state[0])
        return (front <= state[1]) & (front < jnp.inf)

    def visit(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        fronts, nearest, face = state
        group = first_smallest(fronts)
        low, its_face = nearest_of(group)
        nearer = (low < nearest) | ((low == nearest) & (its_face < face))
        fronts = jnp.where(jnp.arange(groups) == group, jnp.inf, fronts)
        return fronts, jnp.where(nearer, low, nearest), jnp.where(nearer, its_face, face)

    nothing = jnp.full_like(fronts[0], jnp.inf), jnp.zeros((), int)
    return jax.lax.while_loop(may_be_nearer, visit, (fronts, *nothing))[1:]


def _change_of_lowest(
    corners: Float[Array, "3 3"], moved: Float[Array, "3 3"], half: Array, d_half: Array
) -> Float[Array, ""]:
    """Rate of change of the smallest z of a triangle inside the square, where its corners move.

    A lowest point is a corner of the triangle, which takes it along; or it lies where an edge crosses a side of the
    square, or under a corner of the square, and slides on the edge or on the triangle. Several lowest points of one
    height count equally.
    """
    share, slope, there = _vertices(corners, half)
    height = jnp.where(there, share @ corners[:, 2], jnp.inf)
    lowest = there & (height <= jnp.min(height))
    aside, up = share @ moved[:, :2], share @ moved[:, 2]
    held = jnp.sign(share @ corners[:, :2]) * d_half  # sides move outwards
    change = up - jnp.sum(slope * (aside - held), axis=1)
    return jnp.sum(jnp.where(lowest, change, 0)) / jnp.maximum(jnp.sum(lowest), 1)


def _vertices(
    corners: Float[Array, "3 3"], half: Array
) -> tuple[Float[Array, "10 3"], Float[Array, "10 2"], Bool[Array, " 10"]]:
    """The ends of the clipped edges, then the square's corners: each one's weights of the triangle's corners, the
    change of its height with a side of the square that holds it, and whether it is a vertex of the clipped triangle.
    """
    run = jnp.roll(corners, -1, axis=0) - corners
    inverse = 1 / jnp.where(jnp.abs(run[:, :2]) < MIN_RUN_M, MIN_RUN_M, run[:, :2])
    crossings = (half * jnp.array([-1.0, 1.0])[:, None, None] - corners[None, :, :2]) * inverse[None]
    # What ends an edge: its own corner, a side across x, or one across y.
    begins = jnp.concatenate([jnp.zeros((3, 1)), jnp.min(crossings, axis=0)], axis=1)
    ends = jnp.concatenate([jnp.ones((3, 1)), jnp.max(crossings, axis=0)], axis=1)
    t = jnp.concatenate([jnp.max(begins, axis=1), jnp.min(ends, axis=1)])
    by = jnp.concatenate([jnp.argmax(begins, axis=1), jnp.argmin(ends, axis=1)])
    first = jnp.tile(jnp.eye(3), (2, 1))
    on_edge = (1 - t)[:, None] * first + t[:, None] * jnp.roll(first, 1, axis=1)
    steep = jnp.tile(run[:, 2:] * inverse, (2, 1)) * (by[:, None] == jnp.array([[1, 2]]))
    crossed = jnp.tile(t[:3] <= t[3:], 2)

    side = half * jnp.array([[-1.0, -1], [-1, 1], [1, -1], [1, 1]])
    away = corners[None, :, :2] - side[:, None]  # (4, 3, 2)
    following = jnp.roll(away, -1, axis=1)
    areas = jnp.roll(away[..., 0] * following[..., 1] - away[..., 1] * following[..., 0], -1, axis=1)
    inside = (jnp.min(areas, axis=1) >= 0) | (jnp.max(areas, axis=1) <= 0)
    total = jnp.sum(areas, axis=1)
    inside &= total != 0
    normal = _cross(corners[None])[0]
    tilt = -normal[:2] / jnp.where(normal[2] == 0, 1, normal[2])
    under = areas / jnp.where(inside, total, 1)[:, None]
    return (
        jnp.concatenate([on_edge, under]),
        jnp.concatenate([steep, jnp.tile(tilt, (4, 1))]),
        jnp.concatenate([crossed, inside]),
    )


def double_areas(triangles: Float[Array, "faces 3 3"]) -> Float[Array, " faces"]:
    """Twice the area of each face.

    Args:
        triangles: m.

    Returns:
        m^2.
    """
    return jnp.linalg.norm(_cross(triangles), axis=-1)


def _cross(triangles: Float[Array, "faces 3 3"]) -> Float[Array, "faces 3"]:
    return jnp.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _height_range(
    x: Float[Array, "3 faces"], y: Float[Array, "3 faces"], z: Float[Array, "3 faces"], half: float | Array
) -> tuple[Float[Array, " faces"], Float[Array, " faces"]]:
    """Smallest and largest z of each triangle inside the square |x|, |y| <= half; (+inf, -inf) where it misses it."""
    low = jnp.full(x.shape[1], jnp.inf)
    high = -low
    for i, j in ((0, 1), (1, 2), (2, 0)):  # edges, clipped to the part from t0 to t1 that lies in the square
        t0, t1 = jnp.zeros_like(low), jnp.ones_like(low)
        for p in (x, y):
            run = p[j] - p[i]
            inverse = 1 / jnp.where(jnp.abs(run) < MIN_RUN_M, MIN_RUN_M, run)  # parallel: ends fly off to their side
            to_low, to_high = (-half - p[i]) * inverse, (half - p[i]) * inverse
            t0 = jnp.maximum(t0, jnp.minimum(to_low, to_high))
            t1 = jnp.minimum(t1, jnp.maximum(to_low, to_high))
        z0, z1 = z[i] + t0 * (z[j] - z[i]), z[i] + t1 * (z[j] - z[i])
        low = jnp.where(t0 <= t1, jnp.minimum(low, jnp.minimum(z0, z1)), low)
        high = jnp.where(t0 <= t1, jnp.maximum(high, jnp.maximum(z0, z1)), high)
    for u, v in ((-half, -half), (-half, half), (half, -half), (half, half)):  # corners of the square in the triangle
        a, b, c = ((x[i] - u) * (y[j] - v) - (y[i] - v) * (x[j] - u) for i, j in ((1, 2), (2, 0), (0, 1)))
        total = a + b + c
        inside = ((jnp.minimum(jnp.minimum(a, b), c) >= 0) | (jnp.maximum(jnp.maximum(a, b), c) <= 0)) & (total != 0)
        height = (a * z[0] + b * z[1] + c * z[2]) / jnp.where(inside, total, 1)
        low = jnp.where(inside, jnp.minimum(low, height), low)
        high = jnp.where(inside, jnp.maximum(high, height), high)
    return low, high
