"""What training minimises, for one touch at a time; training takes the (weighted) mean.

With standardised readings y, predictions m and log variances s, each averaged over the values of a reading:

  squared error   (y - m)^2
  Gaussian        (s + (y - m)^2 exp(-s) + log 2 pi) / 2, weighted by exp(beta s) held constant: beta = 0 is the
                  likelihood itself, beta = 0.5 keeps poorly fitted readings from being explained away as noise
                  (Seitzer et al., "On the pitfalls of heteroscedastic uncertainty estimation with probabilistic
                  neural networks", 2022)
  auxiliary       the decoded image against the prepared one, averaged over pixels: squared error for depth, cross
                  entropy of logits for a mask
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from i2t.prediction.model import ImageKind, Inputs, ModelConfig, Prediction


@dataclass(frozen=True)
class LossConfig:
    """Weights of the parts."""

    auxiliary: float = 1.0
    beta: float = 0.5  # of the Gaussian loss

    def __post_init__(self) -> None:
        """Refuse weights without meaning (ValueError)."""
        if not (self.auxiliary >= 0 and math.isfinite(self.auxiliary)):
            raise ValueError(f"loss.auxiliary is {self.auxiliary}; it must be a number >= 0.")
        if not 0 <= self.beta <= 1:
            raise ValueError(f"loss.beta is {self.beta}; it must lie between 0 and 1.")


class Losses(NamedTuple):
    """The loss of one touch and its parts, all dimensionless."""

    total: Float[Array, ""]
    reading: Float[Array, ""]  # squared error or Gaussian, as trained
    squared: Float[Array, ""]  # squared error, whatever was trained
    image: Float[Array, ""]  # 0 without the auxiliary head


def losses(
    cfg: LossConfig, model: ModelConfig, prediction: Prediction, inputs: Inputs, target: Float[Array, " c"]
) -> Losses:
    """All parts for one example.

    Args:
        cfg: Weights.
        model: Which network predicted.
        prediction: Of one member, standardised.
        inputs: Prepared.
        target: The reading, standardised.

    Returns:
        The loss and its parts.
    """
    squared = squared_error(prediction.reading, target)
    reading = squared
    if prediction.log_variance is not None:
        reading = gaussian(prediction.reading, prediction.log_variance, target, cfg.beta)
    image = jnp.zeros(())
    if prediction.image is not None:
        image = image_error(model.input, prediction.image, inputs.image)
    return Losses(reading + cfg.auxiliary * image, reading, squared, image)


def squared_error(reading: Float[Array, " k"], target: Float[Array, " k"]) -> Float[Array, ""]:
    """Mean squared error over the values of one reading.

    Args:
        reading: Predicted, standardised.
        target: Measured, standardised.

    Returns:
        Dimensionless.
    """
    return jnp.mean((reading - target) ** 2)


def gaussian(
    reading: Float[Array, " k"], log_variance: Float[Array, " k"], target: Float[Array, " k"], beta: float
) -> Float[Array, ""]:
    """Beta-weighted negative log likelihood per value; its value (not its gradient) depends on the weights too.

    Args:
        reading: Predicted, standardised.
        log_variance: Predicted, of each value.
        target: Measured, standardised.
        beta: Exponent of the weights; 0 is the likelihood itself.

    Returns:
        Dimensionless.
    """
    nll = 0.5 * (log_variance + (target - reading) ** 2 * jnp.exp(-log_variance) + jnp.log(2 * jnp.pi))
    return jnp.mean(jax.lax.stop_gradient(jnp.exp(beta * log_variance)) * nll)


def image_error(kind: ImageKind, image: Float[Array, "n n"], target: Float[Array, "n n"]) -> Float[Array, ""]:
    """How far a decoded image is from the prepared one: cross entropy of logits for a mask, squared error otherwise.

    Args:
        kind: What the network sees.
        image: Decoded.
        target: Prepared.

    Returns:
        Mean over pixels.
    """
    if kind == "mask":
        return jnp.mean(optax.sigmoid_binary_cross_entropy(image, target))
    return jnp.mean((image - target) ** 2)
