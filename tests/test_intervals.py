"""Intervals over clusters have their stated coverage if episodes of a cluster are dependent."""

from itertools import combinations

import numpy as np
import pytest
from scipy import optimize, stats

from i2t.intervals import (
    bootstrap_clusters,
    cluster_interval,
    grouped_interval,
    holm,
    mean_interval,
    p_values,
    rate_interval,
    student_interval,
)


def _episodes(pads, pools, objects, each):
    """Labels of episodes: pads, pools of their own, and the same objects everywhere."""
    pad, pool, thing, _ = (label.ravel() for label in np.indices((pads, pools, objects, each)))
    return pad, pad * pools + pool, thing


@pytest.mark.parametrize("factors", [1, 2, 3])
def test_crossed_factors_give_the_t_interval_of_the_variances_of_their_clusters_means(factors):
    """Of a balanced table: those of single factors are added, of pairs taken off, of all three added again; degrees of
    freedom are Satterthwaite's.
    """
    rng = np.random.default_rng(0)
    sizes, spreads = (4, 4, 5), (1.0, 0.8, 1.2)
    parts = [spread * stats.zscore(rng.normal(size=size)) for spread, size in zip(spreads, sizes, strict=True)]
    table = np.add.outer(np.add.outer(*parts[:2]), parts[2]) + 2.5 * rng.normal(size=sizes)
    variance = degrees = 0.0
    for some in (some for count in range(1, factors + 1) for some in combinations(range(factors), count)):
        means = table.mean(tuple(axis for axis in range(3) if axis not in some))
        own = means.var(ddof=1) / means.size
        variance += (-1) ** (len(some) + 1) * own
        degrees += own**2 / (means.size - 1) if len(some) == 1 else 0.0
    half = stats.t.ppf(0.975, variance**2 / degrees) * np.sqrt(variance)
    found = cluster_interval(table.ravel(), [label.ravel() for label in np.indices(sizes)[:factors]], draws=5000)
    assert found.mean == pytest.approx(table.mean())
    assert (found.mean - found.low, found.high - found.mean) == pytest.approx((half, half), rel=0.02)


def test_seed_intervals_have_their_stated_coverage():
    draws = np.random.default_rng(1).normal(3, 2, (4000, 5))
    _, low, high = np.array([student_interval(list(row)) for row in draws]).T
    # Student's interval is exact for normal values: a binomial proportion, 4.5 deviations.
    assert abs(np.mean((low < 3) & (high > 3)) - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / 4000)
    mean, low, high = student_interval([7.0])
    assert mean == 7
    assert np.isnan([low, high]).all()
    assert np.isnan(student_interval([1.0])[1:]).all()


@pytest.mark.parametrize("groups", [4, 30])
def test_grouped_interval_covers_where_rows_of_a_group_agree(groups):
    """For a mean of normal groups, the interval is Student's, exact except for the draws, whose variance is off by a
    few per cent. Five equal rows count as one: as separate rows, the interval would be sqrt(5) too short.
    """
    rng, repeats = np.random.default_rng(2), 120
    members = np.repeat(np.arange(groups), 5)
    covered = {True: 0, False: 0}
    for seed in range(repeats):
        values = rng.normal(size=groups)[members] + 0.1 * rng.normal(size=len(members))
        for torn, names in enumerate((members, np.arange(len(members)))):
            low, high = grouped_interval(lambda rows, values=values: values[rows].mean(), names, seed)
            covered[bool(torn)] += low < 0 < high
    torn = 1 - 2 * stats.t.sf(stats.t.ppf(0.975, 5 * groups - 1) * np.sqrt((groups - 1) / (5 * groups - 1)), groups - 1)
    for how, expected in ((False, 0.95), (True, torn)):
        assert abs(covered[how] / repeats - expected) < 3.5 * np.sqrt(expected * (1 - expected) / repeats) + 0.01, how


def test_the_upper_limit_of_a_bounded_statistic_is_at_most_its_bound():
    values, group = np.array([0.9, 1.0, 0.2, 1.0]), np.arange(4)
    low, high = grouped_interval(lambda rows: values[rows].mean(), group)
    assert high > 1
    assert grouped_interval(lambda rows: values[rows].mean(), group, most=1.0) == (low, 1.0)


def test_grouped_interval_needs_three_groups_and_leaves_out_draws_without_a_value():
    assert np.isnan(grouped_interval(lambda rows: rows.mean(), np.arange(6) % 2)).all()
    values = np.random.default_rng(0).normal(size=40)
    group = np.repeat(np.arange(8), 5)

    def mean(rows):  # NaN of draws without the first group
        return values[rows].mean() if 0 in rows else np.nan

    low, high = grouped_interval(mean, group)
    assert low < values.mean() < high


