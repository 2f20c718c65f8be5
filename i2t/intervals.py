"""95 % intervals of scores whose errors come in clusters: touches share a pad, a session or a place on the skin;
episodes share a pad, a pool of touch sites and an object.

`student_interval` is for independent values, such as one for each seed. `cluster_interval` of a mean, and
`bootstrap_clusters` of any statistic, resample whole clusters. The variance over several crossed factors is put
together as Cameron, Gelbach and Miller do (Journal of Business and Economic Statistics 29, 2011); few clusters are
allowed for by Student's t with the degrees of freedom of Satterthwaite (Biometrics Bulletin 2, 1946).
`rate_interval` is Jeffreys' (Brown, Cai and DasGupta, Statistical Science 16, 2001) for as many independent trials as
would have that variance (Korn and Graubard, Survey Methodology 24, 1998). Near 0 and 1 few episodes show how alike
those of a cluster are, so that the variance over clusters says too little; the number of trials is bounded there by the
number of clusters.
NumPy, because nothing here is differentiated.
"""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy import stats

from i2t.types import Array

RESAMPLES = 1000
COVERAGE = 0.95  # of every interval
MIN_CLUSTERS = 3  # fewer say nothing about others: there is no interval over them
ALIKE = 1e-12  # variance of episodes that differ by rounding only

Clusters = Sequence[Shaped[Array, " n"]]  # labels of the episodes, for each factor
Statistic = Callable[[Float[np.ndarray, " n"]], Array]  # of the episodes' weights
# The same in each of some draws, from how often each cluster was drawn (draws, groups) and the episodes' labels.
Resampled = Callable[[Float[np.ndarray, "draws groups"], Int[np.ndarray, " n"]], Float[np.ndarray, "draws k"]]


class Estimate(NamedTuple):
    """Means with their intervals: floats, or arrays of one shape."""

    mean: Any
    low: Any
    high: Any


def estimate_at(estimates: Estimate, index: int) -> Estimate:
    """One of several estimates.

    Args:
        estimates: Along a leading axis.
        index: Which, for instance -1 for the last touch.

    Returns:
        That one.
    """
    return Estimate(estimates.mean[index], estimates.low[index], estimates.high[index])


def student_interval(values: Sequence[int | float] | np.ndarray) -> Estimate:
    """Mean and Student's t interval of independent values, such as seeds or episodes.

    Args:
        values: (n, ...), independent along axis 0.

    Returns:
        Mean and both ends, floats for values (n,); a single value has no interval (NaN).
    """
    sample = np.asarray(values, np.float64)
    n, mean = len(sample), sample.mean(0)
    if n < 2:
        return Estimate(mean, mean * np.nan, mean * np.nan)
    half = stats.t.ppf((1 + COVERAGE) / 2, n - 1) * sample.std(0, ddof=1) / np.sqrt(n)
    return Estimate(mean, mean - half, mean + half)


