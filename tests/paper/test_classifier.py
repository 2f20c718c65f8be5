"""The classifier's network against an explicit computation."""

import jax
import jax.numpy as jnp
import numpy as np

from i2t.paper.classifier import init, logits

EPS = float(np.finfo(np.float32).eps)


def test_the_logits_agree_with_an_explicit_computation() -> None:
    layers = [{**layer, "bias": layer["bias"] + 0.3} for layer in init(jax.random.key(0), (3, 6, 5, 2))]
    x = np.array([[0.5, -1.0, 2.0], [-2.0, 0.1, 1.0]])
    a, b, c = ((np.asarray(layer["kernel"], np.float64), np.asarray(layer["bias"], np.float64)) for layer in layers)
    expected = np.maximum(np.maximum(x @ a[0] + a[1], 0) @ b[0] + b[1], 0) @ c[0] + c[1]
    # Three products in a row of at most six terms of order one.
    np.testing.assert_allclose(logits(layers, jnp.float32(x)), expected, rtol=64 * EPS, atol=64 * EPS)
