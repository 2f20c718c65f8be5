"""Training as pure functions of explicit state: minibatch Adam on data that stays on the device. A training task is a
`Learner`: initial parameters, and the loss of a batch.

    epoch = training.compiled(learner, cfg)
    state = training.init(key, learner, cfg, touches)
    while not training.finished(state, cfg):
        state, info = epoch(state, train, validation)

An epoch draws a permutation from `fold_in(key, epoch)`, divides it into minibatches and takes an AdamW step on the mean
loss of each. If the batch size does not divide the number of touches, the last minibatch is filled up with touches of
weight zero, so that every touch counts once in an epoch. After each epoch the validation touches are scored, and the
best parameters so far are kept. `finished` returns when no better parameters are to be expected (early stopping;
Prechelt, "Early stopping - but when?", 1998). The state is complete: a training that continues from any state repeats
the uninterrupted one bit for bit. Members of an ensemble are axis 0 of every array of the state, and each has its own
key, minibatches and best epoch. `descend` is for small problems and takes a step for each key.
"""

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from i2t.runtime.batching import map_rows_on_devices
from i2t.types import in_one_line

Tree = TypeVar("Tree")


class Losses(NamedTuple):
    """Dimensionless losses of a predictor of readings, for each example of a batch or as means over it."""

    total: Float[Array, "..."]  # total loss, which training minimises
    reading: Float[Array, "..."]  # loss of the reading, which determines the best epoch on validation examples
    squared: Float[Array, "..."]  # squared error of the reading, independent of the training loss
    image: Float[Array, "..."]  # loss of an auxiliary decoder; 0 without a decoder

    def mean(self, weights: Float[Array, " n"]) -> "tuple[Float[Array, ''], Losses]":
        """Average the losses of the examples.

        Args:
            weights: `(n,)` weights of the examples.

        Returns:
            Weighted mean of the total, and weighted means of all parts.
        """
        parts = jax.tree.map(lambda part: part @ weights / weights.sum(), self)
        return parts.total, parts


class Batch(NamedTuple):
    """Inputs of a network and target readings (n, c) of n training examples, along axis 0, as its losses take them."""

    inputs: PyTree
    target: Float[Array, "n c"]


class Learner(NamedTuple):
    """A training task: functions that initialise a network and compute its losses. Equal tasks are compiled once."""

    cfg: Hashable  # sizes and weights, without arrays
    init: Callable[[Key[Array, ""], Any], PyTree]  # function (key, cfg) -> parameters of one member
    # function (parameters, cfg, batch, weights) -> loss to minimise, all parts
    losses: Callable[..., tuple[Array, Losses]]
    members: int = 1


@in_one_line
class Standard(NamedTuple):
    """Mean and standard deviation of each of k values over a training set, in the values' units."""

    mean: Float[Array, " k"]
    std: Float[Array, " k"]


class TrainState(NamedTuple):
    """Parameters, optimizer state and best epoch of an ensemble in training, between epochs; members on axis 0."""

    params: PyTree
    opt_state: PyTree
    key: Key[Array, " m"]
    epoch: Int[Array, " m"]  # number of finished epochs
    best_params: PyTree  # parameters of the best epoch
    best_loss: Float[Array, " m"]  # loss of validation touches; +inf before the first epoch
    best_epoch: Int[Array, " m"]


class EpochInfo(NamedTuple):
    """Mean losses of one epoch: those of its minibatches, each before its step, and those of the validation touches
    after the epoch (NaN without validation touches).
    """

    train: Losses  # losses as means over the epoch's minibatches, evaluated before each step
    validation: Losses  # losses after the epoch; NaN without validation touches


