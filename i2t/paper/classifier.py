"""The paper's classifier of stamps: the pressed shape, one of five, from one reading.

    15 -> 500 -> 10 -> 5, cross entropy; inputs are standardised by the training presses

The paper does not say what follows the hidden layers (rectifiers here), nor how it was trained (Adam, 300 epochs of its
1024 presses in minibatches of 128, the rate falling to 0 as a cosine).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key

from i2t.training import descend

Layers: TypeAlias = list[dict[str, Array]]  # of each layer "kernel" (inputs, outputs) and "bias" (outputs,)


@dataclass(frozen=True)
class Classifier:
    """Sizes and training options."""

    hidden: tuple[int, ...] = (500, 10)
    steps: int = 2400
    batch: int = 128
    rate: float = 1e-3
    decay: float = 0.0  # decoupled, of matrices
    members: int = 1


def fit(
    key: Key[Array, ""],
    draw: Callable[[Key[Array, ""]], tuple[Float[Array, "batch d"], Int[Array, " batch"]]],
    cfg: Classifier,
    *,
    inputs: int,
    classes: int,
) -> Layers:
    """Train one member; pure, to be jitted by the caller.

    Args:
        key: Random key.
        draw: `draw(key)` gives a minibatch of standardised readings and their classes.
        cfg: Sizes, and how to train.
        inputs: Values of a reading.
        classes: Number of classes.

    Returns:
        Layers.
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
    """Random layers: normal weights of variance 2 / inputs, which suits rectifiers (He et al., "Delving deep into
    rectifiers", 2015), and biases of 0.

    Args:
        key: Random key.
        sizes: Width of the input, of each hidden layer and of the output.

    Returns:
        One layer fewer than there are sizes.
    """
    keys = jax.random.split(key, len(sizes) - 1)
    return [
        {"kernel": jnp.sqrt(2.0 / a) * jax.random.normal(k, (a, b)), "bias": jnp.zeros(b)}
        for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]


def logits(layers: Layers, x: Float[Array, "n d"]) -> Float[Array, "n classes"]:
    """Logits of each class.

    Args:
        layers: Of one member.
        x: Standardised readings.

    Returns:
        Log probabilities, up to a constant for each reading.
    """

    def one(x: Float[Array, " d"]) -> Float[Array, " classes"]:
        *hidden, last = layers
        for layer in hidden:
            x = jax.nn.relu(x @ layer["kernel"] + layer["bias"])
        return x @ last["kernel"] + last["bias"]

    return jax.vmap(one)(x)
