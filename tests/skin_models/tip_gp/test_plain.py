"""The baseline's plain process: its scales, its predictions and the gradient of its loss."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF

from i2t.skin_models.tip_gp import plain


def test_the_plain_process_finds_the_scales_of_its_own_presses():
    """Presses are drawn from the process itself: lengths are within a third, and better than half the length."""
    rng = np.random.default_rng(4)
    position, load = rng.uniform(-0.01, 0.01, (200, 2)), rng.uniform(0, 2, 200)
    square = ((position[:, None] - position) ** 2).sum(-1) / 4e-3**2 + (load[:, None] - load) ** 2 / 1.5**2
    system = np.exp(-square / 2) + 0.01 * np.eye(200)
    readings = 30 * np.linalg.cholesky(system) @ rng.normal(size=(200, 9)) + 100
    fitted = position[:120], load[:120], readings[:120]
    fit = plain.fit_scales(*fitted)
    assert fit.length == pytest.approx(4e-3, rel=0.33)
    assert fit.width == pytest.approx(1.5, rel=0.33)
    at = position[120:], load[120:]
    errors = [
        ((plain.predict_plain(scales, fitted, at) - readings[120:]) ** 2).sum()
        for scales in (fit, fit._replace(length=fit.length / 2))
    ]
    assert errors[0] < errors[1]
    # For presses at the same travel, it is a process over positions.
    reading = position @ rng.normal(size=(2, 6)) * 1e4
    pressed = position[:12], np.zeros(12), reading[:12]
    flat = plain.predict_plain(plain.fit_scales(*pressed), pressed, (position[:12], np.zeros(12)))
    assert ((flat - reading[:12]) ** 2).sum() < 0.1 * ((reading[:12] - reading[:12].mean(0)) ** 2).sum()


def test_predictions_agree_with_scikit_learn_and_the_gradient_with_finite_differences():
    rng = np.random.default_rng(5)
    position, load, readings = rng.uniform(-0.01, 0.01, (12, 2)), rng.uniform(0, 2, 12), rng.normal(100, 30, (12, 4))
    scales = plain.PlainScales(4e-3, 1.5, 0.01)
    fitted, at = (slice(8), slice(8, None))
    x = np.column_stack([position, load])
    other = GaussianProcessRegressor(RBF([4e-3, 4e-3, 1.5]), alpha=0.01, optimizer=None)
    mean = readings[fitted].mean(0)
    expected = other.fit(x[fitted], readings[fitted] - mean).predict(x[at]) + mean
    predicted = plain.predict_plain(
        scales, (position[fitted], load[fitted], readings[fitted]), (position[at], load[at])
    )
    np.testing.assert_allclose(predicted, expected, rtol=1e-9)

    square = ((position[:, None] - position) ** 2).sum(-1), (load[:, None] - load) ** 2
    fixed = np.array(scales), square, readings - readings.mean(0)
    free = np.array([0.2, -0.1, 1.0])
    numeric = approx_fprime(free, lambda free: plain._loss(free, *fixed)[0], 1e-6)
    np.testing.assert_allclose(plain._loss(free, *fixed)[1], numeric, rtol=1e-4)


def test_presses_that_no_process_fits_are_refused(monkeypatch):
    def fails(*_, **__):
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(plain, "cho_factor", fails)
    rng = np.random.default_rng(6)
    with pytest.raises(ValueError, match="no plain Gaussian process fits these 12 presses"):
        plain.fit_scales(rng.normal(size=(12, 2)), np.ones(12), rng.normal(size=(12, 3)))
