"""Calibrated beliefs: known temperatures and logit scalings are recovered; priors change by Bayes' rule."""

import numpy as np
import pytest
from scipy.special import expit, logsumexp

from i2t.recognition import calibrated, metrics
from i2t.recognition.calibrated import TemperatureScaling


def test_the_fitted_temperature_corrects_beliefs_that_count_touches_twice():
    """Correct beliefs about normal readings are made overconfident by a known temperature."""
    rng = np.random.default_rng(0)
    episodes, touches, classes = 4000, 6, 3
    truth = rng.integers(classes, size=episodes)
    logs = rng.normal(size=(episodes, touches, classes))
    logs[np.arange(episodes), :, truth] += 1  # log likelihoods of unit normal readings, one of each class
    right = np.cumsum(logs, axis=1)
    for wanted in (TemperatureScaling(1.0, 0.0), TemperatureScaling(1.5, 0.2)):
        t = np.arange(1, touches + 1)
        sure = right * (wanted.initial * (1 + wanted.growth * (t - 1)))[None, :, None]
        p = np.exp(sure - logsumexp(sure, axis=-1, keepdims=True))
        fitted = calibrated.fit_temperature(p, truth)
        assert fitted.initial == pytest.approx(wanted.initial, abs=0.06)
        assert fitted.growth == pytest.approx(wanted.growth, abs=0.03)
        sober = calibrated.calibrated_beliefs(p, fitted)
        assert (sober.argmax(-1) == p.argmax(-1)).mean() > 0.9999
        assert metrics.log_loss(sober, truth).mean() <= metrics.log_loss(p, truth).mean() + 1e-4


def test_platt_scaling_corrects_slope_and_offset_of_log_odds():
    """Odds of normal signals about -1 and 1 (log odds 2x) are reported with a wrong slope and offset."""
    rng = np.random.default_rng(1)
    unknown = rng.random(4000) < 0.5
    x = rng.normal(size=(4000, 3)) + np.where(unknown, 1, -1)[:, None]
    odds = calibrated.fit_platt(expit(0.5 * 2 * x + 1.5), unknown)
    assert odds.slope == pytest.approx(2, rel=0.08)  # 12 000 signals: 2 % each way is one standard error
    assert odds.offset == pytest.approx(-3, rel=0.08)
    assert odds.growth < 0.1
    surer = calibrated.fit_platt(expit(2 * x * (1 + 0.5 * np.arange(3))), unknown)  # with every touch
    np.testing.assert_allclose(surer, [0, 1, 0.5], atol=0.1)
    p = rng.dirichlet(np.ones(4), (4000, 3))
    named, none = calibrated.apply_platt(0.3 * p, np.full((4000, 3), 0.7), calibrated.PlattScaling(0.0, 1.0))
    np.testing.assert_allclose(none, 0.7, rtol=1e-12)
    np.testing.assert_allclose(named, 0.3 * p, rtol=1e-9)
    nothing, _ = calibrated.apply_platt(np.zeros((1, 1, 4)), np.ones((1, 1)), calibrated.PlattScaling(-3.0, 1.0))
    np.testing.assert_allclose(nothing, nothing[0, 0, 0])  # knows none from another


def test_changing_the_unknown_prior_follows_bayes_rule():
    p = np.array([[[0.3, 0.2]]])
    q, other = calibrated.with_unknown_prior(p, np.array([[0.5]]), 0.2, 0.5)  # odds 1/4 to 1: four times as likely
    np.testing.assert_allclose(np.append(q, other), np.array([0.3, 0.2, 2.0]) / 2.5)
    closed, nothing = calibrated.with_unknown_prior(np.array([[0.0, 0.0]]), np.array([1.0]), 0.5, 0.0)
    np.testing.assert_array_equal(np.append(closed, nothing), [0.5, 0.5, 0])
    with pytest.raises(ValueError, match="with_unknown_prior: priors"):
        calibrated.with_unknown_prior(p, np.array([[0.5]]), 0.0, 0.5)


def test_empty_or_non_finite_beliefs_are_refused():
    p, truth = np.full((5, 3, 4), 0.25), np.zeros(5, int)
    wrong = np.where(np.arange(5)[:, None, None] == 3, np.nan, p)
    with pytest.raises(ValueError, match="log loss of these beliefs is not finite"):
        calibrated.fit_temperature(wrong, truth)
    with pytest.raises(ValueError, match="log loss of these beliefs is not finite"):
        calibrated.fit_platt(wrong[..., 0], truth > 0)
    with pytest.raises(ValueError, match="there is no episode"):
        calibrated.fit_temperature(p[:0], truth[:0])
    with pytest.raises(ValueError, match="there is no episode"):
        calibrated.fit_platt(p[:0, :, 0], truth[:0] > 0)
