"""Scores of recognition: accuracy, calibration error, proper scoring rules, stopping, and unknown objects.

An array of beliefs p (episodes, touches, classes) holds the probabilities of the classes after each touch, `truth`
(episodes,) the class that was there. Where an object may be unknown, `with_unknown_class` makes the unknown class the
last one. Episodes are independent, the touches within one are not, so every interval is over episodes (or seeds) and
covers 95 %: Wilson's for rates (JASA 22, 1927), Student's t for means, the percentile bootstrap for ratios and ranks.
How beliefs are calibrated is in `i2t.recognition.calibrated`. NumPy, because nothing here is differentiated.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy import stats

from i2t.prediction.metrics import Estimate as Estimate
from i2t.prediction.metrics import student_interval as student_interval
from i2t.types import Array

COVERAGE = 0.95  # of every interval
RESAMPLES = 1000  # of a bootstrap
TIE_TOLERANCE = 1e-6  # probabilities that differ by less are equal: sums of votes in float32
PROBABILITY_FLOOR = 1e-6  # no logarithm of a smaller one is taken
BINS = 15


def estimate_at(estimates: Estimate, index: int) -> Estimate:
    """One of several estimates.

    Args:
        estimates: Along a leading axis.
        index: Which, for instance -1 for the last touch.
    """
    return Estimate(estimates.mean[index], estimates.low[index], estimates.high[index])


# --- intervals ---


def wilson_interval(values: Shaped[Array, "n ..."]) -> Estimate:
    """Mean and Wilson's interval of independent values between 0 and 1.

    Fractions, which shared ties give, are welcome: nothing in [0, 1] varies more than a coin of the same mean.

    Args:
        values: (n, ...) in [0, 1].

    Returns:
        Estimates of the trailing shape; NaN where n is 0.
    """
    values = np.asarray(values, np.float64)
    n, z = len(values), stats.norm.ppf((1 + COVERAGE) / 2)
    if not n:
        nothing = np.full(values.shape[1:], np.nan)
        return Estimate(nothing, nothing, nothing)
    mean = values.mean(0)
    centre = (mean + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(mean * (1 - mean) / n + z**2 / (4 * n**2))
    return Estimate(mean, np.minimum(centre - half, mean), np.maximum(centre + half, mean))


def to_json(values: Any) -> Any:
    """Scores as JSON has them: fields by name, arrays as lists.

    Args:
        values: A named tuple of scores, an array or a number.
    """
    if hasattr(values, "_asdict"):
        return {name: to_json(value) for name, value in values._asdict().items()}
    return values.tolist() if isinstance(values, np.ndarray | np.generic) else values


# --- accuracy ---


def with_unknown_class(
    p: Float[Array, "e t objects"], p_unknown: Float[Array, "e t"], truth: Int[Array, " e"]
) -> tuple[Float[Array, "e t classes"], Int[Array, " e"]]:
    """Make the unknown class the last one.

    Args:
        p: Probabilities of the known objects.
        p_unknown: Probability of the unknown class.
        truth: Objects that were there, -1 for unknown ones.

    Returns:
        Beliefs (e, t, objects + 1) and classes (e,).
    """
    joined = np.concatenate([np.asarray(p), np.asarray(p_unknown)[..., None]], axis=-1)
    return joined, np.where(np.asarray(truth) < 0, joined.shape[-1] - 1, truth)


def with_unknown_prior(
    p: Float[Array, "*shape objects"], p_unknown: Float[Array, "*shape"], old: float, new: float
) -> tuple[Float[Array, "*shape objects"], Float[Array, "*shape"]]:
    """The same beliefs under another prior probability of unknown objects, by Bayes' rule.

    Args:
        p: Probabilities of the known objects.
        p_unknown: Probability of the unknown class.
        old: Prior probability of unknown objects from which these beliefs come, in (0, 1).
        new: The prior probability they get, in [0, 1).

    Returns:
        Both under the new prior.

    Raises:
        ValueError: A prior lies outside its range.
    """
    if not (0 < old < 1 and 0 <= new < 1):
        raise ValueError(f"with_unknown_prior: priors {old} and {new} must lie in (0, 1) and [0, 1)")
    odds = new / (1 - new) * (1 - old) / old
    joined = np.concatenate([np.asarray(p, np.float64), odds * np.asarray(p_unknown, np.float64)[..., None]], axis=-1)
    total = joined.sum(-1, keepdims=True)
    # A belief that had ruled out all known objects and may no longer hold them unknown becomes uniform.
    uniform = np.append(np.full(np.shape(p)[-1], 1 / np.shape(p)[-1]), 0)
    joined = np.where(total > 0, joined / np.where(total > 0, total, 1), uniform)
    return joined[..., :-1], joined[..., -1]


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
    """Whether each decision is right.

    Args:
        p: Beliefs.
        truth: Classes that were there.

    Returns:
        1 or 0, and 1/n where the truth ties with n - 1 others.

    Raises:
        ValueError: Shapes do not fit, or `truth` names a class that is none.
    """
    return of_truth(decision_shares(p), truth)


def accuracy(p: Float[Array, "e t c"], truth: Int[Array, " e"]) -> Estimate:
    """Share of right decisions after each touch.

    Args:
        p: Beliefs.
        truth: Classes that were there.

    Returns:
        Estimates (t,).
    """
    return wilson_interval(hits(p, truth))


def mean_accuracy(p: Float[Array, "e t c"], truth: Int[Array, " e"]) -> Estimate:
    """Share of right decisions, mean over touches 1 to t.

    Args:
        p: Beliefs.
        truth: Classes that were there.

    Returns:
        One estimate.
    """
    return student_interval(hits(p, truth).mean(1))


def confusion(p: Float[Array, "e c"], truth: Int[Array, " e"]) -> Float[Array, "c c"]:
    """How often each class was taken for each.

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


