"""Losses against closed forms and finite differences."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import stats

from i2t.paper import loss, network
from i2t.paper.config import PaperConfig
from i2t.paper.loss import image_error, squared_error
from i2t.prediction import model
from i2t.prediction.model import Inputs, ModelConfig, gaussian
from i2t.training import Batch

EPS = float(np.finfo(np.float32).eps)


@pytest.fixture
def values() -> tuple[jax.Array, jax.Array, jax.Array]:
    rng = np.random.default_rng(0)
    return tuple(jnp.asarray(rng.normal(size=15), jnp.float32) for _ in range(3))


def test_gaussian_is_scipys_likelihood(values) -> None:
    mean, log_variance, target = values
    expected = -stats.norm.logpdf(target, mean, np.exp(log_variance / 2)).mean()
    # A mean of 15 terms below 30 in size, each with a few roundings.
    assert gaussian(mean, log_variance, target, 0.0) == pytest.approx(expected, abs=30 * 8 * EPS)


def test_beta_weights_the_gradient_and_one_makes_the_mean_learn_like_squared_error(values) -> None:
    mean, log_variance, target = values
    by_beta = jax.grad(gaussian)(mean, log_variance, target, 1.0)
    # With beta = 1 the variance cancels in the gradient of the mean: (m - y) / 15, half that of the squared error.
    np.testing.assert_allclose(by_beta, jax.grad(squared_error)(mean, target) / 2, rtol=16 * EPS, atol=EPS)
    plain, half = (jax.grad(gaussian, 1)(mean, log_variance, target, beta) for beta in (0.0, 0.5))
    np.testing.assert_allclose(half, plain * jnp.exp(log_variance / 2), rtol=16 * EPS, atol=EPS)


def test_image_errors_are_their_closed_forms() -> None:
    rng = np.random.default_rng(1)
    image = jnp.asarray(rng.normal(size=(6, 6)), jnp.float32)
    mask = jnp.asarray(rng.random((6, 6)) < 0.4, jnp.float32)
    chance = 1 / (1 + np.exp(-np.asarray(image, np.float64)))
    entropy = -np.where(mask, np.log(chance), np.log(1 - chance)).mean()
    assert image_error("mask", image, mask) == pytest.approx(entropy, rel=16 * EPS)
    assert image_error("depth", image, mask) == pytest.approx(float(((image - mask) ** 2).mean()), rel=16 * EPS)


def test_gradients_agree_with_finite_differences(values) -> None:
    mean, log_variance, target = values
    image = jax.random.normal(jax.random.key(0), (4, 4))
    seen = jnp.asarray(jax.random.bernoulli(jax.random.key(1), 0.5, (4, 4)), jnp.float32)
    # Central differences with step h err by h^2 (third derivative ~ 1) and eps / h (loss ~ 1): at h = eps^(1/3) = 5e-3
    # both are below 1e-4; ten times that is allowed.
    h, allowed = EPS ** (1 / 3), 1e-3
    check = {"order": 1, "modes": ["rev"], "eps": h, "atol": allowed, "rtol": allowed}
    check_grads(lambda m: squared_error(jnp.asarray(m), target), (mean,), **check)
    check_grads(lambda m, s: gaussian(jnp.asarray(m), jnp.asarray(s), target, 0.0), (mean, log_variance), **check)
    check_grads(lambda x: image_error("mask", jnp.asarray(x), seen), (image,), **check)
    check_grads(lambda x: image_error("depth", jnp.asarray(x), seen), (image,), **check)


def test_losses_are_weighted_means_and_the_total_is_the_weighted_sum_of_the_parts(values) -> None:
    cfg = PaperConfig(pixels=4, encoder_width=6, auxiliary_width=8, auxiliary_weight=0.5)
    params, readings = network.init(jax.random.key(0), cfg), jnp.stack(values)
    patches = jax.random.uniform(jax.random.key(1), (3, 4, 4))
    weights = jnp.array([1.0, 0.0, 3.0])
    total, parts = loss.losses(params, cfg, Batch(patches, readings), weights)
    predictions = [network.apply(params, cfg, patch) for patch in patches]
    squared = [
        squared_error(prediction.reading, reading) for prediction, reading in zip(predictions, readings, strict=True)
    ]
    image = [
        image_error("depth", prediction.image, patch) for prediction, patch in zip(predictions, patches, strict=True)
    ]
    near = partial(pytest.approx, rel=16 * EPS)
    assert parts.squared == parts.reading == near(float((squared[0] + 3 * squared[2]) / 4))
    assert parts.image == near(float((image[0] + 3 * image[2]) / 4))
    assert total == parts.total == near(float(parts.reading + 0.5 * parts.image))


@pytest.mark.parametrize("whole", [False, True])
def test_the_best_epoch_of_other_networks_is_chosen_by_the_likelihood_itself(values, whole: bool) -> None:
    cfg = ModelConfig(pixels=4, encoder_width=6, heteroscedastic=whole, auxiliary=whole, beta=0.25)
    params, inputs, reading = model.init(jax.random.key(0), cfg), Inputs(jnp.ones((4, 4)), jnp.zeros(0)), values[2]
    params = jax.tree.map(lambda leaf: leaf + 0.01, params)  # so that log variances are not zero
    batch = jax.tree.map(lambda leaf: leaf[None], Batch(inputs, reading))
    got, predicted = model.losses(params, cfg, batch, jnp.ones(1))[1], model.apply(params, cfg, inputs)
    near = partial(pytest.approx, rel=16 * EPS)
    assert got.squared == near(float(squared_error(predicted.reading, reading)))
    if not whole:
        assert (got.total, got.reading, got.image) == (got.squared, got.squared, 0.0)
        return
    assert got.reading == near(float(gaussian(predicted.reading, predicted.log_variance, reading, 0.0)))
    assert got.total == near(float(gaussian(predicted.reading, predicted.log_variance, reading, 0.25) + got.image))
    assert got.image == near(float(image_error("depth", predicted.image, inputs.image)))
