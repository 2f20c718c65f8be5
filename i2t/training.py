"""Training as pure functions of explicit state: minibatch Adam over data that stays on the device. What is trained is a
`Learner`: parameters to begin with, and the loss of a batch.

    epoch = training.compiled(learner, cfg)
    state = training.init(key, learner, cfg, touches)
    while not training.finished(state, cfg):
        state, info = epoch(state, train, validation)

An epoch draws a permutation from `fold_in(key, epoch)`, cuts it into minibatches and takes one AdamW step on the mean
loss of each; where the batch size does not divide the number of touches the last minibatch is filled up with touches of
weight zero, so every touch counts once an epoch. After each epoch the validation touches are scored and the best
parameters so far are kept; `finished` says when no better ones are to be expected (early stopping; Prechelt, "Early
stopping - but when?", 1998). All of it is in the state: a training that goes on from
any state repeats the uninterrupted one bit for bit. Members of an ensemble are axis 0 of every array of the state: each
has its own key, minibatches and best epoch. `descend` is for small problems, a step for each key.
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

from i2t.runtime.batching import spread_rows
from i2t.types import in_one_line

Tree = TypeVar("Tree")


class Losses(NamedTuple):
    """Parts of the loss, means over a batch or one for each of its examples, all dimensionless."""

    total: Float[Array, "..."]  # what is descended
    reading: Float[Array, "..."]  # what the best epoch is chosen by, on validation examples
    squared: Float[Array, "..."]  # squared error of the reading, whatever was trained
    image: Float[Array, "..."]  # of an auxiliary decoder; 0 without one

    def mean(self, weights: Float[Array, " n"]) -> "tuple[Float[Array, ''], Losses]":
        """Mean loss, and all parts.

        Args:
            weights: Of the examples.

        Returns:
            Weighted means over the examples.
        """
        parts = jax.tree.map(lambda part: part @ weights / weights.sum(), self)
        return parts.total, parts


class Batch(NamedTuple):
    """Examples to learn from, on axis 0."""

    inputs: PyTree
    target: Float[Array, "n c"]


class Learner(NamedTuple):
    """Training task: hashable, so that equal ones are compiled once."""

    cfg: Hashable  # sizes and weights, without arrays
    init: Callable[[Key[Array, ""], Any], PyTree]  # (key, cfg) -> parameters of one member
    losses: Callable[..., tuple[Array, Losses]]  # (parameters, cfg, batch, weights) -> what is descended, all parts
    members: int = 1


@in_one_line
class Standard(NamedTuple):
    """Mean and standard deviation of each value over a training set."""

    mean: Float[Array, " k"]
    std: Float[Array, " k"]


class TrainState(NamedTuple):
    """State of a training between epochs; every array has the members as axis 0."""

    params: PyTree
    opt_state: PyTree
    key: Key[Array, " m"]
    epoch: Int[Array, " m"]  # epochs done
    best_params: PyTree  # as params
    best_loss: Float[Array, " m"]  # on validation touches; +inf before the first epoch
    best_epoch: Int[Array, " m"]


class EpochInfo(NamedTuple):
    """Losses of an epoch."""

    train: Losses  # mean over the epoch's minibatches, each before its step
    validation: Losses  # after the epoch; NaN where there are no validation touches


@dataclass(frozen=True)
class TrainConfig:
    """Training options."""

    epochs: int = 200  # at most, over which the learning rate falls
    batch_size: int = 128
    learning_rate: float = 1e-3
    # Epochs without a better one after which a training ends. Chosen on three simulated pads with three seeds each, by
    # R2 on six objects outside the default preset: as good as 30, in 0.63 of the epochs; 7 lost 0.003 on masks.
    patience: int = 10

    def __post_init__(self) -> None:
        """Refuse impossible values (ValueError)."""
        for name in ("epochs", "batch_size", "patience"):
            if getattr(self, name) < 1:
                raise ValueError(f"train.{name} is {getattr(self, name)}; it must be at least 1.")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise ValueError(f"train.learning_rate is {self.learning_rate}; it must be a number above 0.")

    def optimizer(self, touches: int) -> optax.GradientTransformation:
        """Adam (Kingma and Ba, 2015), whose learning rate falls to 0 by a cosine.

        Args:
            touches: Of the training set, which make an epoch.

        Returns:
            The optimizer.
        """
        steps = self.epochs * -(-touches // self.batch_size)
        return optax.adam(optax.cosine_decay_schedule(self.learning_rate, steps))


def standard(values: Float[Array, "n k"]) -> Standard:
    """Mean and standard deviation over a training set; a value that never changes keeps its unit.

    Args:
        values: In physical units.

    Returns:
        Of each column.
    """
    mean, std = values.mean(0), values.std(0)
    resolution = jnp.finfo(values.dtype).eps * jnp.sqrt(len(values)) * jnp.abs(mean)  # what rounding makes of none
    return Standard(mean, jnp.where(std > resolution, std, 1.0))


def standardise(scale: Standard, values: Float[Array, " k"]) -> Float[Array, " k"]:
    """Physical values in standard deviations about their mean.

    Args:
        scale: Mean and standard deviation of each value over the training set.
        values: In their physical units.

    Returns:
        Dimensionless values.
    """
    return (values - scale.mean) / scale.std


def init(key: Key[Array, ""], learner: Learner, cfg: TrainConfig, touches: int) -> TrainState:
    """The state before the first epoch; member i depends on `fold_in(key, i)` only.

    Args:
        key: Random key.
        learner: What is trained.
        cfg: How to train.
        touches: In the training set.

    Returns:
        The state, members as axis 0.
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
    """Touches that one member meets in an epoch, and their weights.

    Args:
        key: The member's.
        epoch: Epochs done before.
        touches: In the training set.
        size: Of a minibatch.

    Returns:
        Rows of a new permutation for each epoch, and their weights: 1, and 0 where the last minibatch is filled up.
    """
    steps = -(-touches // size)
    permutation = jax.random.permutation(jax.random.fold_in(key, epoch), touches)
    rows = jnp.pad(permutation, (0, steps * size - touches)).reshape(steps, size)
    return rows, (jnp.arange(steps * size) < touches).astype(jnp.float32).reshape(steps, size)


@lru_cache(maxsize=8)
def compiled(
    learner: Learner, cfg: TrainConfig
) -> Callable[[TrainState, Batch, Batch | None], tuple[TrainState, EpochInfo]]:
    """An epoch of all members as one program.

    On a CPU they are trained one after the other, as a few cores have no use for several products at once; on several
    devices each trains its share of them.

    Args:
        learner: What is trained.
        cfg: How to train.

    Returns:
        `epoch` with its first two arguments, to be called with states, touches and validation touches.
    """
    one = partial(epoch, learner, cfg)
    one = jax.custom_batching.sequential_vmap(one) if jax.default_backend() == "cpu" else one

    def members(state: TrainState, train: Batch, validation: Batch | None) -> tuple[TrainState, EpochInfo]:
        given = state._replace(key=jax.random.clone(state.key))  # epochs fold their number in, and may be repeated
        after, info = jax.vmap(one, in_axes=(0, None, None))(given, train, validation)
        return after._replace(key=jax.random.clone(state.key)), info

    program = jax.jit(members)
    return program if jax.device_count() == 1 else partial(_spread, program)


def _spread(program: Callable, state: TrainState, *shared: Batch | None) -> tuple[TrainState, EpochInfo]:
    made: tuple[TrainState, EpochInfo] = spread_rows(program, (state,), shared=shared)
    return made


def epoch(
    learner: Learner, cfg: TrainConfig, state: TrainState, train: Batch, validation: Batch | None
) -> tuple[TrainState, EpochInfo]:
    """One epoch of one member.

    Args:
        learner: What is trained.
        cfg: How to train.
        state: Of the member.
        train: Prepared touches to learn from.
        validation: Prepared touches that choose the best epoch; without them it is the last.

    Returns:
        The state after the epoch, and its losses.
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
    """Tell whether a training has had its epochs, or all its members have waited long enough for a better one.

    Args:
        state: Between epochs.
        cfg: How to train.

    Returns:
        Whether it has.
    """
    epoch, best = np.asarray(state.epoch), np.asarray(state.best_epoch)
    return bool(np.all((epoch >= cfg.epochs) | (epoch - best >= cfg.patience)))


def evaluate(params: PyTree, learner: Learner, batch: Batch) -> Losses:
    """Mean losses of one member over prepared examples.

    Args:
        params: Of one member.
        learner: What was trained.
        batch: Prepared examples.

    Returns:
        Means over the examples.
    """
    return learner.losses(params, learner.cfg, batch, jnp.ones(len(batch.target)))[1]


def descend(
    params: Tree,
    loss: Callable[[Tree, Key[Array, ""]], Float[Array, ""]],
    optimizer: optax.GradientTransformation,
    keys: Key[Array, " steps"],
) -> tuple[Tree, Float[Array, " steps"]]:
    """Descend a loss, one step for each key; pure, to be jitted by the caller.

    Args:
        params: Where to start: any tree of arrays that the loss takes.
        loss: `loss(params, key)`; a full-batch loss ignores the key, another draws its minibatch with it.
        optimizer: Optax's rule of a step.
        keys: A key for each step, for instance `jax.random.split(key, steps)`.

    Returns:
        The parameters after the last step, and the loss before each step.
    """

    def step(
        carry: tuple[Tree, optax.OptState], key: Key[Array, ""]
    ) -> tuple[tuple[Tree, optax.OptState], Float[Array, ""]]:
        now, moments = carry
        value, gradient = jax.value_and_grad(loss)(now, key)
        updates, moments = optimizer.update(gradient, moments, now)
        return (optax.apply_updates(now, updates), moments), value

    (params, _), path = jax.lax.scan(step, (params, optimizer.init(params)), keys)
    return params, path


def _step(
    learner: Learner,
    optimizer: optax.GradientTransformation,
    train: Batch,
    carry: tuple[PyTree, PyTree],
    rows_weights: tuple[Array, Array],
) -> tuple[tuple[PyTree, PyTree], tuple[Losses, Array]]:
    """Step on one minibatch: new (params, opt_state), the mean losses and the number of their touches."""
    (params, opt_state), (rows, weights) = carry, rows_weights
    batch = jax.tree.map(lambda leaf: leaf[rows], train)
    gradient, parts = jax.grad(learner.losses, has_aux=True)(params, learner.cfg, batch, weights)
    # Without the barrier XLA may update a matrix while its old value is still needed for other gradients, at the price
    # of a copy of it in each step.
    gradient, params = jax.lax.optimization_barrier((gradient, params))
    updates, opt_state = optimizer.update(gradient, opt_state, params)
    return (optax.apply_updates(params, updates), opt_state), (parts, weights.sum())
