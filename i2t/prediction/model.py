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

import hashlib
import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from i2t.prediction.mlp import Layer, dense
from i2t.prediction.mlp import apply as apply_mlp
from i2t.rendering.render import contact_mask
from i2t.types import PATCH_PIXELS, REACH

Params: TypeAlias = dict[str, Layer]  # layers by name
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


class Standard(NamedTuple):
    """Mean and standard deviation of each value over a training set."""

    mean: Float[Array, " k"]
    std: Float[Array, " k"]


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
    tolerance: float = 1.5e-3  # m behind the nearest point that still counts as contact in a mask
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


def init(key: Key[Array, ""], cfg: ModelConfig) -> Params:
    """Random parameters of one member (He et al. 2015 before rectifiers, LeCun et al. 1998 before linear outputs).

    Args:
        key: Random key.
        cfg: Which network.

    Returns:
        Layers by name. The weights of a layer depend on the key, its name and its shape only.
    """
    params: Params = {}

    def add(name: str, gain: float, *shape: int) -> None:
        # Drawn flat: XLA takes seconds to compile draws of four axes.
        weights = jax.random.normal(_layer_key(key, name), (math.prod(shape),)).reshape(shape)
        params[name] = {"kernel": math.sqrt(gain / math.prod(shape[:-1])) * weights, "bias": jnp.zeros(shape[-1])}

    features, conditions = cfg.pixels**2, len(cfg.conditions)
    if cfg.encoder == "cnn":
        size, depth = cfg.pixels, 1
        for i, channels in enumerate(cfg.channels):
            kernel = 5 if i == 0 else 3
            add(f"conv{i}", 2.0, kernel, kernel, depth, channels)
            size, depth = -(-size // 2), channels
        features = size**2 * depth
    add("encoder", 2.0, features + conditions, cfg.encoder_width)
    add("bottleneck", 1.0, cfg.encoder_width, cfg.bottleneck)
    add("decoder", 2.0, cfg.bottleneck + (conditions if cfg.skip else 0), cfg.decoder_width)
    add("reading", 1.0, cfg.decoder_width, cfg.readings)
    if cfg.heteroscedastic:  # zero at first: the variance of the data itself
        params["log_variance"] = {
            "kernel": jnp.zeros((cfg.decoder_width, cfg.readings)),
            "bias": jnp.zeros(cfg.readings),
        }
    if cfg.auxiliary:
        add("auxiliary", 2.0, cfg.bottleneck, cfg.auxiliary_width)
        add("image", 1.0, cfg.auxiliary_width, cfg.pixels**2)
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
    features = inputs.image
    if cfg.encoder == "cnn":
        features = features[..., None]
        for i in range(len(cfg.channels)):
            features = jax.nn.relu(_convolution(params[f"conv{i}"], features))
    features = jnp.concatenate([features.reshape(-1), inputs.conditions])
    latent = apply_mlp([params["encoder"], params["bottleneck"]], features)
    code = jnp.concatenate([latent, inputs.conditions]) if cfg.skip else latent

    decoded = jax.nn.relu(dense(params["decoder"], code))
    log_variance = image = None
    if cfg.heteroscedastic:
        # Bounded smoothly, so that no reading can make the loss overflow.
        log_variance = LOG_VARIANCE_LIMIT * jnp.tanh(dense(params["log_variance"], decoded) / LOG_VARIANCE_LIMIT)
    if cfg.auxiliary:
        image = apply_mlp([params["auxiliary"], params["image"]], latent).reshape(cfg.pixels, cfg.pixels)
    return Prediction(dense(params["reading"], decoded), log_variance, image, latent)


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


def _layer_key(key: Key[Array, ""], name: str) -> Key[Array, ""]:
    """A layer's own key, from a hash of its name: layers that are added or left out change no other. (It is the key
    that flax.linen gives to a layer's first parameter; trainings of earlier versions start with the same weights.)
    """
    digest = hashlib.sha1(name.encode() + b"\x01", usedforsecurity=False).digest()
    return jax.random.fold_in(key, jnp.uint32(int.from_bytes(digest[:4], "big")))


def _convolution(layer: Layer, image: Float[Array, "h w c"]) -> Float[Array, "half_h half_w d"]:
    """A convolution of stride 2; outside of the image is zero."""
    numbers = ("NHWC", "HWIO", "NHWC")
    convolved = jax.lax.conv_general_dilated(image[None], layer["kernel"], (2, 2), "SAME", dimension_numbers=numbers)
    return convolved[0] + layer["bias"][None, None]
