"""The network that predicts a touch: a depth patch, and what is measured at contact, become a reading.

The paper's network encodes the flattened patch (48 x 48 = 2304 values) in one hidden layer of 200, squeezes it through
a bottleneck of 5 and decodes a reading (3 values for each chip) through a hidden layer of 500; an auxiliary head
decodes the bottleneck through 2000 units into the patch again, so that the bottleneck keeps what was seen. Hidden
layers are rectified, the bottleneck and the outputs are linear (as in the paper's published code). By configuration the
patch is a depth image scaled by its reach to [0, 1], the paper's binary contact mask, or any square image taken as it
is; a small convolutional encoder (in the manner of the published one, with strides in place of pooling and batch
normalisation) comes before the hidden layer; conditions measured at contact (force, nearest, depth) join the image's
features at the encoder's input and again, for the reading, next to the bottleneck, because what the camera saw does not
tell how hard the skin is pressed; and a second output predicts the log variance of each value.

Inside the network everything is standardised; `predict` speaks physical units. Parameters are one plain pytree; the
members of an ensemble are its axis 0. `init` and `apply` work on one member and one example and are lifted by `vmap`.

Source: Ayad et al., "Imagine2touch" (network); Lakshminarayanan et al., "Simple and scalable predictive uncertainty
estimation using deep ensembles", 2017 (heteroscedastic members and the moments of their mixture).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from i2t.rendering.render import contact_mask
from i2t.types import CONTACT_TOLERANCE_M, PATCH_PIXELS, REACH, in_one_line

Params: TypeAlias = dict[str, dict[str, Array]]  # {layer: {"kernel": ..., "bias": ...}}
ImageKind: TypeAlias = Literal["depth", "mask", "image"]
Condition: TypeAlias = Literal["force", "nearest", "depth"]

LOG_VARIANCE_LIMIT = 10.0  # of standardised readings: standard deviations between 0.7 % and 150 times the data's own


class Inputs(NamedTuple):
    """What the network sees of one touch."""

    image: Float[Array, "n n"]  # a patch in m, or whatever `ModelConfig.input` says
    conditions: Float[Array, " k"]  # in the order of `ModelConfig.conditions`: N, m, m


class Prediction(NamedTuple):
    """What one member says about one touch, in standardised units."""

    reading: Float[Array, " c"]
    log_variance: Float[Array, " c"] | None  # None unless heteroscedastic
    image: Float[Array, "n n"] | None  # the prepared image decoded again (logits for a mask), by the auxiliary head
    latent: Float[Array, " b"]


@in_one_line
class Standard(NamedTuple):
    """Mean and standard deviation of each value over a training set."""

    mean: Float[Array, " k"]
    std: Float[Array, " k"]


@in_one_line
class Normalisation(NamedTuple):
    """What turns physical units into the network's and back."""

    reading: Standard  # uT
    conditions: Standard  # in the order of `ModelConfig.conditions`
    residual: Float[Array, " c"]  # variance (standardised) that a model without variance of its own leaves unexplained


@dataclass(frozen=True)
class ModelConfig:
    """Which network; the defaults are the paper's."""

    pixels: int = PATCH_PIXELS
    readings: int = 15  # values of a reading, 3 for each chip of the board
    input: ImageKind = "depth"
    reach: float = REACH  # m, depth that becomes 1
    tolerance: float = CONTACT_TOLERANCE_M  # m behind the nearest point that still counts as contact in a mask
    encoder: Literal["mlp", "cnn"] = "mlp"
    channels: tuple[int, ...] = (8, 16, 16)  # of the convolutions, each of stride 2
    encoder_width: int = 200
    bottleneck: int = 5
    decoder_width: int = 500
    auxiliary: bool = True
    auxiliary_width: int = 2000
    heteroscedastic: bool = False
    conditions: tuple[Condition, ...] = ()
    skip: bool = True  # conditions also next to the bottleneck
    members: int = 1

    def __post_init__(self) -> None:
        """Refuse what cannot be built (ValueError)."""
        for field, kind in (("input", ImageKind), ("encoder", Literal["mlp", "cnn"])):
            if getattr(self, field) not in get_args(kind):
                raise ValueError(
                    f"model.{field} is {getattr(self, field)!r}; choose one of {', '.join(get_args(kind))}."
                )
        unknown = [name for name in self.conditions if name not in get_args(Condition)]
        if unknown or len(set(self.conditions)) < len(self.conditions):
            raise ValueError(
                f"model.conditions is {self.conditions}; name each of {', '.join(get_args(Condition))} at most once."
            )
        sizes = ("pixels", "readings", "encoder_width", "bottleneck", "decoder_width", "auxiliary_width", "members")
        for field in sizes:
            if getattr(self, field) < 1:
                raise ValueError(f"model.{field} is {getattr(self, field)}; it must be at least 1.")


