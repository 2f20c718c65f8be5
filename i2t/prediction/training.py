"""Training as pure functions of explicit state: minibatch Adam over data that stays on the device.

An epoch draws a permutation from `fold_in(key, epoch)`, cuts it into minibatches and takes one AdamW step on the mean
loss of each; where the batch size does not divide the number of touches the last minibatch is filled up with touches of
weight zero, so every touch counts once an epoch. After each epoch the validation touches are scored and the best
parameters so far are kept, inside the compiled loop (early stopping, without stopping).

`fit` runs epochs in compiled chunks from any state it is given and reports on the way; every chunk is the same program,
whatever its length, so an interrupted and resumed training repeats the uninterrupted one bit for bit. Members of an
ensemble are axis 0 of every array of the state: each has its own key, minibatches and best epoch. `make_chunk` is the
pure function beneath, to be jitted, or mapped over the states of several seeds; on a CPU, members and seeds are then
trained one after the other within the one program.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from i2t.prediction import model as net
from i2t.prediction.loss import LossConfig, Losses, losses
from i2t.prediction.model import Inputs, ModelConfig, Normalisation, Params, Standard, standardise
from i2t.sharding import spread_rows


class Batch(NamedTuple):
    """Touches to learn from, in physical units, or in the network's after `prepare`."""

    inputs: Inputs  # image (n, h, w) m, conditions (n, k) N, m, m
    target: Float[Array, "n c"]  # uT


class TrainState(NamedTuple):
    """All that a training carries from epoch to epoch; every array has the members as axis 0."""

    params: Params
    opt_state: PyTree
    key: Key[Array, " m"]
    epoch: Int[Array, " m"]  # epochs done
    best_params: PyTree  # as params
    best_loss: Float[Array, " m"]  # on validation touches; +inf before the first epoch
    best_epoch: Int[Array, " m"]


class EpochInfo(NamedTuple):
    """What a person plots of an epoch."""

    train: Losses  # mean over the epoch's minibatches, each before its step
    validation: Losses  # after the epoch; NaN where there are no validation touches