def rate_interval(values: Shaped[Array, "n ..."], clusters: Clusters = ()) -> Estimate:
    """Mean of values between 0 and 1, with Jeffreys' limits at the effective number of trials.

    n_e = p (1 - p) / v [t(n - 1) / t(k)]^2, where v is the variance of the mean p over clusters, which is at least that
    of independent episodes, k its degrees of freedom and t() the quantiles of Student's t. Of c clusters with m
    exceptions in all, which are the rarer outcome of each cluster, n_e is at most c (1 + m): c clusters that are all
    right are c trials, however many episodes they have, and each exception shows that the episodes of a cluster differ.
    Where all values are alike, n_e is n within that bound. Limits lie between 0 and 1.

    Args:
        values: (n, ...) in [0, 1]; fractions are those of shared ties, or means over touches.
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.

    Returns:
        Estimates of the trailing shape; NaN where n is 0, limits NaN where no factor has three clusters.
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
    variance = np.where(variance * n < ALIKE, 0.0, variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        trials = mean * (1 - mean) / variance * (_t(np.float64(max(n - 1, 1))) / _t(freedom)) ** 2
        most = np.where(independent == 0, n, mean * (1 - mean) / independent)  # those of independent episodes
        most = most * _share_of_trials(flat, factors)
        trials = np.where(variance == 0, most, np.minimum(trials, most))
    right, wrong = mean * trials + 0.5, (1 - mean) * trials + 0.5
    low, high = (stats.beta.ppf((1 + sign * COVERAGE) / 2, right, wrong) for sign in (-1, 1))
    low, high = np.where(mean == 0, 0, np.minimum(low, mean)), np.where(mean == 1, 1, np.maximum(high, mean))
    low, high = (np.where(np.isfinite(trials), limit, np.nan) for limit in (low, high))
    return Estimate(*(part.reshape(shape) for part in (mean, low, high)))


def _share_of_trials(
    values: Float[np.ndarray, "n k"], factors: Sequence[Int[np.ndarray, " n"]]
) -> Float[np.ndarray, " k"]:
    """Largest share of n independent trials that clusters of each factor may count for: at most c (1 + m) of them, with
    c clusters and m exceptions in all.
    """
    share = np.ones(values.shape[1])
    for label in factors:
        counts = np.bincount(label)
        sums = np.zeros((len(counts), values.shape[1]))
        np.add.at(sums, label, values)
        exceptions = np.clip(np.minimum(sums, counts[:, None] - sums), 0, None).sum(0)
        share = np.minimum(share, len(counts) * (1 + exceptions) / len(values))
    return share


def _independent(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " k"]:
    """Variance of the mean of independent values; zero where they differ by rounding only."""
    variance = values.var(0) / max(len(values), 1)
    return np.where(variance * len(values) < ALIKE, 0.0, variance)


def mean_interval(values: Shaped[Array, "n ..."], clusters: Clusters = ()) -> Estimate:
    """Mean of any values: `cluster_interval`, or Student's t where episodes are independent.

    Args:
        values: (n, ...).
        clusters: Factors in which episodes are alike, as of `cluster_interval`.

    Returns:
        Estimates of the trailing shape.
    """
    return cluster_interval(values, clusters) if clusters and len(values) else student_interval(values)


def rows_of(clusters: Clusters, rows: Shaped[Array, "..."]) -> Sequence[Shaped[Array, " kept"]]:
    """Labels of some of the episodes.

    Args:
        clusters: Of all.
        rows: Which: a mask or numbers.

    Returns:
        Those of the rows.
    """
    return [np.asarray(label)[rows] for label in clusters]


def cluster_interval(
    values: Shaped[Array, "n ..."], clusters: Clusters, *, draws: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Mean of values of episodes, with an interval over the clusters that they come in; its variance is at least that
    of independent episodes, as a few clusters may be alike by chance.

    Args:
        values: (n, ...) of the episodes, for instance whether each was right after each touch.
        clusters: One label for each episode, for each factor: its pad, its pool of sites, its object. Labels of
            different pads' pools must differ. A factor left out is taken as fixed: the interval is then for these very
            objects, say; so is one of fewer than three clusters. No factor at all means independent episodes.
        draws: Of each bootstrap.
        seed: Of the draws.

    Returns:
        Estimates of the trailing shape. Limits are NaN where no factor has three clusters.

    Raises:
        ValueError: Labels are not as many as values.
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
    """Student's t for half of the width of an interval."""
    return np.asarray(stats.t.ppf((1 + COVERAGE) / 2, freedom))


