"""Scores by hand, intervals by their coverage, baselines against closed forms."""

import numpy as np
import pytest

from i2t.prediction.baselines import predict_with_best_option
from i2t.prediction.metrics import nearest_neighbours, score


def test_scores_by_hand():
    truth = np.zeros((2, 15))
    truth[:, 0], truth[:, 1], truth[:, 2] = (1, 3), (0, 4), (-1, 1)  # spreads 2, 8 and 2 about their means
    truth[:, 3:] = np.array([[-1.0], [1.0]])  # twelve channels of spread 2
    predicted = truth.copy()
    predicted[0, 0] += 1  # the only errors: 1 on an x, 2 on a y
    predicted[1, 1] -= 2
    seen = score(truth, predicted, noise=np.r_[0.5, 2.0, np.ones(13)])
    assert seen.r2 == pytest.approx(1 - 5 / 36)
    assert seen.r2_median == 1
    assert seen.rmse == pytest.approx(np.sqrt(5 / 30))
    assert seen.rmse_sigma == pytest.approx(np.sqrt((1 / 0.25 + 4 / 4) / 30))
    assert seen.r2_axis == pytest.approx((1 - 1 / 10, 1 - 4 / 16, 1))
    assert seen.rmse_axis == pytest.approx((np.sqrt(1 / 10), np.sqrt(4 / 10), 0))
    # |t|^2 = 1 + 0 + 1 + 12 = 14 and 9 + 16 + 1 + 12 = 38; |p|^2 = 17 and 26; t.p = 15 and 30.
    assert seen.cosine == pytest.approx((15 / np.sqrt(14 * 17) + 30 / np.sqrt(38 * 26)) / 2)
    assert np.isnan(score(truth, predicted).rmse_sigma)


def test_r2_is_zero_for_the_mean_one_for_the_truth_and_nan_without_variation():
    truth = np.random.default_rng(0).normal(size=(30, 15))
    assert score(truth, np.broadcast_to(truth.mean(0), truth.shape)).r2 == pytest.approx(0)
    assert score(truth, truth).r2 == 1
    assert score(truth, np.zeros_like(truth)).cosine == 0  # nothing predicted points nowhere
    still = np.zeros((4, 6))
    assert np.isnan(score(still, still + 1).r2)
    still[:, 0] = np.arange(4)
    seen = score(still, still)
    assert seen.r2 == seen.r2_median == 1
    assert np.isnan(seen.r2_axis[1])


def test_neighbours_by_hand():
    x = np.array([[0.0, 0], [1, 0], [5, 0], [0, 7]])
    y = np.arange(4.0)[:, None] * np.ones((1, 15))
    at = np.array([[0.4, 0.1], [4.0, 0]])
    for k, expected in ((1, [0, 2]), (2, [0.5, 1.5]), (99, [1.5, 1.5])):
        np.testing.assert_array_equal(nearest_neighbours(x, y, at, k)[:, 0], expected)
    # Presses at one place are as near as each other: which of them are taken is not left to rounding.
    x = np.repeat(np.random.default_rng(1).normal(size=(6, 4)), 5, axis=0)
    y = np.arange(30.0)[:, None]
    np.testing.assert_allclose(nearest_neighbours(x, y, x[[7]] + 1e-9, 2), [[y[5:10].mean()]])


def test_options_are_chosen_between_groups():
    """Every touch occurs twice, in one group. Within a group its copy is the best neighbour; across groups, neighbours
    are random and many of them are better than one.
    """
    rng = np.random.default_rng(5)
    x, y = np.tile(rng.normal(size=(50, 4)), (2, 1)), np.tile(rng.normal(size=(50, 15)), (2, 1))
    asked = []

    def method(x: np.ndarray, y: np.ndarray, at: np.ndarray, k: float) -> np.ndarray:
        asked.append(k)
        return nearest_neighbours(x, y, at, k)

    for groups, best in ((np.tile(np.arange(50), 2), 32), (np.repeat([0, 1], 50), 1)):  # copies together, and apart
        predict_with_best_option(method, (1.0, 32.0), x, y, groups, at=x[:3])
        assert asked[-1] == best
