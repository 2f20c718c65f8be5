"""Touch sites of an object, and the contact of a touch.

Sites are drawn uniformly over a surface's area and given contact frames; three checks of the paper's collection
procedure say which are safe: the normal is not too far from up, nothing rises above the contact plane inside the
sensor's square, and the flange stays above the table. `press_along` moves the flat face of the skin along a straight
line until it meets the surface.

Both depend on the lowest point of the surface inside a square, which is found exactly instead of on a
pixel grid: a triangle clipped to a square prism is a convex polygon whose corners are either on the triangle's edges
(each edge clipped as in Liang and Barsky, "A new concept and method for line clipping", 1984) or where a corner line
of the prism pierces the triangle, and height is linear on it, so its extremes lie at those corners.

Frames as in `i2t.types`: the surface is given in W (an object frame serves as W while the object stands where it was
made); lengths in metres. Degenerate faces, which pad a surface to its size class, are never drawn and never met.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from i2t import validation
from i2t.geometry import contact_frame, full_precision, inverse
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import PAD_WINDOW, STANDOFF
from i2t.rendering.render import prepare_surface
from i2t.rendering.tiles import ToolView, place_boxes
from i2t.runtime.compiling import jit_quickly, traced_floats
from i2t.simulation.site_limits import SiteLimits
from i2t.types import Surface, in_one_line

MIN_RUN_M = 1e-12  # of an edge along x or y; a shorter one is parallel to the sides of the square
CHECKED_AT_A_TIME = 64  # sites, at most: more take more memory
MIN_FORWARD_COSINE = 1e-3  # cosine; closer to sideways, the skin's face would meet a surface edge-on

traced_floats(SiteLimits)  # here, as its own module is without JAX
COLLECTION_LIMITS = SiteLimits()
RECOGNITION_LIMITS = SiteLimits(min_cos=0.5)


@in_one_line
class Sites(NamedTuple):
    """Places to touch, and which of them passed the checks."""

    T_w_t: Float[Array, "n 4 4"]  # contact frames
    safe: Bool[Array, " n"]


@in_one_line
class TouchSites(NamedTuple):
    """Safe sites of one object, in its frame."""

    T_o_t: Float[np.ndarray, "n 4 4"]  # pose of the tool at contact: its z points into the object
    points: Float[np.ndarray, "n 3"]  # m, the tool's origin on the surface
    normals: Float[np.ndarray, "n 3"]  # outward, unit


def sample_points(
    key: Key[Array, ""], surface: Surface, n: int, wanted: Bool[Array, " faces"] | None = None
) -> tuple[Float[Array, "{n} 3"], Float[Array, "{n} 3"]]:
    """Draw points uniformly over the area of a surface.

    Args:
        key: Random key.
        surface: To draw from.
        n: Number of points.
        wanted: Faces to draw from; by default all.

    Returns:
        Points (m) and their outward unit normals; NaN where no face is wanted.
    """
    key_face, key_place = jax.random.split(key)
    triangles = jnp.asarray(surface.triangles)
    area = double_areas(triangles)
    weight = area if wanted is None else jnp.where(wanted, area, 0)
    total = jnp.cumsum(weight)
    drawn = jnp.searchsorted(total, jax.random.uniform(key_face, (n,)) * total[-1], side="right")
    # Sums in float32 may still grow in their last digit across empty faces: step back to the last face that has weight.
    full = jax.lax.cummax(jnp.where(weight > 0, jnp.arange(len(weight)), -1))
    face = full[jnp.minimum(drawn, len(weight) - 1)]
    face = jnp.where(face < 0, jnp.argmax(weight > 0), face)
    nothing = jnp.where(total[-1] > 0, 0.0, jnp.nan)
    u, v = jax.random.uniform(key_place, (2, n, 1))
    root = jnp.sqrt(u)  # uniform in a triangle: Osada et al., "Shape distributions", 2002
    a, b, c = jnp.moveaxis(triangles[face], 1, 0)
    points = (1 - root) * a + root * (1 - v) * b + root * v * c
    return points + nothing, face_normals(surface)[face] + nothing


def face_normals(surface: Surface) -> Float[Array, "faces 3"]:
    """Outward unit normals of the faces.

    Args:
        surface: With its triangles.

    Returns:
        Normals; zero for degenerate faces.
    """
    cross = _cross(jnp.asarray(surface.triangles))
    norm = jnp.linalg.norm(cross, axis=-1, keepdims=True)
    return cross / jnp.where(norm > 0, norm, 1)


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


@full_precision
def press_along(
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


def is_upward(T_w_t: Float[Array, "4 4"], limits: SiteLimits) -> Bool[Array, ""]:
    """First check: the surface's normal (minus tool z) is not too far from up.

    Args:
        T_w_t: Pose of the tool at the site.
        limits: Of the angle.

    Returns:
        Whether it holds.
    """
    return -T_w_t[2, 2] > limits.min_cos


def is_unoccluded(surface: Surface, T_w_t: Float[Array, "4 4"], limits: SiteLimits) -> Bool[Array, ""]:
    """Second check: no surface is more than `max_rise` above the contact plane inside the sensor's square.

    Args:
        surface: In the world.
        T_w_t: Pose of the tool at the site.
        limits: Of the rise.

    Returns:
        Whether it holds.
    """
    return nearest_in_square(surface, inverse(T_w_t), limits.half, behind=jnp.inf) >= -limits.max_rise


def is_above_table(T_w_t: Float[Any, "4 4"], limits: SiteLimits) -> Bool[Any, ""]:
    """Third check: the boxes of mount and flange keep their clearance above the table.

    Args:
        T_w_t: Pose of the tool at the site; a NumPy array is checked by NumPy, without a compiler.
        limits: The boxes and their clearance.

    Returns:
        Whether it holds.
    """
    boxes = ((limits.mount, 0.0, limits.flange_near), (limits.flange, limits.flange_near, limits.flange_far))
    lowest = [
        T_w_t[2, 3]
        - T_w_t[2, 2] * 0.5 * (near + far)
        - 0.5 * (abs(T_w_t[2, :2]).sum() * edge + abs(T_w_t[2, 2]) * (far - near))
        for edge, near, far in boxes
    ]
    least = limits.table + limits.clearance
    return (lowest[0] >= least) & (lowest[1] >= least)


def is_safe(surface: Surface, T_w_t: Float[Array, "4 4"], limits: SiteLimits) -> Bool[Array, ""]:
    """All three checks.

    Args:
        surface: In the world.
        T_w_t: Pose of the tool at the site.
        limits: Of the checks.

    Returns:
        Whether all hold.
    """
    return is_upward(T_w_t, limits) & is_unoccluded(surface, T_w_t, limits) & is_above_table(T_w_t, limits)


def sample_sites(
    key: Key[Array, ""],
    surface: Surface,
    n: int,
    limits: SiteLimits = COLLECTION_LIMITS,
    oversample: int = 8,
    obstacles: Surface | None = None,
) -> Sites:
    """Draw sites uniformly over the safe part of a surface, each turned about its normal by a uniformly random angle.

    The first n safe ones of `oversample` n candidates are returned; where there are fewer, poses of NaN fill up, to
    which no arm goes.

    Args:
        key: Random key.
        surface: In the world.
        n: Number of sites; static.
        limits: Of what is safe.
        oversample: Candidates for each site; static.
        obstacles: What else stands there in the world, and is not to be touched.

    Returns:
        The sites, with a mask of the safe ones, which come first.
    """
    key_points, key_spin = jax.random.split(key)
    # Faces that look away fail the first check, so leaving them out changes nothing but the yield.
    wanted = face_normals(surface)[:, 2] > limits.min_cos
    points, normals = sample_points(key_points, surface, oversample * n, wanted)
    spins = jax.random.uniform(key_spin, (oversample * n,), maxval=2 * jnp.pi)
    frames = jax.vmap(contact_frame)(points, normals, spins)
    plausible = jax.vmap(lambda T_w_t: is_upward(T_w_t, limits) & is_above_table(T_w_t, limits))(frames)
    order = jnp.argsort(~plausible, stable=True)
    free = _first_free(surface, frames[order], jnp.sum(plausible), n, limits=limits, obstacles=obstacles)
    rank = jnp.argsort(~free, stable=True)[:n]
    return Sites(jnp.where(free[rank][:, None, None], frames[order[rank]], jnp.nan), free[rank])


def _first_free(
    surface: Surface,
    frames: Float[Array, "m 4 4"],
    count: Int[Array, ""],
    n: int,
    *,
    limits: SiteLimits,
    obstacles: Surface | None,
) -> Bool[Array, " m"]:
    """Which of the first `count` frames are unoccluded, the dear check, until n are; frames after those stay false."""
    batch = min(n, CHECKED_AT_A_TIME)

    def is_free(T_w_t: Float[Array, "4 4"]) -> Bool[Array, ""]:
        free = is_unoccluded(surface, T_w_t, limits)
        return free if obstacles is None else free & is_unoccluded(obstacles, T_w_t, limits)

    def too_few(state: tuple[Array, Array]) -> Bool[Array, ""]:
        start, free = state
        return (start < count) & (jnp.sum(free) < n)

    def check(state: tuple[Array, Array]) -> tuple[Array, Array]:
        start, free = state
        rows = jnp.minimum(start + jnp.arange(batch), len(frames) - 1)
        return start + batch, free.at[rows].set(jax.vmap(is_free)(frames[rows]) & (rows < count))

    return jax.lax.while_loop(too_few, check, (jnp.int32(0), jnp.zeros(len(frames), bool)))[1]


_draw_sites = jit_quickly(sample_sites, static_argnames="n")


def collect_sites(
    key: Key[Array, ""],
    surface: Surface,
    n: int,
    limits: SiteLimits = COLLECTION_LIMITS,
    name: str = "the object",
    rounds: int = 8,
    obstacles: Surface | None = None,
) -> Float[np.ndarray, "{n} 4 4"]:
    """Draw safe sites in several rounds; for the host, so it compiles what it draws.

    Args:
        key: Random key.
        surface: In the world.
        n: Number of sites.
        limits: Of what is safe.
        name: Of the object, for the message.
        rounds: After which too few is an error.
        obstacles: What else stands there in the world, and is not to be touched.

    Returns:
        T_w_t of the sites.

    Raises:
        ValueError: The object has too few safe sites.
    """
    found: list[np.ndarray] = []
    count = 0
    for step in range(rounds):
        sites = _draw_sites(jax.random.fold_in(key, step), surface, n=n, limits=limits, obstacles=obstacles)
        found.append(np.asarray(sites.T_w_t)[np.asarray(sites.safe)])
        count += len(found[-1])
        if count >= n:
            return np.concatenate(found)[:n]
    raise ValueError(
        f"{name} has too few safe sites: {count} of {n} found; lower min_cos or the flange's size, or raise max_rise"
    )


def sample_touch_sites(
    mesh: Mesh | Surface, n: int, *, seed: int = 0, limits: SiteLimits = COLLECTION_LIMITS, name: str = "the object"
) -> TouchSites:
    """Touch sites of an object: n random safe ones with the tool's contact poses.

    Sites are uniform over the safe part of the surface, each turned about its normal by a random angle; the object
    stands as it was made, with z up on a table at `limits.table`.

    Args:
        mesh: of the object, or its prepared surface.
        n: number of sites, at least 1.
        seed: the same seed gives the same sites.
        limits: what makes a site safe.
        name: of the object, for the message of an error.

    Returns:
        Poses, points and normals of n sites.

    Raises:
        ValueError: the object has too few safe sites, or `n` is below 1.
        TypeError: `n` or the seed is no whole number.

    Example:
        from i2t import make_object, sample_touch_sites

        sites = sample_touch_sites(make_object("star").mesh, 20)
        patch = render_patch(surface, sites.T_o_t[0])
    """
    n, seed = validation.count("n", n), validation.count("seed", seed, least=0)
    surface = mesh if isinstance(mesh, Surface) else prepare_surface(mesh)
    T_o_t = np.asarray(collect_sites(jax.random.key(seed), surface, n, limits, name))
    return TouchSites(T_o_t, T_o_t[:, :3, 3], -T_o_t[:, :3, 2])


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
