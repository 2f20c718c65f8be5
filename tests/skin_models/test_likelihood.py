"""Position errors fitted to left-out touches, against the distribution that they were drawn from."""

import numpy as np
import pytest
from scipy import stats

from i2t.skin_models.likelihood import ScaleMixture, fit_position_errors

STD, SHARE = np.array([0.1e-3, 0.8e-3]), np.array([0.85, 0.15])


def drawn(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Draw errors of the mixture with additional errors of known variances."""
    rng = np.random.default_rng(seed)
    own = rng.uniform(0, 0.2e-3, count)
    return rng.normal(size=count) * np.hypot(rng.choice(STD, count, p=SHARE), own), own**2


def tail(mixture: ScaleMixture, beyond: float) -> float:
    """Compute the probability of a larger error (m)."""
    return float(np.sum(mixture.share * 2 * stats.norm.sf(beyond, scale=mixture.std)))


def _total_std(mixture: ScaleMixture) -> float:
    """Compute the standard deviation of the mixture."""
    return float(np.sqrt(np.sum(mixture.share * mixture.std**2)))


def test_a_mixture_is_recovered_without_the_known_variances():
    errors, variance = drawn(20_000)
    fitted = fit_position_errors(errors, variance)
    assert fitted.share.sum() == pytest.approx(1)
    truth = ScaleMixture(STD, SHARE)
    assert _total_std(fitted) == pytest.approx(_total_std(truth), rel=0.03)
    for beyond in (0.1e-3, 0.3e-3, 1e-3, 1.5e-3):
        assert tail(fitted, beyond) == pytest.approx(tail(truth, beyond), abs=0.01)
    # If the known variances are ignored, they widen the middle of the distribution.
    assert tail(fit_position_errors(errors, 0 * variance), 0.1e-3) > tail(truth, 0.1e-3) + 0.05


def test_errors_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="1 of 3 errors of position are not finite"):
        fit_position_errors(np.array([1e-4, np.nan, 0.0]), np.zeros(3))


def test_few_touches_leave_a_tail_and_many_normal_ones_hardly_any():
    rng = np.random.default_rng(1)
    few, many = (fit_position_errors(rng.normal(scale=0.1e-3, size=count), np.zeros(count)) for count in (10, 5000))
    assert tail(few, 0.5e-3) > 0.02
    assert tail(many, 0.5e-3) < 0.005
    assert (many.share > 0).all()


def test_outliers_do_not_belong_to_the_mixture():
    errors, variance = drawn(5000, 2)
    strays = np.random.default_rng(3).uniform(-16e-3, 16e-3, 50)
    with_strays = np.append(errors, strays), np.append(variance, np.zeros(50))
    accounted = fit_position_errors(*with_strays, outlier_density=0.01 / 32e-3)
    blamed = fit_position_errors(*with_strays)
    clean = fit_position_errors(errors, variance)
    assert _total_std(accounted) == pytest.approx(_total_std(clean), rel=0.08)
    assert _total_std(blamed) > 1.08 * _total_std(clean)
