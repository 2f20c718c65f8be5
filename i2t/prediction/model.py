"""Networks beyond the paper's, built of its parts (`i2t.paper.network`), and functions that every network needs.

By configuration the input is any square image (say a predicted contact pressure);
conditions measured at contact (force, nearest, depth) join the image's features at the encoder's input and again, for
the reading, next to the bottleneck, because what the camera saw does not tell how hard the skin is pressed; and a
second output predicts the log variance of each value, which makes the loss of a reading the Gaussian one,

    (s + (y - m)^2 exp(-s) + log 2 pi) / 2,  weighted by exp(beta s) held constant

for a reading y, its prediction m and its log variance s: beta = 0 is the likelihood itself, beta = 0.5 keeps poorly
fitted readings from being explained away as noise (Seitzer et al., "On the pitfalls of heteroscedastic uncertainty
estimation with probabilistic neural networks", 2022).

Inside a network everything is standardised; `predict` speaks physical units. Parameters are one plain pytree; the
members of an ensemble are its axis 0. `init`, `apply` and `losses` work on one member and one example and are lifted by
`vmap`; `predict` mixes members (Lakshminarayanan et al., "Simple and scalable predictive uncertainty estimation using
deep ensembles", 2017).
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from i2t.paper import loss, network
from i2t.paper.config import PaperConfig
from i2t.paper.network import Params, decode, decode_image, dense, encode
from i2t.training import Batch, Learner, Losses, Standard, standard, standardise
from i2t.types import in_one_line

Condition: TypeAlias = Literal["force", "nearest", "depth"]

LOG_VARIANCE_LIMIT = 10.0  # of standardised readings: standard deviations between 0.7 % and 150 times the data's own


class Inputs(NamedTuple):
    """Inputs of a network for one touch."""

    image: Float[Array, "n n"]  # a patch in m, or whatever `PaperConfig.input` says
    conditions: Float[Array, " k"]  # in the order of `ModelConfig.conditions`: N, m, m


class MemberPrediction(NamedTuple):
    """Prediction of one member for one touch, in standardised units."""

    reading: Float[Array, " c"]
    log_variance: Float[Array, " c"] | None  # None unless heteroscedastic
    image: Float[Array, "n n"] | None  # the prepared image decoded again (logits for a mask), by the auxiliary head
    latent: Float[Array, " b"]


@in_one_line
class Normalisation(NamedTuple):
    """Scales between physical units and the network's."""

    reading: Standard  # uT
    conditions: Standard  # in the order of `ModelConfig.conditions`
    residual: Float[Array, " c"]  # variance (standardised) that a model without variance of its own leaves unexplained


@dataclass(frozen=True)
class ModelConfig(PaperConfig):
    """A network's options; without its own fields, the paper's."""

    auxiliary: bool = True  # whether there is an auxiliary decoder
    heteroscedastic: bool = False
    beta: float = 0.5  # of the Gaussian loss
    conditions: tuple[Condition, ...] = ()
    members: int = 1

    def __post_init__(self) -> None:
        """Refuse impossible values (ValueError)."""
        super().__post_init__()
        unknown = [name for name in self.conditions if name not in get_args(Condition)]
        if unknown or len(set(self.conditions)) < len(self.conditions):
            raise ValueError(
                f"model.conditions is {self.conditions}; name each of {', '.join(get_args(Condition))} at most once."
            )
        if self.members < 1:
            raise ValueError(f"model.members is {self.members}; it must be at least 1.")
        if not 0 <= self.beta <= 1:
            raise ValueError(f"model.beta is {self.beta}; it must lie between 0 and 1.")


