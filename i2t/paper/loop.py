"""The paper's recognition loop: imagine, touch, believe.

Before each touch a hypothesis is sampled from the belief so far (`sample_hypothesis`), and the heuristic draws the next
touch on it: where the other objects' nearest points face elsewhere, but not too far elsewhere (`site_informativeness`,
which the paper leaves out and its published code shows). The touch is made, its distances from what each object would
feel like there are taken, and the rule of the ensemble (`i2t.paper.rules`) makes the next belief. Ten touches are made.
The baseline is proprioception: the distance of the contact from each object's surface (`nearest_distance`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.paper.rules import RULES
from i2t.types import Surface

State = TypeVar("State")  # of episodes

TOUCHES = 10  # of an episode, as in the paper
MIN_NORMAL_COSINE = 0.2  # between a point's normal and those of its nearest points on other objects
MAX_MEAN_NORMAL_COSINE = 0.65  # of those cosines: a sum of 1.3 for the paper's two other objects


class LoopResult(NamedTuple):
    """Episodes of the paper's loop: e of them, t touches each."""

    distance: Float[np.ndarray, "e t objects"]  # of each touch from each object
    hypothesis: Int[np.ndarray, "e t"]  # the object on which each touch was drawn
    site: Int[np.ndarray, "e t"]  # of that object's sites


def run(
    key: Key[Array, ""],
    state: State,
    touch: Callable[[State, Int[np.ndarray, " e"], Int[np.ndarray, " e"]], tuple[State, Any]],
    score: Callable[[Any], Float[np.ndarray, "e objects"]],
    informativeness: Float[np.ndarray, "e objects sites"],
    *,
    count: int = TOUCHES,
    rule: str = "votes",
    progress: Callable[[int], object] = lambda touches: None,
) -> LoopResult:
    """The paper's loop in many episodes side by side.

    Equal keys draw alike for all methods as far as they believe alike.

    Args:
        key: Of hypotheses and sites.
        state: Of the episodes before the first touch.
        touch: `touch(state, hypothesis, site)` makes the next touch of every episode and gives the state after it, and
            what was measured.
        score: Distances d_io of what was measured from every object: the method.
        informativeness: With which probability the heuristic takes each site of each object (`site_informativeness`).
        count: Touches of each episode.
        rule: Which of `RULES` makes the belief that hypotheses are sampled from; the paper's is that of votes.
        progress: Called with how many touches were made.

    Returns:
        What happened.
    """
    weight = jnp.asarray(informativeness)
    episodes, objects, _ = weight.shape
    distance = np.zeros((episodes, count, objects), np.float32)
    hypotheses, sites = np.zeros((2, episodes, count), int)
    belief = np.full((episodes, objects), 1 / objects, np.float32)  # the paper does not say; every object alike
    for i in range(count):
        keys = jax.random.split(jax.random.fold_in(key, i), episodes)
        hypotheses[:, i], sites[:, i] = (np.asarray(x) for x in _draw(keys, jnp.asarray(belief), weight))
        state, measured = touch(state, hypotheses[:, i], sites[:, i])
        distance[:, i] = score(measured)
        belief = beliefs(distance, rule)[:, i]
        progress(episodes)
    return LoopResult(distance, hypotheses, sites)


def beliefs(distance: Float[np.ndarray, "e t objects"], rule: str) -> Float[np.ndarray, "e t objects"]:
    """Beliefs of a rule from the distances of many episodes.

    Args:
        distance: d_io of each episode.
        rule: Which of `RULES`.

    Returns:
        Beliefs after each touch.
    """
    return np.asarray(_believe(RULES[rule], jnp.asarray(distance)))


def sample_hypothesis(key: Key[Array, ""], belief: Float[Array, " objects"]) -> Int[Array, ""]:
    """The object to be distinguished from the others next, as in the paper: sampled from the belief.

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
    """The paper's heuristic: the probability that each point of the believed object is touched next.

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


@jax.jit
def _draw(keys: Array, belief: Array, weight: Array) -> tuple[Array, Array]:
    """The hypothesis (e,) and the number (e,) of the site on it, from beliefs (e, objects) and the sites' probabilities
    (e, objects, sites).
    """

    def one(key: Array, belief: Array, weight: Array) -> tuple[Array, Array]:
        key_object, key_site = jax.random.split(key)
        which = sample_hypothesis(key_object, belief)
        return which, jax.random.categorical(key_site, jnp.log(weight[which]))

    return jax.vmap(one)(keys, belief, weight)


@partial(jax.jit, static_argnums=0)
def _believe(rule: Callable[[Array], Array], distance: Array) -> Array:
    return jax.vmap(rule)(distance)
