"""The paper's loss; training takes the mean over the touches of a minibatch.

    L = mean_i (tau_i - tau~_i)^2 + w * d(x, x~)

tau is the measured reading, standardised; x the prepared patch and x~ the patch that the auxiliary decoder makes of the
bottleneck. d is the mean over pixels of the squared error for depths, and of the cross entropy for a mask. Neither
d nor the weight w is in the paper; w is 1 (`PaperOptions.auxiliary_weight`).
"""

from functools import partial

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from i2t.paper.config import ImageKind, PaperConfig
from i2t.paper.network import Params, apply
from i2t.training import Batch, Losses


def losses(
    params: Params, cfg: PaperConfig, batch: Batch, weights: Float[Array, " n"]
) -> tuple[Float[Array, ""], Losses]:
    """The mean loss of some touches, as `i2t.training` descends it.

    Args:
        params: Of one member.
        cfg: Sizes, and the weight w.
        batch: Prepared patches x (n, pixels, pixels), and readings tau (n, c), standardised.
        weights: Of the touches.

    Returns:
        Mean of L, and means of its parts.
    """
    predicted = jax.vmap(partial(apply, params, cfg))(batch.inputs)
    squared = jax.vmap(squared_error)(predicted.reading, batch.target)
    image = jax.vmap(partial(image_error, cfg.input))(predicted.image, batch.inputs)
    return Losses(squared + cfg.auxiliary_weight * image, squared, squared, image).mean(weights)


def squared_error(predicted: Float[Array, " c"], reading: Float[Array, " c"]) -> Float[Array, ""]:
    """mean_i (tau_i - tau~_i)^2.

    Args:
        predicted: tau~, standardised.
        reading: tau, standardised.

    Returns:
        Dimensionless.
    """
    return jnp.mean((predicted - reading) ** 2)


def image_error(kind: ImageKind, decoded: Float[Array, "n n"], image: Float[Array, "n n"]) -> Float[Array, ""]:
    """d(x, x~).

    Args:
        kind: What the network sees.
        decoded: x~; logits for a mask.
        image: x, prepared.

    Returns:
        Mean over pixels.
    """
    if kind == "mask":
        return jnp.mean(optax.sigmoid_binary_cross_entropy(decoded, image))
    return jnp.mean((decoded - image) ** 2)
