"""Draw touch sites on an object.

Sites are drawn uniformly over the area of a surface and have contact frames. Three checks of the paper's collection
procedure decide which sites are safe: the normal is close enough to up, nothing rises above the contact plane inside
the sensor's square (`i2t.contact.approach.nearest_in_square`), and the flange stays above the table.

Frames as in `i2t.types`: the surface is given in W, or in the object frame as long as the object stands as it was made.
Lengths are in metres. Degenerate faces, which pad a surface to its size class, are never drawn.
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

traced_floats(SiteLimits)  # here, because its own module does not import JAX
COLLECTION_LIMITS = SiteLimits()  # limits of safe sites for collections of touches: normals within 76 degrees of up
RECOGNITION_LIMITS = SiteLimits(min_cos=0.5)  # limits of safe sites for recognition: normals within 60 degrees of up


@in_one_line
class Sites(NamedTuple):
    """n touch sites, as tool poses in the world, and whether each passed the safety checks; other poses are NaN."""

    T_w_t: Float[Array, "n 4 4"]  # (4, 4) contact frames in W, m
    safe: Bool[Array, " n"]


@in_one_line
class TouchSites(NamedTuple):
    """n safe touch sites on an object, in its frame: tool poses, points (m) and outward unit normals."""

    T_o_t: Float[np.ndarray, "n 4 4"]  # pose of the tool at contact, whose z points into the object
    points: Float[np.ndarray, "n 3"]  # m, origin of the tool on the surface
    normals: Float[np.ndarray, "n 3"]  # outward unit normals


def sample_points(
    key: Key[Array, ""], surface: Surface, n: int, wanted: Bool[Array, " faces"] | None = None
) -> tuple[Float[Array, "{n} 3"], Float[Array, "{n} 3"]]:
    """Draw points uniformly over the area of a surface.

    Args:
        key: Random key.
        surface: The surface.
        n: Number of points.
        wanted: Mask of the faces to draw from, by default all.

    Returns:
        `(n, 3)` points (m) and their outward unit normals; NaN if no face is wanted.
    """
    key_face, key_place = jax.random.split(key)
    triangles = jnp.asarray(surface.triangles)
    area = double_areas(triangles)
    weight = area if wanted is None else jnp.where(wanted, area, 0)
    total = jnp.cumsum(weight)
    drawn = jnp.searchsorted(total, jax.random.uniform(key_face, (n,)) * total[-1], side="right")
    # Sums in float32 may grow in their last digit across empty faces, so step back to the last face with a weight.
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
    """Compute the outward unit normals of the faces.

    Args:
        surface: The surface.

    Returns:
        `(faces, 3)` normals; zero for degenerate faces.
    """
    a, b, c = jnp.moveaxis(jnp.asarray(surface.triangles), 1, 0)
    cross = jnp.cross(b - a, c - a)
    norm = jnp.linalg.norm(cross, axis=-1, keepdims=True)
    return cross / jnp.where(norm > 0, norm, 1)


def is_upward(T_w_t: Float[Any, "4 4"], limits: SiteLimits) -> Bool[Any, ""]:
    """Check that the surface's normal (minus tool z) is close enough to up.

    Args:
        T_w_t: Pose of the tool at the site.
        limits: Limits of a safe site.

    Returns:
        Whether the angle is within its limit.
    """
    return -T_w_t[2, 2] > limits.min_cos


def is_unoccluded(surface: Surface, T_w_t: Float[Array, "4 4"], limits: SiteLimits) -> Bool[Array, ""]:
    """Check that no surface is more than `max_rise` above the contact plane inside the sensor's square.

    Args:
        surface: Surface in the world.
        T_w_t: Pose of the tool at the site.
        limits: Limits of a safe site.

    Returns:
        Whether the rise is within its limit.
    """
    return nearest_in_square(surface, inverse(T_w_t), limits.half_edge, behind=jnp.inf) >= -limits.max_rise


def is_above_table(T_w_t: Float[Any, "4 4"], limits: SiteLimits) -> Bool[Any, ""]:
    """Check that the boxes of mount and flange keep their clearance above the table.

    Args:
        T_w_t: Pose of the tool at the site. A NumPy array is checked by NumPy, without compilation.
        limits: Limits of a safe site, with the boxes.

    Returns:
        Whether both boxes keep the clearance.
    """
    boxes = ((limits.mount, 0.0, limits.flange_near), (limits.flange, limits.flange_near, limits.flange_far))
    bottoms = [
        T_w_t[2, 3]
        - T_w_t[2, 2] * 0.5 * (near + far)
        - 0.5 * (abs(T_w_t[2, :2]).sum() * edge + abs(T_w_t[2, 2]) * (far - near))
        for edge, near, far in boxes
    ]
    lowest = limits.table + limits.clearance
    return (bottoms[0] >= lowest) & (bottoms[1] >= lowest)


def is_safe(surface: Surface, T_w_t: Float[Array, "4 4"], limits: SiteLimits) -> Bool[Array, ""]:
    """Check that a site is safe: upward enough, unoccluded, and clear of the table.

    Args:
        surface: Surface in the world.
        T_w_t: Pose of the tool at the site.
        limits: Limits of a safe site.

    Returns:
        Whether the site passes all checks.
    """
    return is_upward(T_w_t, limits) & is_unoccluded(surface, T_w_t, limits) & is_above_table(T_w_t, limits)


_is_unoccluded = jit_quickly(is_unoccluded)


def explain_unsafe(surface: Surface, T_w_t: Float[Any, "4 4"], limits: SiteLimits = COLLECTION_LIMITS) -> str:
    """Explain why an arm would not touch a site.

    Args:
        surface: Surface in the world.
        T_w_t: Pose of the tool at the site.
        limits: Limits of a safe site.

    Returns:
        The reasons, as one phrase after "the site is unsafe: "; empty if the site is safe.
    """
    angle, most = (np.degrees(np.arccos(np.clip(cosine, -1, 1))) for cosine in (-T_w_t[2, 2], limits.min_cos))
    checks = (
        (is_upward(T_w_t, limits), f"its normal is {angle:.0f} degrees from up, and {most:.0f} are allowed"),
        (
            _is_unoccluded(surface, jnp.asarray(T_w_t, jnp.float32), limits),
            f"the object rises more than {1e3 * limits.max_rise:g} mm above it next to the skin",
        ),
        (is_above_table(T_w_t, limits), "the mount or the flange would meet the table"),
    )
    return "; ".join(reason for passed, reason in checks if not passed)


def sample_sites(
    key: Key[Array, ""],
    surface: Surface,
    n: int,
    limits: SiteLimits = COLLECTION_LIMITS,
    oversample: int = 8,
    obstacles: Surface | None = None,
) -> Sites:
    """Draw sites uniformly over the safe part of a surface, each turned about its normal by a uniformly random angle.

    The first n safe sites of `oversample` n candidates are returned. If there are fewer, the remaining poses are NaN,
    so that no arm can move there.

    Args:
        key: Random key.
        surface: Surface in the world.
        n: Number of sites; static.
        limits: Limits of a safe site.
        oversample: Number of candidates for each site; static.
        obstacles: Surfaces of other objects in the world, which must not be touched.

    Returns:
        The sites with a mask of the safe ones, which come first.
    """
    key_points, key_spin = jax.random.split(key)
    # Faces that point away fail the first check, so leaving them out only raises the number of safe candidates.
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
    batch_size: int = 64,
) -> Bool[Array, " m"]:
    """Test in batches which of the first `count` frames are unoccluded, until n are; later frames stay false.

    This check is expensive, and larger batches need more memory.
    """
    batch = min(n, batch_size)

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
    enough: int | None = None,
) -> Float[np.ndarray, "sites 4 4"]:
    """Draw safe sites in several rounds. This function runs on the host and calls a compiled one in each round.

    Args:
        key: Random key.
        surface: Surface in the world.
        n: Number of sites.
        limits: Limits of a safe site.
        name: Name of the object in messages.
        rounds: Number of rounds after which too few sites are an error.
        obstacles: Surfaces of other objects in the world, which must not be touched.
        enough: Number of sites that suffices if the object has fewer than n; by default n.

    Returns:
        `(n, 4, 4)` poses T_w_t of the tool at the sites, or fewer if fewer suffice.

    Raises:
        ValueError: The object has too few safe sites.
    """
    safe: list[np.ndarray] = []
    count = 0
    for step in range(rounds):
        sites = _draw_sites(jax.random.fold_in(key, step), surface, n=n, limits=limits, obstacles=obstacles)
        safe.append(np.asarray(sites.T_w_t)[np.asarray(sites.safe)])
        count += len(safe[-1])
        if count >= n:
            return np.concatenate(safe)[:n]
    if enough is not None and count >= enough:
        return np.concatenate(safe)
    raise ValueError(
        f"{name} has too few safe sites: {count} of {enough or n} found; lower min_cos or the flange's size, or raise "
        "max_rise"
    )


def sample_touch_sites(
    mesh: Mesh | Surface, n: int, *, seed: int = 0, limits: SiteLimits = COLLECTION_LIMITS, name: str = "the object"
) -> TouchSites:
    """Draw safe touch sites of an object at random, with the contact poses of the tool.

    Sites are uniform over the safe part of the surface, each turned about its normal by a random angle. The object
    stands as it was made, with z up on a table at `limits.table`.

    Args:
        mesh: Mesh of the object, or its prepared surface.
        n: Number of sites, at least 1.
        seed: Seed of the random numbers.
        limits: Limits of a safe site.
        name: Name of the object in error messages.

    Returns:
        Poses, points and normals of n sites.

    Raises:
        ValueError: The object has too few safe sites, or `n` is below 1.
        TypeError: `n` or the seed is not an integer.

    Example:
        from i2t import make_object, sample_touch_sites

        sites = sample_touch_sites(make_object("star").mesh, 20)
        patch = render_patch(surface, sites.T_o_t[0])
    """
    n, seed = validation.count("n", n), validation.count("seed", seed, minimum=0)
    surface = mesh if isinstance(mesh, Surface) else prepare_surface(mesh)
    T_o_t = np.asarray(collect_sites(jax.random.key(seed), surface, n, limits, name))
    return TouchSites(T_o_t, T_o_t[:, :3, 3], -T_o_t[:, :3, 2])
