"""The paper's network: it predicts a reading from a depth patch or its contact mask.

    h    = relu(W1 x + b1)                  x: the patch, 48 x 48 = 2304 values; h: 200
    z    = W2 h + b2                        the bottleneck: 5
    tau~ = W4 relu(W3 z + b3) + b4          500 units, then 3 values for each chip
    x~   = W6 relu(W5 z + b5) + b6          2000 units, then the patch again: the auxiliary decoder, so that the
                                            bottleneck keeps the content of the patch

Functions take one member and one example; `vmap` lifts both. Readings are standardised (`i2t.training.Standard`).
Parameters are a plain pytree. The parts `encode`, `decode` and `decode_image` are functions, so that other networks can
be built from them (`i2t.prediction.model`).

The paper does not specify activations: hidden layers are rectified here, bottleneck and outputs are linear.
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
    """Output of the paper's network for one touch: standardised reading, reconstructed patch and latent code."""

    reading: Float[Array, " c"]  # predicted reading tau~, standardised
    image: Float[Array, "n n"]  # reconstructed patch x~ (logits for a mask)
    latent: Float[Array, " b"]  # latent code z


class PaperNetwork(nn.Module):
    """The paper's network, as a Flax module: from a prepared depth patch or contact mask to a standardised reading."""

    cfg: PaperConfig

    @nn.compact
    def __call__(self, patch: Float[Array, "n n"]) -> Prediction:
        """Predict from a prepared patch (see `prepare_patch`)."""
        latent = encode(self.cfg, patch.reshape(-1))
        reading = dense(self.cfg.readings, "reading")(decode(self.cfg, latent))
        return Prediction(reading, decode_image(self.cfg, latent), latent)


def encode(cfg: PaperConfig, x: Float[Array, " values"]) -> Float[Array, " b"]:
    """Compute the bottleneck z of a flattened patch, inside a Flax module.

    Args:
        cfg: Sizes of the network.
        x: `(values,)` flattened input.

    Returns:
        `(bottleneck,)` latent vector z.
    """
    return dense(cfg.bottleneck, "bottleneck")(nn.relu(dense(cfg.encoder_width, "encoder", gain=2.0)(x)))


def decode(cfg: PaperConfig, z: Float[Array, " values"]) -> Float[Array, " units"]:
    """Compute the decoder's hidden layer, from which the reading is predicted, inside a Flax module.

    Args:
        cfg: Sizes of the network.
        z: Latent vector, followed by the measured conditions if there are any.

    Returns:
        `(units,)` rectified units of the hidden layer.
    """
    return nn.relu(dense(cfg.decoder_width, "decoder", gain=2.0)(z))


def decode_image(cfg: PaperConfig, z: Float[Array, " b"]) -> Float[Array, "n n"]:
    """Reconstruct the patch x~ by the auxiliary decoder, inside a Flax module.

    Args:
        cfg: Sizes of the network.
        z: `(bottleneck,)` latent vector.

    Returns:
        `(pixels, pixels)` prepared patch; logits for a mask.
    """
    seen = nn.relu(dense(cfg.auxiliary_width, "auxiliary", gain=2.0)(z))
    return dense(cfg.pixels**2, "image")(seen).reshape(cfg.pixels, cfg.pixels)


def init(key: Key[Array, ""], cfg: PaperConfig) -> Params:
    """Draw random parameters of one member.

    Args:
        key: Random key.
        cfg: Sizes of the network.

    Returns:
        Kernels and biases of the layers by name.
    """
    params: Params = PaperNetwork(cfg).init(key, jnp.zeros((cfg.pixels, cfg.pixels)))["params"]
    return params


def apply(params: Params, cfg: PaperConfig, patch: Float[Array, "n n"]) -> Prediction:
    """Compute one member's prediction for one patch.

    Args:
        params: Parameters of one member.
        cfg: Sizes of the network.
        patch: `(pixels, pixels)` prepared patch (see `prepare_patch`).

    Returns:
        The reading, the reconstructed patch and the bottleneck.
    """
    prediction: Any = PaperNetwork(cfg).apply({"params": params}, patch)
    return prediction


def prepare_patch(cfg: PaperConfig, patch: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Convert a depth patch to the network's input.

    Args:
        cfg: Kind of input, and the scale of depths.
        patch: `(n, n)` depth (m) behind the nearest point, or any image for an input that is not converted.

    Returns:
        `(n, n)` contact mask or depth in units of the reach, in [0, 1]; or the unchanged image.
    """
    if cfg.input == "mask":
        return contact_mask(patch, cfg.tolerance)
    return jnp.clip(patch / cfg.reach, 0, 1) if cfg.input == "depth" else patch


def dense(width: int, name: str, *, gain: float = 1.0) -> nn.Dense:
    """Make a layer W x + b with normal initial weights of variance gain / inputs, which the paper does not specify.

    Args:
        width: Number of units.
        name: Name of the layer's parameters.
        gain: 2 before rectifiers (He et al. 2015), 1 before linear units (LeCun et al. 1998).

    Returns:
        The Flax layer with its initialiser.
    """
    return nn.Dense(width, kernel_init=normal(gain), name=name)


def normal(gain: float) -> Callable[..., Array]:
    """Make an initialiser of normal weights with variance gain / fan-in.

    Args:
        gain: Factor on the variance, as of `dense`.

    Returns:
        A Flax initialiser.
    """

    def draw(key: Key[Array, ""], shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        # Drawn flat, because XLA takes seconds to compile draws of four axes.
        scale = math.sqrt(gain / math.prod(shape[:-1]))
        return scale * jax.random.normal(key, (math.prod(shape),), dtype).reshape(shape)

    return draw
