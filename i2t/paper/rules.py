"""The rules of the paper's ensemble: every touch is a weak classifier of the object, and touches vote.

    d_io = |tau_i - tau~_io|        touch i, object o: how far the standardised reading is from the one predicted there
    p(i | o) ~ exp(-d_io)           the paper's likelihood, which writes exp(-(tau - tau~)); the norm is ours

Three rules make one belief of all touches so far: the share of touches that each object wins (the paper's exclusive
winner), the mean of the touches' normalised likelihoods, and their product (in the published code). The paper's
baseline, proprioception, takes for d_io the distance of the contact from the object (`i2t.paper.loop`).

Arrays hold touches in rows and objects in columns; beliefs come after each touch and sum to 1.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.jit
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


RULES = {"votes": votes, "average": average, "product": product}
