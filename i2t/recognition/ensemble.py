"""Recognition as in the paper: every touch is a weak model of which object is there, and touches vote.

For touch i and possible object o the distance d_io = ||tau_i - tau~_io|| separates the standardised reading from the
one imagined at the same pose on o (or, for the proprioception baseline, the contact point from the nearest point of o's
model: `nearest_distance`). exp(-d_io) is the paper's likelihood. Three ways make one belief of all touches so far: the
share of touches that each object wins (the paper's), the mean of the touches' normalised likelihoods, and their product
(in the published code).

The place of the next touch is drawn on the object believed in, by the heuristic that the paper leaves out and the
published code (github.com/ayadabdalla/imagine2touch) shows: where the other objects' nearest points face elsewhere, but
not too far elsewhere.

Arrays hold touches in rows and objects in columns; beliefs come after each touch and sum to 1.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.types import Surface

ALIKE = 0.2  # least cosine between a point's normal and those of its nearest points on other objects
DIFFERENT = 0.65  # largest mean of those cosines: 1.3 for the paper's two other objects


def distances(
    readings: Float[Array, "n 15"],
    imagined: Float[Array, "n objects 15"],
    mean: Float[Array, "15"],
    std: Float[Array, "15"],
) -> Float[Array, "n objects"]:
    """Between readings and imagined readings (uT), standardised by the mean and standard deviation of training data."""
    return jnp.linalg.norm((readings[:, None] - imagined) / std[None, None], axis=-1)


def votes(distance: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    """Share of the touches so far whose nearest object each is; equally near ones share a vote."""
    nearest = distance == jnp.min(distance, axis=1, keepdims=True)
    return _so_far(nearest / jnp.sum(nearest, axis=1, keepdims=True))


def average(distance: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    """Mean of the normalised likelihoods of the touches so far."""
    return _so_far(jax.nn.softmax(-distance, axis=1))


def product(distance: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    """Normalised product of the likelihoods of the touches so far."""
    return jax.nn.softmax(-jnp.cumsum(distance, axis=0), axis=1)


def _so_far(each: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    touch = jnp.arange(1, len(each) + 1)
    return jnp.cumsum(each, axis=0) / touch[:, None]


def hypothesis(key: Key[Array, ""], belief: Float[Array, " objects"], touches: Int[Array, ""] | int) -> Int[Array, ""]:
    """The object to tell from the others next: any before the first touch, the most believed one after it."""
    any_one = jax.random.randint(key, (), 0, len(belief))
    return jnp.where(touches == 0, any_one, jnp.argmax(belief))


def telling(
    points: Float[Array, "objects m 3"],
    normals: Float[Array, "objects m 3"],
    safe: Bool[Array, "objects m"],
    believed: Int[Array, ""] | int,
) -> Float[Array, " m"]:
    """Probabilities of the m points of the object believed in to be touched next.

    A point with normal n competes with the nearest safe point of every other object, with normal n_j. It qualifies if
    it is safe, every n.n_j > ALIKE, and the sum of -n.n_j lies between -DIFFERENT times the number of others and 0; its
    probability is proportional to that sum less the least of those that qualify. Where none does or all are equal,
    those that qualify, or else all safe ones, are equally probable; NaN if none is safe.
    """
    here, facing = points[believed], normals[believed]
    apart = jnp.sum((here[None, :, None] - points[:, None]) ** 2, axis=-1)
    nearest = jnp.argmin(jnp.where(safe[:, None], apart, jnp.inf), axis=-1)
    cosines = jnp.sum(facing[None] * jnp.take_along_axis(normals, nearest[..., None], axis=1), axis=-1)
    other = (jnp.arange(len(points)) != believed)[:, None]
    score = -jnp.sum(jnp.where(other, cosines, 0), axis=0)
    fits = safe[believed] & jnp.all(~other | (cosines > ALIKE), axis=0)
    fits = fits & (score > -DIFFERENT * (len(points) - 1)) & (score < 0)
    weight = jnp.where(fits, score - jnp.min(jnp.where(fits, score, jnp.inf)), 0)
    equally = jnp.where(jnp.any(fits), fits, safe[believed]).astype(weight.dtype)
    weight = jnp.where(jnp.sum(weight) > 0, weight, equally)
    return weight / jnp.sum(weight)


def nearest_distance(point: Float[Array, "3"], surface: Surface) -> Float[Array, ""]:
    """Distance (m) of a point from the nearest point of a surface."""
    corners = jnp.asarray(surface.triangles)
    return jnp.sqrt(jnp.min(jax.vmap(_to_triangle, (None, 0))(point, corners)))


def _to_triangle(p: Float[Array, "3"], triangle: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Squared distance (m2) from a triangle: to its plane above the inside, else to the nearest edge."""
    a, b, c = triangle
    normal = jnp.cross(b - a, c - a)
    area = jnp.sum(normal**2)
    ends = ((a, b), (b, c), (c, a))
    sides = jnp.stack([jnp.dot(jnp.cross(end - start, p - start), normal) for start, end in ends])
    above = jnp.dot(p - a, normal) ** 2 / jnp.where(area > 0, area, 1)
    beside = jnp.min(jnp.stack([_to_segment(p, *end) for end in ends]))
    # Faces without area fill a surface up to its size class.
    return jnp.where(area > 0, jnp.where(jnp.all(sides >= 0), above, beside), jnp.inf)


def _to_segment(p: Float[Array, "3"], a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    along, square = b - a, jnp.sum((b - a) ** 2)
    part = jnp.clip(jnp.dot(p - a, along) / jnp.where(square > 0, square, 1), 0, 1)
    return jnp.sum((p - a - part * along) ** 2)