class Network(nn.Module):
    """One member on one example."""

    cfg: ModelConfig

    @nn.compact
    def __call__(self, inputs: Inputs) -> Prediction:
        """`inputs` are prepared (see `prepare`)."""
        cfg = self.cfg
        features = inputs.image
        if cfg.encoder == "cnn":
            features = features[..., None]
            for i, channels in enumerate(cfg.channels):
                size = 5 if i == 0 else 3
                convolution = nn.Conv(channels, (size, size), 2, kernel_init=_normal(2.0), name=f"conv{i}")
                features = nn.relu(convolution(features))
        features = jnp.concatenate([features.reshape(-1), inputs.conditions])
        encoded = nn.relu(_dense(cfg.encoder_width, "encoder", gain=2.0)(features))
        latent = _dense(cfg.bottleneck, "bottleneck")(encoded)
        code = jnp.concatenate([latent, inputs.conditions]) if cfg.skip else latent

        decoded = nn.relu(_dense(cfg.decoder_width, "decoder", gain=2.0)(code))
        reading = _dense(cfg.readings, "reading")(decoded)
        log_variance = image = None
        if cfg.heteroscedastic:
            # Starts at the data's own variance, and is bounded smoothly so that no reading can make the loss overflow.
            raw = nn.Dense(cfg.readings, kernel_init=nn.initializers.zeros, name="log_variance")(decoded)
            log_variance = LOG_VARIANCE_LIMIT * jnp.tanh(raw / LOG_VARIANCE_LIMIT)
        if cfg.auxiliary:
            seen = nn.relu(_dense(cfg.auxiliary_width, "auxiliary", gain=2.0)(latent))
            image = _dense(cfg.pixels**2, "image")(seen).reshape(cfg.pixels, cfg.pixels)
        return Prediction(reading, log_variance, image, latent)


def init(key: Key[Array, ""], cfg: ModelConfig) -> Params:
    """Random parameters of one member (He et al. 2015 before rectifiers, LeCun et al. 1998 before linear outputs).

    Args:
        key: Random key.
        cfg: Which network.

    Returns:
        Layers by name.
    """
    example = Inputs(jnp.zeros((cfg.pixels, cfg.pixels)), jnp.zeros(len(cfg.conditions)))
    params: Params = Network(cfg).init(key, example)["params"]
    return params


def apply(params: Params, cfg: ModelConfig, inputs: Inputs) -> Prediction:
    """One member's prediction for one example, both in the network's units.

    Args:
        params: Of one member.
        cfg: Which network.
        inputs: Prepared (see `prepare`).

    Returns:
        The reading and what else the network gives.
    """
    prediction: Any = Network(cfg).apply({"params": params}, inputs)
    return prediction


def prepare(cfg: ModelConfig, normalisation: Normalisation, inputs: Inputs) -> Inputs:
    """Physical inputs of one touch as the network wants them.

    Args:
        cfg: Which network.
        normalisation: Of the training set.
        inputs: The image (m, or N on each cell for a contact pressure) and the conditions (N, m, m).

    Returns:
        The image in [0, 1] unless it is taken as it is, and the conditions standardised.
    """
    image = inputs.image
    if cfg.input == "depth":
        image = jnp.clip(image / cfg.reach, 0, 1)
    elif cfg.input == "mask":
        image = contact_mask(image, cfg.tolerance)
    return Inputs(image, standardise(normalisation.conditions, inputs.conditions))


def standardise(standard: Standard, values: Float[Array, " k"]) -> Float[Array, " k"]:
    """Physical values in standard deviations about their mean.

    Args:
        standard: Mean and standard deviation of each value over the training set.
        values: In their physical units.

    Returns:
        Dimensionless values.
    """
    return (values - standard.mean) / standard.std


def predict(
    params: Params, cfg: ModelConfig, normalisation: Normalisation, inputs: Inputs
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Reading of one touch from all members.

    The members' mixture has the mean of their means and, for its variance, the mean of their variances plus the
    variance of their means (Lakshminarayanan et al. 2017). Members without a variance of their own share the residual
    one.

    Args:
        params: Members as axis 0.
        cfg: Which network.
        normalisation: Of the training set, with the residual of the validation set.
        inputs: In physical units.

    Returns:
        Mean and standard deviation, uT.
    """
    prepared = prepare(cfg, normalisation, inputs)
    members = jax.vmap(lambda member: apply(member, cfg, prepared))(params)
    own = normalisation.residual if members.log_variance is None else jnp.exp(members.log_variance).mean(0)
    std = jnp.sqrt(own + members.reading.var(0))
    mean = members.reading.mean(0) * normalisation.reading.std + normalisation.reading.mean
    return mean, std * normalisation.reading.std


def _dense(width: int, name: str, *, gain: float = 1.0) -> nn.Dense:
    return nn.Dense(width, kernel_init=_normal(gain), name=name)


def _normal(gain: float) -> Callable[..., Array]:
    """Normal weights of variance gain / fan-in, drawn flat: XLA takes seconds to compile draws of four axes."""

    def draw(key: Key[Array, ""], shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        scale = math.sqrt(gain / math.prod(shape[:-1]))
        return scale * jax.random.normal(key, (math.prod(shape),), dtype).reshape(shape)

    return draw
