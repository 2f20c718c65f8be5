"""A network that has pressed many other skins before: features of a press, learnt on random skins, and for each skin a
linear layer fitted to its few presses in closed form.

The last layer is Bayesian ridge regression, and the features before it are trained so that this regression, given some
presses of a skin, predicts the others (Harrison, Sharma and Pavone, "Meta-learning priors for efficient online Bayesian
regression", WAFR 2018; Bertinetto et al., ICLR 2019). Without any skins before, the same network is trained on the
presses at hand alone: `scratch`.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from i2t.calibration.structured_gp import Presses

WIDTH = 64
FEATURES = 64
BATCH = 16  # skins to a step


class Network(NamedTuple):
    """Features of a press, of a tip and a kind of skin."""

    half: Float[Array, ""]  # m that become 1
    unit: Float[Array, ""]  # load that becomes 1
    w1: Float[Array, "3 w"]
    b1: Float[Array, " w"]
    w2: Float[Array, "w w"]
    b2: Float[Array, " w"]
    w3: Float[Array, "w k"]
    b3: Float[Array, " k"]
    noise: Float[Array, ""]  # log variance of a reading's noise, relative to the weights' prior


class Head(NamedTuple):
    """The last layer of one skin."""

    weights: Float[Array, "k channels"]
    cholesky: Float[Array, "k k"]
    scale: Float[Array, ""]  # uT, of all channels


def start(key: Key[Array, ""], half: float | Array, unit: float | Array) -> Network:
    """A network that knows nothing."""
    a, b, c, d = jax.random.split(key, 4)
    return Network(
        jnp.asarray(half), jnp.asarray(unit), 2.0 * jax.random.normal(a, (3, WIDTH)), jax.random.normal(b, (WIDTH,)),
        jax.random.normal(c, (WIDTH, WIDTH)) / np.sqrt(WIDTH), jnp.zeros(WIDTH),
        jax.random.normal(d, (WIDTH, FEATURES)) / np.sqrt(WIDTH), jnp.zeros(FEATURES), jnp.asarray(-3.0),
    )  # fmt: skip


def features(network: Network, presses: Presses) -> Float[Array, "n k"]:
    """What the last layer sees, of size 1 together."""
    n = network
    x = jnp.concatenate([presses.place / n.half, presses.load[:, None] / n.unit], axis=1)
    x = jnp.sin(x @ n.w1 + n.b1[None])
    x = jnp.tanh(x @ n.w2 + n.b2[None])
    return (x @ n.w3 + n.b3[None]) / np.sqrt(FEATURES)


def adapt(
    network: Network, presses: Presses, readings: Float[Array, "n channels"], used: Float[Array, " n"] | None = None
) -> Head:
    """The last layer for a skin from n presses and their readings (uT), or those of them that are `used` (1, not 0)."""
    used = jnp.ones(len(readings)) if used is None else used
    phi = features(network, presses) * used[:, None]
    scale = jnp.sqrt(jnp.sum(used[:, None] * readings**2) / (jnp.sum(used) * readings.shape[1])) + 1e-6
    noise = jnp.exp(network.noise) + 1e-4
    cholesky = jnp.linalg.cholesky(jnp.matmul(phi.T, phi, precision="highest") / noise + jnp.eye(phi.shape[1]))
    told = jnp.matmul(phi.T, readings, precision="highest") / (noise * scale)
    return Head(jax.scipy.linalg.cho_solve((cholesky, True), told), cholesky, scale)


def predict_network(
    network: Network, head: Head, presses: Presses
) -> tuple[Float[Array, "n channels"], Float[Array, "n channels"]]:
    """Mean and standard deviation (uT) of the readings of n presses."""
    phi = features(network, presses)
    half = jax.scipy.linalg.solve_triangular(head.cholesky, phi.T, lower=True)
    std = jnp.sqrt(jnp.sum(half**2, axis=0) + jnp.exp(network.noise)) * head.scale
    mean = jnp.matmul(phi, head.weights, precision="highest") * head.scale
    return mean, jnp.broadcast_to(std[:, None], mean.shape)


@partial(jax.jit, static_argnames=("steps", "counts"))
def pretrain(
    key: Key[Array, ""],
    presses: Presses,
    readings: Float[Array, "skins n channels"],
    steps: int = 3000,
    counts: Sequence[int] = (5, 10, 20, 50, 100),
) -> tuple[Network, Float[Array, " steps"]]:
    """Learn features on many skins, (skins, n) presses each in random order, and the loss on the way.

    In each step every skin is told a random number of its presses, and all its others are predicted.
    """
    key_start, key_steps = jax.random.split(key)
    skins, n = presses.load.shape
    network = start(key_start, jnp.max(jnp.abs(presses.place)), jnp.max(presses.load))
    optimizer = optax.adam(optax.cosine_decay_schedule(3e-3, steps))

    def loss(free: dict[str, Array], key: Array) -> Array:
        now = network._replace(**free)
        pick, count, roll = jax.random.split(key, 3)
        rows = jax.random.randint(pick, (BATCH,), 0, skins)
        told = jnp.asarray(counts)[jax.random.randint(count, (BATCH,), 0, len(counts))]
        used = (jnp.arange(n)[None] < jnp.minimum(told, n - 5)[:, None]).astype(jnp.float32)
        shift = jax.random.randint(roll, (BATCH,), 0, n)

        def one(row: Array, used: Array, shift: Array) -> Array:
            at = Presses(*(jnp.roll(part[row], shift, axis=0) for part in presses))
            y = jnp.roll(readings[row], shift, axis=0)
            mean, _ = predict_network(now, adapt(now, at, y, used), at)
            unused = (1 - used)[:, None]
            total = jnp.sum(unused * (y - jnp.mean(y, axis=0, keepdims=True)) ** 2)
            return jnp.sum(unused * (y - mean) ** 2) / total

        return jnp.mean(jnp.minimum(jax.vmap(one)(rows, used, shift), 2.0))

    def step(state: tuple, key: Array) -> tuple:
        free, moments = state
        value, slope = jax.value_and_grad(loss)(free, key)
        change, moments = optimizer.update(slope, moments)
        return (optax.apply_updates(free, change), moments), value

    free = {name: getattr(network, name) for name in Network._fields if name not in ("half", "unit")}
    keys = jax.random.split(key_steps, steps)
    ((free, _), path) = jax.lax.scan(step, (free, optimizer.init(free)), keys)  # type: ignore[var-annotated]
    return network._replace(**free), path


@partial(jax.jit, static_argnames=("steps",))
def scratch(
    key: Key[Array, ""],
    presses: Presses,
    readings: Float[Array, "n channels"],
    half: float | Array,
    unit: float | Array,
    steps: int = 1500,
) -> tuple[Network, Head]:
    """The same network trained on the presses at hand alone: all layers by Adam with weight decay, `steps` times all
    presses; the last layer is then regression as before.
    """
    network = start(key, half, unit)
    network = network._replace(w1=network.w1 / 2)
    scale = jnp.sqrt(jnp.mean(readings**2)) + 1e-6
    free = {name: getattr(network, name) for name in Network._fields if name not in ("half", "unit", "noise")}
    free["last"] = jnp.zeros((FEATURES, readings.shape[1]))
    optimizer = optax.adamw(optax.cosine_decay_schedule(3e-3, steps), weight_decay=1e-2)

    def loss(free: dict[str, Array]) -> Array:
        now = network._replace(**{name: value for name, value in free.items() if name != "last"})
        return jnp.mean((features(now, presses) @ free["last"] - readings / scale) ** 2)

    def step(state: tuple, _: None) -> tuple:
        free, moments = state
        change, moments = optimizer.update(jax.grad(loss)(free), moments, free)
        return (optax.apply_updates(free, change), moments), None

    (free, _), _ = jax.lax.scan(step, (free, optimizer.init(free)), None, steps)
    trained = network._replace(**{name: value for name, value in free.items() if name != "last"})
    return trained, adapt(trained, presses, readings)