class Network(nn.Module):
    """One member on one example."""

    cfg: ModelConfig

    @nn.compact
    def __call__(self, inputs: Inputs) -> MemberPrediction:
        """`inputs` are prepared (see `prepare`)."""
        cfg = self.cfg
        latent = encode(cfg, jnp.concatenate([inputs.image.reshape(-1), inputs.conditions]))
        decoded = decode(cfg, jnp.concatenate([latent, inputs.conditions]))
        reading = dense(cfg.readings, "reading")(decoded)
        log_variance = None
        if cfg.heteroscedastic:
            # Starts at the data's own variance, and is bounded smoothly so that no reading can make the loss overflow.
            raw = nn.Dense(cfg.readings, kernel_init=nn.initializers.zeros, name="log_variance")(decoded)
            log_variance = LOG_VARIANCE_LIMIT * jnp.tanh(raw / LOG_VARIANCE_LIMIT)
        return MemberPrediction(reading, log_variance, decode_image(cfg, latent) if cfg.auxiliary else None, latent)


def init(key: Key[Array, ""], cfg: ModelConfig) -> Params:
    """Random parameters of one member, as `i2t.paper.network.init` draws them.

    Args:
        key: Random key.
        cfg: Which network.

    Returns:
        Layers by name.
    """
    example = Inputs(jnp.zeros((cfg.pixels, cfg.pixels)), jnp.zeros(len(cfg.conditions)))
    params: Params = Network(cfg).init(key, example)["params"]
    return params


def apply(params: Params, cfg: PaperConfig, inputs: Inputs | Array) -> MemberPrediction:
    """One member's prediction for one example, both in the network's units.

    Args:
        params: Of one member.
        cfg: Which network.
        inputs: As `prepare` gives them.

    Returns:
        The reading and what else the network gives.
    """
    if not isinstance(cfg, ModelConfig):
        assert not isinstance(inputs, Inputs)
        said = network.apply(params, cfg, inputs)
        return MemberPrediction(said.reading, None, said.image, said.latent)
    prediction: Any = Network(cfg).apply({"params": params}, inputs)
    return prediction


def losses(
    params: Params, cfg: ModelConfig, batch: Batch, weights: Float[Array, " n"]
) -> tuple[Float[Array, ""], Losses]:
    """The mean loss of some examples and its parts.

    The best epoch is chosen by the likelihood itself (beta 0), because beta's weights, good for gradients, would reward
    any small variance.

    Args:
        params: Of one member.
        cfg: Which network, and its weights.
        batch: Of `Inputs`, prepared, with standardised readings.
        weights: Of the examples.

    Returns:
        What is descended, and all parts.
    """
    said = jax.vmap(partial(apply, params, cfg))(batch.inputs)
    squared = jax.vmap(loss.squared_error)(said.reading, batch.target)
    descended = reading = squared
    if said.log_variance is not None:
        likelihood = jax.vmap(gaussian, in_axes=(0, 0, 0, None))
        descended, reading = (likelihood(said.reading, said.log_variance, batch.target, b) for b in (cfg.beta, 0.0))
    image = jnp.zeros(len(weights))
    if said.image is not None:
        image = jax.vmap(partial(loss.image_error, cfg.input))(said.image, batch.inputs.image)
    return Losses(descended + cfg.auxiliary_weight * image, reading, squared, image).mean(weights)


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


def learner(cfg: PaperConfig) -> Learner:
    """Learner for `i2t.training`.

    Args:
        cfg: Which network; the paper's looks at patches, any other at `Inputs`.

    Returns:
        The learner.
    """
    if isinstance(cfg, ModelConfig):
        return Learner(cfg, init, losses, cfg.members)
    return Learner(cfg, network.init, loss.losses)


def check(batch: Batch, cfg: PaperConfig, name: str) -> None:
    """Refuse touches that cannot be learned from.

    Args:
        batch: Of `Inputs`, in physical units.
        cfg: Which network is to learn from them.
        name: Of the set, for the message: "training" or "validation".

    Raises:
        ValueError: There are no touches, shapes do not fit the network, or values are not finite.
    """
    touches = len(batch.target)
    if touches == 0:
        raise ValueError(f"The {name} set holds no touches; choose other objects or another split.")
    if batch.inputs.image.shape != (touches, cfg.pixels, cfg.pixels):
        raise ValueError(
            f"The {name} set's images have shape {batch.inputs.image.shape}; {touches} touches of model.pixels = "
            f"{cfg.pixels} are expected."
        )
    bad = [("image", batch.inputs.image, (1, 2)), ("reading", batch.target, (1,))]
    bad += [(f"condition {c!r}", batch.inputs.conditions[:, i], ()) for i, c in enumerate(conditions_of(cfg))]
    for label, values, axes in bad:
        wrong = ~np.isfinite(np.asarray(values)).all(axis=axes)
        if wrong.any():
            raise ValueError(
                f"{wrong.sum()} of {touches} touches of the {name} set have a {label} that is not finite (first at "
                f"index {np.argmax(wrong)}); leave these touches out, or train without that input."
            )


