"""Baselines as predictors: closed forms, explained variance, and coverage of their ranges."""

import numpy as np

from i2t.leave_one_out import STDS_WITHIN_90
from i2t.prediction.baselines import ridge
from i2t.prediction.methods import TrainingTouches
from i2t.prediction.metrics import score
from tests.helpers.baselines import PRESSURE, bare_dataset, fit_baselines, predict


def test_ridge_minimises_its_loss():
    rng = np.random.default_rng(3)
    x, y, penalty = rng.normal(size=(40, 6)) + 3, rng.normal(size=(40, 15)), 0.3
    # The same problem as plain least squares: an unpenalised column of ones, and rows that ask for small weights.
    tall = np.r_[np.c_[x, np.ones(40)], np.c_[np.sqrt(penalty * 40) * np.eye(6), np.zeros(6)]]
    weights = np.linalg.lstsq(tall, np.r_[y, np.zeros((6, 15))])[0]
    at = rng.normal(size=(5, 6))
    np.testing.assert_allclose(ridge(x, y, at, penalty), np.c_[at, np.ones(5)] @ weights, atol=1e-10)
    line = x @ rng.normal(size=(6, 15)) + 2
    np.testing.assert_allclose(ridge(x, line, x, 1e-12), line, atol=1e-8)


def touches(n=240, seed=6):
    """Patches, two measured values, and readings that depend on both, two thirds on the measured ones."""
    rng = np.random.default_rng(seed)
    patches = rng.normal(size=(n, 6, 6))
    measured = rng.normal(size=(n, 2)) * (1, 1e-3)
    true = np.random.default_rng(0)
    from_patch, from_measured = true.normal(size=(36, 15)), true.normal(size=(2, 15)) * [[1], [1e3]]
    y = patches.reshape(n, -1) @ from_patch + 6 * measured @ from_measured
    return patches, measured, y + rng.normal(size=y.shape)


def test_baselines_explain_only_what_their_inputs_determine():
    patches, measured, y = touches()
    train, test = slice(0, 200), slice(200, 240)
    fitted = fit_baselines(patches[train], measured[train], y[train], np.arange(200) // 9)
    assert list(fitted) == ["mean", "nearest", "nearest-measured", "ridge", "ridge-measured"]
    mean = {name: predict(model, patches[test], measured[test]).mean for name, model in fitted.items()}
    r2 = {name: score(y[test], values).r2 for name, values in mean.items()}
    np.testing.assert_allclose(mean["mean"], np.tile(y[train].mean(0), (40, 1)), rtol=1e-5)
    # The measured values carry two thirds of the variance: only a method that is given them can explain that much.
    assert r2["mean"] <= 0
    assert r2["ridge"] < 1 / 3 + 0.15
    assert r2["ridge-measured"] > 0.8
    assert r2["nearest-measured"] > r2["nearest"]


def test_baselines_on_predicted_pressure_equal_those_on_patches_for_the_same_image():
    """With pressures in place of the patches and noise in place of the pressures, the model is the same."""
    patches, measured, y = touches()
    noise, groups = np.random.default_rng(1).normal(size=patches.shape), np.arange(240) // 9
    on_patches = fit_baselines(patches, measured, y, groups)
    on_pressure = fit_baselines(noise, measured, y, groups, patches)
    for name in ("nearest", "ridge"):
        for measured_too in ("", "-measured"):
            expected = predict(on_patches[name + measured_too], patches[:9], measured[:9])
            model = on_pressure[f"{name}-pressure{measured_too}"]
            assert model.pressure == PRESSURE
            actual = predict(model, noise[:9], measured[:9], patches[:9])
            np.testing.assert_allclose(actual.mean, expected.mean, rtol=1e-4)
            np.testing.assert_allclose(actual.std, expected.std, rtol=1e-4)


def test_intervals_of_baselines_cover_the_stated_fraction():
    """Before any scaling on validation touches: 90 % of new values, or a little less, because components are of all
    training patches, also of those that are held out.
    """
    patches, measured, y = touches()
    new_patches, new_measured, new = touches(400, seed=7)
    for name, model in fit_baselines(patches, measured, y, np.arange(240) // 4).items():
        mean, std = predict(model, new_patches, new_measured)
        assert 0.82 < np.mean(np.abs(new - mean) < STDS_WITHIN_90 * std) < 0.95, name


def test_the_interval_widens_away_from_the_training_touches():
    rng = np.random.default_rng(2)
    place = rng.uniform(-1, 1, (150, 2))
    patches = np.zeros((150, 4, 4))
    patches[:, 0, :2] = place
    y = np.sin(3 * place) @ rng.normal(size=(2, 6))
    fitted = fit_baselines(patches, np.zeros((150, 0)), y, np.arange(150))
    assert list(fitted) == ["mean", "nearest", "ridge"]  # nothing was measured
    away = patches[:2].copy()
    away[1, 0, :2] = 3.0
    for name in ("nearest", "ridge"):
        std = predict(fitted[name], away, np.zeros((2, 0))).std
        assert (std[1] > std[0]).all()


def test_methods_share_values_of_the_same_touches_only():
    calls: list[int] = []
    given, rows = TrainingTouches(bare_dataset(np.zeros((4, 5, 5)), np.zeros((4, 6)))), np.arange(4) < 2
    values = [given.cached("sum", mask, lambda: calls.append(1) or len(calls)) for mask in (rows, rows, ~rows)]
    assert values == [1, 1, 2]


def test_touches_that_are_all_alike_are_predicted_as_well():
    """Patches of one position, a value that never changes and a dead channel give finite readings and ranges above
    zero.
    """
    y = np.random.default_rng(5).normal(size=(30, 6))
    y[:, 2] = 0
    for model in fit_baselines(np.zeros((30, 5, 5)), np.full((30, 1), 2.0), y, np.zeros(30, int)).values():
        mean, std = predict(model, np.zeros((3, 5, 5)), np.full((3, 1), 2.0))
        assert np.isfinite(mean).all()
        assert (std > 0).all()
