"""The Gaussian process against a dense one in double precision, and its hyperparameters against cross-validation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.contact.pressure import ContactPressure
from i2t.skin_models import pressure_gp as gp
from i2t.skin_models.pressure_gp import GPHyperparameters

M = 12  # mm, edge of the maps
CHANNELS = 15
fit, predict = gp.fit, jax.jit(gp.predict)
HYPER = GPHyperparameters(
    jnp.array([0.1, 0.5, 0.2, 0.15, 0.05]), jnp.array(0.3), jnp.array(0.7), jnp.array(0.05)
)  # all different from one another


def spots(rng: np.random.Generator, n: int) -> ContactPressure:
    """Make round contacts at random places under random loads."""
    x = np.arange(M)
    place = rng.uniform(1, M - 2, (n, 2, 1))
    along = np.exp(-((x - place) ** 2) / (2 * rng.uniform(1, 2, (n, 1, 1)) ** 2))
    pressure = along[:, 0, :, None] * along[:, 1, None, :]
    pressure *= rng.uniform(0.3, 3, (n, 1, 1)) / pressure.sum((1, 2), keepdims=True)
    return ContactPressure(jnp.float32(pressure), jnp.float32(pressure.sum((1, 2))))


def covariance(
    hyper: GPHyperparameters, a: ContactPressure, b: ContactPressure, unit: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Compute k(a, b) by the formula of the module, cell by cell, and the mean of p C p over a for each length."""
    cells = np.stack(np.meshgrid(np.arange(M), np.arange(M), indexing="ij"), -1).reshape(-1, 2)
    square = ((cells[:, None] - cells[None]) ** 2).sum(-1)
    p, q = (np.asarray(x.pressure, np.float64).reshape(len(x.load), -1) for x in (a, b))
    linear = np.stack([p @ np.exp(-square / (2 * length**2)) @ q.T for length in gp.MAP_LENGTHS_MM])
    unit = np.trace(linear, axis1=1, axis2=2) / len(p) if unit is None else unit
    ratio = np.log(np.asarray(a.load, np.float64)[:, None] / np.asarray(b.load, np.float64))
    bend = float(hyper.bend)
    bracket = 1 - bend + bend * np.exp(-(ratio**2) / (2 * float(hyper.width) ** 2))
    return np.einsum("l,lab->ab", np.asarray(hyper.weights, np.float64) / unit, linear) * bracket, unit


def explained_between_groups(
    hyper: GPHyperparameters, touches: ContactPressure, readings: np.ndarray, groups: np.ndarray
) -> tuple[float, float]:
    """Compute R2 with each group predicted from all others, and the error by rounding of the hyperparameters."""
    K, _ = covariance(hyper, touches, touches, None)
    noise = float(hyper.noise)
    error = 0.0
    for group in np.unique(groups):
        kept = groups != group
        weights = np.linalg.solve(K[np.ix_(kept, kept)] + noise * np.eye(kept.sum()), readings[kept])
        error += (((K[np.ix_(~kept, kept)] @ weights - readings[~kept]) / np.sqrt((readings**2).mean(0))) ** 2).sum()
    # The hyperparameters are rounded to float32, and their errors count a few times.
    return 1 - error / readings.size, 1e-5


def smooth_readings(rng: np.random.Generator, touches: ContactPressure) -> np.ndarray:
    """Make readings from random walks across the skin, with a tenth of noise."""
    maps = rng.normal(size=(CHANNELS, M, M)).cumsum(1).cumsum(2)
    readings = np.einsum("cij,nij->nc", maps - maps.mean((1, 2), keepdims=True), touches.pressure)
    return (readings + 0.1 * readings.std() * rng.normal(size=readings.shape)).astype(np.float32)


def test_mean_and_variance_agree_with_a_dense_process():
    rng = np.random.default_rng(0)
    train, other = spots(rng, 30), spots(rng, 20)
    readings = rng.normal(scale=20, size=(30, CHANNELS)).astype(np.float32)
    mean, std = predict(fit(HYPER, train, jnp.asarray(readings)), other)

    K, unit = covariance(HYPER, train, train, None)
    cross, _ = covariance(HYPER, other, train, unit)
    own, _ = covariance(HYPER, other, other, unit)
    noise = float(HYPER.noise)
    inverse = np.linalg.inv(K + noise * np.eye(30))
    # The total variance of a channel is its signal's times 1 + noise.
    scale = np.sqrt((readings.astype(np.float64) ** 2).mean(0) / (1 + noise))
    variance = np.diag(own - cross @ inverse @ cross.T) + noise
    # float32 solves lose a condition number of digits: at most trace K / noise.
    loss = np.finfo(np.float32).eps * np.trace(K) / noise
    assert loss < 1e-3
    np.testing.assert_allclose(mean, cross @ inverse @ readings, atol=loss * np.abs(readings).max())
    np.testing.assert_allclose(std, np.sqrt(variance)[:, None] * scale, rtol=loss / noise)


