"""Losses against closed forms and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import stats

from i2t.prediction.loss import LossConfig, gaussian, image_error, losses, squared_error
from i2t.prediction.model import Inputs, ModelConfig, Prediction

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


@pytest.mark.parametrize("whole", [False, True])
def test_total_is_the_weighted_sum_of_what_the_model_has(values, whole: bool) -> None:
    mean, log_variance, target = values
    image, seen = jnp.full((4, 4), 3.0), jnp.ones((4, 4))
    model = ModelConfig(pixels=4, heteroscedastic=whole, auxiliary=whole)
    prediction = Prediction(mean, log_variance if whole else None, image if whole else None, jnp.zeros(5))
    got = losses(LossConfig(auxiliary=0.5, beta=0.25), model, prediction, Inputs(seen, jnp.zeros(0)), target)
    reading = gaussian(mean, log_variance, target, 0.25) if whole else squared_error(mean, target)
    assert (got.squared, got.reading) == (squared_error(mean, target), reading)
    assert (got.image, got.total) == ((4.0, reading + 2.0) if whole else (0.0, reading))


@pytest.mark.parametrize("change", [{"auxiliary": -1.0}, {"beta": 2.0}])
def test_meaningless_weights_are_refused(change: dict) -> None:
    with pytest.raises(ValueError, match=f"loss.{next(iter(change))}"):
        LossConfig(**change)