def compare_paired(hit: Shaped[Array, "e t"], other: Shaped[Array, "... t2"]) -> PairedComparison:
    """Compare two methods on the same episodes.

    Args:
        hit: `hits` of the one method.
        other: `hits` of the other.

    Raises:
        ValueError: They are not of the same episodes, or of fewer than two.
    """
    hit, other = np.asarray(hit, np.float64), np.asarray(other, np.float64)
    if hit.shape != other.shape or len(hit) < 2:
        raise ValueError(f"compare_paired: hits {hit.shape} and {other.shape} must be of the same episodes, at least 2")
    last, mean = hit[:, -1] - other[:, -1], (hit - other).mean(1)
    return PairedComparison(student_interval(last), sign_test(last), student_interval(mean), _t_test(mean))


def sign_test(difference: Shaped[Array, " n"]) -> float:
    """Two-sided exact p-value of as many differences above zero as below.

    Args:
        difference: Paired differences; of right-or-wrong answers this is McNemar's test.
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
    """Expected calibration error, next to what the same confidences give by chance if they are calibrated."""

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
    """
    return -np.log(np.clip(of_truth(p, truth), PROBABILITY_FLOOR, 1))


def brier(p: Float[Array, "e t c"], truth: Int[Array, " e"]) -> Float[Array, "e t"]:
    """Brier score (Monthly Weather Review 78, 1950): squared distance of the probabilities from the truth, 0 to 2.

    Args:
        p: Beliefs.
        truth: Classes that were there.
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


def stopping(p: Float[Array, "e t c"], truth: Int[Array, " e"], error: float) -> Stopping:
    """Stop as soon as the most probable class has at least 1 - `error`.

    Args:
        p: Beliefs.
        truth: Classes that were there.
        error: Requested probability of a wrong decision.
    """
    confidences, hit = confidence(p), hits(p, truth)
    first = confident_at(p, 1 - error)
    stopped = np.isfinite(first)
    last = np.where(stopped, first, confidences.shape[1]).astype(int)
    wrong, doubt = (np.take_along_axis(1 - x, last[:, None] - 1, 1)[:, 0] for x in (hit, confidences))
    return Stopping(
        requested_error=error,
        error=wilson_interval(wrong),
        predicted_error=float(doubt.mean()),
        stopped=wilson_interval(stopped),
        stopped_error=wilson_interval(wrong[stopped]),
        stopped_predicted_error=float(doubt[stopped].mean()) if stopped.any() else float("nan"),
        touches=student_interval(last),
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


def not_yet_confident(first: Shaped[Array, " e"], touches: int) -> Estimate:
    """Share of episodes that are not yet confident after 0, 1, ... `touches` touches.

    Args:
        first: Of each episode, as `confident_at`.
        touches: How many each episode has.

    Returns:
        Estimates (touches + 1,).
    """
    return wilson_interval(np.asarray(first)[:, None] > np.arange(touches + 1)[None])


class TouchesToConfidence(NamedTuple):
    """Touches until confident; an episode that never was confident counts in the mean as all its touches."""

    mean: Estimate
    median: Estimate  # infinite where half of them never were; limits from order statistics
    never: Estimate  # share


def touches_to_confidence(first: Shaped[Array, " e"], touches: int) -> TouchesToConfidence:
    """Summarise how many touches it takes to be confident.

    Args:
        first: Of each episode, as `confident_at`.
        touches: How many each episode has.
    """
    first = np.asarray(first, np.float64)
    limits = stats.quantile_test(first, p=0.5).confidence_interval(COVERAGE)
    middle = np.quantile(first, 0.5, method="inverted_cdf")
    return TouchesToConfidence(
        student_interval(np.minimum(first, touches)),
        Estimate(middle, np.asarray(limits.low), np.asarray(limits.high)),
        wilson_interval(np.isinf(first)),
    )


def touches_saved(first: Shaped[Array, " e"], other: Shaped[Array, " e"], touches: int, seed: int = 0) -> Estimate:
    """By what share the restricted mean number of touches until confident is less than that of another policy.

    Paired bootstrap over the episodes. Episodes in which neither becomes confident count as equal, so a limit on
    touches hides part of what is saved.

    Args:
        first: Of each episode under this policy, as `confident_at`.
        other: The same under the other policy.
        touches: How many each episode has.
        seed: Of the bootstrap.
    """
    mine, theirs = (np.minimum(x, touches).astype(np.float64) for x in (first, other))

    def share_saved(a: np.ndarray, b: np.ndarray, axis: int = -1) -> Array:
        return 1 - a.mean(axis) / b.mean(axis)

    return _bootstrap((mine, theirs), share_saved, paired=True, seed=seed)


# --- unknown objects ---


def auroc(p_unknown: Shaped[Array, "e t"], unknown: Bool[Array, " e"], seed: int = 0) -> Estimate:
    """Area under the receiver operating characteristic of detecting unknown objects: the probability that an episode
    with an unknown object has more in the unknown class than one without, equal ones counted half.

    Args:
        p_unknown: Probability of the unknown class.
        unknown: Whether the object was unknown.
        seed: Of the bootstrap, in which known and unknown episodes are resampled apart.

    Returns:
        Estimates (t,).

    Raises:
        ValueError: Episodes of one kind are missing.
    """
    p_unknown, unknown = np.asarray(p_unknown, np.float64), np.asarray(unknown, bool)
    if unknown.all() or not unknown.any():
        raise ValueError("auroc: it needs episodes with and without an unknown object")
    areas = [_bootstrap((x[unknown], x[~unknown]), _area, paired=False, seed=seed) for x in p_unknown.T]
    return Estimate(*(np.array(column) for column in zip(*areas, strict=True)))


def _area(above: np.ndarray, below: np.ndarray, axis: int = -1) -> Array:
    """Mann and Whitney's statistic, as a share of all pairs."""
    n, m = above.shape[axis], below.shape[axis]
    ranks = stats.rankdata(np.concatenate([above, below], axis), axis=axis)
    return (np.take(ranks, np.arange(n), axis).sum(axis) - n * (n + 1) / 2) / (n * m)


