"""Small classifiers of readings: the paper's (15 - 500 - 10 - 5, cross entropy), and others of its kind that are shown
imagined presses too.

Rectifiers follow both hidden layers; that, Adam and the number of steps are not in the paper. Inputs are standardised
by the training presses. Minibatches are drawn with replacement, so that trainings on different numbers of presses share
one compiled program.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key

ROWS = 2048  # capacities are multiples of it


@dataclass(frozen=True)
class Classifier:
    """How to train."""

    hidden: tuple[int, ...] = (500, 10)
    steps: int = 2400  # of 128 presses: 300 epochs of the paper's 1024
    batch: int = 128
    rate: float = 1e-3  # falls to 0 as a cosine
    decay: float = 0.0  # decoupled, of matrices
    members: int = 1


def init(key: Key[Array, ""], sizes: Sequence[int]) -> list[dict[str, Array]]:
    """Random layers (He et al. 2015)."""
    keys = jax.random.split(key, len(sizes) - 1)
    return [
        {"kernel": jnp.sqrt(2 / a) * jax.random.normal(k, (a, b)), "bias": jnp.zeros(b)}
        for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]


def apply(layers: list[dict[str, Array]], x: Float[Array, " d"]) -> Float[Array, " c"]:
    """Logits of one input."""
    for layer in layers[:-1]:
        x = jax.nn.relu(x @ layer["kernel"] + layer["bias"])
    return x @ layers[-1]["kernel"] + layers[-1]["bias"]


@partial(jax.jit, static_argnames=("cfg", "classes"))
def _train(
    key: Key[Array, ""], x: Float[Array, "r d"], y: Int[Array, " r"], noise: Float[Array, "r d"],
    mix: Float[Array, "d d"], n: Int[Array, ""], cfg: Classifier, classes: int,
) -> list[dict[str, Array]]:  # fmt: skip
    """Train on the first n rows; each time a row is met, `noise` times a normal draw mixed by `mix` is added to it."""
    key_init, key_steps = jax.random.split(key)
    optimizer = optax.adamw(
        optax.cosine_decay_schedule(cfg.rate, cfg.steps),
        weight_decay=cfg.decay,
        mask=lambda tree: jax.tree.map(lambda leaf: leaf.ndim > 1, tree),
    )

    def loss(layers: list, rows: Array, jitter: Array) -> Array:
        seen = x[rows] + noise[rows] * (jitter @ mix)
        logits = jax.vmap(lambda one: apply(layers, one))(seen)
        return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, y[rows]))

    def step(i: Array, carry: tuple) -> tuple:
        layers, state = carry
        key_rows, key_noise = jax.random.split(jax.random.fold_in(key_steps, i))
        rows = jax.random.randint(key_rows, (cfg.batch,), 0, n)
        gradient = jax.grad(loss)(layers, rows, jax.random.normal(key_noise, (cfg.batch, x.shape[1])))
        updates, state = optimizer.update(gradient, state, layers)
        return optax.apply_updates(layers, updates), state

    layers = init(key_init, (x.shape[1], *cfg.hidden, classes))
    return jax.lax.fori_loop(0, cfg.steps, step, (layers, optimizer.init(layers)))[0]


@jax.jit
def _log_p(layers: list[dict[str, Array]], x: Float[Array, "n d"]) -> Float[Array, "n c"]:
    return jax.nn.log_softmax(jax.vmap(lambda one: apply(layers, one))(x))


def classify(
    seed: int, cfg: Classifier, x: np.ndarray, y: np.ndarray, at: np.ndarray, classes: int,
    noise: np.ndarray | None = None, mix: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Train on inputs x (n, d) of classes y (n,) and give log probabilities (m, classes) at `at` (m, d).

    `noise` (n,) is the share, row by row, of the spread whose covariance (d, d) is `mix` that training adds afresh each
    time a row is met.
    """
    n, d = x.shape
    mean, std = x.mean(0), x.std(0)
    std = np.where(std > 0, std, 1)
    capacity = -(-n // ROWS) * ROWS
    rows = np.zeros((capacity, d), np.float32)
    rows[:n] = (x - mean) / std
    labels = np.zeros(capacity, np.int32)
    labels[:n] = y
    share = np.zeros((capacity, d), np.float32)
    factor = np.zeros((d, d), np.float32)
    if noise is not None and mix is not None:
        share[:n] = noise[:, None]
        factor = (np.linalg.cholesky(mix + 1e-9 * np.eye(d)).T / std).astype(np.float32)
    seen = jnp.float32((at - mean) / std)
    log_p = [
        _log_p(
            _train(
                jax.random.fold_in(jax.random.key(seed), i), rows, labels, share, factor, jnp.int32(n), cfg, classes
            ),
            seen,
        )
        for i in range(cfg.members)
    ]
    return np.asarray(jax.nn.logsumexp(jnp.stack(log_p), axis=0) - np.log(cfg.members))
