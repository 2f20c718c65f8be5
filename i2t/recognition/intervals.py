"""Intervals of scores over episodes, whose errors come in clusters: episodes share a pad, a pool of touch sites and the
object that was there.

`cluster_interval` resamples whole clusters. Its variance over several crossed factors is put together as Cameron,
Gelbach and Miller do (Journal of Business and Economic Statistics 29, 2011), each part by a bootstrap of clusters;
few clusters are allowed for by Student's t with the degrees of freedom of Satterthwaite (Biometrics Bulletin 2, 1946).
`wilson_interval` is for rates of independent trials (Wilson, JASA 22, 1927). All cover 95 %.
NumPy, because nothing here is differentiated.
"""

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy import stats

from i2t.prediction.metrics import MIN_CLUSTERS as MIN_CLUSTERS
from i2t.prediction.metrics import Estimate as Estimate
from i2t.prediction.metrics import student_interval as student_interval
from i2t.types import Array

COVERAGE = 0.95  # of every interval
RESAMPLES = 1000  # of a bootstrap

Clusters = Sequence[Shaped[Array, " n"]]  # labels of the episodes, for each factor
Statistic = Callable[[Float[np.ndarray, " n"]], Array]  # of the episodes' weights


def estimate_at(estimates: Estimate, index: int) -> Estimate:
    """One of several estimates.

    Args:
        estimates: Along a leading axis.
        index: Which, for instance -1 for the last touch.

    Returns:
        That one.
    """
    return Estimate(estimates.mean[index], estimates.low[index], estimates.high[index])


def wilson_interval(values: Shaped[Array, "n ..."]) -> Estimate:
    """Mean and Wilson's interval of independent values between 0 and 1.

    Fractions, which shared ties give, are welcome: nothing in [0, 1] varies more than a coin of the same mean.

    Args:
        values: (n, ...) in [0, 1].

    Returns:
        Estimates of the trailing shape; NaN where n is 0.
    """
    values = np.asarray(values, np.float64)
    if not len(values):
        nothing = np.full(values.shape[1:], np.nan)
        return Estimate(nothing, nothing, nothing)
    return _wilson(values.mean(0), len(values))


def rate_interval(values: Shaped[Array, "n ..."], clusters: Clusters = ()) -> Estimate:
    """Mean of values between 0 and 1: `cluster_interval`, or Wilson's where episodes are independent.

    Limits stay between 0 and 1; where clusters do not differ at all, they are Wilson's for as many trials as there are
    clusters.

    Args:
        values: (n, ...) in [0, 1].
        clusters: Factors in which episodes are alike, as of `cluster_interval`.

    Returns:
        Estimates of the trailing shape.
    """
    if not clusters or not len(values):
        return wilson_interval(values)
    return _within_unit(cluster_interval(values, clusters), np.asarray(values, np.float64), clusters)


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
    """Mean of values of episodes, with an interval over the clusters that they come in.

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
    flat = values.reshape(len(values), -1)

    def weighted_mean(weight: np.ndarray) -> np.ndarray:
        return weight @ flat / weight.sum()

    found = bootstrap_clusters(weighted_mean, clusters, len(values), draws=draws, seed=seed)
    return Estimate(*(part.reshape(values.shape[1:]) for part in found))


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
    shape, centre = seen.shape, seen.reshape(-1)
    factors = _factors(clusters, count)
    if not factors:
        return Estimate(seen, np.full_like(seen, np.nan), np.full_like(seen, np.nan))
    rng = np.random.default_rng(seed)
    variance, first, spread = (np.zeros_like(centre) for _ in range(3))
    for size in range(1, len(factors) + 1):
        for some in combinations(factors, size):
            label = _cells(some)
            part = _resampled_variance(statistic, label, draws, rng)
            variance += (-1) ** (size + 1) * part
            if size == 1:
                first = np.maximum(first, part)
                spread += part**2 / label.max()
    variance = np.maximum(variance, first)  # what cells take off is noisy too
    fewest = min(int(factor.max()) for factor in factors)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = np.clip(np.where(spread > 0, variance**2 / spread, fewest), fewest, None)
    half = stats.t.ppf((1 + COVERAGE) / 2, freedom) * np.sqrt(variance)
    return Estimate(*(part.reshape(shape) for part in (centre, centre - half, centre + half)))


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
    statistic: Statistic, label: Int[np.ndarray, " n"], draws: int, rng: np.random.Generator
) -> Float[np.ndarray, " k"]:
    """Variance of a statistic over resampled clusters, one less than there are: so it is unbiased for a mean (McCarthy
    and Snowden, Vital and Health Statistics 2:95, 1985).
    """
    groups = int(label.max()) + 1
    counts = rng.multinomial(groups - 1, np.full(groups, 1 / groups), size=draws).astype(np.float64)
    found = np.array([np.atleast_1d(statistic(count[label])) for count in counts], np.float64)
    return np.nanvar(found.reshape(draws, -1), axis=0, ddof=1)


def _within_unit(found: Estimate, values: np.ndarray, clusters: Clusters) -> Estimate:
    """Limits of rates: between 0 and 1, and Wilson's where clusters show no difference."""
    factors = _factors(clusters, len(values))
    if not factors:
        return found
    wilson = _wilson(values.mean(0), int(_cells(factors).max()) + 1)
    alike = np.asarray(found.high - found.low) < 1e-12
    low = np.where(alike, wilson.low, np.clip(found.low, 0, 1))
    return Estimate(found.mean, low, np.where(alike, wilson.high, np.clip(found.high, 0, 1)))


def _wilson(mean: Shaped[Array, "..."], trials: int) -> Estimate:
    z = stats.norm.ppf((1 + COVERAGE) / 2)
    centre = (mean + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * np.sqrt(mean * (1 - mean) / trials + z**2 / (4 * trials**2))
    return Estimate(mean, np.minimum(centre - half, mean), np.maximum(centre + half, mean))
