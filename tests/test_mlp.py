"""The small network written out by hand, and its descent against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from i2t import mlp, training

EPS = float(np.finfo(np.float32).eps)


def test_the_output_is_the_one_written_out_by_hand() -> None:
    layers = mlp.init(jax.random.key(0), (3, 6, 5, 2))
    layers = [{**layer, "bias": layer["bias"] + 0.3} for layer in layers]
    x = np.array([0.5, -1.0, 2.0])
    a, b, c = ((np.asarray(layer["kernel"], np.float64), np.asarray(layer["bias"], np.float64)) for layer in layers)
    rectified = np.maximum(np.maximum(x @ a[0] + a[1], 0) @ b[0] + b[1], 0) @ c[0] + c[1]
    mixed = np.tanh(np.sin(x @ a[0] + a[1]) @ b[0] + b[1]) @ c[0] + c[1]
    # Three products in a row of at most six terms of order one.
    np.testing.assert_allclose(mlp.apply(layers, jnp.float32(x)), rectified, rtol=64 * EPS, atol=64 * EPS)
    both = mlp.apply(layers, jnp.float32(x), activation=(jnp.sin, jnp.tanh))
    np.testing.assert_allclose(both, mixed, rtol=64 * EPS, atol=64 * EPS)


def test_full_batch_descent_finds_least_squares_and_reports_the_loss_before_each_step() -> None:
    key_x, key_y, key_layers = jax.random.split(jax.random.key(2), 3)
    x, y = jax.random.normal(key_x, (40, 3)), jax.random.normal(key_y, (40, 2))
    layers = mlp.init(key_layers, (3, 2))

    def loss(layers: mlp.Layers, _: jax.Array) -> jax.Array:
        return jnp.mean((jax.vmap(lambda one: mlp.apply(layers, one))(x) - y) ** 2)

    keys = jax.random.split(jax.random.key(3), 300)
    fitted, path = jax.jit(lambda start: training.descend(start, loss, optax.sgd(0.3), keys))(layers)
    tall = np.c_[np.asarray(x, np.float64), np.ones(40)]
    best = np.linalg.lstsq(tall, np.asarray(y, np.float64))[0]
    np.testing.assert_allclose(fitted[0]["kernel"], best[:3], atol=1e-5)
    np.testing.assert_allclose(fitted[0]["bias"], best[3], atol=1e-5)
    assert path.shape == (300,)
    assert path[0] == pytest.approx(float(loss(layers, keys[0])), rel=64 * EPS)
