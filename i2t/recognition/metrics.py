"""Scores of recognition: accuracy, calibration error, proper scoring rules, and stopping.

An array of beliefs p (episodes, touches, classes) holds the probabilities of the classes after each touch, and `truth`
(episodes,) the true classes. If an object may be unknown, the unknown class is the last one. The touches of an episode
are not independent, and neither are episodes that share a pad, a pool of sites or an object: `clusters` names these
factors, and intervals (95 %) are over them (`i2t.intervals`). `i2t.recognition.calibrated` calibrates beliefs.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from i2t.intervals import (
    COVERAGE,
    RESAMPLES,
    Clusters,
    Estimate,
    bootstrap_clusters,
    mean_interval,
    rate_interval,
    rows_of,
)
from i2t.types import Array

PROBABILITY_FLOOR = 1e-6  # smallest probability in a log loss or in log odds; smaller ones are raised to it


def to_json(values: Any) -> Any:
    """Convert scores to JSON values: fields by name, arrays as lists.

    Args:
        values: A named tuple or a dict of scores, an array or a number.

    Returns:
        Dicts, lists and numbers.
    """
    if hasattr(values, "_asdict"):
        values = values._asdict()
    if isinstance(values, dict):
        return {name: to_json(value) for name, value in values.items()}
    return values.tolist() if isinstance(values, np.ndarray | np.generic) else values


# --- accuracy ---


def decision_shares(p: Float[Array, "*shape c"]) -> Float[Array, "*shape c"]:
    """Compute each class's share of the decision for the most probable class.

    Args:
        p: Beliefs, probabilities of the c classes on the last axis.

    Returns:
        `(*shape, c)` shares: 1 for the most probable class, equal parts for ties, so that the order of the classes does
        not matter.
    """
    p = np.asarray(p, np.float64)
    best = p >= p.max(-1, keepdims=True) - 1e-6  # smaller differences are rounding of sums of votes in float32
    return best / best.sum(-1, keepdims=True)


def hits(p: Float[Array, "e t c"], truth: Int[Array, " e"]) -> Float[Array, "e t"]:
    """Score whether each decision, the most probable class, is right.

    Args:
        p: `(e, t, c)` probabilities of c classes after each of t touches in e episodes.
        truth: `(e,)` indices of the true classes.

    Returns:
        `(e, t)` scores: 1 if right, 0 if wrong, and 1/n if the true class ties with n - 1 others.

    Raises:
        ValueError: Shapes do not fit, or `truth` contains an invalid class.
    """
    return values_of_truth(decision_shares(p), truth)


def accuracy(p: Float[Array, "e t c"], truth: Int[Array, " e"], *, clusters: Clusters = ()) -> Estimate:
    """Estimate the fraction of right decisions after each touch.

    Args:
        p: `(e, t, c)` probabilities of c classes after each of t touches in e episodes.
        truth: `(e,)` indices of the true classes.
        clusters: Factors that episodes share, as for `cluster_interval`; empty if they are independent.

    Returns:
        `(t,)` accuracies with intervals.
    """
    return rate_interval(hits(p, truth), clusters)


def mean_accuracy(p: Float[Array, "e t c"], truth: Int[Array, " e"], *, clusters: Clusters = ()) -> Estimate:
    """Estimate the fraction of right decisions, averaged over touches 1 to t.

    Args:
        p: `(e, t, c)` probabilities of c classes after each of t touches in e episodes.
        truth: `(e,)` indices of the true classes.
        clusters: Factors that episodes share, as for `cluster_interval`; empty if they are independent.

    Returns:
        Scalar accuracy with its interval.
    """
    hit = hits(p, truth).mean(1)
    return rate_interval(hit, clusters) if clusters else mean_interval(hit)


def confusion(p: Float[Array, "e c"], truth: Int[Array, " e"]) -> Float[Array, "c c"]:
    """Count the decisions for each true class.

    Args:
        p: `(e, c)` probabilities of c classes at the decision in e episodes.
        truth: `(e,)` indices of the true classes.

    Returns:
        `(c, c)` counts: rows are the true classes, columns the decisions.
    """
    counts = np.zeros((np.shape(p)[-1],) * 2)
    np.add.at(counts, np.asarray(truth), decision_shares(p))
    return counts


class PairedComparison(NamedTuple):
    """Differences in accuracy between two methods on the same episodes, after the last touch and averaged over touches,
    with intervals; positive if the first method is better.
    """

    last: Estimate  # difference of the accuracies after the last touch
    mean: Estimate  # difference of the accuracies averaged over touches


def compare_paired(
    hit: Shaped[Array, "e t"], other: Shaped[Array, "... t2"], *, clusters: Clusters = ()
) -> PairedComparison:
    """Compare two methods on the same episodes.

    Args:
        hit: `(e, t)` scores of the first method from `hits`, for t touches of each of e episodes.
        other: `(e, t)` scores of the second method on the same episodes, from `hits`.
        clusters: Factors that episodes share, as for `cluster_interval`; empty if they are independent.

    Returns:
        Accuracy of the first method minus that of the second, after the last touch and averaged over touches.

    Raises:
        ValueError: The methods have different episodes, or fewer than two.
    """
    hit, other = np.asarray(hit, np.float64), np.asarray(other, np.float64)
    if hit.shape != other.shape or len(hit) < 2:
        raise ValueError(f"compare_paired: hits {hit.shape} and {other.shape} must be of the same episodes, at least 2")
    last, mean = hit[:, -1] - other[:, -1], (hit - other).mean(1)
    return PairedComparison(mean_interval(last, clusters), mean_interval(mean, clusters))


# --- calibration ---


def confidence(p: Float[Array, "*shape c"]) -> Float[Array, "*shape"]:
    """Return the probability of the decided class.

    Args:
        p: Beliefs, probabilities of the c classes on the last axis.

    Returns:
        `(*shape,)` largest probability of each belief.
    """
    return np.asarray(p, np.float64).max(-1)


class CalibrationError(NamedTuple):
    """Expected calibration error, from 0 (perfect) to 1, with the mean and the 95 % quantile that it would have by
    chance if decisions of these confidences were right as often as predicted.
    """

    error: float
    chance: float  # mean calibration error of decisions that are right as often as predicted
    chance_high: float  # 95 % quantile of the calibration error of decisions that are right as often as predicted


def calibration_error(
    confidences: Float[Array, "*n"],
    hit: Shaped[Array, "*n"],
    bins: int = 15,
    *,
    cluster: Shaped[Array, "*n"] | None = None,
) -> CalibrationError:
    """Compute the expected calibration error of the top class: the mean over decisions of `|frequency - confidence|` of
    their bin (Guo et al., ICML 2017).

    Few decisions in a bin make it positive for any forecaster, so it comes with its distribution for decisions that are
    right as often as predicted (consistency resampling; Bröcker and Smith, Weather and Forecasting 22, 2007). These are
    either independent, which requires one touch of each episode, or fully alike within a cluster.

    Args:
        confidences: Confidences of the decisions, in [0, 1].
        hit: Whether each decision is right, as from `hits`.
        bins: Number of bins.
        cluster: Label of each decision's cluster, whose decisions at one confidence are right or wrong together.

    Returns:
        Error, and mean and 95 % quantile of its distribution by chance.
    """
    confidences, hit = np.ravel(np.asarray(confidences, np.float64)), np.ravel(hit)
    which = np.clip((confidences * bins).astype(int), 0, bins - 1)
    of_draw = np.arange(len(which)) if cluster is None else np.unique(np.ravel(cluster), return_inverse=True)[1]
    drawn = np.random.default_rng(0).random((RESAMPLES, of_draw.max(initial=-1) + 1))[:, of_draw] < confidences
    in_bin = (which[:, None] == np.arange(bins)).astype(np.float64)
    observed, *chance = np.abs(np.vstack([hit, drawn]) @ in_bin - confidences @ in_bin).sum(1) / len(confidences)
    return CalibrationError(float(observed), float(np.mean(chance)), float(np.quantile(chance, COVERAGE)))


def log_loss(p: Float[Array, "e t c"], truth: Int[Array, " e"]) -> Float[Array, "e t"]:
    """Compute minus the natural logarithm of the true class's probability, raised to `PROBABILITY_FLOOR` if smaller.

    Args:
        p: `(e, t, c)` probabilities of c classes after each of t touches in e episodes.
        truth: `(e,)` indices of the true classes.

    Returns:
        `(e, t)` losses (nats) after each touch.
    """
    return -np.log(np.clip(values_of_truth(p, truth), PROBABILITY_FLOOR, 1))


# --- stopping ---


class Stopping(NamedTuple):
    """Scores of episodes that stop once the belief is as confident as requested, or after the last touch: requested,
    measured and predicted fractions of wrong decisions, of all episodes and of those that became confident, the
    fraction that did, and the mean number of touches.
    """

    requested_error: float
    error: Estimate  # fraction of wrong decisions
    predicted_error: float  # mean of 1 - the decided class's probability, which equals `error` for calibrated beliefs
    stopped: Estimate  # fraction of episodes that became as confident as requested
    stopped_error: Estimate  # fraction of wrong decisions among the episodes that became as confident as requested
    stopped_predicted_error: float
    touches: Estimate


def stopping(p: Float[Array, "e t c"], truth: Int[Array, " e"], error: float, *, clusters: Clusters = ()) -> Stopping:
    """Score episodes that stop as soon as the probability of the most probable class is at least 1 - `error`.

    Args:
        p: `(e, t, c)` probabilities of c classes after each of t touches in e episodes.
        truth: `(e,)` indices of the true classes.
        error: Requested probability of a wrong decision.
        clusters: Factors that episodes share, as for `cluster_interval`; empty if they are independent.

    Returns:
        Fractions of stopped episodes and of wrong decisions, and the mean number of touches, with intervals.
    """
    confidences, hit = confidence(p), hits(p, truth)
    confident = confidences >= 1 - error
    stopped = confident.any(1)
    last = np.where(stopped, confident.argmax(1) + 1, confidences.shape[1])
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


# --- unknown objects ---


def auroc(p_unknown: Shaped[Array, "e t"], unknown: Bool[Array, " e"], *, clusters: Clusters = ()) -> Estimate:
    """Estimate the area under the receiver operating characteristic of detecting unknown objects.

    It is the probability that an episode with an unknown object has a larger probability of the unknown class than an
    episode without one; equal probabilities count half.

    Args:
        p_unknown: `(e, t)` probability of the unknown class after each of t touches in e episodes.
        unknown: `(e,)` True where the object was unknown.
        clusters: Factors that episodes share, as for `cluster_interval`; empty if they are independent.

    Returns:
        `(t,)` areas with intervals; 1 is perfect, 0.5 is chance.

    Raises:
        ValueError: Episodes with or without an unknown object are missing.
    """
    p_unknown, unknown = np.asarray(p_unknown, np.float64), np.asarray(unknown, bool)
    if unknown.all() or not unknown.any():
        raise ValueError("auroc: it needs episodes with and without an unknown object")

    def areas(weight: np.ndarray) -> np.ndarray:
        return np.array([_area(x[unknown], x[~unknown], weight[unknown], weight[~unknown]) for x in p_unknown.T])

    area = bootstrap_clusters(areas, clusters, len(unknown))
    # For few clusters, intervals of Student's t may exceed the range of an area.
    return area._replace(low=np.maximum(area.low, 0.0), high=np.minimum(area.high, 1.0))


def _area(above: np.ndarray, below: np.ndarray, w_above: np.ndarray, w_below: np.ndarray) -> float:
    """Compute Mann and Whitney's statistic of weighted values as a fraction of pairs; NaN for a side of weight 0."""
    values, place = np.unique(np.concatenate([above, below]), return_inverse=True)
    up = np.bincount(place[: len(above)], w_above, len(values))
    down = np.bincount(place[len(above) :], w_below, len(values))
    pairs = up.sum() * down.sum()
    return float(np.sum(up * (np.cumsum(down) - down / 2)) / pairs) if pairs else float("nan")


# --- parts ---


def values_of_truth(values: Shaped[Array, "..."], truth: Int[Array, "..."]) -> Float[Array, "e t"]:
    """Select the values of the true classes.

    Args:
        values: (episodes, touches, classes) values of all classes.
        truth: (episodes,) true classes.

    Returns:
        `(episodes, touches)` values of the true classes.

    Raises:
        ValueError: Shapes do not fit, or `truth` contains an invalid class.
    """
    values, truth = np.asarray(values, np.float64), np.asarray(truth)
    if values.ndim != 3 or truth.shape != values.shape[:1]:
        raise ValueError(
            f"beliefs {values.shape} must be (episodes, touches, classes), truth {truth.shape} (episodes,)"
        )
    if truth.size and not (truth.min() >= 0 and truth.max() < values.shape[-1]):
        raise ValueError(
            f"truth: {truth.min()} to {truth.max()} are not classes 0 to {values.shape[-1] - 1}; "
            "the unknown one comes last"
        )
    return np.take_along_axis(values, truth[:, None, None], -1)[..., 0]