class OpenSetAccuracy(NamedTuple):
    """Right decisions after each touch, (t,), where the unknown class is one of the classes."""

    known: Estimate  # of episodes with a known object
    unknown: Estimate  # of those without
    overall: Estimate  # of a mixture with the given share of unknown objects


def open_set_accuracy(
    p: Float[Array, "e t objects"],
    p_unknown: Float[Array, "e t"],
    truth: Int[Array, " e"],
    share: float,
    prior: float | None = None,
) -> OpenSetAccuracy:
    """Decide among the known objects and the unknown class, as if a share of the episodes had an unknown object.

    The overall interval combines the two others' (Zou and Donner, Statistics in Medicine 27, 2008).

    Args:
        p: Probabilities of the known objects.
        p_unknown: Probability of the unknown class.
        truth: Objects that were there, -1 for unknown ones.
        share: Share of unknown objects, in [0, 1].
        prior: Prior probability of unknown objects from which these beliefs come. Given it, beliefs get `share` as
            their prior first.
    """
    truth = np.asarray(truth)
    if prior is not None:
        p, p_unknown = with_unknown_prior(p, p_unknown, prior, share)
    hit = hits(*with_unknown_class(p, p_unknown, truth))
    known, unknown = wilson_interval(hit[truth >= 0]), wilson_interval(hit[truth < 0])
    parts = [(part, weight) for part, weight in ((known, 1 - share), (unknown, share)) if weight > 0]
    mean = np.sum([weight * part.mean for part, weight in parts], 0)
    below = np.sqrt(np.sum([(weight * (part.mean - part.low)) ** 2 for part, weight in parts], 0))
    above = np.sqrt(np.sum([(weight * (part.high - part.mean)) ** 2 for part, weight in parts], 0))
    return OpenSetAccuracy(known, unknown, Estimate(mean, mean - below, mean + above))


def of_truth(values: Shaped[Array, "..."], truth: Int[Array, "..."]) -> Float[Array, "e t"]:
    """The values of the classes that were there.

    Args:
        values: (episodes, touches, classes).
        truth: (episodes,) classes that were there.

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


def _bootstrap(
    samples: tuple[np.ndarray, np.ndarray], statistic: Callable[..., Array], paired: bool, seed: int
) -> Estimate:
    """A statistic of two samples with its percentile interval."""
    found = stats.bootstrap(
        samples,
        statistic,
        paired=paired,
        method="percentile",
        n_resamples=RESAMPLES,
        confidence_level=COVERAGE,
        batch=100,
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Estimate(statistic(*samples), np.asarray(found.low), np.asarray(found.high))
