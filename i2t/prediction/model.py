"""Networks beyond the paper's, built from its parts (`i2t.paper.network`), and functions that all networks share.

The configuration allows any square image as input, such as a predicted contact pressure.
Conditions measured at contact (force, nearest, travel) join the image's features at the encoder's input and, for the
reading, again next to the bottleneck, because the camera's view does not show how hard the skin is pressed.
A second output predicts the log variance of each value, and the loss of a reading becomes the Gaussian one,

    (s + (y - m)^2 exp(-s) + log 2 pi) / 2,  weighted by exp(beta s) held constant

for a reading y, its prediction m and its log variance s. With beta = 0 it is the likelihood itself; beta = 0.5 prevents
poorly fitted readings from being explained away as noise (Seitzer et al., "On the pitfalls of heteroscedastic
uncertainty estimation with probabilistic neural networks", 2022).

Inside a network everything is standardised; `predict` uses physical units. Parameters are one plain pytree, whose
axis 0 counts the members of an ensemble. `init`, `apply` and `losses` work on one member and one example and are lifted
by `vmap`; `predict` mixes members (Lakshminarayanan et al., "Simple and scalable predictive uncertainty estimation
using deep ensembles", 2017).
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

Condition: TypeAlias = Literal["force", "nearest", "travel"]


class Inputs(NamedTuple):
    """Inputs of a network for one touch: a patch (m) or contact pressure (N), and conditions (N, m) at contact.

    `prepare` converts them to the network's units.
    """

    image: Float[Array, "n n"]  # a patch in m, or another image by `PaperConfig.input`
    conditions: Float[Array, " k"]  # conditions in the order of `ModelConfig.conditions`: N, m, m


class MemberPrediction(NamedTuple):
    """Output of one member of an ensemble for one touch: standardised reading, log variance, image and latent code."""

    reading: Float[Array, " c"]
    log_variance: Float[Array, " c"] | None  # predicted log variance of the reading; None unless heteroscedastic
    image: Float[Array, "n n"] | None  # the input image as the auxiliary head decodes it (logits for a mask)
    latent: Float[Array, " b"]


@in_one_line
class Normalisation(NamedTuple):
    """Means and standard deviations that standardise readings and conditions, and the residual variance of readings.

    The residual, in standardised units, serves networks that predict no variance.
    """

    reading: Standard  # uT
    conditions: Standard  # in the order of `ModelConfig.conditions`
    residual: Float[Array, " c"]  # standardised variance of the errors of a model that predicts no variance


@dataclass(frozen=True)
class ModelConfig(PaperConfig):
    """Options of a network beyond the paper's: auxiliary decoder, predicted variance, conditions and ensemble size."""

    auxiliary: bool = True  # whether there is an auxiliary decoder
    heteroscedastic: bool = False
    beta: float = 0.5  # exponent of the weights in the Gaussian loss
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
    """One network of an ensemble, as a Flax module: from standardised inputs of one touch to its standardised reading.

    It also gives the log variance and the decoded image if the configuration asks for them, and the latent code.
    """

    cfg: ModelConfig

    @nn.compact
    def __call__(self, inputs: Inputs) -> MemberPrediction:
        """Apply the network to prepared inputs (see `prepare`)."""
        cfg = self.cfg
        latent = encode(cfg, jnp.concatenate([inputs.image.reshape(-1), inputs.conditions]))
        decoded = decode(cfg, jnp.concatenate([latent, inputs.conditions]))
        reading = dense(cfg.readings, "reading")(decoded)
        log_variance = None
        if cfg.heteroscedastic:
            # The output starts at the data's own variance. Its smooth bound keeps the loss from overflowing: standard
            # deviations lie between 0.7 % and 150 times the data's own.
            limit = 10.0
            raw = nn.Dense(cfg.readings, kernel_init=nn.initializers.zeros, name="log_variance")(decoded)
            log_variance = limit * jnp.tanh(raw / limit)
        return MemberPrediction(reading, log_variance, decode_image(cfg, latent) if cfg.auxiliary else None, latent)


