"""One small fully connected network: layers as a plain tree.

    layers = mlp.init(key, (15, 500, 10, 5))
    logits = mlp.apply(layers, x)                                            # one example; lift it with vmap
    layers, path = training.descend(layers, loss, optax.adam(1e-3), jax.random.split(key, 1000))

Layer i computes `x W_i + b_i`; an activation follows every layer but the last. Parameters are a list of
`{"kernel", "bias"}`, so that optax, vmap over ensembles and `jax.tree` treat them as they treat any tree.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

Layer: TypeAlias = dict[str, Array]  # {"kernel": (inputs, outputs), "bias": (outputs,)}
Layers: TypeAlias = list[Layer]
Activation: TypeAlias = Callable[[Array], Array]


def init(key: Key[Array, ""], sizes: Sequence[int], *, gain: float = 2.0) -> Layers:
    """Random layers: normal weights of variance `gain` / inputs, and biases of 0.

    A gain of 2 suits rectifiers (He et al., "Delving deep into rectifiers", 2015), 1 suits linear units and tanh
    (LeCun et al., "Efficient backprop", 1998).

    Args:
        key: Random key.
        sizes: Width of the input, of each hidden layer and of the output.
        gain: Variance of a weight times the number of its layer's inputs.

    Returns:
        One layer fewer than there are sizes.
    """
    keys = jax.random.split(key, len(sizes) - 1)
    return [
        {"kernel": jnp.sqrt(gain / a) * jax.random.normal(k, (a, b)), "bias": jnp.zeros(b)}
        for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True)
    ]


def dense(layer: Layer, x: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
    """One layer without its activation: x W + b.

    Args:
        layer: Its kernel and bias.
        x: The example's values.

    Returns:
        The layer's values.
    """
    return x @ layer["kernel"] + layer["bias"]


def apply(
    layers: Sequence[Layer],
    x: Float[Array, " inputs"],
    *,
    activation: Activation | Sequence[Activation] = jax.nn.relu,
) -> Float[Array, " outputs"]:
    """The network's output for one example.

    Args:
        layers: Parameters, as `init` makes them.
        x: The example's values.
        activation: What follows every hidden layer, or one function for each hidden layer.

    Returns:
        The last layer's values, to which no activation is applied.
    """
    *hidden, last = layers
    activations = [activation] * len(hidden) if callable(activation) else activation
    for layer, active in zip(hidden, activations, strict=True):
        x = active(dense(layer, x))
    return dense(last, x)
