"""Properties of training that hold for any data: what it fits, what it repeats exactly, and what it refuses."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from i2t import training
from i2t.prediction import model as net
from i2t.prediction.model import Inputs, ModelConfig, Normalisation, learner, predict
from i2t.training import Batch, EpochInfo, TrainConfig, TrainState

MODEL = ModelConfig(pixels=8, encoder_width=16, bottleneck=4, decoder_width=24, auxiliary_width=12)
TRAIN = TrainConfig(epochs=7, batch_size=16, learning_rate=3e-3)
EPS = float(np.finfo(np.float32).eps)


def touches(n: int, seed: int = 0, conditions: int = 0, noise: float = 0.0) -> Batch:
    """Smooth random depth patches and a linear response to their slopes, mean and conditions, plus noise (uT)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-1:1:8j, -1:1:8j]
    slope = rng.uniform(-1, 1, (n, 3))
    image = 2e-3 * (1 + 0.4 * (slope[:, 0, None, None] * x + slope[:, 1, None, None] * y + slope[:, 2, None, None]))
    measured = rng.normal(size=(n, conditions))
    response = np.random.default_rng(99).normal(size=(3 + conditions, 15))
    target = 30 * np.hstack([slope, measured]) @ response + noise * rng.normal(size=(n, 15))
    return Batch(Inputs(jnp.float32(image), jnp.float32(measured)), jnp.float32(target))


class Case(NamedTuple):
    norm: Normalisation
    train: Batch
    validation: Batch


@pytest.fixture(scope="module")
def case() -> Case:
    raw = touches(40)  # two minibatches of 16 and one of 8
    norm = net.normalisation(raw)
    return Case(norm, *(net.prepared(MODEL, norm, batch) for batch in (raw, touches(24, 1))))


def begin(model: ModelConfig, cfg: TrainConfig, n: int) -> TrainState:
    return jax.jit(training.init, static_argnums=(1, 2, 3))(jax.random.key(0), learner(model), cfg, n)


def fit(
    state: TrainState, model: ModelConfig, cfg: TrainConfig, train: Batch, validation: Batch | None
) -> tuple[TrainState, list[EpochInfo]]:
    """Train up to the last epoch."""
    epoch, infos = training.compiled(learner(model), cfg), []
    while not training.finished(state, cfg):
        state, info = epoch(state, train, validation)
        infos.append(info)
    return state, infos


def assert_same(a: object, b: object) -> None:
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(left, right)


def assert_near(left: object, right: object) -> None:
    """Equal but for the order of summation inside the products.

    An Adam step of rate r can differ by 2 r where a gradient is near zero, and hardly elsewhere: over the 21 steps of
    a training no weight may be further apart than that, and their mean distance stays below a hundredth of it.
    """
    furthest = 2 * TRAIN.learning_rate * 3 * TRAIN.epochs
    for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        assert jnp.abs(a - b).max() <= furthest
        assert jnp.abs(a - b).mean() <= 0.01 * furthest


@pytest.mark.full
def test_an_epoch_meets_every_touch_once_and_weighs_the_last_minibatch_by_its_size(case: Case) -> None:
    # A learning rate too small to move float32 parameters, so the epoch's mean is the mean over all touches.
    cfg = replace(TRAIN, learning_rate=1e-30)
    state = begin(MODEL, cfg, 40)
    after, info = training.compiled(learner(MODEL), cfg)(state, case.train, None)
    for left, right in zip(jax.tree.leaves(after.params), jax.tree.leaves(state.params), strict=True):
        np.testing.assert_allclose(left, right, atol=3 * 1e-29)  # three steps, none longer than ten times the rate
    params = jax.tree.map(lambda leaf: leaf[0], state.params)
    expected = jax.jit(lambda p: training.evaluate(p, learner(MODEL), case.train))(params)
    # Two orders of summing 40 positive terms, each from products of up to 64 terms.
    np.testing.assert_allclose(info.train.total[0], expected.total, rtol=104 * EPS)


def test_every_epoch_meets_the_touches_in_an_order_of_its_own() -> None:
    orders = [training.minibatches(jax.random.key(0), jnp.int32(epoch), 40, 16)[0].ravel()[:40] for epoch in range(3)]
    for order in orders:
        np.testing.assert_array_equal(np.sort(order), np.arange(40))
    assert len({tuple(np.asarray(order).tolist()) for order in orders}) == 3


