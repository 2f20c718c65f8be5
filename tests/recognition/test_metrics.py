"""Scores of beliefs against tables worked by hand, SciPy, scikit-learn, and calibrated forecasters."""

import numpy as np
import pytest
from helpers.forecasters import calibrated_forecaster
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from i2t import intervals
from i2t.recognition import metrics as scores


def sharper(p, power):
    return p**power / (p**power).sum(-1, keepdims=True)


@pytest.mark.parametrize(("right", "n"), [(0, 10), (3, 10), (351, 400)])
def test_intervals_equal_those_of_scipy(right, n):
    expected = stats.beta(right + 0.5, n - right + 0.5)  # Jeffreys' posterior
    interval = intervals.rate_interval((np.arange(n) < right).astype(float))
    assert_allclose(interval, (right / n, expected.ppf(0.025) if right else 0.0, expected.ppf(0.975)), atol=1e-12)
    values = np.random.default_rng(0).normal(size=(6, 2))
    expected = stats.ttest_1samp(values, 0).confidence_interval(0.95)
    assert_allclose(intervals.student_interval(values), (values.mean(0), expected.low, expected.high), rtol=1e-12)


# --- accuracy ---


def test_a_tie_is_shared_and_no_object_is_favoured():
    p = np.array([[[0.5, 0.5, 0.0], [0.2, 0.2, 0.6]], [[1 / 3, 1 / 3, 1 / 3], [0.1, 0.8, 0.1]]], np.float32)
    assert_allclose(scores.hits(p, np.array([0, 2])), [[1 / 2, 0], [1 / 3, 0]])
    assert_allclose(sum(scores.hits(p, np.full(2, which)) for which in range(3)), 1)  # one decision is made
    thirds = np.float32(1) / np.float32(3)
    votes = np.array([[[thirds + thirds, np.float32(2 / 3) + np.float32(1e-7)]]])
    assert_allclose(scores.hits(votes, np.array([0])), 0.5)  # in single precision


def test_accuracy_by_hand():
    p = np.zeros((4, 2, 2))
    p[:, 0] = [0.9, 0.1]
    p[:, 1] = [[0.9, 0.1], [0.2, 0.8], [0.2, 0.8], [0.5, 0.5]]
    truth = np.array([0, 1, 1, 1])
    accuracy, mean = scores.accuracy(p, truth), scores.mean_accuracy(p, truth)
    assert_allclose(accuracy.mean, [1 / 4, 3.5 / 4])
    assert_allclose((accuracy.low[0], accuracy.high[0]), stats.beta(1.5, 3.5).interval(0.95))
    episode_scores = np.array([1, 0.5, 0.5, 0.25])  # scores of episodes
    assert_allclose(
        (mean.mean, mean.high - mean.mean),
        (episode_scores.mean(), stats.t.ppf(0.975, 3) * episode_scores.std(ddof=1) / 2),
    )
    assert_array_equal(scores.confusion(p[:, 1], truth), [[1, 0], [0.5, 2.5]])


def test_pairs_by_hand():
    # Last touch: right both 3, first only 5, second only 1, neither 1.
    hit = np.array([[1, 1]] * 3 + [[0, 1]] * 5 + [[1, 0]] + [[0, 0]], float)
    other = np.array([[1, 1]] * 3 + [[0, 0]] * 5 + [[1, 1]] + [[0, 0]], float)
    difference, swapped, same = (scores.compare_paired(*pair) for pair in ((hit, other), (other, hit), (hit, hit)))
    expected = stats.ttest_rel(hit.mean(1), other.mean(1))
    assert_allclose(difference.mean[1:], expected.confidence_interval(0.95))
    assert difference.last.mean == pytest.approx(0.4)
    assert swapped.last.mean == pytest.approx(-0.4)
    assert float(same.mean.high) == 0
    with pytest.raises(ValueError, match="same episodes"):
        scores.compare_paired(hit, hit[:4])


# --- calibration ---


def test_bins_and_their_gap_by_hand():
    sure, hit = np.array([0.05, 0.15, 0.55, 0.59, 1.0]), np.array([0.0, 1.0, 1.0, 0.0, 1.0])
    assert scores.calibration_error(sure, hit, 10).error == pytest.approx((0.05 + 0.85 + 2 * 0.07 + 0) / 5)