@dataclass(frozen=True)
class TrainConfig:
    """How to train."""

    epochs: int = 200
    batch_size: int = 128
    learning_rate: float = 1e-3
    schedule: Literal["constant", "cosine"] = "cosine"  # cosine falls to 0 at the last epoch
    weight_decay: float = 0.0  # decoupled, of matrices only
    loss: LossConfig = field(default_factory=LossConfig)
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be run (ValueError)."""
        for name in ("epochs", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"train.{name} is {getattr(self, name)}; it must be at least 1.")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise ValueError(f"train.learning_rate is {self.learning_rate}; it must be a number above 0.")
        if not (math.isfinite(self.weight_decay) and self.weight_decay >= 0):
            raise ValueError(f"train.weight_decay is {self.weight_decay}; it must be a number >= 0.")
        if self.schedule not in get_args(Literal["constant", "cosine"]):
            raise ValueError(f"train.schedule is {self.schedule!r}; choose constant or cosine.")

    def optimizer(self, touches: int) -> optax.GradientTransformation:
        """AdamW with the schedule of the learning rate.

        Args:
            touches: Of the training set, which make an epoch.

        Returns:
            The optimizer; weights decay in matrices only.
        """
        rate: optax.ScalarOrSchedule = self.learning_rate
        if self.schedule == "cosine":
            rate = optax.cosine_decay_schedule(self.learning_rate, self.epochs * -(-touches // self.batch_size))
        matrices = partial(jax.tree.map, lambda leaf: leaf.ndim > 1)
        return optax.adamw(rate, weight_decay=self.weight_decay, mask=matrices)


def check(batch: Batch, model: ModelConfig, name: str) -> None:
    """Refuse touches that cannot be learned from.

    Args:
        batch: In physical units.
        model: Which network is to learn from them.
        name: Of the set, for the message: "training" or "validation".

    Raises:
        ValueError: There are no touches, shapes do not fit the network, or values are not finite.
    """
    touches = len(batch.target)
    if touches == 0:
        raise ValueError(f"The {name} set holds no touches; choose other objects or another split.")
    if batch.inputs.image.shape != (touches, model.pixels, model.pixels):
        raise ValueError(
            f"The {name} set's images have shape {batch.inputs.image.shape}; {touches} touches of model.pixels = "
            f"{model.pixels} are expected."
        )
    if batch.inputs.conditions.shape != (touches, len(model.conditions)):
        raise ValueError(
            f"The {name} set's conditions have shape {batch.inputs.conditions.shape}; {touches} touches of "
            f"model.conditions = {model.conditions} are expected."
        )
    bad = [("image", batch.inputs.image, (1, 2)), ("reading", batch.target, (1,))]
    bad += [(f"condition {c!r}", batch.inputs.conditions[:, i], ()) for i, c in enumerate(model.conditions)]
    for label, values, axes in bad:
        wrong = ~np.isfinite(np.asarray(values)).all(axis=axes)
        if wrong.any():
            raise ValueError(
                f"{wrong.sum()} of {touches} touches of the {name} set have a {label} that is not finite (first at "
                f"index {np.argmax(wrong)}); leave these touches out, or train without that input."
            )


def normalisation(batch: Batch) -> Normalisation:
    """Mean and standard deviation of the readings and conditions of a training set.

    Args:
        batch: In physical units.

    Returns:
        The normalisation, without a residual; a value that never changes keeps its unit.
    """
    return Normalisation(_standard(batch.target), _standard(batch.inputs.conditions), jnp.zeros(batch.target.shape[1]))


def prepare(model: ModelConfig, norm: Normalisation, batch: Batch) -> Batch:
    """Physical touches in the network's units.

    Args:
        model: Which network.
        norm: Of the training set.
        batch: In physical units.

    Returns:
        The same touches, prepared.
    """
    inputs = jax.vmap(partial(net.prepare, model, norm))(batch.inputs)
    return Batch(inputs, jax.vmap(partial(standardise, norm.reading))(batch.target))


def init(key: Key[Array, ""], model: ModelConfig, cfg: TrainConfig, touches: int) -> TrainState:
    """The state before the first epoch; member i depends on `fold_in(key, i)` only.

    Args:
        key: Random key.
        model: Which network.
        cfg: How to train.
        touches: In the training set.

    Returns:
        The state, members as axis 0.
    """

    def member(index: Int[Array, ""]) -> TrainState:
        key_params, key_epochs = jax.random.split(jax.random.fold_in(key, index))
        params = net.init(key_params, model)
        zero = jnp.zeros((), jnp.int32)
        best = jax.tree.map(jnp.zeros_like, params)
        return TrainState(
            params=params,
            opt_state=cfg.optimizer(touches).init(params),
            key=key_epochs,
            epoch=zero,
            best_params=best,
            best_loss=jnp.full((), jnp.inf, jnp.float32),
            best_epoch=zero,
        )

    return jax.vmap(member)(jnp.arange(model.members))


def start(model: ModelConfig, cfg: TrainConfig, touches: int) -> TrainState:
    """The state before the first epoch with the configuration's seed.

    Args:
        model: Which network.
        cfg: How to train.
        touches: In the training set.

    Returns:
        The state, members as axis 0.
    """
    return init(jax.random.key(cfg.seed), model, cfg, touches)


def minibatches(
    key: Key[Array, ""], epoch: Int[Array, ""], touches: int, size: int
) -> tuple[Int[Array, "steps size"], Float[Array, "steps size"]]:
    """Which touches one member meets in an epoch, and with which weights.

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


def make_chunk(
    model: ModelConfig, cfg: TrainConfig, capacity: int
) -> Callable[[TrainState, Batch, Batch | None, Int[Array, ""]], tuple[TrainState, EpochInfo]]:
    """A function that trains for some epochs, as one program whose length is an argument.

    Args:
        model: Which network.
        cfg: How to train.
        capacity: The most epochs of a call.

    Returns:
        `chunk(state, train, validation, count) -> (state, info)`: `count` epochs of every member on prepared touches;
        without validation touches the last parameters count as the best. `info` has the epochs as its leading axis,
        before the members; its rows beyond `count` are zero.
    """

    def member(
        state: TrainState, train: Batch, validation: Batch | None, count: Int[Array, ""]
    ) -> tuple[TrainState, EpochInfo]:
        epoch = partial(_run_epoch, model, cfg, train=train, validation=validation)
        row = jax.eval_shape(epoch, state)[1]
        empty = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), row)

        def body(i: Int[Array, ""], carry: tuple[TrainState, EpochInfo]) -> tuple[TrainState, EpochInfo]:
            state, info = epoch(carry[0])
            return state, jax.tree.map(lambda rows, row: rows.at[i].set(row), carry[1], info)

        return jax.lax.fori_loop(0, count, body, (state, empty))

    if jax.default_backend() == "cpu":
        member = _in_turn(member)

    def chunk(
        state: TrainState, train: Batch, validation: Batch | None, count: Int[Array, ""]
    ) -> tuple[TrainState, EpochInfo]:
        # Keys pass as bits, because JAX's check of their reuse does not see through custom batching.
        bits = state._replace(key=jax.random.key_data(state.key))
        each = jax.vmap(member, in_axes=(0, None, None, None), out_axes=(0, 1))
        after, info = each(bits, train, validation, count)
        return after._replace(key=state.key), info

    return chunk


