"""Recognition as in the paper: every touch is a weak model of which object is there, and touches vote.

For touch i and possible object o the distance d_io = ||tau_i - tau~_io|| separates the standardised reading from the
one predicted at the same pose on o (or, for the proprioception baseline, the contact position from the nearest point of
o's model: `nearest_distance`). exp(-d_io) is the paper's likelihood. Three rules make one belief of all touches so far:
the share of touches that each object wins (the paper's), the mean of the touches' normalised likelihoods, and their
product (in the published code).

The position of the next touch is drawn on a hypothesis, which in the paper is sampled from the belief
(`sample_hypothesis`) and in the published code (github.com/ayadabdalla/imagine2touch) is the most probable object
(`choose_hypothesis`). The heuristic is the one that the paper leaves out and that code shows: where the other objects'
nearest points face elsewhere, but not too far elsewhere.

Arrays hold touches in rows and objects in columns; beliefs come after each touch and sum to 1.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.types import Surface

MIN_NORMAL_COSINE = 0.2  # between a point's normal and those of its nearest points on other objects
MAX_MEAN_NORMAL_COSINE = 0.65  # of those cosines: a sum of 1.3 for the paper's two other objects


def distances(
    readings: Float[Array, "n c"], predicted: Float[Array, "n objects c"], std: Float[Array, " c"]
) -> Float[Array, "n objects"]:
    """Distances between measured and predicted readings.

    Args:
        readings: Measured (uT).
        predicted: The readings of each touch on each object (uT).
        std: Standard deviation (uT) of each channel in the training data.

    Returns:
        Euclidean distances in standard deviations.
    """
    return jnp.linalg.norm((readings[:, None] - predicted) / std[None, None], axis=-1)


def votes(distance: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    """The paper's rule: each touch votes for its nearest object; equally near ones share a vote.

    Args:
        distance: Of each touch from each object.

    Returns:
        Share of the votes after each touch.
    """
    nearest = distance == jnp.min(distance, axis=1, keepdims=True)
    return _mean_so_far(nearest / jnp.sum(nearest, axis=1, keepdims=True))


def average(distance: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    """Mean of the normalised likelihoods of the touches so far.

    Args:
        distance: Of each touch from each object.

    Returns:
        Beliefs after each touch.
    """
    return _mean_so_far(jax.nn.softmax(-distance, axis=1))


def product(distance: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    """Normalised product of the likelihoods of the touches so far.

    Args:
        distance: Of each touch from each object.

    Returns:
        Beliefs after each touch.
    """
    return jax.nn.softmax(-jnp.cumsum(distance, axis=0), axis=1)


def _mean_so_far(each: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    touch = jnp.arange(1, len(each) + 1)
    return jnp.cumsum(each, axis=0) / touch[:, None]


def sample_hypothesis(key: Key[Array, ""], belief: Float[Array, " objects"]) -> Int[Array, ""]:
    """The object to be distinguished from the others next, as in the paper: sampled from what is believed.

    Args:
        key: Of the draw.
        belief: Probabilities of the objects.

    Returns:
        Index of the object.
    """
    return jax.random.categorical(key, jnp.log(belief))


def choose_hypothesis(
    key: Key[Array, ""], belief: Float[Array, " objects"], touches: Int[Array, ""] | int
) -> Int[Array, ""]:
    """The object to be distinguished from the others next, as in the published code: any before the first touch, the
    most probable one after it.

    Args:
        key: Of the first choice.
        belief: Probabilities of the objects.
        touches: How many were made.

    Returns:
        Index of the object.
    """
    any_one = jax.random.randint(key, (), 0, len(belief))
    return jnp.where(touches == 0, any_one, jnp.argmax(belief))


def site_informativeness(
    points: Float[Array, "objects m 3"],
    normals: Float[Array, "objects m 3"],
    safe: Bool[Array, "objects m"],
    believed: Int[Array, ""] | int,
) -> Float[Array, " m"]:
    """The paper's heuristic: with which probability each point of the object believed in is touched next.

    A point with normal n competes with the nearest safe point of every other object, with normal n_j. It qualifies if
    it is safe, every n.n_j > MIN_NORMAL_COSINE, and the sum of -n.n_j lies between -MAX_MEAN_NORMAL_COSINE times the
    number of others and 0; its probability is proportional to that sum less the least of those that qualify. Where none
    does or all are equal, those that qualify, or else all safe ones, are equally probable.

    Args:
        points: Of each object (m).
        normals: Outward unit normals there.
        safe: Which points may be touched.
        believed: Index of the object believed in.

    Returns:
        Probabilities, 0 for points that are not safe; all 0 where none is safe: then no point may be chosen.
    """
    here, facing = points[believed], normals[believed]
    square = jnp.sum((here[None, :, None] - points[:, None]) ** 2, axis=-1)
    nearest = jnp.argmin(jnp.where(safe[:, None], square, jnp.inf), axis=-1)
    cosines = jnp.sum(facing[None] * jnp.take_along_axis(normals, nearest[..., None], axis=1), axis=-1)
    other = (jnp.arange(len(points)) != believed)[:, None]
    score = -jnp.sum(jnp.where(other, cosines, 0), axis=0)
    fits = safe[believed] & jnp.all(~other | (cosines > MIN_NORMAL_COSINE), axis=0)
    fits = fits & (score > -MAX_MEAN_NORMAL_COSINE * (len(points) - 1)) & (score < 0)
    weight = jnp.where(fits, score - jnp.min(jnp.where(fits, score, jnp.inf)), 0)
    equally = jnp.where(jnp.any(fits), fits, safe[believed]).astype(weight.dtype)
    weight = jnp.where(jnp.sum(weight) > 0, weight, equally)
    total = jnp.sum(weight)
    return weight / jnp.where(total > 0, total, 1)


def nearest_distance(point: Float[Array, "3"], surface: Surface) -> Float[Array, ""]:
    """Distance of a point from a surface.

    Args:
        point: In the surface's frame (m).
        surface: Of an object.

    Returns:
        Distance (m) from the nearest point of the surface.
    """
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
    outside = jnp.min(jnp.stack([_to_segment(p, *end) for end in ends]))
    # Faces without area fill a surface up to its size class.
    return jnp.where(area > 0, jnp.where(jnp.all(sides >= 0), above, outside), jnp.inf)


def _to_segment(p: Float[Array, "3"], a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    along, square = b - a, jnp.sum((b - a) ** 2)
    part = jnp.clip(jnp.dot(p - a, along) / jnp.where(square > 0, square, 1), 0, 1)
    return jnp.sum((p - a - part * along) ** 2)