def conditions_of(cfg: PaperConfig) -> tuple[Condition, ...]:
    """Conditions of a network beside the image.

    Args:
        cfg: Which network.

    Returns:
        Names of conditions; none for the paper's.
    """
    return cfg.conditions if isinstance(cfg, ModelConfig) else ()


def normalisation(batch: Batch) -> Normalisation:
    """Mean and standard deviation of the readings and conditions of a training set.

    Args:
        batch: Of `Inputs`, in physical units.

    Returns:
        The normalisation, without a residual.
    """
    return Normalisation(standard(batch.target), standard(batch.inputs.conditions), jnp.zeros(batch.target.shape[1]))


def prepare(cfg: PaperConfig, norm: Normalisation, inputs: Inputs) -> Inputs | Array:
    """Physical inputs of one touch as the network wants them.

    Args:
        cfg: Which network.
        norm: Of the training set.
        inputs: The image (m, or N on each cell for a contact pressure) and the conditions (N, m, m).

    Returns:
        The image in [0, 1] unless it is taken as it is, and the conditions standardised; for the paper's network the
        patch alone.
    """
    image = network.prepare_patch(cfg, inputs.image)
    if not isinstance(cfg, ModelConfig):
        return image
    return Inputs(image, standardise(norm.conditions, inputs.conditions))


def prepared(cfg: PaperConfig, norm: Normalisation, batch: Batch) -> Batch:
    """Physical touches in the network's units.

    Args:
        cfg: Which network.
        norm: Of the training set.
        batch: Of `Inputs`, in physical units.

    Returns:
        The same touches, prepared for its learner.
    """
    inputs = jax.vmap(partial(prepare, cfg, norm))(batch.inputs)
    return Batch(inputs, jax.vmap(partial(standardise, norm.reading))(batch.target))


def with_residual(params: Params, cfg: PaperConfig, norm: Normalisation, batch: Batch) -> Normalisation:
    """Note in the normalisation the variance that all members leave unexplained on touches not trained on.

    It is the mean squared error of their mean less the variance they already show, so that `predict` has the right
    standard deviation on these touches.

    Args:
        params: Members as axis 0.
        cfg: Which network.
        norm: Of the training set.
        batch: Prepared touches.

    Returns:
        The normalisation with its residual.
    """
    readings = jax.vmap(lambda member: jax.vmap(lambda x: apply(member, cfg, x).reading)(batch.inputs))(params)
    unexplained = jnp.mean((readings.mean(0) - batch.target) ** 2 - readings.var(0), axis=0)
    return norm._replace(residual=jnp.maximum(unexplained, 0))


def predict(
    params: Params, cfg: PaperConfig, norm: Normalisation, inputs: Inputs
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Reading of one touch from all members.

    The members' mixture has the mean of their means and, for its variance, the mean of their variances plus the
    variance of their means (Lakshminarayanan et al. 2017). Members without a variance of their own share the residual
    one.

    Args:
        params: Members as axis 0.
        cfg: Which network.
        norm: Of the training set, with the residual of the validation set.
        inputs: In physical units.

    Returns:
        Mean and standard deviation, uT.
    """
    ready = prepare(cfg, norm, inputs)
    members = jax.vmap(lambda member: apply(member, cfg, ready))(params)
    own = norm.residual if members.log_variance is None else jnp.exp(members.log_variance).mean(0)
    std = jnp.sqrt(own + members.reading.var(0))
    mean = members.reading.mean(0) * norm.reading.std + norm.reading.mean
    return mean, std * norm.reading.std