def test_the_system_of_many_similar_touches_is_factored_in_double_precision():
    """300 touches of 144 cells with a noise of 1e-5 give a condition number of 3e7, too much for float32."""
    rng = np.random.default_rng(5)
    touches, noise = spots(rng, 300), 1e-5
    readings = smooth_readings(rng, touches)
    hyper = HYPER._replace(noise=jnp.float32(noise))
    K, _ = covariance(hyper, touches, touches, None)
    assert np.linalg.cond(K + noise * np.eye(300)) > 1e6
    fitted = fit(hyper, touches, jnp.asarray(readings))
    expected = np.linalg.solve(K + noise * np.eye(300), readings / np.asarray(fitted.scale))
    np.testing.assert_allclose(fitted.weights, expected, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(
        np.tril(fitted.cholesky) @ np.asarray(fitted.cholesky).T, K + noise * np.eye(300), atol=1e-5
    )


def test_leave_one_out_errors_agree_with_a_process_without_the_touch():
    rng = np.random.default_rng(1)
    touches = spots(rng, 20)
    readings = rng.normal(scale=20, size=(20, CHANNELS)).astype(np.float32)
    K, _ = covariance(HYPER, touches, touches, None)
    K += (float(HYPER.noise)) * np.eye(20)
    errors = fit(HYPER, touches, jnp.asarray(readings)).leave_one_out
    for i in (0, 7):
        rest = np.delete(np.arange(20), i)
        expected = readings[i] - K[i, rest] @ np.linalg.solve(K[np.ix_(rest, rest)], readings[rest])
        np.testing.assert_allclose(errors[i], expected, rtol=1e-3, atol=1e-2)


def test_no_pressure_gives_no_reading_and_predictions_are_independent():
    rng = np.random.default_rng(4)
    fitted = fit(HYPER, spots(rng, 30), jnp.float32(rng.normal(size=(30, CHANNELS))))
    other = spots(rng, 20)
    pressure, load = (part.at[:19].set(0) for part in other)
    mean, std = predict(fitted, ContactPressure(pressure, load))
    np.testing.assert_array_equal(mean[:19], 0)
    # Only the sensor's noise remains.
    np.testing.assert_allclose(std[:19], np.broadcast_to(np.sqrt(0.05) * fitted.scale, (19, CHANNELS)), rtol=1e-6)
    for alone, together in zip((mean, std), predict(fitted, other), strict=True):
        # Sums of a few hundred float32 terms, through a solve with a condition number of 10 / 0.05.
        np.testing.assert_allclose(alone[19], together[19], rtol=200 * 1e-5, atol=1e-5)


def test_cross_validation_leaves_whole_groups_out_and_the_best_step_is_taken():
    rng = np.random.default_rng(9)
    touches, groups = spots(rng, 24), np.repeat([7, 3, 9, 1], 6)
    readings = smooth_readings(rng, touches)
    # There are as many folds as groups, so each group is left out once, however they are shuffled.
    chosen, explained = gp.choose_hyperparameters(touches, jnp.asarray(readings), groups, steps=8)
    start = GPHyperparameters(jnp.full(5, 0.2), jnp.array(0.5), jnp.array(1.0), jnp.exp(-2.0))
    at_start, rounding = explained_between_groups(start, touches, readings, groups)
    assert abs(float(explained[0]) - at_start) < rounding
    best, rounding = explained_between_groups(chosen, touches, readings, groups)
    explained = np.sort(explained)
    # The best step differs enough from all others that a wrong choice would show.
    assert explained[-1] - explained[-2] > 2 * rounding
    assert abs(best - explained[-1]) < rounding


def test_touches_without_groups_or_finite_readings_are_refused():
    touches, readings = spots(np.random.default_rng(8), 24), np.ones((24, CHANNELS), np.float32)
    with pytest.raises(ValueError, match="at least two groups"):
        gp.choose_hyperparameters(touches, jnp.asarray(readings), np.zeros(24, int))
    readings[3, 2] = np.nan
    with pytest.raises(ValueError, match="no finite score on 24 touches"):
        gp.choose_hyperparameters(touches, jnp.asarray(readings), np.repeat([7, 3, 9, 1], 6), steps=8)


def test_steps_without_a_finite_score_are_counted(monkeypatch):
    touches, readings = spots(np.random.default_rng(8), 24), np.ones((24, CHANNELS), np.float32)
    descend = gp._descend

    def breaks_down(*args, **options):
        path, errors = descend(*args, **options)
        return path, errors.at[3:].set(jnp.nan)

    monkeypatch.setattr(gp, "_descend", breaks_down)
    with pytest.warns(UserWarning, match="not finite in 5 of 8 steps on 24 touches"):
        gp.choose_hyperparameters(touches, jnp.asarray(readings), np.repeat([7, 3, 9, 1], 6), steps=8)
