"""The paper's recognition loop: imagine, touch, believe.

Before each touch a hypothesis is sampled from the current belief (`sample_hypothesis`), and a heuristic draws the next
touch on it: where the nearest points of the other objects face elsewhere, but not too far elsewhere
(`site_informativeness`, which the paper omits and its published code contains). The touch is made, its distances from
the predictions for each object are computed, and the rule of the ensemble (`i2t.paper.rules`) gives the next belief.
There are ten touches. The baseline is proprioception: the distance of the contact from each object's surface
(`nearest_distance`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.paper.rules import BELIEF_RULES
from i2t.types import Surface

State = TypeVar("State")  # state of the episodes

PAPER_TOUCHES = 10  # number of touches of an episode in the paper


class LoopResult(NamedTuple):
    """Result of the paper's recognition loop in e episodes: each touch's distances d_io, hypothesis and site."""

    distance: Float[np.ndarray, "e t objects"]  # distance of each touch from each object
    hypothesis: Int[np.ndarray, "e t"]  # object on which each touch was drawn
    site: Int[np.ndarray, "e t"]  # number of the site on that object


def run(
    key: Key[Array, ""],
    state: State,
    touch: Callable[[State, Int[np.ndarray, " e"], Int[np.ndarray, " e"]], tuple[State, Any]],
    score: Callable[[Any], Float[np.ndarray, "e objects"]],
    informativeness: Float[np.ndarray, "e objects sites"],
    *,
    count: int = PAPER_TOUCHES,
    rule: str = "votes",
    progress: Callable[[int], object] = lambda touches: None,
) -> LoopResult:
    """Run the paper's recognition loop (choose hypothesis and site, touch, update the belief) in e episodes at once.

    With equal keys all methods of scoring make the same draws as long as their beliefs are equal.

    Args:
        key: Random key of hypotheses and sites.
        state: State of the episodes before the first touch.
        touch: Function `touch(state, hypothesis, site)` that makes the next touch of every episode and returns the
            state after it, and the measurements.
        score: Function from the measurements to their `(e, objects)` distances d_io from every object; this is the
            method.
        informativeness: `(e, objects, sites)` probability with which the heuristic chooses each site
            (`site_informativeness`).
        count: Number of touches of each episode.
        rule: Name of the rule in `BELIEF_RULES` that gives the belief from which hypotheses are sampled; the paper's is
            votes.
        progress: Function that is called with the number of touches just made.

    Returns:
        The distances, hypotheses and sites of all touches.
    """
    weight = jnp.asarray(informativeness)
    episodes, objects, _ = weight.shape
    distance = np.zeros((episodes, count, objects), np.float32)
    hypotheses, sites = np.zeros((2, episodes, count), int)
    belief = np.full((episodes, objects), 1 / objects, np.float32)  # uniform, because the paper does not specify it
    for i in range(count):
        keys = jax.random.split(jax.random.fold_in(key, i), episodes)
        hypotheses[:, i], sites[:, i] = (np.asarray(x) for x in _draw(keys, jnp.asarray(belief), weight))
        state, measured = touch(state, hypotheses[:, i], sites[:, i])
        distance[:, i] = score(measured)
        belief = beliefs(distance, rule)[:, i]
        progress(episodes)
    return LoopResult(distance, hypotheses, sites)


def beliefs(distance: Float[np.ndarray, "e t objects"], rule: str) -> Float[np.ndarray, "e t objects"]:
    """Compute beliefs over the objects from the distances of touches, by one of the paper's rules.

    Args:
        distance: `(e, t, objects)` distances of each touch from each object, for e episodes of t touches.
        rule: Name of one of `BELIEF_RULES`.

    Returns:
        `(e, t, objects)` beliefs after each touch.
    """
    return np.asarray(_believe(BELIEF_RULES[rule], jnp.asarray(distance)))


def sample_hypothesis(key: Key[Array, ""], belief: Float[Array, " objects"]) -> Int[Array, ""]:
    """Sample, from the belief, the object to be distinguished from the others next, as in the paper.

    Args:
        key: Random key of the draw.
        belief: `(objects,)` probabilities of the objects.

    Returns:
        Index of the object.
    """
    return jax.random.categorical(key, jnp.log(belief))


def choose_hypothesis(
    key: Key[Array, ""], belief: Float[Array, " objects"], touches: Int[Array, ""] | int
) -> Int[Array, ""]:
    """Choose the object to be distinguished from the others next, as in the published code.

    It is a random one before the first touch, and the most probable one afterwards.

    Args:
        key: Random key of the first choice.
        belief: `(objects,)` probabilities of the objects.
        touches: Number of touches that were made.

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
    *,
    min_cosine: float = 0.2,
    max_mean_cosine: float = 0.65,
) -> Float[Array, " m"]:
    """Compute the probability that each point of the believed object is touched next, by the paper's heuristic.

    A point with normal n competes with the nearest safe point of every other object, with normal n_j. It qualifies if
    it is safe, every n.n_j > `min_cosine`, and the sum of -n.n_j lies between -`max_mean_cosine` times the number of
    other objects and 0. Its probability is proportional to that sum minus the smallest of the points that qualify. If
    no point qualifies or all sums are equal, those that qualify, or else all safe ones, are equally probable.

    Args:
        points: `(objects, m, 3)` points of each object (m).
        normals: `(objects, m, 3)` outward unit normals at the points.
        safe: `(objects, m)` mask of the points that may be touched.
        believed: Index of the believed object.
        min_cosine: Minimum of n.n_j.
        max_mean_cosine: Maximum of the mean of n.n_j; the default is a sum of 1.3 for the paper's two other objects.

    Returns:
        `(m,)` probabilities, 0 for points that are not safe. All are 0 if no point is safe; then none may be chosen.
    """
    here, facing = points[believed], normals[believed]
    square = jnp.sum((here[None, :, None] - points[:, None]) ** 2, axis=-1)
    nearest = jnp.argmin(jnp.where(safe[:, None], square, jnp.inf), axis=-1)
    cosines = jnp.sum(facing[None] * jnp.take_along_axis(normals, nearest[..., None], axis=1), axis=-1)
    other = (jnp.arange(len(points)) != believed)[:, None]
    score = -jnp.sum(jnp.where(other, cosines, 0), axis=0)
    fits = safe[believed] & jnp.all(~other | (cosines > min_cosine), axis=0)
    fits = fits & (score > -max_mean_cosine * (len(points) - 1)) & (score < 0)
    weight = jnp.where(fits, score - jnp.min(jnp.where(fits, score, jnp.inf)), 0)
    equally = jnp.where(jnp.any(fits), fits, safe[believed]).astype(weight.dtype)
    weight = jnp.where(jnp.sum(weight) > 0, weight, equally)
    total = jnp.sum(weight)
    return weight / jnp.where(total > 0, total, 1)