def fit(
    state: TrainState,
    model: ModelConfig,
    cfg: TrainConfig,
    train: Batch,
    validation: Batch | None,
    *,
    chunk: int = 10,
    log: Callable[[int, EpochInfo], None] = lambda epoch, info: None,
    save: Callable[[TrainState], None] = lambda state: None,
) -> TrainState:
    """Train to the last epoch, members on all devices; an interruption leaves the last saved state to resume from.

    Args:
        state: Where to start: see `start`, or a state that was saved.
        model: Which network.
        cfg: How to train.
        train: Prepared touches to learn from.
        validation: Prepared touches that choose the best epoch; without them it is the last.
        chunk: Epochs between two saves.
        log: Hears of each epoch (from 1) with its losses (NumPy arrays, members as the last axis).
        save: Receives the state after every chunk.

    Returns:
        The state after the last epoch.

    Raises:
        ValueError: The loss on the validation touches was at no epoch finite.
    """
    run = _compiled_chunk(model, replace(cfg, seed=0), chunk)
    done = int(state.epoch.max())
    while done < cfg.epochs:
        count = min(chunk, cfg.epochs - done)
        state, info = spread_rows(run, (state,), shared=(train, validation, jnp.int32(count)))
        info = jax.device_get(info)
        for i in range(count):
            log(done + i + 1, jax.tree.map(lambda rows, i=i: rows[:, i], info))
        done += count
        if not np.isfinite(state.best_loss).all() and validation is not None:
            raise ValueError(
                f"the loss on the validation touches was not finite in any of the first {done} epochs; lower "
                f"train.learning_rate ({cfg.learning_rate:g}), or look for extreme readings or images"
            )
        save(state)
    return state


def evaluate(params: Params, model: ModelConfig, cfg: LossConfig, batch: Batch) -> Losses:
    """Mean losses of one member over prepared touches.

    A Gaussian reading is scored by its likelihood itself (beta 0), because beta's weights, good for gradients, would
    reward any small variance.

    Args:
        params: Of one member.
        model: Which network.
        cfg: Weights of the loss.
        batch: Prepared touches.

    Returns:
        Means over the touches.
    """
    return jax.tree.map(jnp.mean, _batch_losses(params, model, replace(cfg, beta=0.0), batch))


def with_residual(params: Params, model: ModelConfig, norm: Normalisation, batch: Batch) -> Normalisation:
    """Note in the normalisation what all members together leave unexplained of touches that they were not trained on.

    It is the mean squared error of their mean less the variance they already show, so that `model.predict` has the
    right standard deviation on these touches.

    Args:
        params: Members as axis 0.
        model: Which network.
        norm: Of the training set.
        batch: Prepared touches.

    Returns:
        The normalisation with its residual.
    """
    readings = jax.vmap(lambda member: jax.vmap(lambda x: net.apply(member, model, x).reading)(batch.inputs))(params)
    unexplained = jnp.mean((readings.mean(0) - batch.target) ** 2 - readings.var(0), axis=0)
    return norm._replace(residual=jnp.maximum(unexplained, 0))


@lru_cache(maxsize=8)
def _compiled_chunk(model: ModelConfig, cfg: TrainConfig, capacity: int) -> Callable:
    """One compiled program for all trainings that differ in seed and data only; the members are axis 0 of its info."""
    chunk = make_chunk(model, cfg, capacity)

    def by_member(state: TrainState, *data: PyTree) -> tuple[TrainState, EpochInfo]:
        after, info = chunk(state, *data)
        return after, jax.tree.map(lambda rows: rows.swapaxes(0, 1), info)

    return jax.jit(by_member)


