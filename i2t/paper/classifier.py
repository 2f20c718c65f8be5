"""The paper's classifier of stamps: it predicts which of five shapes was pressed from one reading.

    15 -> 500 -> 10 -> 5, cross entropy; inputs are standardised by the training presses

The paper specifies neither the activation of the hidden layers (rectifiers here) nor the training (here Adam, 300
epochs of its 1024 presses in minibatches of 128, with a rate that falls to 0 as a cosine).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key

from i2t.training import descend

Layers: TypeAlias = list[dict[str, Array]]  # for each layer "kernel" (inputs, outputs) and "bias" (outputs,)


@dataclass(frozen=True)
class Classifier:
    """Sizes and training options of the paper's classifier, which predicts a stamp's shape from one reading."""

    hidden: tuple[int, ...] = (500, 10)
    steps: int = 2400
    batch: int = 128
    rate: float = 1e-3
    decay: float = 0.0  # decoupled weight decay, applied to matrices only
    members: int = 1


def fit(
    key: Key[Array, ""],
    draw: Callable[[Key[Array, ""]], tuple[Float[Array, "batch d"], Int[Array, " batch"]]],
    cfg: Classifier,
    *,
    inputs: int,
    classes: int,
) -> Layers:
    """Train one member of the classifier's ensemble. The function is pure; the caller compiles it.

    Args:
        key: Random key.
        draw: Function from a random key to a minibatch of standardised readings and their classes.
        cfg: Sizes and training options.
        inputs: Number of values of a reading.
        classes: Number of classes.

    Returns:
        The trained layers of the member, input side first.
    """
    key_init, key_steps = jax.random.split(key)
    optimizer = optax.adamw(
        optax.cosine_decay_schedule(cfg.rate, cfg.steps),
        weight_decay=cfg.decay,
        mask=lambda tree: jax.tree.map(lambda leaf: leaf.ndim > 1, tree),
    )

    def loss(layers: Layers, key: Key[Array, ""]) -> Float[Array, ""]:
        x, y = draw(key)
        return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits(layers, x), y))

    keys = jax.vmap(lambda i: jax.random.fold_in(key_steps, i))(jnp.arange(cfg.steps))
    return descend(init(key_init, (inputs, *cfg.hidden, classes)), loss, optimizer, keys)[0]


def init(key: Key[Array, ""], sizes: Sequence[int]) -> Layers:
    """Initialise the classifier's layers: normal weights of variance 2 / inputs, and biases of 0.

    The variance suits rectifiers (He et al., "Delving deep into rectifiers", 2015).

    Args:
        key: Random key.
        sizes: Widths of the input, of each hidden layer and of the output.

    Returns:
        The layers; their number is one less than that of the sizes.
    """
    keys = jax.random.split(key, len(sizes) - 1)
    return [
        {"kernel": jnp.sqrt(2.0 / a) * jax.random.normal(k, (a, b)), "bias": jnp.zeros(b)}
        for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]


def logits(layers: Layers, x: Float[Array, "n d"]) -> Float[Array, "n classes"]:
    """Compute the classifier's logits for each reading.

    Args:
        layers: Layers of one member.
        x: `(n, d)` standardised readings.

    Returns:
        `(n, classes)` log probabilities, up to a constant for each reading.
    """

    def forward(x: Float[Array, " d"]) -> Float[Array, " classes"]:
        *hidden, last = layers
        for layer in hidden:
            x = jax.nn.relu(x @ layer["kernel"] + layer["bias"])
        return x @ last["kernel"] + last["bias"]

    return jax.vmap(forward)(x)
