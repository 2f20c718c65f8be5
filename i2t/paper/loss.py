"""The paper's loss; training uses its mean over the touches of a minibatch.

    L = mean_i (tau_i - tau~_i)^2 + w * d(x, x~)

tau is the measured, standardised reading; x is the prepared patch and x~ the patch that the auxiliary decoder
reconstructs from the bottleneck. d is the mean over pixels of the squared error for depths, and of the cross entropy
for a mask. The paper specifies neither d nor the weight w; here w is 1 (`PaperOptions.auxiliary_weight`).
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
    """Compute the paper's mean loss L over a minibatch of touches, in the form that `i2t.training` takes.

    Args:
        params: Parameters of one member.
        cfg: Sizes of the network, and the weight of the image error in L.
        batch: Prepared patches x `(n, pixels, pixels)` and standardised readings tau `(n, c)`.
        weights: `(n,)` weights of the touches.

    Returns:
        Weighted mean of L, and weighted means of its parts (reading error and image error), all dimensionless.
    """
    predicted = jax.vmap(partial(apply, params, cfg))(batch.inputs)
    squared = jax.vmap(squared_error)(predicted.reading, batch.target)
    image = jax.vmap(partial(image_error, cfg.input))(predicted.image, batch.inputs)
    return Losses(squared + cfg.auxiliary_weight * image, squared, squared, image).mean(weights)


def squared_error(predicted: Float[Array, " c"], reading: Float[Array, " c"]) -> Float[Array, ""]:
    """Compute the mean squared error of a predicted reading, mean_i (tau_i - tau~_i)^2.

    Args:
        predicted: `(c,)` predicted reading tau~, standardised.
        reading: `(c,)` measured reading tau, standardised.

    Returns:
        The mean squared error, dimensionless.
    """
    return jnp.mean((predicted - reading) ** 2)


def image_error(kind: ImageKind, decoded: Float[Array, "n n"], image: Float[Array, "n n"]) -> Float[Array, ""]:
    """Compute the error d(x, x~) of the patch that the auxiliary decoder reconstructs.

    Args:
        kind: Kind of the network's input.
        decoded: `(n, n)` decoded patch x~; logits for a mask.
        image: `(n, n)` prepared patch x.

    Returns:
        Mean error over the pixels, dimensionless.
    """
    if kind == "mask":
        return jnp.mean(optax.sigmoid_binary_cross_entropy(decoded, image))
    return jnp.mean((decoded - image) ** 2)