def test_p_values_of_intervals_are_those_of_the_t_test_and_holm_adjusts_them_step_by_step():
    samples = np.random.default_rng(3).normal(0.8, 1, (6, 5))
    np.testing.assert_allclose(p_values(student_interval(samples), 5), stats.ttest_1samp(samples, 0).pvalue)
    # 4 x .01, 3 x .02, 2 x .03, .04, none below the one before.
    np.testing.assert_allclose(holm(np.array([0.04, 0.01, 0.03, 0.02])), [0.06, 0.04, 0.06, 0.06])
    np.testing.assert_allclose(holm(np.array([0.9, 0.6])), [1, 1])


def test_pools_within_pads_add_nothing_and_two_pads_are_these_two_pads():
    """Two pads say nothing about others: the interval is over the pools, as if the pads were fixed."""
    rng = np.random.default_rng(1)
    pad, pool, _ = _episodes(5, 4, 1, 10)
    values = rng.normal(size=20)[pool] + rng.normal(size=len(pad))
    for factors in ([pad, pool], [pool, pad]):
        assert cluster_interval(values, factors) == cluster_interval(values, [pad])
    pad, pool, _ = _episodes(2, 10, 1, 5)
    values = 10.0 * pad + rng.normal(size=20)[pool]
    assert cluster_interval(values, [pad, pool]) == cluster_interval(values, [pool])


@pytest.mark.parametrize(
    ("name", "pads", "pools", "middle", "spread"),
    [
        ("few pads", 5, 4, 1.0, (0.8, 0.8)),
        ("one pad", 1, 20, 1.0, (0.0, 1.2)),
        ("nearly always right", 5, 4, 3.0, (1.0, 1.0)),
    ],
)
def test_the_interval_covers_clustered_rates_unlike_binomial_ones(name, pads, pools, middle, spread):
    """Accuracies of clusters differ by a logit of `spread` (pads, pools), as they do in recognition."""
    covered, naive, trials = 0, 0, 150
    nodes = np.random.default_rng(9).normal(size=20_000) * np.hypot(*spread)
    true = float((1 / (1 + np.exp(-(middle + nodes)))).mean())
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        pad, pool, _ = _episodes(pads, pools, 1, 25)
        logit = middle + spread[0] * rng.normal(size=pads)[pad] + spread[1] * rng.normal(size=pads * pools)[pool]
        hit = (rng.random(len(pad)) < 1 / (1 + np.exp(-logit))).astype(float)
        found = rate_interval(hit, [pad, pool] if pads > 1 else [pool])
        covered += found.low <= true <= found.high
        independent = rate_interval(hit)
        naive += independent.low <= true <= independent.high
    assert covered / trials > 0.91, name
    assert naive / trials < 0.75, name


@pytest.mark.full
def test_the_interval_covers_crossed_pads_and_objects():
    covered, trials = 0, 200
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        pad, pool, thing = _episodes(6, 3, 6, 4)
        values = 1.0 * rng.normal(size=6)[pad] + 0.5 * rng.normal(size=18)[pool] + 1.0 * rng.normal(size=6)[thing]
        values = values + rng.normal(size=len(pad))
        found = cluster_interval(values, [pad, pool, thing], draws=200, seed=trial)
        covered += found.low <= 0.0 <= found.high
    assert 0.91 < covered / trials <= 0.995


def test_clusters_that_are_alike_one_cluster_and_labels_that_do_not_fit():
    label = np.repeat(np.arange(10), 30)
    right, same = rate_interval(np.ones(300), [label]), mean_interval(np.zeros(300), [label])
    low = stats.beta.ppf(0.025, 10 + 0.5, 0.5)  # ten clusters that are all right are ten trials
    assert (float(right.low), float(right.high)) == pytest.approx((low, 1.0))
    assert (float(same.low), float(same.mean), float(same.high)) == (0.0, 0.0, 0.0)
    one = cluster_interval(np.array([0.0, 1.0]), [np.zeros(2, int)])
    np.testing.assert_array_equal([one.mean, one.low, one.high], [0.5, np.nan, np.nan])
    with pytest.raises(ValueError, match=r"3.* labels for 2"):
        bootstrap_clusters(np.sum, [np.zeros(3, int)], 2)


def trials_of(interval) -> float:
    """Number of trials whose Jeffreys interval has the same lower limit, or the same upper one where that is 0."""
    mean, low, high = map(float, interval)

    def excess(count: float) -> float:
        right, wrong = mean * count + 0.5, (1 - mean) * count + 0.5
        return stats.beta.ppf(0.025, right, wrong) - low if low > 0 else stats.beta.ppf(0.975, right, wrong) - high

    return optimize.brentq(excess, 1e-3, 1e6)