@pytest.mark.full
def test_ensemble_members_differ_and_are_what_they_would_be_alone(case: Case) -> None:
    model = replace(MODEL, members=2)
    state = begin(model, TRAIN, 40)
    after, _ = fit(state, model, TRAIN, case.train, case.validation)
    for i in range(2):
        first = jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], state)
        alone, _ = fit(first, MODEL, TRAIN, case.train, case.validation)
        assert_near(jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], after.params), alone.params)
    kernels = after.params["encoder"]["kernel"]
    assert jnp.abs(kernels[0] - kernels[1]).mean() > 0.01  # weights are of order 1/sqrt(64)


def test_a_training_resumed_from_any_epoch_equals_the_uninterrupted_one(case: Case) -> None:
    sets = (case.train, case.validation)
    whole, heard = fit(begin(MODEL, TRAIN, 40), MODEL, TRAIN, *sets)
    assert len(heard) == TRAIN.epochs
    state, epoch = begin(MODEL, TRAIN, 40), training.compiled(learner(MODEL), TRAIN)
    for _ in range(3):
        state, _ = epoch(state, *sets)
    resumed, again = fit(jax.device_get(state), MODEL, TRAIN, *sets)
    assert (resumed.key == whole.key).all()
    assert_same(resumed._replace(key=None), whole._replace(key=None))
    assert_same(again, heard[3:])


def test_the_best_epoch_is_kept(case: Case) -> None:
    # Validation readings that contradict training: the score rises sooner or later.
    contrary = case.validation._replace(target=-case.validation.target)
    state, infos = fit(begin(MODEL, TRAIN, 40), MODEL, TRAIN, case.train, contrary)
    scores = [info.validation.reading[0] for info in infos]
    assert int(state.best_epoch[0]) == 1 + int(np.argmin(scores)) < TRAIN.epochs
    assert state.best_loss[0] == min(scores)
    best = jax.tree.map(lambda leaf: leaf[0], state.best_params)
    score = jax.jit(lambda p: training.evaluate(p, learner(MODEL), contrary).reading)(best)
    np.testing.assert_allclose(score, min(scores), rtol=104 * EPS)


@pytest.mark.parametrize(
    ("epoch", "best", "over"),
    [((3, 3), (0, 0), False), ((4, 4), (0, 1), False), ((4, 4), (0, 0), True), ((7, 7), (7, 6), True)],
    ids=["not yet", "one still hopes", "all have waited", "no epoch is left"],
)
def test_a_training_ends_when_all_members_have_waited_or_its_epochs_are_over(
    epoch: tuple[int, ...], best: tuple[int, ...], over: bool
) -> None:
    state = TrainState({}, {}, np.zeros((2, 2)), np.array(epoch), {}, np.zeros(2), np.array(best))
    assert training.finished(state, replace(TRAIN, patience=4)) is over


@pytest.mark.full
def test_known_noise_is_recovered() -> None:
    model = replace(MODEL, heteroscedastic=True, auxiliary=False)
    raw = touches(2000, noise=6.0)
    norm = net.normalisation(raw)
    cfg = TrainConfig(epochs=60, learning_rate=3e-3, batch_size=100)
    held_out = touches(500, 1, noise=6.0)
    sets = (net.prepared(model, norm, batch) for batch in (raw, held_out))
    state, _ = fit(begin(model, cfg, 2000), model, cfg, *sets)
    std = jax.jit(jax.vmap(lambda x: predict(state.best_params, model, norm, x)[1]))(held_out.inputs)
    # The likelihood's best constant estimate of one channel from 2000 touches has a relative standard error of
    # 1/sqrt(4000) = 1.6 %; the model also has to learn the mean (about 1000 parameters on 30 000 values, 3 % of the
    # variance): 10 % is three times their sum.
    np.testing.assert_allclose(jnp.sqrt(jnp.mean(std**2, axis=0)), 6.0, rtol=0.1)


