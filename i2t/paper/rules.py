"""Rules of the paper's ensemble: every touch is a weak classifier of the object, and the touches vote.

    d_io = |tau_i - tau~_io|        touch i, object o: distance of the standardised reading from the predicted one
    p(i | o) ~ exp(-d_io)           the paper's likelihood; it writes exp(-(tau - tau~)), the norm is ours

Three rules combine all touches so far into a belief: the share of touches that each object wins (the paper's exclusive
winner), the mean of the touches' normalised likelihoods, and their product (in the published code). For the paper's
baseline, proprioception, d_io is the distance of the contact from the object (`i2t.paper.loop`).

Arrays hold touches in rows and objects in columns; beliefs are those after each touch and sum to 1.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.jit
def distances(
    readings: Float[Array, "n c"], predicted: Float[Array, "n objects c"], std: Float[Array, " c"]
) -> Float[Array, "n objects"]:
    """Compute the distances between measured readings and those predicted for each object.

    Args:
        readings: `(n, c)` measured readings (uT).
        predicted: `(n, objects, c)` readings (uT) predicted for each touch on each object.
        std: `(c,)` standard deviations (uT) of the channels in the training data.

    Returns:
        `(n, objects)` Euclidean distances in standard deviations; a smaller one favours the object.
    """
    return jnp.linalg.norm((readings[:, None] - predicted) / std[None, None], axis=-1)


def votes(distance: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    """Compute votes, the paper's rule: each touch votes for its nearest object; equally near objects share a vote.

    Args:
        distance: `(n, objects)` distance of each touch from each object.

    Returns:
        `(n, objects)` shares of the votes after each touch.
    """
    nearest = distance == jnp.min(distance, axis=1, keepdims=True)
    return _mean_so_far(nearest / jnp.sum(nearest, axis=1, keepdims=True))


def average(distance: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    """Compute the mean of the normalised likelihoods of the touches so far.

    Args:
        distance: `(n, objects)` distance of each touch from each object.

    Returns:
        `(n, objects)` beliefs after each touch.
    """
    return _mean_so_far(jax.nn.softmax(-distance, axis=1))


def product(distance: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    """Compute the normalised product of the likelihoods of the touches so far.

    Args:
        distance: `(n, objects)` distance of each touch from each object.

    Returns:
        `(n, objects)` beliefs after each touch.
    """
    return jax.nn.softmax(-jnp.cumsum(distance, axis=0), axis=1)


def _mean_so_far(values: Float[Array, "n objects"]) -> Float[Array, "n objects"]:
    touch = jnp.arange(1, len(values) + 1)
    return jnp.cumsum(values, axis=0) / touch[:, None]


# Rules that combine the distances of the touches so far into a belief over the objects, by name.
BELIEF_RULES = {"votes": votes, "average": average, "product": product}