def nearest_distance(point: Float[Array, "3"], surface: Surface) -> Float[Array, ""]:
    """Compute the unsigned distance of a point from a surface.

    Args:
        point: `(3,)` point (m) in the surface's frame.
        surface: Surface of an object.

    Returns:
        Distance (m) from the nearest point of the surface.
    """
    corners = jnp.asarray(surface.triangles)
    return jnp.sqrt(jnp.min(jax.vmap(_to_triangle, (None, 0))(point, corners)))


def _to_triangle(p: Float[Array, "3"], triangle: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Compute the squared distance (m2) from a triangle: to its plane above the inside, else to the nearest edge."""
    a, b, c = triangle
    normal = jnp.cross(b - a, c - a)
    area = jnp.sum(normal**2)
    ends = ((a, b), (b, c), (c, a))
    sides = jnp.stack([jnp.dot(jnp.cross(end - start, p - start), normal) for start, end in ends])
    above = jnp.dot(p - a, normal) ** 2 / jnp.where(area > 0, area, 1)
    outside = jnp.min(jnp.stack([_to_segment(p, *end) for end in ends]))
    # Faces without area only pad a surface to its size class.
    return jnp.where(area > 0, jnp.where(jnp.all(sides >= 0), above, outside), jnp.inf)


def _to_segment(p: Float[Array, "3"], a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    along, square = b - a, jnp.sum((b - a) ** 2)
    part = jnp.clip(jnp.dot(p - a, along) / jnp.where(square > 0, square, 1), 0, 1)
    return jnp.sum((p - a - part * along) ** 2)


@jax.jit
def _draw(keys: Array, belief: Array, weight: Array) -> tuple[Array, Array]:
    """Draw the hypothesis (e,) and the number (e,) of the site on it, from beliefs (e, objects) and the sites'
    probabilities (e, objects, sites).
    """

    def draw(key: Array, belief: Array, weight: Array) -> tuple[Array, Array]:
        key_object, key_site = jax.random.split(key)
        which = sample_hypothesis(key_object, belief)
        return which, jax.random.categorical(key_site, jnp.log(weight[which]))

    return jax.vmap(draw)(keys, belief, weight)


@partial(jax.jit, static_argnums=0)
def _believe(rule: Callable[[Array], Array], distance: Array) -> Array:
    return jax.vmap(rule)(distance)
