"""The method that is kept: the best on validation touches, and how sure that is."""

import numpy as np
import pytest

from experiments.train.evaluation import choose

MEAN, NEAREST = "mean reading", "k nearest patches"


def predictions(error):
    """Predictions whose errors differ in size only."""
    rng = np.random.default_rng(1)
    truth, off, groups = rng.normal(size=(40, 6)), rng.normal(size=(40, 6)), np.arange(40) // 5
    return truth, groups, {name: truth + e * off for name, e in error.items()}


@pytest.mark.parametrize("best", [MEAN, NEAREST, "network", "GP"])
def test_the_best_on_validation_touches_is_kept_a_baseline_too(best):
    truth, groups, predicted = predictions(
        {name: 0.2 if name == best else 0.9 - 0.01 * (name == "GP") for name in (MEAN, NEAREST, "network", "GP")}
    )
    choice = choose(truth, predicted, groups, baselines=(MEAN, NEAREST), on_pressure=("GP",))
    assert choice.best == best
    assert choice.pressure_loses == (best in (MEAN, NEAREST))
    lead = choice.over_baseline
    assert lead.low <= lead.r2 <= lead.high
    assert (lead.r2 > 0) == (best in ("network", "GP"))


def test_a_method_with_non_finite_predictions_is_never_selected():
    truth, groups, predicted = predictions({MEAN: 1.0, "GP": 0.1})
    predicted["GP"][3, 2] = np.nan
    choice = choose(truth, predicted, groups, baselines=(MEAN,), on_pressure=("GP",))
    assert (choice.best, choice.best_on_pressure, choice.pressure_loses) == (MEAN, None, False)
    assert np.isnan(choice.r2["GP"])
    predicted[MEAN][:] = np.inf
    with pytest.raises(ValueError, match="no method predicts finite readings"):
        choose(truth, predicted, groups, baselines=(MEAN,), on_pressure=("GP",))


def test_a_chance_difference_is_not_counted_as_a_loss():
    """Half a per cent of the variance is not a loss, nor is a larger one that groups cannot distinguish from chance."""
    truth, groups, predicted = predictions({MEAN: 0.300, "GP": 0.305})
    assert not choose(truth, predicted, groups, baselines=(MEAN,), on_pressure=("GP",)).pressure_loses
    better = np.where(groups % 2 == 0, 0.9, 1.14)[:, None]
    predicted["GP"] = truth + better * (predicted[MEAN] - truth)
    choice = choose(truth, predicted, groups, baselines=(MEAN,), on_pressure=("GP",))
    assert choice.pressure_over_baseline.low < 0 < choice.pressure_over_baseline.high
    assert not choice.pressure_loses
