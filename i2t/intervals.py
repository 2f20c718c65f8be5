"""95 % confidence intervals of scores whose errors are clustered: touches share a pad, a session or a place on it, and
episodes share a pad, a pool of touch sites and an object.

`student_interval` is for independent values, such as one for each seed. `cluster_interval` (of a mean) and
`bootstrap_clusters` (of any statistic) resample whole clusters. They combine the variances of several crossed factors
as Cameron, Gelbach and Miller do (Journal of Business and Economic Statistics 29, 2011), and account for small numbers
of clusters by Student's t with Satterthwaite's degrees of freedom (Biometrics Bulletin 2, 1946). `rate_interval` is
Jeffreys' interval (Brown, Cai and DasGupta, Statistical Science 16, 2001) for the number of independent trials that has
the same variance (Korn and Graubard, Survey Methodology 24, 1998). Near 0 and 1, too few episodes differ to estimate
the variance over clusters, so the number of trials is bounded by the number of clusters.

This module uses NumPy, because nothing here is differentiated.
"""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy import stats

from i2t.types import Array

RESAMPLES = 1000  # number of bootstrap samples from which an interval is computed
COVERAGE = 0.95  # probability that a confidence interval contains the true value
MIN_CLUSTERS = 3  # number of clusters below which a factor has no confidence interval
ROUNDING_VARIANCE = 1e-12  # variance below which values count as equal up to rounding

Clusters = Sequence[Shaped[Array, " n"]]  # labels of the episodes, one array for each factor
Statistic = Callable[[Float[np.ndarray, " n"]], Array]  # maps weights of the episodes to a value
# Maps the number of times each cluster was drawn, and the label of each episode, to a value for each draw.
Resampled = Callable[[Float[np.ndarray, "draws groups"], Int[np.ndarray, " n"]], Float[np.ndarray, "draws k"]]


class Estimate(NamedTuple):
    """Means (or other statistics) with the lower and upper ends of 95 % intervals, as floats or arrays of one shape."""

    mean: Any
    low: Any
    high: Any


def estimate_at(estimates: Estimate, index: int) -> Estimate:
    """Select one of several estimates.

    Args:
        estimates: Estimates stacked along a leading axis.
        index: Index along that axis, for instance -1 for the last touch.

    Returns:
        The estimate at that index.
    """
    return Estimate(estimates.mean[index], estimates.low[index], estimates.high[index])


def student_interval(values: Sequence[int | float] | np.ndarray) -> Estimate:
    """Compute the mean and Student's 95 % interval of independent values, such as one for each seed.

    Args:
        values: `(n, ...)` values, independent along axis 0.

    Returns:
        The mean and both limits over axis 0, floats for values of shape `(n,)`. The limits of a single value are NaN.
    """
    sample = np.asarray(values, np.float64)
    n, mean = len(sample), sample.mean(0)
    if n < 2:
        return Estimate(mean, mean * np.nan, mean * np.nan)
    half = stats.t.ppf((1 + COVERAGE) / 2, n - 1) * sample.std(0, ddof=1) / np.sqrt(n)
    return Estimate(mean, mean - half, mean + half)