@pytest.mark.full
def test_residual_makes_the_standard_deviation_right_where_it_was_measured(case: Case) -> None:
    model = replace(MODEL, members=2)
    state = begin(model, TRAIN, 40)
    norm = jax.jit(partial(net.with_residual, cfg=model))(state.params, norm=case.norm, batch=case.validation)
    raw = touches(24, 1)
    mean, std = jax.jit(jax.vmap(lambda x: predict(state.params, model, norm, x)))(raw.inputs)
    error = jnp.mean((mean - raw.target) ** 2, axis=0)
    shown = jnp.mean(std**2, axis=0)
    apart = norm.residual > 0
    assert apart.any()
    # Means over 24 touches of squares of numbers of order one.
    np.testing.assert_allclose(shown[apart], error[apart], rtol=100 * EPS * 24)
    assert (shown[~apart] >= error[~apart]).all()


def test_normalisation_standardises_and_survives_constant_channels() -> None:
    raw = touches(50, conditions=2)
    raw = raw._replace(
        target=raw.target.at[:, 4].set(0.1),
        inputs=raw.inputs._replace(conditions=raw.inputs.conditions.at[:, 1].set(-3e-4)),
    )
    model = replace(MODEL, conditions=("force", "travel"))
    norm = net.normalisation(raw)
    prepared = net.prepared(model, norm, raw)
    varying = np.arange(15) != 4
    for values, channels in ((prepared.target, varying), (prepared.inputs.conditions, np.array([True, False]))):
        # Sums of 50 float32 terms of order one.
        np.testing.assert_allclose(values.mean(0), 0, atol=50 * EPS * 4)
        np.testing.assert_allclose(values.std(0)[channels], 1, rtol=50 * EPS * 4)
        np.testing.assert_allclose(values[:, ~channels], 0, atol=50 * EPS)
    assert norm.reading.std[4] == 1


RAW = touches(20, conditions=1)


def inputs(**changed) -> Batch:
    return RAW._replace(inputs=RAW.inputs._replace(**changed))


@pytest.mark.parametrize(
    ("damaged", "words"),
    [
        (
            inputs(image=RAW.inputs.image.at[7, 2, 3].set(jnp.nan)),
            "1 of 20 touches of the training set have a non-finite image .first at index 7",
        ),
        (inputs(conditions=RAW.inputs.conditions.at[7, 0].set(jnp.inf)), "non-finite condition 'force'"),
        (RAW._replace(target=RAW.target.at[7, 1].set(jnp.nan)), "non-finite reading"),
        (inputs(image=RAW.inputs.image[:, :7, :7]), "20 touches of model.pixels = 8"),
        (jax.tree.map(lambda leaf: leaf[:0], RAW), "holds no touches"),
    ],
    ids=["image", "force", "reading", "pixels", "none"],
)
def test_touches_that_cannot_be_learned_from_are_refused(damaged: Batch, words: str) -> None:
    model = replace(MODEL, conditions=("force",))
    net.check(RAW, model, "training")
    with pytest.raises(ValueError, match=words):
        net.check(damaged, model, "training")


@pytest.mark.parametrize("change", [{"epochs": 0}, {"learning_rate": float("nan")}])
def test_impossible_trainings_are_refused(change: dict) -> None:
    with pytest.raises(ValueError, match=f"train.{next(iter(change))}"):
        TrainConfig(**change)


def test_full_batch_descent_finds_least_squares_and_reports_the_loss_before_each_step() -> None:
    x, y = jax.random.normal(jax.random.key(2), (40, 3)), jax.random.normal(jax.random.key(3), (40, 2))
    start = jnp.ones((3, 2))

    def loss(kernel: jax.Array, _: jax.Array) -> jax.Array:
        return jnp.mean((x @ kernel - y) ** 2)

    keys = jax.random.split(jax.random.key(4), 300)
    fitted, path = jax.jit(lambda start: training.descend(start, loss, optax.sgd(0.3), keys))(start)
    best = np.linalg.lstsq(np.asarray(x, np.float64), np.asarray(y, np.float64))[0]
    np.testing.assert_allclose(fitted, best, atol=1e-5)
    assert path.shape == (300,)
    assert path[0] == pytest.approx(float(loss(start, keys[0])), rel=64 * EPS)
