"""The paper's network: a depth patch, or its contact mask, becomes the reading that is expected there.

    h    = relu(W1 x + b1)                  x: the patch, 48 x 48 = 2304 values; h: 200
    z    = W2 h + b2                        the bottleneck: 5
    tau~ = W4 relu(W3 z + b3) + b4          500 units, then 3 values for each chip
    x~   = W6 relu(W5 z + b5) + b6          2000 units, then the patch again: the auxiliary decoder, so that the
                                            bottleneck keeps what was seen

One member and one example; `vmap` lifts both. Readings are standardised (`i2t.training.Standard`). Parameters are one
plain pytree. The parts `encode`, `decode` and `decode_image` are functions, so that other networks are built of them
(`i2t.prediction.model`).

The paper does not say what follows a layer: hidden layers are rectified here, bottleneck and outputs are linear.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from i2t.paper.config import PaperConfig
from i2t.rendering.render import contact_mask

Params: TypeAlias = dict[str, dict[str, Array]]  # {layer: {"kernel": ..., "bias": ...}}


class Prediction(NamedTuple):
    """Output of the network for one touch."""

    reading: Float[Array, " c"]  # tau~, standardised
    image: Float[Array, "n n"]  # x~: the prepared patch decoded again (logits for a mask)
    latent: Float[Array, " b"]  # z


class Network(nn.Module):
    """The paper's network."""

    cfg: PaperConfig

    @nn.compact
    def __call__(self, patch: Float[Array, "n n"]) -> Prediction:
        """`patch` is prepared (see `prepare_patch`)."""
        latent = encode(self.cfg, patch.reshape(-1))
        reading = dense(self.cfg.readings, "reading")(decode(self.cfg, latent))
        return Prediction(reading, decode_image(self.cfg, latent), latent)


def encode(cfg: PaperConfig, x: Float[Array, " values"]) -> Float[Array, " b"]:
    """The bottleneck z of a flattened patch, inside a Flax module.

    Args:
        cfg: Sizes.
        x: What is seen.

    Returns:
        z.
    """
    return dense(cfg.bottleneck, "bottleneck")(nn.relu(dense(cfg.encoder_width, "encoder", gain=2.0)(x)))


def decode(cfg: PaperConfig, z: Float[Array, " values"]) -> Float[Array, " units"]:
    """The hidden layer before the reading, inside a Flax module.

    Args:
        cfg: Sizes.
        z: The bottleneck.

    Returns:
        Rectified units.
    """
    return nn.relu(dense(cfg.decoder_width, "decoder", gain=2.0)(z))


def decode_image(cfg: PaperConfig, z: Float[Array, " b"]) -> Float[Array, "n n"]:
    """The auxiliary decoder's patch x~, inside a Flax module.

    Args:
        cfg: Sizes.
        z: The bottleneck.

    Returns:
        The patch as it was prepared; logits for a mask.
    """
    seen = nn.relu(dense(cfg.auxiliary_width, "auxiliary", gain=2.0)(z))
    return dense(cfg.pixels**2, "image")(seen).reshape(cfg.pixels, cfg.pixels)


def init(key: Key[Array, ""], cfg: PaperConfig) -> Params:
    """Random parameters of one member.

    Args:
        key: Random key.
        cfg: Sizes.

    Returns:
        Layers by name.
    """
    params: Params = Network(cfg).init(key, jnp.zeros((cfg.pixels, cfg.pixels)))["params"]
    return params


def apply(params: Params, cfg: PaperConfig, patch: Float[Array, "n n"]) -> Prediction:
    """One member's prediction for one patch.

    Args:
        params: Of one member.
        cfg: Sizes.
        patch: Prepared (see `prepare_patch`).

    Returns:
        The reading, the patch decoded again and the bottleneck.
    """
    prediction: Any = Network(cfg).apply({"params": params}, patch)
    return prediction


def prepare_patch(cfg: PaperConfig, patch: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A depth patch as the network sees it.

    Args:
        cfg: Which input.
        patch: m behind the nearest point; or any image, where it is taken as it is.

    Returns:
        In [0, 1]: the contact mask, or the depth in units of the reach; an image as it is.
    """
    if cfg.input == "mask":
        return contact_mask(patch, cfg.tolerance)
    return jnp.clip(patch / cfg.reach, 0, 1) if cfg.input == "depth" else patch


def dense(width: int, name: str, *, gain: float = 1.0) -> nn.Dense:
    """A layer W x + b. The paper does not say how weights begin: normal, of variance gain / inputs.

    Args:
        width: Units.
        name: Of the layer's parameters.
        gain: 2 before rectifiers (He et al. 2015), 1 before linear units (LeCun et al. 1998).

    Returns:
        The layer.
    """
    return nn.Dense(width, kernel_init=normal(gain), name=name)


def normal(gain: float) -> Callable[..., Array]:
    """Normal weights of variance gain / fan-in.

    Args:
        gain: As of `dense`.

    Returns:
        A Flax initialiser.
    """

    def draw(key: Key[Array, ""], shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        # Drawn flat: XLA takes seconds to compile draws of four axes.
        scale = math.sqrt(gain / math.prod(shape[:-1]))
        return scale * jax.random.normal(key, (math.prod(shape),), dtype).reshape(shape)

    return draw