def test_the_calibration_error_of_a_calibrated_forecaster_is_due_to_chance():
    p, truth = calibrated_forecaster(2, 4000)
    sure, hit = scores.confidence(p)[:, 2], scores.hits(p, truth)[:, 2]
    calibration = scores.calibration_error(sure, hit)
    # The frequency of n decisions misses by 0.8 * 0.5 / sqrt(n) on average at most; 15 equal bins are the worst.
    assert calibration.chance < 0.8 * 0.5 * np.sqrt(15 / 4000)
    assert calibration.error < 1.5 * calibration.chance_high
    # Odds to the power 2 are too sure of themselves, by a lot.
    worse = scores.calibration_error(scores.confidence(sharper(p, 2))[:, 2], hit)
    assert worse.error > 0.05 > worse.chance_high
    # Decisions that come in 40 clusters of 100, right or wrong together, miss by as much as 40 of them.
    forty = scores.calibration_error(sure, hit, cluster=np.arange(4000) // 100)
    few = scores.calibration_error(sure[::100], hit[::100])
    assert forty.error == calibration.error
    assert forty.chance > 3 * calibration.chance
    assert forty.chance < few.chance


def test_the_loss_is_proper_and_as_by_hand():
    p, truth = np.array([[[0.7, 0.2, 0.1]], [[1.0, 0.0, 0.0]]]), np.array([0, 2])
    assert_allclose(scores.log_loss(p, truth)[:, 0], [-np.log(0.7), -np.log(scores.PROBABILITY_FLOOR)])
    p, truth = calibrated_forecaster(4, 4000)
    for power in (2, 0.5):
        more = (scores.log_loss(sharper(p, power), truth) - scores.log_loss(p, truth)).mean(1)
        assert intervals.student_interval(more).low > 0


# --- stopping ---


def test_stopping_by_hand():
    p = np.array([[0.6, 0.96, 0.5], [0.7, 0.8, 0.9], [0.99, 0.2, 0.2], [0.5, 0.5, 0.5]])
    p = np.stack([p, 1 - p], -1)
    stopped = scores.stopping(p, np.array([0, 1, 1, 0]), 0.05)
    # Decided at touches 2, 3, 1, 3 with 0.96, 0.9, 0.99 and a tie: right, wrong, wrong, half right.
    assert_allclose((stopped.error.mean, stopped.predicted_error), (2.5 / 4, (0.04 + 0.1 + 0.01 + 0.5) / 4))
    assert (stopped.stopped.mean, stopped.stopped_error.mean, stopped.touches.mean) == (0.5, 0.5, 9 / 4)
    assert stopped.stopped_predicted_error == pytest.approx(0.025)
    never = scores.stopping(p[3:], np.array([0]), 0.01)
    assert np.isnan([never.stopped_predicted_error, float(never.stopped_error.mean)]).all()


def test_a_calibrated_forecaster_stops_with_the_predicted_error():
    p, truth = calibrated_forecaster(7, 20000, touches=8)
    stopped = scores.stopping(p, truth, 0.1)
    four_sigma = 4 * np.sqrt(0.25 / (20000 * stopped.stopped.mean))
    assert abs(stopped.error.mean - stopped.predicted_error) < four_sigma
    assert abs(stopped.stopped_error.mean - stopped.stopped_predicted_error) < four_sigma
    assert stopped.stopped_predicted_error < 0.1
    hasty = scores.stopping(sharper(p, 2), truth, 0.1)
    assert hasty.stopped_error.low > hasty.stopped_predicted_error


# --- unknown objects ---


def test_auroc_is_that_of_scikit_learn_and_its_interval_that_of_hanley_and_mcneil():
    metrics = pytest.importorskip("sklearn.metrics", reason="scikit-learn, of the extra `notebooks`, is not installed")
    rng = np.random.default_rng(10)
    unknown = rng.random(150) < 0.3
    none = np.round(rng.normal(size=(150, 2)) + unknown[:, None] * np.array([0.0, 1.5]), 1)  # with ties
    assert_allclose(scores.auroc(none, unknown).mean, [metrics.roc_auc_score(unknown, x) for x in none.T], atol=1e-12)
    unknown = np.arange(400) < 200
    wide = scores.auroc((rng.normal(size=400) + unknown)[:, None], unknown)
    area = stats.norm.cdf(1 / np.sqrt(2))
    # Radiology 143, 1982, for exponential scores; within a fifth for normal ones.
    q1, q2 = area / (2 - area), 2 * area**2 / (1 + area)
    sigma = np.sqrt((area * (1 - area) + 199 * (q1 + q2 - 2 * area**2)) / 200**2)
    assert wide.low[0] < area < wide.high[0]
    assert wide.high[0] - wide.low[0] == pytest.approx(2 * 1.96 * sigma, rel=0.2)
    with pytest.raises(ValueError, match="with and without"):
        scores.auroc(np.ones((3, 1)), np.ones(3, bool))