def rate_interval(values: Shaped[Array, "n ..."], clusters: Clusters = ()) -> Estimate:
    """Compute a mean of values between 0 and 1, with Jeffreys' 95 % interval at the effective number of trials n_e.

    n_e = p (1 - p) / v [t(n - 1) / t(k)]^2, where v is the variance of the mean p over clusters (at least the variance
    for independent episodes), k its degrees of freedom, and t() quantiles of Student's t. Let m be the number of
    exceptions, the rarer outcome of each cluster, in all c clusters. Then n_e is at most c (1 + m): c clusters of
    successes are c trials, however many episodes they have, and each exception shows that the episodes of a cluster
    differ. If all values are equal, n_e is n within that bound.

    Args:
        values: `(n, ...)` values in [0, 1] of n episodes. Fractions come from shared ties, or from means over touches.
        clusters: Factors that episodes share, as for `cluster_interval`; none if episodes are independent.

    Returns:
        Estimates of shape `(...)`, with limits in [0, 1]. They are NaN if n is 0, and the limits are NaN if no factor
        has three clusters.
    """
    values = np.asarray(values, np.float64)
    n, shape = len(values), values.shape[1:]
    if not n:
        return Estimate(*np.full((3, *shape), np.nan))
    flat = values.reshape(n, -1)
    mean, independent = np.clip(flat.mean(0), 0, 1), _independent(flat)
    factors = _factors(clusters, n) if clusters else []
    if clusters:
        variance, freedom = _spread(_means(flat), factors)
    else:
        variance, freedom = independent, np.full_like(mean, max(n - 1, 1))
    variance = np.maximum(variance, independent)
    variance = np.where(variance * n < ROUNDING_VARIANCE, 0.0, variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        trials = mean * (1 - mean) / variance * (_t(np.float64(max(n - 1, 1))) / _t(freedom)) ** 2
        bound = np.where(independent == 0, n, mean * (1 - mean) / independent)  # trials if episodes were independent
        bound = bound * _share_of_trials(flat, factors)
        trials = np.where(variance == 0, bound, np.minimum(trials, bound))
    right, wrong = mean * trials + 0.5, (1 - mean) * trials + 0.5
    low, high = (stats.beta.ppf((1 + sign * COVERAGE) / 2, right, wrong) for sign in (-1, 1))
    low, high = np.where(mean == 0, 0, np.minimum(low, mean)), np.where(mean == 1, 1, np.maximum(high, mean))
    low, high = (np.where(np.isfinite(trials), limit, np.nan) for limit in (low, high))
    return Estimate(*(part.reshape(shape) for part in (mean, low, high)))


def _share_of_trials(
    values: Float[np.ndarray, "n k"], factors: Sequence[Int[np.ndarray, " n"]]
) -> Float[np.ndarray, " k"]:
    """Bound the effective number of trials by c (1 + m), as a share of n, for c clusters and m exceptions in all."""
    share = np.ones(values.shape[1])
    for label in factors:
        counts = np.bincount(label)
        sums = np.zeros((len(counts), values.shape[1]))
        np.add.at(sums, label, values)
        exceptions = np.clip(np.minimum(sums, counts[:, None] - sums), 0, None).sum(0)
        share = np.minimum(share, len(counts) * (1 + exceptions) / len(values))
    return share


def _independent(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " k"]:
    """Compute the variance of the mean of independent values, zero where they differ by rounding only."""
    variance = values.var(0) / max(len(values), 1)
    return np.where(variance * len(values) < ROUNDING_VARIANCE, 0.0, variance)


def mean_interval(values: Shaped[Array, "n ..."], clusters: Clusters = ()) -> Estimate:
    """Compute a mean with a 95 % interval over clusters, or Student's 95 % interval if there are no clusters.

    Args:
        values: `(n, ...)` values of n episodes.
        clusters: Factors that episodes share, as for `cluster_interval`.

    Returns:
        Estimates of shape `(...)`.
    """
    return cluster_interval(values, clusters) if clusters and len(values) else student_interval(values)


def rows_of(clusters: Clusters, rows: Shaped[Array, "..."]) -> Sequence[Shaped[Array, " kept"]]:
    """Select the cluster labels of some episodes from those of all.

    Args:
        clusters: Labels of all episodes, one array for each factor.
        rows: Mask or row numbers of the episodes to select.

    Returns:
        Labels of the selected episodes, one array for each factor.
    """
    return [np.asarray(label)[rows] for label in clusters]


def cluster_interval(
    values: Shaped[Array, "n ..."], clusters: Clusters, *, draws: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Compute the mean of values of clustered episodes, with a 95 % interval over clusters.

    The variance is at least that of independent episodes, because a few clusters may agree by chance.

    Args:
        values: `(n, ...)` values of n episodes, for instance whether each was right after each touch.
        clusters: For each factor (pad, pool of sites, object), one label for each episode. Labels of the pools of
            different pads must differ. A factor that is left out, or has fewer than three clusters, is taken as fixed:
            the interval is then for these very objects, for instance. Without factors, episodes are independent.
        draws: Number of draws in each bootstrap.
        seed: Seed of the draws.

    Returns:
        Estimates of shape `(...)`. The limits are NaN if no factor has three clusters.

    Raises:
        ValueError: The number of labels differs from the number of values.
    """
    values = np.asarray(values, np.float64)
    n, shape = len(values), values.shape[1:]
    flat = values.reshape(n, -1)
    variance, freedom = _spread(_means(flat), _factors(clusters, n), draws, seed)
    mean, half = flat.mean(0), _t(freedom) * np.sqrt(np.maximum(variance, _independent(flat)))
    return Estimate(*(part.reshape(shape) for part in (mean, mean - half, mean + half)))


def _means(values: Float[np.ndarray, "n k"]) -> Resampled:
    def resampled(counts: np.ndarray, label: np.ndarray) -> np.ndarray:
        sums = np.zeros((counts.shape[1], values.shape[1]))
        np.add.at(sums, label, values)
        return counts @ sums / (counts @ np.bincount(label))[:, None]

    return resampled


def _t(freedom: Shaped[Array, "..."]) -> np.ndarray:
    """Compute the quantile of Student's t that scales a standard error to half the width of an interval."""
    return np.asarray(stats.t.ppf((1 + COVERAGE) / 2, freedom))


def bootstrap_clusters(
    statistic: Statistic, clusters: Clusters, count: int, *, draws: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Compute any statistic of weighted episodes, with a 95 % bootstrap interval over clusters.

    Args:
        statistic: Function that maps weights `(n,)` of the episodes, 1 each for the data as observed, to an array.
        clusters: Factors that episodes share, as for `cluster_interval`.
        count: Number n of episodes.
        draws: Number of draws in each bootstrap.
        seed: Seed of the draws.

    Returns:
        Estimates of the statistic's shape. The limits are NaN if no factor has three clusters.

    Raises:
        ValueError: The number of labels differs from the number of episodes.
    """
    observed = np.asarray(statistic(np.ones(count)), np.float64)

    def resampled(counts: np.ndarray, label: np.ndarray) -> np.ndarray:
        return np.stack([np.ravel(statistic(drawn[label])) for drawn in counts]).astype(np.float64)

    variance, freedom = _spread(resampled, _factors(clusters, count), draws, seed)
    half = np.broadcast_to(_t(freedom) * np.sqrt(variance), observed.size).reshape(observed.shape)
    return Estimate(observed, observed - half, observed + half)


def grouped_interval(
    statistic: Callable[[np.ndarray], float], groups: Shaped[Array, " n"], seed: int = 0, *, most: float = np.inf
) -> tuple[float, float]:
    """Compute the 95 % interval of a statistic of rows, such as a median or R2, over the clusters of one factor.

    Args:
        statistic: Function of row numbers. The rows of a cluster that was drawn twice appear twice. Draws for which the
            function returns NaN are ignored.
        groups: `(n,)` labels, such as the session or spatial block of each row; rows of one group are not independent.
        seed: Seed of the draws.
        most: Upper bound of the statistic, such as 1 for R2, which the upper limit does not exceed.

    Returns:
        The lower and upper limit, NaN if there are fewer than three groups.
    """
    rows = np.arange(len(groups))
    estimate = bootstrap_clusters(
        lambda weights: np.float64(statistic(np.repeat(rows, weights.astype(int)))), [groups], len(rows), seed=seed
    )
    return float(estimate.low), min(float(estimate.high), most)


def p_values(estimates: Estimate, freedom: int | Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Compute two-sided p values, for the null hypothesis of a zero mean, from intervals of Student's t.

    Args:
        estimates: Means with intervals of Student's t.
        freedom: Degrees of freedom of the intervals. A lower bound of them makes the p values too large rather than too
            small.

    Returns:
        P values of the shape of the means, NaN where there is no interval.
    """
    mean, low, high = (np.asarray(part, np.float64) for part in estimates)
    with np.errstate(divide="ignore", invalid="ignore"):
        return 2 * stats.t.sf(np.abs(mean) / ((high - low) / 2) * _t(np.asarray(freedom)), freedom)


def holm(p: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Adjust p values for their number, so that the chance of any false rejection at 0.05 is at most 5 %.

    Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6, 1979.

    Args:
        p: `(n,)` p values.

    Returns:
        `(n,)` adjusted p values in the same order.
    """
    order = np.argsort(p)
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate((len(p) - np.arange(len(p))) * np.asarray(p)[order]), 1)
    return adjusted


def _spread(
    resampled: Resampled, factors: Sequence[Int[np.ndarray, " n"]], draws: int = RESAMPLES, seed: int = 0
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Compute the variance of a statistic over crossed factors and its degrees of freedom, NaN without factors."""
    if not factors:
        return np.full(1, np.nan), np.full(1, np.nan)
    rng = np.random.default_rng(seed)
    variance = first = spread = np.zeros(1)
    for size in range(1, len(factors) + 1):
        for subset in combinations(factors, size):
            label = _cells(subset)
            part = _resampled_variance(resampled, label, draws, rng)
            variance = variance + (-1) ** (size + 1) * part
            if size == 1:
                first = np.maximum(first, part)
                spread = spread + part**2 / label.max()
    variance = np.maximum(variance, first)  # the subtracted variances of intersections are noisy
    fewest = min(int(factor.max()) for factor in factors)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = np.clip(np.where(spread > 0, variance**2 / spread, fewest), fewest, None)
    return variance, freedom


def _factors(clusters: Clusters, count: int) -> list[Int[np.ndarray, " n"]]:
    """Number the clusters 0, 1, ... of each factor with enough clusters, without factors nested in a coarser one, whose
    resampling resamples them too. Independent episodes are clusters of one episode.
    """
    if any(len(label) != count for label in clusters):
        raise ValueError(f"clusters: {[len(label) for label in clusters]} labels for {count} episodes")
    labels = [np.unique(np.asarray(label), return_inverse=True)[1] for label in clusters]
    if not labels:
        labels = [np.arange(count)]
    several = [label for label in labels if count and label.max() >= MIN_CLUSTERS - 1]
    kept: list[np.ndarray] = []
    for label in sorted(several, key=lambda label: int(label.max())):
        if not any(_cells((coarse, label)).max() == label.max() for coarse in kept):
            kept.append(label)
    return kept


def _cells(factors: Sequence[Int[np.ndarray, " n"]]) -> Int[np.ndarray, " n"]:
    """Number the intersections of the clusters of all factors."""
    return np.unique(np.stack(factors), axis=1, return_inverse=True)[1].reshape(-1)


def _resampled_variance(
    resampled: Resampled, label: Int[np.ndarray, " n"], draws: int, rng: np.random.Generator
) -> Float[np.ndarray, " k"]:
    """Compute the variance of a statistic over resampled clusters. Each draw has one cluster less than there are, which
    makes the variance of a mean unbiased (McCarthy and Snowden, Vital and Health Statistics 2:95, 1985).
    """
    groups = int(label.max()) + 1
    counts = rng.multinomial(groups - 1, np.full(groups, 1 / groups), size=draws).astype(np.float64)
    return np.nanvar(resampled(counts, label), axis=0, ddof=1)