@pytest.mark.parametrize("labels", [3, 10, 60])
@pytest.mark.parametrize("repeats", [1, 2, 40])
def test_labels_that_are_all_right_or_all_wrong_are_at_most_one_trial_for_each(labels, repeats):
    label = np.repeat(np.arange(labels), repeats)
    for right in range(0, labels + 1, max(labels // 5, 1)):
        assert trials_of(rate_interval((label < right).astype(float), [label])) <= labels * (1 + 1e-6)
    thing = np.tile(np.arange(repeats), labels)  # crossed: the factor with the fewest clusters bounds it
    several = [count for count in (labels, repeats) if count >= 3]
    crossed = rate_interval(np.ones(len(label)), [label, thing])
    assert trials_of(crossed) == pytest.approx(min(several))


def test_ten_labels_whose_episodes_are_one_and_the_same_set_are_ten_trials():
    certain = rate_interval(np.ones(1200), [np.repeat(np.arange(10), 120)])
    assert (float(certain.mean), round(float(certain.low), 2), float(certain.high)) == (1.0, 0.78, 1.0)
    assert certain == rate_interval(np.ones(10))
    mirrored = rate_interval(np.zeros(1200), [np.repeat(np.arange(10), 120)])
    assert (float(mirrored.low), float(mirrored.high)) == pytest.approx((0.0, 1 - float(certain.low)))


def test_an_interval_widens_gradually_towards_certainty():
    """One exception more never makes it jump, and rates away from certainty are as many trials as before."""
    label = np.repeat(np.arange(10), 100)
    counts = []
    for wrong in range(100):  # spread evenly over the labels
        values = np.ones(1000)
        values[(np.arange(wrong) % 10) * 100 + np.arange(wrong) // 10] = 0
        counts.append(trials_of(rate_interval(values, [label])))
    few, bracket = np.arange(20), (stats.t.ppf(0.975, 999) / stats.t.ppf(0.975, 9)) ** 2
    np.testing.assert_allclose(np.array(counts)[few], 10 * (1 + few), rtol=1e-3)
    assert counts[-1] == pytest.approx(1000 * bracket, rel=0.05)


def coverage(rate: float, alike: float, labels: int, repeats: int, draws: int) -> float:
    """Share of intervals that cover the rate of clusters whose own rates are beta distributed."""
    rng, label = np.random.default_rng(0), np.repeat(np.arange(labels), repeats)
    spread = (1 - alike) / alike
    own = rng.beta(rate * spread, (1 - rate) * spread, (labels, draws))
    hit = (rng.random((labels * repeats, draws)) < own[label]).astype(float)
    interval = rate_interval(hit, [label])
    return float(np.mean((interval.low <= rate) & (rate <= interval.high)))


def test_the_interval_covers_rates_near_certainty_of_a_few_labels():
    assert coverage(0.97, 0.6, 10, 30, 500) > 0.93  # 0.51 of intervals that trust the spread of such labels
    assert coverage(0.99, 0.6, 20, 30, 500) > 0.93  # 0.38


@pytest.mark.full
@pytest.mark.parametrize("labels", [10, 20])
@pytest.mark.parametrize("repeats", [5, 30])
@pytest.mark.parametrize("alike", [0.02, 0.2, 0.6])
@pytest.mark.parametrize("rate", [0.97, 0.99, 0.998])
def test_the_interval_covers_rates_near_certainty(labels, repeats, alike, rate):
    assert coverage(rate, alike, labels, repeats, 3000) > 0.94


def test_clusters_with_equal_means_do_not_narrow_the_interval():
    label, values = np.repeat(np.arange(3), 50), np.tile([0.0] * 45 + [1.0] * 5, 3)
    found = mean_interval(values, [label])
    assert found.high - found.mean == pytest.approx(stats.t.ppf(0.975, 2) * values.std() / np.sqrt(150))


@pytest.mark.parametrize("fraction", [0.1, 1 / 3, 0.5, 0.7, 0.9999])
def test_one_fraction_everywhere_is_as_many_trials_as_there_are_episodes(fraction):
    found, known = rate_interval(np.full(50, fraction)), stats.beta(50 * fraction + 0.5, 50 * (1 - fraction) + 0.5)
    assert (float(found.low), float(found.high)) == pytest.approx((known.ppf(0.025), max(known.ppf(0.975), fraction)))
    two = rate_interval(np.ones(40), [np.repeat([0, 1], 20)])
    assert np.isnan([two.low, two.high]).all()


def test_any_statistic_of_weights_where_no_factor_means_independent_episodes():
    """The statistic is a ratio of sums."""
    a, b = np.array([1.0, 2.0, 3.0, 4.0] * 10), np.array([2.0, 2.0, 4.0, 6.0] * 10)
    found = bootstrap_clusters(lambda w: (w @ a) / (w @ b), [], 40, draws=4000)
    residual = (a - a.sum() / b.sum() * b) / b.mean()
    assert float(found.mean) == pytest.approx(a.sum() / b.sum())
    assert float(found.high - found.mean) == pytest.approx(stats.t.ppf(0.975, 39) * stats.sem(residual), rel=0.1)
