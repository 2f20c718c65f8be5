"""Classifiers of readings: the paper's (`i2t.paper.classifier`), and others of its kind that are shown imagined presses
too, with noise drawn afresh.

Minibatches are drawn with replacement, so that trainings on different numbers of presses share one compiled program.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from i2t.mlp import Layers
from i2t.paper import classifier
from i2t.paper.classifier import Classifier

CAPACITY_ROWS = 2048  # capacities are multiples of it


class TrainingSet(NamedTuple):
    """Standardised inputs and their classes, padded to a capacity."""

    x: Float[Array, "rows d"]
    y: Int[Array, " rows"]
    noise_share: Float[Array, "rows d"]  # of the noise, by which each row is disturbed afresh when it is met
    noise_factor: Float[Array, "d d"]  # turns normal draws into the noise
    n: Int[Array, ""]  # rows that count, the first


@partial(jax.jit, static_argnames=("cfg", "classes"))
def _train(key: Key[Array, ""], known: TrainingSet, cfg: Classifier, classes: int) -> Layers:
    inputs = known.x.shape[1]

    def draw(key: Key[Array, ""]) -> tuple[Array, Array]:
        key_rows, key_noise = jax.random.split(key)
        rows = jax.random.randint(key_rows, (cfg.batch,), 0, known.n)
        noise = jax.random.normal(key_noise, (cfg.batch, inputs)) @ known.noise_factor
        return known.x[rows] + known.noise_share[rows] * noise, known.y[rows]

    return classifier.fit(key, draw, cfg, inputs=inputs, classes=classes)


@jax.jit
def _log_probability(layers: Layers, x: Float[Array, "n d"]) -> Float[Array, "n classes"]:
    return jax.nn.log_softmax(classifier.logits(layers, x))


def classify(
    cfg: Classifier,
    x: Float[np.ndarray, "n d"],
    y: Int[np.ndarray, " n"],
    at: Float[np.ndarray, "m d"],
    *,
    classes: int,
    seed: int,
    noise_share: Float[np.ndarray, " n"] | None = None,
    noise_covariance: Float[np.ndarray, "d d"] | None = None,
) -> Float[np.ndarray, "m classes"]:
    """Train on inputs x of classes y, and give log probabilities at other inputs.

    Args:
        cfg: How to train.
        x: Inputs.
        y: Their classes.
        at: Inputs to classify.
        classes: Number of classes.
        seed: Of the training.
        noise_share: For each row, the share of the noise that is added to it afresh each time it is met.
        noise_covariance: Of that noise.

    Returns:
        Log probabilities, the mean over the ensemble's members.
    """
    n, d = x.shape
    mean, std = x.mean(0), x.std(0)
    std = np.where(std > 0, std, 1)
    capacity = -(-n // CAPACITY_ROWS) * CAPACITY_ROWS
    rows, share = np.zeros((capacity, d), np.float32), np.zeros((capacity, d), np.float32)
    rows[:n] = (x - mean) / std
    labels = np.zeros(capacity, np.int32)
    labels[:n] = y
    factor = np.zeros((d, d), np.float32)
    if noise_share is not None and noise_covariance is not None:
        share[:n] = noise_share[:, None]
        factor = (np.linalg.cholesky(noise_covariance + 1e-9 * np.eye(d)).T / std).astype(np.float32)
    known = TrainingSet(
        jnp.asarray(rows), jnp.asarray(labels), jnp.asarray(share), jnp.asarray(factor), jnp.asarray(n, jnp.int32)
    )
    seen = jnp.float32((at - mean) / std)
    keys = [jax.random.fold_in(jax.random.key(seed), i) for i in range(cfg.members)]
    log_p = [_log_probability(_train(key, known, cfg, classes), seen) for key in keys]
    return np.asarray(jax.nn.logsumexp(jnp.stack(log_p), axis=0) - np.log(cfg.members))