def _in_turn(train: Callable) -> Callable:
    """`train(state, *data) -> (state, info)` whose `vmap` trains one after the other, in place.

    A few cores have no use for several products at once. (`jax.lax.map` would do, but for its copies of all states.)
    """
    one = jax.custom_batching.custom_vmap(train)

    @one.def_vmap
    def _(size: int, batched: PyTree, *args: PyTree) -> tuple[PyTree, PyTree]:
        states = jax.tree.map(
            lambda leaf, own: leaf if own else jnp.broadcast_to(leaf, (size, *leaf.shape)), args[0], batched[0]
        )

        def pick(i: Int[Array, ""]) -> PyTree:
            return jax.tree.map(lambda leaf, own: leaf[i] if own else leaf, args[1:], tuple(batched[1:]))

        def body(i: Int[Array, ""], carry: PyTree) -> PyTree:
            states, infos = carry
            new = one(jax.tree.map(lambda leaf: leaf[i], states), *pick(i))
            return jax.tree.map(lambda rows, row: rows.at[i].set(row), (states, infos), new)

        row = jax.eval_shape(lambda: one(jax.tree.map(lambda leaf: leaf[0], states), *pick(jnp.int32(0))))[1]
        infos = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), row)
        result = jax.lax.fori_loop(0, size, body, (states, infos))
        return result, jax.tree.map(lambda _: True, result)

    return one


def _run_epoch(
    model: ModelConfig, cfg: TrainConfig, state: TrainState, train: Batch, validation: Batch | None
) -> tuple[TrainState, EpochInfo]:
    """One epoch of one member, whose key comes as bits."""
    key = jax.random.wrap_key_data(state.key)
    touches = len(train.target)
    rows, weights = minibatches(key, state.epoch, touches, cfg.batch_size)
    step = partial(_step, model, cfg, cfg.optimizer(touches), train)
    (params, opt_state), (parts, sums) = jax.lax.scan(step, (state.params, state.opt_state), (rows, weights))
    trained = jax.tree.map(lambda part: part @ sums / touches, parts)

    if validation is None:
        scored = jax.tree.map(lambda part: jnp.full_like(part, jnp.nan), trained)
        better = jnp.ones((), bool)
    else:
        scored = evaluate(params, model, cfg.loss, validation)
        better = scored.reading < state.best_loss
    epoch = state.epoch + 1
    best = jax.tree.map(partial(jnp.where, better), params, state.best_params)
    best_loss = jnp.where(better, scored.reading, state.best_loss)
    best_epoch = jnp.where(better, epoch, state.best_epoch)
    return TrainState(
        params=params,
        opt_state=opt_state,
        key=state.key,
        epoch=epoch,
        best_params=best,
        best_loss=best_loss,
        best_epoch=best_epoch,
    ), EpochInfo(trained, scored)


def _step(
    model: ModelConfig,
    cfg: TrainConfig,
    optimizer: optax.GradientTransformation,
    train: Batch,
    carry: tuple[Params, PyTree],
    rows_weights: tuple[Array, Array],
) -> tuple[tuple[Params, PyTree], tuple[Losses, Array]]:
    """One minibatch: new (params, opt_state), and the mean losses with the touches they are of."""
    params, opt_state = carry
    rows, weights = rows_weights
    batch = jax.tree.map(lambda leaf: leaf[rows], train)
    total = weights.sum()

    def mean_loss(params: Params) -> tuple[Float[Array, ""], Losses]:
        parts = jax.tree.map(lambda part: part @ weights / total, _batch_losses(params, model, cfg.loss, batch))
        return parts.total, parts

    gradient, parts = jax.grad(mean_loss, has_aux=True)(params)
    # Without the barrier XLA may update a matrix while its old value is still needed for other gradients, at the price
    # of a copy of it in each step.
    gradient, params = jax.lax.optimization_barrier((gradient, params))
    updates, opt_state = optimizer.update(gradient, opt_state, params)
    return (optax.apply_updates(params, updates), opt_state), (parts, total)


def _batch_losses(params: Params, model: ModelConfig, cfg: LossConfig, batch: Batch) -> Losses:
    """Losses of one member for each of a batch of prepared touches."""

    def one(inputs: Inputs, target: Float[Array, " c"]) -> Losses:
        return losses(cfg, model, net.apply(params, model, inputs), inputs, target)

    return jax.vmap(one)(batch.inputs, batch.target)


def _standard(values: Float[Array, "n k"]) -> Standard:
    """Mean and standard deviation; the rounding noise of a constant value does not count."""
    mean, std = values.mean(0), values.std(0)
    resolution = jnp.finfo(values.dtype).eps * jnp.sqrt(len(values)) * jnp.abs(mean)
    return Standard(mean, jnp.where(std > resolution, std, 1.0))
