"""Touch sites of an object.

Sites are drawn uniformly over a surface's area and given contact frames; three checks of the paper's collection
procedure say which are safe: the normal is not too far from up, nothing rises above the contact plane inside the
sensor's square (`i2t.contact.approach.nearest_in_square`), and the flange stays above the table.

Frames as in `i2t.types`: the surface is given in W (an object frame serves as W while the object stands where it was
made); lengths in metres. Degenerate faces, which pad a surface to its size class, are never drawn.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from i2t import validation
from i2t.contact.approach import double_areas, nearest_in_square
from i2t.geometry import contact_frame, inverse
from i2t.objects.solids import Mesh
from i2t.rendering.render import prepare_surface
from i2t.runtime.compiling import jit_quickly, traced_floats
from i2t.simulation.site_limits import SiteLimits
from i2t.types import Surface, in_one_line

CHECKED_AT_A_TIME = 64  # sites, at most: more take more memory

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
    a, b, c = jnp.moveaxis(jnp.asarray(surface.triangles), 1, 0)
    cross = jnp.cross(b - a, c - a)
    norm = jnp.linalg.norm(cross, axis=-1, keepdims=True)
    return cross / jnp.where(norm > 0, norm, 1)


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