@dataclass(frozen=True)
class TrainConfig:
    """Options of the training of networks: epochs, batch size, learning rate and patience.

    Example:
        training = i2t.TrainConfig(epochs=60, batch_size=32)
        predictor = i2t.fit_predictor(dataset, split, method="paper-depth", training=training)
    """

    epochs: int = 200  # largest number of epochs, over which the learning rate falls to 0
    batch_size: int = 128
    learning_rate: float = 1e-3
    # Epochs without improvement after which training ends. Chosen on three simulated pads with three seeds each, by R2
    # on six objects outside the default preset: as good as 30, in 0.63 of the epochs; 7 lost 0.003 on masks.
    patience: int = 10

    def __post_init__(self) -> None:
        """Refuse impossible values (ValueError)."""
        for name in ("epochs", "batch_size", "patience"):
            if getattr(self, name) < 1:
                raise ValueError(f"train.{name} is {getattr(self, name)}; it must be at least 1.")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise ValueError(f"train.learning_rate is {self.learning_rate}; it must be a number above 0.")

    def optimizer(self, touches: int) -> optax.GradientTransformation:
        """Make Adam (Kingma and Ba, 2015) with a learning rate that falls to 0 along a cosine.

        Args:
            touches: Number of touches in the training set, which make an epoch.

        Returns:
            The optimizer as a transformation of gradients.
        """
        steps = self.epochs * -(-touches // self.batch_size)
        return optax.adam(optax.cosine_decay_schedule(self.learning_rate, steps))


def standard(values: Float[Array, "n k"]) -> Standard:
    """Compute mean and standard deviation of each value over a training set; a constant value gets deviation 1.

    Args:
        values: `(n, k)` values in physical units.

    Returns:
        Mean and standard deviation of each of the k columns.
    """
    mean, std = values.mean(0), values.std(0)
    resolution = jnp.finfo(values.dtype).eps * jnp.sqrt(len(values)) * jnp.abs(mean)  # rounding error of a constant
    return Standard(mean, jnp.where(std > resolution, std, 1.0))


def standardise(scale: Standard, values: Float[Array, " k"]) -> Float[Array, " k"]:
    """Standardise physical values: subtract the mean of a training set and divide by its standard deviation.

    Args:
        scale: Mean and standard deviation of each value over the training set.
        values: `(k,)` values in physical units.

    Returns:
        `(k,)` dimensionless values.
    """
    return (values - scale.mean) / scale.std


def init(key: Key[Array, ""], learner: Learner, cfg: TrainConfig, touches: int) -> TrainState:
    """Make the training state before the first epoch. Member i of the ensemble depends on `fold_in(key, i)` only.

    Args:
        key: Random key.
        learner: The training task.
        cfg: Training options.
        touches: Number of touches in the training set.

    Returns:
        The state; axis 0 of its arrays is that of the members.
    """

    def member(index: Int[Array, ""]) -> TrainState:
        key_params, key_epochs = jax.random.split(jax.random.fold_in(key, index))
        params = learner.init(key_params, learner.cfg)
        zero = jnp.zeros((), jnp.int32)
        return TrainState(
            params=params,
            opt_state=cfg.optimizer(touches).init(params),
            key=key_epochs,
            epoch=zero,
            best_params=jax.tree.map(jnp.zeros_like, params),
            best_loss=jnp.full((), jnp.inf, jnp.float32),
            best_epoch=zero,
        )

    return jax.vmap(member)(jnp.arange(learner.members))


def minibatches(
    key: Key[Array, ""], epoch: Int[Array, ""], touches: int, size: int
) -> tuple[Int[Array, "steps size"], Float[Array, "steps size"]]:
    """Draw the minibatches of one ensemble member for one epoch.

    Args:
        key: Key of the member.
        epoch: Number of finished epochs.
        touches: Number of touches in the training set.
        size: Number of touches in a minibatch.

    Returns:
        `(steps, size)` row numbers from a permutation that is new in each epoch, and their weights: 1, or 0 for the
        rows that fill up the last minibatch.
    """
    steps = -(-touches // size)
    permutation = jax.random.permutation(jax.random.fold_in(key, epoch), touches)
    rows = jnp.pad(permutation, (0, steps * size - touches)).reshape(steps, size)
    return rows, (jnp.arange(steps * size) < touches).astype(jnp.float32).reshape(steps, size)


@lru_cache(maxsize=8)
def compiled(
    learner: Learner, cfg: TrainConfig
) -> Callable[[TrainState, Batch, Batch | None], tuple[TrainState, EpochInfo]]:
    """Compile the training of all ensemble members for one epoch.

    On a CPU the members are trained in turn, because a few cores do not benefit from several products in parallel. On
    several devices, each trains some of the members.

    Args:
        learner: The training task.
        cfg: Training options.

    Returns:
        A function that takes states, training touches and validation touches, and calls `epoch` for all members.
    """
    member = partial(epoch, learner, cfg)
    member = jax.custom_batching.sequential_vmap(member) if jax.default_backend() == "cpu" else member

    def members(state: TrainState, train: Batch, validation: Batch | None) -> tuple[TrainState, EpochInfo]:
        # The key may be used again, because each epoch folds its number in.
        before = state._replace(key=jax.random.clone(state.key))
        after, info = jax.vmap(member, in_axes=(0, None, None))(before, train, validation)
        return after._replace(key=jax.random.clone(state.key)), info

    program = jax.jit(members)
    return program if jax.device_count() == 1 else partial(_spread, program)


def _spread(program: Callable, state: TrainState, *shared: Batch | None) -> tuple[TrainState, EpochInfo]:
    result: tuple[TrainState, EpochInfo] = map_rows_on_devices(program, (state,), shared=shared)
    return result


def epoch(
    learner: Learner, cfg: TrainConfig, state: TrainState, train: Batch, validation: Batch | None
) -> tuple[TrainState, EpochInfo]:
    """Train one ensemble member for one epoch.

    Args:
        learner: The training task.
        cfg: Training options.
        state: State of the member.
        train: Prepared training touches.
        validation: Prepared touches that determine the best epoch; without them, the last epoch is the best.

    Returns:
        The state after the epoch, and the losses of the epoch.
    """
    touches = len(train.target)
    rows, weights = minibatches(state.key, state.epoch, touches, cfg.batch_size)
    step = partial(_step, learner, cfg.optimizer(touches), train)
    (params, opt_state), (parts, sums) = jax.lax.scan(step, (state.params, state.opt_state), (rows, weights))
    trained = jax.tree.map(lambda part: part @ sums / touches, parts)

    if validation is None:
        scored = jax.tree.map(lambda part: jnp.full_like(part, jnp.nan), trained)
        better = jnp.ones((), bool)
    else:
        scored = evaluate(params, learner, validation)
        better = scored.reading < state.best_loss
    after = TrainState(
        params=params,
        opt_state=opt_state,
        key=state.key,
        epoch=state.epoch + 1,
        best_params=jax.tree.map(partial(jnp.where, better), params, state.best_params),
        best_loss=jnp.where(better, scored.reading, state.best_loss),
        best_epoch=jnp.where(better, state.epoch + 1, state.best_epoch),
    )
    return after, EpochInfo(trained, scored)


def finished(state: TrainState, cfg: TrainConfig) -> bool:
    """Test whether each ensemble member has finished its epochs or has not improved for `patience` epochs.

    Args:
        state: Training state between epochs.
        cfg: Training options.

    Returns:
        True if all members are finished.
    """
    epoch, best = np.asarray(state.epoch), np.asarray(state.best_epoch)
    return bool(np.all((epoch >= cfg.epochs) | (epoch - best >= cfg.patience)))


def evaluate(params: PyTree, learner: Learner, batch: Batch) -> Losses:
    """Compute the mean losses of one ensemble member over prepared examples.

    Args:
        params: Network parameters of the member.
        learner: The training task.
        batch: Prepared examples.

    Returns:
        Losses as means over the examples.
    """
    return learner.losses(params, learner.cfg, batch, jnp.ones(len(batch.target)))[1]


def descend(
    params: Tree,
    loss: Callable[[Tree, Key[Array, ""]], Float[Array, ""]],
    optimizer: optax.GradientTransformation,
    keys: Key[Array, " steps"],
) -> tuple[Tree, Float[Array, " steps"]]:
    """Minimise a loss by gradient steps, one for each key. The function is pure; the caller compiles it.

    Args:
        params: Initial parameters, any tree of arrays that the loss takes.
        loss: Function `loss(params, key)`. A full-batch loss ignores the key, others draw a minibatch with it.
        optimizer: An optimizer of Optax.
        keys: A key for each step, such as `jax.random.split(key, steps)`.

    Returns:
        The parameters after the last step, and the loss before each step.
    """

    def step(
        carry: tuple[Tree, optax.OptState], key: Key[Array, ""]
    ) -> tuple[tuple[Tree, optax.OptState], Float[Array, ""]]:
        current, moments = carry
        value, gradient = jax.value_and_grad(loss)(current, key)
        updates, moments = optimizer.update(gradient, moments, current)
        return (optax.apply_updates(current, updates), moments), value

    (params, _), path = jax.lax.scan(step, (params, optimizer.init(params)), keys)
    return params, path


def _step(
    learner: Learner,
    optimizer: optax.GradientTransformation,
    train: Batch,
    carry: tuple[PyTree, PyTree],
    rows_weights: tuple[Array, Array],
) -> tuple[tuple[PyTree, PyTree], tuple[Losses, Array]]:
    """Take a step on a minibatch. Return new (params, opt_state), the mean losses and the number of touches."""
    (params, opt_state), (rows, weights) = carry, rows_weights
    batch = jax.tree.map(lambda leaf: leaf[rows], train)
    gradient, parts = jax.grad(learner.losses, has_aux=True)(params, learner.cfg, batch, weights)
    # Without the barrier, XLA may update a matrix while its old value is still needed for other gradients, which costs
    # a copy in each step.
    gradient, params = jax.lax.optimization_barrier((gradient, params))
    updates, opt_state = optimizer.update(gradient, opt_state, params)
    return (optax.apply_updates(params, updates), opt_state), (parts, weights.sum())
