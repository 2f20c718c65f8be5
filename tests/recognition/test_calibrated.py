"""Calibrated beliefs: known temperatures and logit scalings are found again, and sets cover what they promise."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers.forecasters import calibrated_forecaster
from scipy.special import expit, logsumexp

from i2t.recognition import calibrated, metrics
from i2t.recognition.belief import TemperatureScaling, apply_temperature


def test_the_temperature_of_beliefs_that_count_touches_twice_is_found():
    """Right beliefs about normal readings, made too sure by a known temperature."""
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
        found = calibrated.fit_temperature(p, truth)
        assert found.initial == pytest.approx(wanted.initial, abs=0.06)
        assert found.growth == pytest.approx(wanted.growth, abs=0.03)
        at = np.broadcast_to(t, p.shape[:2]).astype(np.float32)
        sober = np.asarray(apply_temperature(jnp.float32(p), jnp.asarray(at), found))
        assert (sober.argmax(-1) == p.argmax(-1)).mean() > 0.9999
        assert metrics.log_loss(sober.astype(np.float64), truth).mean() <= metrics.log_loss(p, truth).mean() + 1e-4


def test_log_odds_with_a_wrong_slope_and_offset_are_put_right():
    """Odds of normal signals about -1 and 1 (log odds 2x), told with a wrong slope and offset."""
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


# --- conformal sets ---


def test_sets_by_hand():
    # Nine validation episodes whose truth is the second of two classes at 0.75: scores are 0.25 u below 1, all in
    # (0.75, 1), and of ten ranks the ninth is the largest of them.
    p = np.tile([0.75, 0.25], (9, 1, 1))
    found = calibrated.conformal_sets(p, np.ones(9, int), p, np.zeros(9, int), level=0.9)
    assert 0.75 < found.threshold[0] < 1
    np.testing.assert_array_equal(found.coverage.mean, 1)  # the first class, at most 0.75, is in every set
    fewer = calibrated.conformal_sets(p[:8], np.ones(8, int), p, np.zeros(9, int), level=0.9)
    assert np.isinf(fewer.threshold[0])  # nine ranks cannot promise 90 %
    np.testing.assert_array_equal(fewer.size.mean, 2)


@pytest.mark.parametrize("power", [0.4, 3])
def test_sets_cover_what_they_promise_however_wrong_the_beliefs(power):
    p, truth = calibrated_forecaster(5, 8000)
    q = p**power / (p**power).sum(-1, keepdims=True)
    found = calibrated.conformal_sets(q[:4000], truth[:4000], q[4000:], truth[4000:])
    # Threshold and coverage each vary by sqrt(0.09 / 4000) = 0.5 points.
    assert np.abs(found.coverage.mean - 0.9).max() < 0.02
    assert (np.diff(found.size.mean) < 0).all()  # touches tell
    assert (found.size.mean < 0.9 * 5).all()  # 0.9 of all classes is what no knowledge needs
