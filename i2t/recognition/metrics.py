"""Scores of recognition: accuracy, calibration error, proper scoring rules, and stopping.

An array of beliefs p (episodes, touches, classes) holds the probabilities of the classes after each touch, `truth`
(episodes,) the class that was there. Where an object may be unknown, `i2t.recognition.open_set.with_unknown_class`
makes the unknown class the last one. The touches of an episode are not independent, and neither are episodes that share
a pad, a pool of sites or an object: `clusters` names these factors, and intervals (95 %) are over them
(`i2t.recognition.intervals`). How beliefs are calibrated is in `i2t.recognition.calibrated`.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy import stats

from i2t.recognition.intervals import (
    COVERAGE,
    RESAMPLES,
    Clusters,
    Estimate,
    bootstrap_clusters,
    mean_interval,
    rate_interval,
    rows_of,
    wilson_interval,
)
from i2t.types import Array

TIE_TOLERANCE = 1e-6  # probabilities that differ by less are equal: sums of votes in float32
PROBABILITY_FLOOR = 1e-6  # no logarithm of a smaller one is taken
BINS = 15


def to_json(values: Any) -> Any:
    """Scores as JSON has them: fields by name, arrays as lists.

    Args:
        values: A named tuple of scores, an array or a number.

    Returns:
        Dicts, lists and numbers.
    """
    if hasattr(values, "_asdict"):
        return {name: to_json(value) for name, value in values._asdict().items()}
    return values.tolist() if isinstance(values, np.ndarray | np.generic) else values


# --- accuracy ---


def restrict_to(
    p: Float[Array, "e t c"], truth: Int[Array, " e"], candidates: list[int]
) -> tuple[Float[Array, "kept t chosen"], Int[Array, " kept"], Int[Array, " kept"]]:
    """The problem of distinguishing some of the classes.

    Args:
        p: Beliefs in all classes.
        truth: Classes that were there.
        candidates: Classes to keep.

    Returns:
        Beliefs in the candidates of the episodes with one of them, uniform where none had any weight; which candidate
        was there; and the numbers of those episodes.
    """
    match = np.asarray(truth)[:, None] == np.asarray(candidates)[None]
    rows = np.flatnonzero(match.any(1))
    kept = np.asarray(p, np.float64)[rows][..., candidates]
    total = kept.sum(-1, keepdims=True)
    kept = np.where(total > 0, kept / np.where(total > 0, total, 1), 1 / len(candidates))
    return kept, match[rows].argmax(1), rows


def decision_shares(p: Float[Array, "*shape c"]) -> Float[Array, "*shape c"]:
    """Share of the decision that each class has.

    Args:
        p: Beliefs.

    Returns:
        1 for the most probable class, equal parts where several are, so that no order of the classes is favoured.
    """
    p = np.asarray(p, np.float64)
    best = p >= p.max(-1, keepdims=True) - TIE_TOLERANCE
    return best / best.sum(-1, keepdims=True)


def hits(p: Float[Array, "e t c"], truth: Int[Array, " e"]) -> Float[Array, "e t"]:
    """Correctness of each decision.

    Args:
        p: Beliefs.
        truth: Classes that were there.

    Returns:
        1 or 0, and 1/n where the truth ties with n - 1 others.

    Raises:
        ValueError: Shapes do not fit, or `truth` names a class that is none.
    """
    return of_truth(decision_shares(p), truth)


def accuracy(p: Float[Array, "e t c"], truth: Int[Array, " e"], *, clusters: Clusters = ()) -> Estimate:
    """Share of right decisions after each touch.

    Args:
        p: Beliefs.
        truth: Classes that were there.
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.

    Returns:
        Estimates (t,).
    """
    return rate_interval(hits(p, truth), clusters)


def mean_accuracy(p: Float[Array, "e t c"], truth: Int[Array, " e"], *, clusters: Clusters = ()) -> Estimate:
    """Share of right decisions, mean over touches 1 to t.

    Args:
        p: Beliefs.
        truth: Classes that were there.
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.

    Returns:
        One estimate.
    """
    hit = hits(p, truth).mean(1)
    return rate_interval(hit, clusters) if clusters else mean_interval(hit)


def confusion(p: Float[Array, "e c"], truth: Int[Array, " e"]) -> Float[Array, "c c"]:
    """Confusion matrix of the decisions.

    Args:
        p: Beliefs at the decision.
        truth: Classes that were there.

    Returns:
        Counts: rows are what was there, columns what was decided.
    """
    counts = np.zeros((np.shape(p)[-1],) * 2)
    np.add.at(counts, np.asarray(truth), decision_shares(p))
    return counts


class PairedComparison(NamedTuple):
    """One method less another on the same episodes."""

    last: Estimate  # difference in accuracy after the last touch
    last_p: float  # McNemar's exact test; where ties are shared, the sign test
    mean: Estimate  # difference in mean accuracy over touches
    mean_p: float  # paired t test


def compare_paired(
    hit: Shaped[Array, "e t"], other: Shaped[Array, "... t2"], *, clusters: Clusters = ()
) -> PairedComparison:
    """Compare two methods on the same episodes.

    Args:
        hit: `hits` of the one method.
        other: `hits` of the other.
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.

    Returns:
        The differences; p-values take episodes as independent, intervals do not.

    Raises:
        ValueError: They are not of the same episodes, or of fewer than two.
    """
    hit, other = np.asarray(hit, np.float64), np.asarray(other, np.float64)
    if hit.shape != other.shape or len(hit) < 2:
        raise ValueError(f"compare_paired: hits {hit.shape} and {other.shape} must be of the same episodes, at least 2")
    last, mean = hit[:, -1] - other[:, -1], (hit - other).mean(1)
    return PairedComparison(
        mean_interval(last, clusters), sign_test(last), mean_interval(mean, clusters), _t_test(mean)
    )


def sign_test(difference: Shaped[Array, " n"]) -> float:
    """Two-sided exact p-value of as many differences above zero as below.

    Args:
        difference: Paired differences; of right-or-wrong answers this is McNemar's test.

    Returns:
        The p-value; 1 where no difference is other than zero.
    """
    above, below = int((difference > 0).sum()), int((difference < 0).sum())
    return float(stats.binomtest(above, above + below).pvalue) if above + below else 1.0


def _t_test(difference: np.ndarray) -> float:
    mean, error = difference.mean(), difference.std(ddof=1) / np.sqrt(len(difference))
    if error == 0:
        return float(mean == 0)
    return float(2 * stats.t.sf(abs(mean) / error, len(difference) - 1))


# --- calibration ---


def confidence(p: Float[Array, "*shape c"]) -> Float[Array, "*shape"]:
    """Probability of the class decided for.

    Args:
        p: Beliefs.

    Returns:
        Greatest probability of each belief.
    """
    return np.asarray(p, np.float64).max(-1)


class Reliability(NamedTuple):
    """Decisions sorted by their confidence into b bins; NaN in those that are empty."""

    number: np.ndarray  # (b,) of decisions
    confidence: np.ndarray  # (b,) mean
    frequency: Estimate  # (b,) of right ones


def reliability(
    confidences: Float[Array, "*n"], hit: Shaped[Array, "*n"], bins: int = BINS, equal_mass: bool = False
) -> Reliability:
    """Sort decisions by their confidence into bins (Guo et al., ICML 2017).

    The intervals take decisions as independent: give one touch of each episode.

    Args:
        confidences: Of the decisions, in [0, 1].
        hit: Whether each is right, as `hits`.
        bins: How many.
        equal_mass: Bins of equal count instead of equal width.

    Returns:
        Mean confidence and frequency of each bin, with its count and interval.
    """
    confidences, hit = np.ravel(confidences), np.ravel(hit)
    which = _bin_numbers(confidences, bins, equal_mass)
    rows = [which == i for i in range(bins)]
    frequency = [wilson_interval(hit[row]) for row in rows]
    return Reliability(
        np.array([row.sum() for row in rows]),
        np.array([confidences[row].mean() if row.any() else np.nan for row in rows]),
        Estimate(*(np.array(column) for column in zip(*frequency, strict=True))),
    )


class CalibrationError(NamedTuple):
    """Expected calibration error, next to that of the same confidences by chance if they are calibrated."""

    error: float
    chance: float  # mean
    chance_high: float  # 95 % of its draws are below


def calibration_error(
    confidences: Float[Array, "*n"],
    hit: Shaped[Array, "*n"],
    bins: int = BINS,
    equal_mass: bool = False,
    seed: int = 0,
) -> CalibrationError:
    """Expected calibration error of the top class: mean over decisions of |frequency - confidence| of their bin (Guo et
    al., ICML 2017).

    A few decisions to a bin make it positive for any forecaster, so it comes with its distribution for decisions that
    are right as often as predicted (consistency resampling; Bröcker and Smith, Weather and Forecasting 22, 2007),
    independent of each other: give one touch of each episode.

    Args:
        confidences: Of the decisions, in [0, 1].
        hit: Whether each is right, as `hits`.
        bins: How many.
        equal_mass: Bins of equal count instead of equal width.
        seed: Of the resampling.

    Returns:
        The error, and mean and 95 % quantile of what chance gives.
    """
    confidences, hit = np.ravel(np.asarray(confidences, np.float64)), np.ravel(hit)
    which = _bin_numbers(confidences, bins, equal_mass)
    drawn = np.random.default_rng(seed).random((RESAMPLES, len(confidences))) < confidences
    chance = [_binned_gap(confidences, draw, which, bins) for draw in drawn]
    observed = _binned_gap(confidences, hit, which, bins)
    return CalibrationError(observed, float(np.mean(chance)), float(np.quantile(chance, COVERAGE)))


def _binned_gap(confidences: np.ndarray, hit: np.ndarray, which: np.ndarray, bins: int) -> float:
    return float(np.abs(np.bincount(which, hit - confidences, minlength=bins)).sum() / len(confidences))


def _bin_numbers(confidences: np.ndarray, bins: int, equal_mass: bool) -> np.ndarray:
    if equal_mass:
        return np.argsort(np.argsort(confidences, kind="stable"), kind="stable") * bins // len(confidences)
    return np.clip((confidences * bins).astype(int), 0, bins - 1)


def log_loss(p: Float[Array, "e t c"], truth: Int[Array, " e"]) -> Float[Array, "e t"]:
    """Minus the natural logarithm of the probability of the truth, which counts as `PROBABILITY_FLOOR` at least.

    Args:
        p: Beliefs.
        truth: Classes that were there.

    Returns:
        The loss (nats) after each touch.
    """
    return -np.log(np.clip(of_truth(p, truth), PROBABILITY_FLOOR, 1))


def brier(p: Float[Array, "e t c"], truth: Int[Array, " e"]) -> Float[Array, "e t"]:
    """Brier score (Monthly Weather Review 78, 1950): squared distance of the probabilities from the truth, 0 to 2.

    Args:
        p: Beliefs.
        truth: Classes that were there.

    Returns:
        The score after each touch.
    """
    p = np.asarray(p, np.float64)
    return (p**2).sum(-1) - 2 * of_truth(p, truth) + 1


# --- stopping ---


class Stopping(NamedTuple):
    """Decisions at the first touch after which the belief is as confident as requested, else after the last one."""

    requested_error: float
    error: Estimate  # share of wrong decisions
    predicted_error: float  # mean of 1 - the probability decided on, which `error` equals where beliefs are calibrated
    stopped: Estimate  # share that became as confident as requested
    stopped_error: Estimate  # share of wrong decisions, of those
    stopped_predicted_error: float
    touches: Estimate


def stopping(p: Float[Array, "e t c"], truth: Int[Array, " e"], error: float, *, clusters: Clusters = ()) -> Stopping:
    """Stop as soon as the most probable class has at least 1 - `error`.

    Args:
        p: Beliefs.
        truth: Classes that were there.
        error: Requested probability of a wrong decision.
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.

    Returns:
        How often it stopped, and how often it was wrong.
    """
    confidences, hit = confidence(p), hits(p, truth)
    first = confident_at(p, 1 - error)
    stopped = np.isfinite(first)
    last = np.where(stopped, first, confidences.shape[1]).astype(int)
    wrong, doubt = (np.take_along_axis(1 - x, last[:, None] - 1, 1)[:, 0] for x in (hit, confidences))
    return Stopping(
        requested_error=error,
        error=rate_interval(wrong, clusters),
        predicted_error=float(doubt.mean()),
        stopped=rate_interval(stopped, clusters),
        stopped_error=rate_interval(wrong[stopped], rows_of(clusters, stopped)),
        stopped_predicted_error=float(doubt[stopped].mean()) if stopped.any() else float("nan"),
        touches=mean_interval(last, clusters),
    )


def confident_at(p: Float[Array, "e t c"], level: float = 0.95) -> Float[Array, " e"]:
    """Number of touches until some class has probability `level`.

    Args:
        p: Beliefs.
        level: The probability asked for.

    Returns:
        Touches of each episode; infinite where that never happens.
    """
    confident = confidence(p) >= level
    return np.where(confident.any(1), confident.argmax(1) + 1.0, np.inf)


def not_yet_confident(first: Shaped[Array, " e"], touches: int, *, clusters: Clusters = ()) -> Estimate:
    """Share of episodes that are not yet confident after 0, 1, ... `touches` touches.

    Args:
        first: Of each episode, as `confident_at`.
        touches: How many each episode has.
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.

    Returns:
        Estimates (touches + 1,).
    """
    return rate_interval(np.asarray(first)[:, None] > np.arange(touches + 1)[None], clusters)


class TouchesToConfidence(NamedTuple):
    """Touches until confident; an episode that never was confident counts in the mean as all its touches."""

    mean: Estimate
    median: Estimate  # infinite where half of them never were; limits from order statistics
    never: Estimate  # share


def touches_to_confidence(first: Shaped[Array, " e"], touches: int, *, clusters: Clusters = ()) -> TouchesToConfidence:
    """Summarise the numbers of touches until confident.

    Args:
        first: Of each episode, as `confident_at`.
        touches: How many each episode has.
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.

    Returns:
        Mean, median and the share that never was confident; the median's limits take episodes as independent.
    """
    first = np.asarray(first, np.float64)
    limits = stats.quantile_test(first, p=0.5).confidence_interval(COVERAGE)
    middle = np.quantile(first, 0.5, method="inverted_cdf")
    return TouchesToConfidence(
        mean_interval(np.minimum(first, touches), clusters),
        Estimate(middle, np.asarray(limits.low), np.asarray(limits.high)),
        rate_interval(np.isinf(first), clusters),
    )


def touches_saved(
    first: Shaped[Array, " e"], other: Shaped[Array, " e"], touches: int, *, clusters: Clusters = (), seed: int = 0
) -> Estimate:
    """Share by which the restricted mean number of touches until confident is less than that of another policy.

    Paired bootstrap. Episodes in which neither becomes confident count as equal, so a limit on
    touches hides part of what is saved.

    Args:
        first: Of each episode under this policy, as `confident_at`.
        other: The same under the other policy.
        touches: How many each episode has.
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.
        seed: Of the bootstrap.

    Returns:
        The share.
    """
    mine, theirs = (np.minimum(x, touches).astype(np.float64) for x in (first, other))

    def share_saved(weight: np.ndarray) -> np.ndarray:
        return np.asarray(1 - (weight @ mine) / (weight @ theirs))

    return bootstrap_clusters(share_saved, clusters, len(mine), seed=seed)


def of_truth(values: Shaped[Array, "..."], truth: Int[Array, "..."]) -> Float[Array, "e t"]:
    """Values of the true classes.

    Args:
        values: (episodes, touches, classes).
        truth: (episodes,) classes that were there.

    Returns:
        One value for each episode and touch.

    Raises:
        ValueError: Shapes do not fit, or `truth` names a class that is none.
    """
    values, truth = np.asarray(values, np.float64), np.asarray(truth)
    if values.ndim != 3 or truth.shape != values.shape[:1]:
        raise ValueError(
            f"beliefs {values.shape} must be (episodes, touches, classes), truth {truth.shape} (episodes,)"
        )
    if truth.size and not (truth.min() >= 0 and truth.max() < values.shape[-1]):
        raise ValueError(
            f"truth: {truth.min()} to {truth.max()} are not classes 0 to {values.shape[-1] - 1}; "
            "add the unknown one with `with_unknown_class`"
        )
    return np.take_along_axis(values, truth[:, None, None], -1)[..., 0]
