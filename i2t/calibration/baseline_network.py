"""Baseline of calibration: a network that was pretrained on many other skins.

It gives features of a press; for each skin a linear head is fitted to its few presses in closed form. The head is
Bayesian ridge regression, and the features are trained so that this regression, given some presses of a skin, predicts
the others (Harrison, Sharma and Pavone, "Meta-learning priors for efficient online Bayesian regression", WAFR 2018;
Bertinetto et al., ICLR 2019). Without any other skins, the same network is trained on the presses at hand alone:
`train_from_scratch`.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from i2t import mlp, training
from i2t.calibration.structured_gp import Presses
from i2t.mlp import Layers

INPUTS = 3  # x, y and load
WIDTH = 64
FEATURES = 64
BATCH_SKINS = 16  # to a step of pretraining
HELD_OUT_PRESSES = 5  # of each skin in a step, at least
LEARNING_RATE = 3e-3  # falls to 0 as a cosine
WEIGHT_DECAY = 1e-2
MAX_LOSS = 2.0  # of a skin: one that is not predicted at all does not lead
_ACTIVATIONS = (jnp.sin, jnp.tanh)


class PressFeatures(NamedTuple):
    """A network from presses to features, for a tip and a kind of skin."""

    max_position: Float[Array, ""]  # m that become 1
    unit_load: Float[Array, ""]  # load that becomes 1
    layers: Layers
    log_noise: Float[Array, ""]  # log variance of a reading's noise, relative to the head's prior


class LinearHead(NamedTuple):
    """The last layer of one skin."""

    weights: Float[Array, "k c"]
    precision_cholesky: Float[Array, "k k"]
    scale: Float[Array, ""]  # uT, of all channels


def init(
    key: Key[Array, ""], max_position: float | Float[Array, ""], unit_load: float | Float[Array, ""]
) -> PressFeatures:
    """A network with random weights.

    Args:
        key: Random key.
        max_position: Largest coordinate of a position (m).
        unit_load: Load that becomes 1 (m or N).

    Returns:
        The network.
    """
    key_first, key_bias, key_second, key_last = jax.random.split(key, 4)
    layers = [
        {
            "kernel": 2.0 * jax.random.normal(key_first, (INPUTS, WIDTH)),
            "bias": jax.random.normal(key_bias, (WIDTH,)),
        },
        {"kernel": jax.random.normal(key_second, (WIDTH, WIDTH)) / np.sqrt(WIDTH), "bias": jnp.zeros(WIDTH)},
        {"kernel": jax.random.normal(key_last, (WIDTH, FEATURES)) / np.sqrt(WIDTH), "bias": jnp.zeros(FEATURES)},
    ]
    return PressFeatures(jnp.asarray(max_position), jnp.asarray(unit_load), layers, jnp.asarray(-3.0))


def features(network: PressFeatures, presses: Presses) -> Float[Array, "n k"]:
    """Features of each press for the head, of size 1 together.

    Args:
        network: The network.
        presses: Positions (m) and loads (m or N).

    Returns:
        Features.
    """
    position, load = presses.position / network.max_position, presses.load[:, None] / network.unit_load
    x = jnp.concatenate([position, load], axis=1)
    return jax.vmap(lambda one: mlp.apply(network.layers, one, activation=_ACTIVATIONS))(x) / np.sqrt(FEATURES)


def fit_head(
    network: PressFeatures,
    presses: Presses,
    readings: Float[Array, "n c"],
    used: Float[Array, " n"] | None = None,
) -> LinearHead:
    """Fit the head of a skin, in closed form.

    Args:
        network: The network.
        presses: Positions (m) and loads (m or N).
        readings: Their readings (uT).
        used: 1 for presses that take part and 0 for others; by default all do.

    Returns:
        The head.
    """
    used = jnp.ones(len(readings)) if used is None else used
    phi = features(network, presses) * used[:, None]
    scale = jnp.sqrt(jnp.sum(used[:, None] * readings**2) / (jnp.sum(used) * readings.shape[1])) + 1e-6
    noise = jnp.exp(network.log_noise) + 1e-4
    cholesky = jnp.linalg.cholesky(jnp.matmul(phi.T, phi, precision="highest") / noise + jnp.eye(phi.shape[1]))
    projected = jnp.matmul(phi.T, readings, precision="highest") / (noise * scale)
    return LinearHead(jax.scipy.linalg.cho_solve((cholesky, True), projected), cholesky, scale)


def predict(
    network: PressFeatures, head: LinearHead, presses: Presses
) -> tuple[Float[Array, "n c"], Float[Array, "n c"]]:
    """Predict the readings of n presses.

    Args:
        network: The network.
        head: Of the skin.
        presses: Positions (m) and loads (m or N).

    Returns:
        Mean and standard deviation (uT).
    """
    phi = features(network, presses)
    half = jax.scipy.linalg.solve_triangular(head.precision_cholesky, phi.T, lower=True)
    std = jnp.sqrt(jnp.sum(half**2, axis=0) + jnp.exp(network.log_noise)) * head.scale
    mean = jnp.matmul(phi, head.weights, precision="highest") * head.scale
    return mean, jnp.broadcast_to(std[:, None], mean.shape)


@partial(jax.jit, static_argnames=("steps", "counts"))
def pretrain(
    key: Key[Array, ""],
    presses: Presses,
    readings: Float[Array, "skins n c"],
    *,
    steps: int = 3000,
    counts: Sequence[int] = (5, 10, 20, 50, 100),
) -> tuple[PressFeatures, Float[Array, " steps"]]:
    """Train features on many skins.

    In each step every skin's head is fitted to a random number of its presses, and all its others are predicted.

    Args:
        key: Random key.
        presses: Presses of each skin, (skins, n), in random order.
        readings: Their readings (uT).
        steps: Of Adam.
        counts: Numbers of presses that heads are fitted to.

    Returns:
        The network, and the loss of each step.
    """
    key_start, key_steps = jax.random.split(key)
    skins, n = presses.load.shape
    network = init(key_start, jnp.max(jnp.abs(presses.position)), jnp.max(presses.load))

    def loss(params: tuple[Layers, Array], key: Key[Array, ""]) -> Array:
        now = network._replace(layers=params[0], log_noise=params[1])
        pick, count, roll = jax.random.split(key, 3)
        rows = jax.random.randint(pick, (BATCH_SKINS,), 0, skins)
        known = jnp.asarray(counts)[jax.random.randint(count, (BATCH_SKINS,), 0, len(counts))]
        used = (jnp.arange(n)[None] < jnp.minimum(known, n - HELD_OUT_PRESSES)[:, None]).astype(jnp.float32)
        shift = jax.random.randint(roll, (BATCH_SKINS,), 0, n)

        def unexplained(row: Array, used: Array, shift: Array) -> Array:
            at = Presses(*(jnp.roll(part[row], shift, axis=0) for part in presses))
            y = jnp.roll(readings[row], shift, axis=0)
            mean, _ = predict(now, fit_head(now, at, y, used), at)
            unused = (1 - used)[:, None]
            total = jnp.sum(unused * (y - jnp.mean(y, axis=0, keepdims=True)) ** 2)
            return jnp.sum(unused * (y - mean) ** 2) / total

        return jnp.mean(jnp.minimum(jax.vmap(unexplained)(rows, used, shift), MAX_LOSS))

    optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, steps))
    start = (network.layers, network.log_noise)
    (layers, log_noise), path = training.descend(start, loss, optimizer, jax.random.split(key_steps, steps))
    return network._replace(layers=layers, log_noise=log_noise), path


@partial(jax.jit, static_argnames=("steps",))
def train_from_scratch(
    key: Key[Array, ""],
    presses: Presses,
    readings: Float[Array, "n c"],
    *,
    max_position: float | Float[Array, ""],
    unit_load: float | Float[Array, ""],
    steps: int = 1500,
) -> tuple[PressFeatures, LinearHead]:
    """The same network trained on the presses at hand alone.

    All layers are trained by Adam with weight decay on all presses at once; the head is then regression as before.

    Args:
        key: Random key.
        presses: Positions (m) and loads (m or N).
        readings: Their readings (uT).
        max_position: Largest coordinate of a position (m).
        unit_load: Load that becomes 1 (m or N).
        steps: Of Adam.

    Returns:
        The network and the head of the skin.
    """
    network = init(key, max_position, unit_load)
    first, *others = network.layers
    network = network._replace(layers=[first | {"kernel": first["kernel"] / 2}, *others])
    scale = jnp.sqrt(jnp.mean(readings**2)) + 1e-6

    def loss(params: tuple[Layers, Array], key: Key[Array, ""]) -> Array:
        layers, last = params
        return jnp.mean((features(network._replace(layers=layers), presses) @ last - readings / scale) ** 2)

    optimizer = optax.adamw(optax.cosine_decay_schedule(LEARNING_RATE, steps), weight_decay=WEIGHT_DECAY)
    start = (network.layers, jnp.zeros((FEATURES, readings.shape[1])))
    (layers, _), _ = training.descend(start, loss, optimizer, jax.random.split(jax.random.fold_in(key, 0), steps))
    trained = network._replace(layers=layers)
    return trained, fit_head(trained, presses, readings)