def init(key: Key[Array, ""], cfg: ModelConfig) -> Params:
    """Draw random parameters of one member, as `i2t.paper.network.init` does.

    Args:
        key: Random key.
        cfg: Configuration of the network.

    Returns:
        Parameters of the layers by name.
    """
    example = Inputs(jnp.zeros((cfg.pixels, cfg.pixels)), jnp.zeros(len(cfg.conditions)))
    params: Params = Network(cfg).init(key, example)["params"]
    return params


def apply(params: Params, cfg: PaperConfig, inputs: Inputs | Array) -> MemberPrediction:
    """Predict the reading of one touch with one member, all in the network's standardised units.

    Args:
        params: Parameters of one member.
        cfg: Configuration of the network.
        inputs: Inputs from `prepare`.

    Returns:
        The standardised reading with the other outputs of the network.
    """
    if not isinstance(cfg, ModelConfig):
        assert not isinstance(inputs, Inputs)
        paper = network.apply(params, cfg, inputs)
        return MemberPrediction(paper.reading, None, paper.image, paper.latent)
    prediction: Any = Network(cfg).apply({"params": params}, inputs)
    return prediction


def losses(
    params: Params, cfg: ModelConfig, batch: Batch, weights: Float[Array, " n"]
) -> tuple[Float[Array, ""], Losses]:
    """Compute a network's mean loss over a minibatch of touches, and its parts.

    The epoch is chosen by the likelihood itself (beta 0), because the weights of beta, which help the gradients, would
    reward any small variance.

    Args:
        params: Parameters of one member.
        cfg: Configuration of the network and of its loss.
        batch: Prepared `Inputs` with standardised readings.
        weights: Weights of the examples.

    Returns:
        Weighted mean of the loss that training minimises, and weighted means of its parts, all dimensionless.
    """
    prediction = jax.vmap(partial(apply, params, cfg))(batch.inputs)
    squared = jax.vmap(loss.squared_error)(prediction.reading, batch.target)
    minimised = reading = squared
    if prediction.log_variance is not None:
        likelihood = jax.vmap(gaussian, in_axes=(0, 0, 0, None))
        minimised, reading = (
            likelihood(prediction.reading, prediction.log_variance, batch.target, beta) for beta in (cfg.beta, 0.0)
        )
    image = jnp.zeros(len(weights))
    if prediction.image is not None:
        image = jax.vmap(partial(loss.image_error, cfg.input))(prediction.image, batch.inputs.image)
    return Losses(minimised + cfg.auxiliary_weight * image, reading, squared, image).mean(weights)


def gaussian(
    reading: Float[Array, " k"], log_variance: Float[Array, " k"], target: Float[Array, " k"], beta: float
) -> Float[Array, ""]:
    """Compute the beta-weighted negative log likelihood of a reading, averaged over its k values.

    The gradient treats the weights as constants.

    Args:
        reading: Predicted standardised reading.
        log_variance: Predicted log variance of each value.
        target: Measured standardised reading.
        beta: Exponent of the weights; 0 gives the likelihood itself.

    Returns:
        Scalar loss without unit.
    """
    nll = 0.5 * (log_variance + (target - reading) ** 2 * jnp.exp(-log_variance) + jnp.log(2 * jnp.pi))
    return jnp.mean(jax.lax.stop_gradient(jnp.exp(beta * log_variance)) * nll)


def learner(cfg: PaperConfig) -> Learner:
    """Make the learner of a network for `i2t.training`.

    Args:
        cfg: Configuration of the network. The paper's network takes patches, any other one `Inputs`.

    Returns:
        Learner with the network's initialisation and losses.
    """
    if isinstance(cfg, ModelConfig):
        return Learner(cfg, init, losses, cfg.members)
    return Learner(cfg, network.init, loss.losses)


