"""The network against the paper's sizes, its own parts written out by hand, and the moments of a mixture."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.paper import loss, network
from i2t.paper.config import PaperConfig
from i2t.prediction.model import (
    Inputs,
    MemberPrediction,
    ModelConfig,
    Normalisation,
    apply,
    init,
    losses,
    predict,
    prepare,
)
from i2t.prediction.networks import _warn_of_lost_epochs
from i2t.training import Batch, Standard, TrainConfig

SMALL = ModelConfig(pixels=12, encoder_width=16, decoder_width=24, auxiliary_width=20)
EPS = float(np.finfo(np.float32).eps)


def examples(cfg: ModelConfig, n: int) -> Inputs:
    key_image, key_conditions = jax.random.split(jax.random.key(3))
    image = 4e-3 * jax.random.uniform(key_image, (n, cfg.pixels, cfg.pixels))
    return Inputs(image, jax.random.normal(key_conditions, (n, len(cfg.conditions))))


def plain(conditions: int) -> Normalisation:
    ones = jnp.ones(15)
    return Normalisation(Standard(0 * ones, ones), Standard(jnp.zeros(conditions), jnp.ones(conditions)), 0 * ones)


def start(cfg: ModelConfig) -> dict:
    return jax.jit(init, static_argnums=1)(jax.random.key(0), cfg)


def test_the_papers_network_has_the_papers_sizes() -> None:
    def dense(inputs: int, outputs: int) -> int:
        return inputs * outputs + outputs

    def trained_values(cfg: PaperConfig, init: Callable = init) -> int:
        shapes = jax.eval_shape(lambda: init(jax.random.key(0), cfg))
        return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))

    readings = dense(2304, 200) + dense(200, 5) + dense(5, 500) + dense(500, 15)
    assert trained_values(ModelConfig(auxiliary=False)) == readings == 472_520
    whole = trained_values(ModelConfig())
    assert whole == trained_values(PaperConfig(), network.init) == readings + dense(5, 2000) + dense(2000, 2304)


def test_forward_pass_is_the_one_written_out_by_hand() -> None:
    cfg = replace(SMALL, conditions=("force",), heteroscedastic=True)
    params = start(cfg)
    params["log_variance"]["kernel"] = jax.random.normal(jax.random.key(1), (24, 15))
    example = jax.tree.map(lambda leaf: leaf[0], examples(cfg, 1))
    got = jax.jit(partial(apply, cfg=cfg))(params, inputs=example)

    weights = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)

    def layer(name: str, values: np.ndarray) -> np.ndarray:
        return values @ weights[name]["kernel"] + weights[name]["bias"]

    force = np.asarray(example.conditions, np.float64)
    features = np.concatenate([np.asarray(example.image, np.float64).ravel(), force])
    latent = layer("bottleneck", np.maximum(layer("encoder", features), 0))
    decoded = np.maximum(layer("decoder", np.concatenate([latent, force])), 0)
    image = layer("image", np.maximum(layer("auxiliary", latent), 0)).reshape(12, 12)
    log_variance = 10 * np.tanh(layer("log_variance", decoded) / 10)
    expected = MemberPrediction(layer("reading", decoded), log_variance, image, latent)
    # Each of at most three products in a row sums at most 145 terms of order one: rounding below 3 * 145 * eps.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=3 * 145 * EPS, rtol=3 * 145 * EPS), got, expected)


def test_with_a_force_that_weighs_nothing_the_network_and_its_loss_are_the_papers() -> None:
    cfg = replace(SMALL, conditions=("force",))
    paper = PaperConfig(pixels=12, encoder_width=16, decoder_width=24, auxiliary_width=20)
    params = start(cfg)
    for name, row in (("encoder", 144), ("decoder", cfg.bottleneck)):
        params[name]["kernel"] = params[name]["kernel"].at[row].set(0)
    without = {name: {**layer} for name, layer in params.items()}
    for name in ("encoder", "decoder"):
        without[name]["kernel"] = params[name]["kernel"][:-1]
    inputs, target = examples(cfg, 5), jax.random.normal(jax.random.key(4), (5, 15))
    weights = jnp.ones(5)
    got = losses(params, cfg, Batch(inputs, target), weights)
    expected = loss.losses(without, paper, Batch(inputs.image, target), weights)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5), got, expected)


def test_weights_of_a_seed_are_those_of_earlier_versions() -> None:
    """A seed that was used for training before gives the same network again."""
    params = start(ModelConfig(pixels=4, encoder_width=3, auxiliary=False))
    expected = [1.2329613, 0.130290493, -0.636551082, 0.406681776, 0.446827978]
    np.testing.assert_allclose(params["bottleneck"]["kernel"][0], expected, rtol=4 * EPS)


def test_omitted_layers_do_not_change_the_others() -> None:
    whole, part = start(replace(SMALL, heteroscedastic=True)), start(replace(SMALL, auxiliary=False))
    for name, layer in part.items():
        jax.tree.map(np.testing.assert_array_equal, layer, whole[name])


def test_prepared_inputs() -> None:
    depth = jnp.array([[0.0, 1e-3], [2e-3, 9e-3]])
    inputs = Inputs(depth, jnp.array([3.0]))
    norm = plain(1)._replace(conditions=Standard(jnp.array([1.0]), jnp.array([4.0])))
    cfg = ModelConfig(pixels=2, conditions=("force",))
    np.testing.assert_allclose(prepare(cfg, norm, inputs).image, [[0, 0.25], [0.5, 1]], rtol=2 * EPS)
    np.testing.assert_array_equal(prepare(cfg, norm, inputs).conditions, [0.5])
    np.testing.assert_array_equal(prepare(replace(cfg, input="mask"), norm, inputs).image, [[1, 1], [0, 0]])
    np.testing.assert_array_equal(prepare(replace(cfg, input="pressure"), norm, inputs).image, depth)


@pytest.mark.full
def test_mixture_has_the_moments_worked_out_by_hand() -> None:
    cfg = replace(SMALL, heteroscedastic=True, members=2)
    params = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), start(cfg))
    # Members that ignore their input: means 1 and 3, variances e^0 and e^ln 3 (before the smooth bound).
    bias = jnp.array([1.0, 3.0])[:, None] * jnp.ones((1, 15))
    params["reading"] = {"kernel": jnp.zeros((2, 24, 15)), "bias": bias}
    raw = 10 * np.arctanh(np.log(3) / 10)
    params["log_variance"]["bias"] = jnp.array([0.0, raw])[:, None] * jnp.ones((1, 15))
    norm = plain(0)._replace(reading=Standard(jnp.arange(15.0), jnp.full(15, 10.0)))
    mean, std = jax.jit(partial(predict, cfg=cfg))(
        params, norm=norm, inputs=jax.tree.map(lambda leaf: leaf[0], examples(cfg, 1))
    )
    # Mixture: mean (1 + 3)/2; variance (1 + 3)/2 + ((1 - 2)^2 + (3 - 2)^2)/2 = 3.
    np.testing.assert_allclose(mean, 20 + np.arange(15.0), rtol=4 * EPS)
    np.testing.assert_allclose(std, np.full(15, 10 * np.sqrt(3)), rtol=16 * EPS)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("input", "rgb", "choose one of depth, mask, pressure"),
        ("conditions", ("force", "colour"), "name each of force, nearest, travel"),
        ("conditions", ("force", "force"), "at most once"),
        ("bottleneck", 0, "paper.bottleneck is 0"),
    ],
)
def test_impossible_networks_are_refused(field: str, value: object, words: str) -> None:
    cfg = ModelConfig()
    object.__setattr__(cfg, field, value)  # the run-time type checks of the tests would refuse some of these earlier
    with pytest.raises(ValueError, match=words):
        cfg.__post_init__()


def test_epochs_without_a_finite_loss_are_counted():
    _warn_of_lost_epochs([[1.0, 2.0], [0.5, 1.0]], "network", TrainConfig())
    with pytest.warns(UserWarning, match="not finite in 2 of 3 epochs"):
        _warn_of_lost_epochs([[1.0, 2.0], [math.nan, math.nan], [0.5, math.inf]], "network", TrainConfig())