def bootstrap_clusters(
    statistic: Statistic, clusters: Clusters, count: int, *, draws: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Any statistic of weighted episodes, with an interval over the clusters that they come in.

    Args:
        statistic: Maps weights (n,) of the episodes, all 1 for what was seen, to one number or several.
        clusters: As of `cluster_interval`.
        count: Number n of episodes.
        draws: Of each bootstrap.
        seed: Of the draws.

    Returns:
        Estimates of the statistic's shape; limits are NaN where no factor has three clusters.

    Raises:
        ValueError: Labels are not as many as episodes.
    """
    seen = np.asarray(statistic(np.ones(count)), np.float64)

    def resampled(counts: np.ndarray, label: np.ndarray) -> np.ndarray:
        return np.stack([np.ravel(statistic(drawn[label])) for drawn in counts]).astype(np.float64)

    variance, freedom = _spread(resampled, _factors(clusters, count), draws, seed)
    half = (_t(freedom) * np.sqrt(variance)).reshape(seen.shape)
    return Estimate(seen, seen - half, seen + half)


def grouped_interval(
    statistic: Callable[[np.ndarray], float], groups: Shaped[Array, " n"], seed: int = 0
) -> tuple[float, float]:
    """`bootstrap_clusters` of a statistic of rows, such as a median or an R2, over one factor.

    Args:
        statistic: Function of row numbers, those of a cluster that was drawn twice twice among them. Draws of which it
            is NaN are left out.
        groups: (n,) run or spatial block of each row; rows of one group are not independent.
        seed: Of the draws.

    Returns:
        Both ends of the interval; NaN where there are fewer than three groups.
    """
    rows = np.arange(len(groups))
    found = bootstrap_clusters(
        lambda weights: np.float64(statistic(np.repeat(rows, weights.astype(int)))), [groups], len(rows), seed=seed
    )
    return float(found.low), float(found.high)


def p_values(estimates: Estimate, freedom: int | Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Two-sided p values of means that are zero in truth, by Student's t, from their intervals.

    Args:
        estimates: Means with intervals that are Student's t.
        freedom: Degrees of freedom of these, or the least that they may have: p values are then too large rather than
            too small.

    Returns:
        The p values; NaN where there is no interval.
    """
    mean, low, high = (np.asarray(part, np.float64) for part in estimates)
    with np.errstate(divide="ignore", invalid="ignore"):
        return 2 * stats.t.sf(np.abs(mean) / ((high - low) / 2) * _t(np.asarray(freedom)), freedom)


def holm(p: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """P values adjusted for their number, so that one below 0.05 among true null hypotheses has a chance of 5 %.

    Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6, 1979.

    Args:
        p: P values.

    Returns:
        The adjusted ones, in the same order.
    """
    order = np.argsort(p)
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate((len(p) - np.arange(len(p))) * np.asarray(p)[order]), 1)
    return adjusted


def _spread(
    resampled: Resampled, factors: Sequence[Int[np.ndarray, " n"]], draws: int = RESAMPLES, seed: int = 0
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Variance of a statistic over crossed factors, and its degrees of freedom; NaN where there is no factor."""
    if not factors:
        return np.full(1, np.nan), np.full(1, np.nan)
    rng = np.random.default_rng(seed)
    variance = first = spread = np.zeros(1)
    for size in range(1, len(factors) + 1):
        for some in combinations(factors, size):
            label = _cells(some)
            part = _resampled_variance(resampled, label, draws, rng)
            variance = variance + (-1) ** (size + 1) * part
            if size == 1:
                first = np.maximum(first, part)
                spread = spread + part**2 / label.max()
    variance = np.maximum(variance, first)  # what cells take off is noisy too
    fewest = min(int(factor.max()) for factor in factors)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = np.clip(np.where(spread > 0, variance**2 / spread, fewest), fewest, None)
    return variance, freedom


def _factors(clusters: Clusters, count: int) -> list[Int[np.ndarray, " n"]]:
    """Labels 0, 1, ... of the factors that have several clusters, without those nested in another: resampling the
    coarser clusters resamples what is in them. Independent episodes are clusters of one.
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
    """Labels of combined clusters of all factors."""
    return np.unique(np.stack(factors), axis=1, return_inverse=True)[1].reshape(-1)


def _resampled_variance(
    resampled: Resampled, label: Int[np.ndarray, " n"], draws: int, rng: np.random.Generator
) -> Float[np.ndarray, " k"]:
    """Variance of a statistic over resampled clusters, one less than there are: so it is unbiased for a mean (McCarthy
    and Snowden, Vital and Health Statistics 2:95, 1985).
    """
    groups = int(label.max()) + 1
    counts = rng.multinomial(groups - 1, np.full(groups, 1 / groups), size=draws).astype(np.float64)
    return np.nanvar(resampled(counts, label), axis=0, ddof=1)