def check(batch: Batch, cfg: PaperConfig, name: str) -> None:
    """Refuse a set of touches that is unsuitable for training a network.

    Args:
        batch: `Inputs` and readings in physical units.
        cfg: Configuration of the network that is to be trained.
        name: Name of the set, "training" or "validation", for messages.

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
                f"{wrong.sum()} of {touches} touches of the {name} set have a non-finite {label} (first at index "
                f"{np.argmax(wrong)}); leave these touches out, or train without that input."
            )


def conditions_of(cfg: PaperConfig) -> tuple[Condition, ...]:
    """List the measured conditions (force, nearest, travel) that a network takes in addition to the image.

    Args:
        cfg: Configuration of the network.

    Returns:
        Names of the conditions; none for the paper's network.
    """
    return cfg.conditions if isinstance(cfg, ModelConfig) else ()


def normalisation(batch: Batch) -> Normalisation:
    """Compute mean and standard deviation of the readings and conditions of a training set.

    Args:
        batch: `Inputs` and readings in physical units.

    Returns:
        Normalisation without a residual.
    """
    return Normalisation(standard(batch.target), standard(batch.inputs.conditions), jnp.zeros(batch.target.shape[1]))


def prepare(cfg: PaperConfig, norm: Normalisation, inputs: Inputs) -> Inputs | Array:
    """Convert the physical inputs of one touch to the network's units.

    Args:
        cfg: Configuration of the network.
        norm: Normalisation of the training set.
        inputs: The image (m, or N on each cell for a contact pressure) and the conditions (N, m, m).

    Returns:
        Image, scaled to [0, 1] if the network asks for it, and standardised conditions; for the paper's network the
        image alone.
    """
    image = network.prepare_patch(cfg, inputs.image)
    if not isinstance(cfg, ModelConfig):
        return image
    return Inputs(image, standardise(norm.conditions, inputs.conditions))


def prepared(cfg: PaperConfig, norm: Normalisation, batch: Batch) -> Batch:
    """Convert physical touches to the network's units.

    Args:
        cfg: Configuration of the network.
        norm: Normalisation of the training set.
        batch: `Inputs` and readings in physical units.

    Returns:
        The same touches with prepared inputs and standardised readings.
    """
    inputs = jax.vmap(partial(prepare, cfg, norm))(batch.inputs)
    return Batch(inputs, jax.vmap(partial(standardise, norm.reading))(batch.target))


def with_residual(params: Params, cfg: PaperConfig, norm: Normalisation, batch: Batch) -> Normalisation:
    """Add to the normalisation the variance that the members leave unexplained on touches outside the training set.

    It is the mean squared error of the members' mean less their own variance, so that `predict` has the right standard
    deviation on these touches.

    Args:
        params: Parameters with members as axis 0.
        cfg: Configuration of the network.
        norm: Normalisation of the training set.
        batch: Prepared touches.

    Returns:
        Normalisation with its residual.
    """
    readings = jax.vmap(lambda member: jax.vmap(lambda x: apply(member, cfg, x).reading)(batch.inputs))(params)
    unexplained = jnp.mean((readings.mean(0) - batch.target) ** 2 - readings.var(0), axis=0)
    return norm._replace(residual=jnp.maximum(unexplained, 0))


def predict(
    params: Params, cfg: PaperConfig, norm: Normalisation, inputs: Inputs
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Predict the reading of one touch from all members.

    The mixture of the members has the mean of their means. Its variance is the mean of their variances plus the
    variance of their means (Lakshminarayanan et al. 2017). Members that predict no variance share the residual one.

    Args:
        params: Parameters with members as axis 0.
        cfg: Configuration of the network.
        norm: Normalisation of the training set, with the residual of the validation set.
        inputs: Inputs in physical units.

    Returns:
        `(c,)` mean and `(c,)` standard deviation of the reading (uT).
    """
    ready = prepare(cfg, norm, inputs)
    members = jax.vmap(lambda member: apply(member, cfg, ready))(params)
    own = norm.residual if members.log_variance is None else jnp.exp(members.log_variance).mean(0)
    std = jnp.sqrt(own + members.reading.var(0))
    mean = members.reading.mean(0) * norm.reading.std + norm.reading.mean
    return mean, std * norm.reading.std
