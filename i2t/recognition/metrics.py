"""How good beliefs about objects are: accuracy, calibration, conformal sets, stopping, unknown objects.

An array of beliefs p (e, t, c) holds the probabilities of c classes after each of t touches in e episodes, `truth` (e,)
the class that was there. Where the object may be none of those known, `with_none` makes that the last class. Episodes
are independent, the touches within one are not, so every interval is over episodes (or seeds) and covers 95 %: Wilson's
for rates (JASA 22, 1927), Student's t for means, the percentile bootstrap for ratios and ranks. NumPy, because nothing
here is differentiated.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import optimize, stats
from scipy.special import expit, logit, logsumexp

from i2t.recognition import belief
from i2t.recognition.belief import Temper

LEVEL = 0.95
RESAMPLES = 1000
TIE = 1e-6  # probabilities that differ by less are equal: sums of votes in float32
LEAST = 1e-6  # probability below which a logarithm is not followed
BINS = 15


class Estimate(NamedTuple):
    """Means with their intervals; floats, or arrays of one shape."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


# --- intervals ---


def rate(values: np.ndarray) -> Estimate:
    """Mean and Wilson's interval of values (n, ...) between 0 and 1; NaN without any.

    Fractions, which shared ties give, are welcome: nothing in [0, 1] varies more than a coin of the same mean.
    """
    values = np.asarray(values, np.float64)
    n, z = len(values), stats.norm.ppf((1 + LEVEL) / 2)
    if not n:
        unknown = np.full(values.shape[1:], np.nan)
        return Estimate(unknown, unknown, unknown)
    mean = values.mean(0)
    centre = (mean + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(mean * (1 - mean) / n + z**2 / (4 * n**2))
    return Estimate(mean, np.minimum(centre - half, mean), np.maximum(centre + half, mean))


def student(values: np.ndarray) -> Estimate:
    """Mean and Student's t interval of independent values (n, ...), episodes or seeds; NaN limits for a single one."""
    values = np.asarray(values, np.float64)
    n, mean = len(values), values.mean(0)
    if n < 2:
        return Estimate(mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan))
    half = stats.t.ppf((1 + LEVEL) / 2, n - 1) * values.std(0, ddof=1) / np.sqrt(n)
    return Estimate(mean, mean - half, mean + half)


def plain(values: Any) -> Any:
    """Scores as JSON has them: fields by name, arrays as lists."""
    if hasattr(values, "_asdict"):
        return {name: plain(value) for name, value in values._asdict().items()}
    return values.tolist() if isinstance(values, np.ndarray | np.generic) else values


# --- accuracy ---


def with_none(p: np.ndarray, none: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Beliefs (e, t, objects + 1) in which "none of these" (e, t) is the last class, and the class of unknown objects
    (`truth` -1) is that.
    """
    joined = np.concatenate([np.asarray(p), np.asarray(none)[..., None]], axis=-1)
    return joined, np.where(np.asarray(truth) < 0, joined.shape[-1] - 1, truth)


def with_prior(p: np.ndarray, none: np.ndarray, was: float, now: float) -> tuple[np.ndarray, np.ndarray]:
    """The same beliefs had unknown objects had the prior probability `now` instead of `was` (both below 1)."""
    if not (0 < was < 1 and 0 <= now < 1):
        raise ValueError(f"with_prior: priors {was} and {now} must lie in (0, 1) and [0, 1)")
    odds = now / (1 - now) * (1 - was) / was
    joined = np.concatenate([np.asarray(p, np.float64), odds * np.asarray(none, np.float64)[..., None]], axis=-1)
    total = joined.sum(-1, keepdims=True)
    # A belief that had ruled out all objects and may no longer doubt them knows nothing.
    rest = np.append(np.full(np.shape(p)[-1], 1 / np.shape(p)[-1]), 0)
    joined = np.where(total > 0, joined / np.where(total > 0, total, 1), rest)
    return joined[..., :-1], joined[..., -1]


def among(p: np.ndarray, truth: np.ndarray, candidates: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The problem of some classes alone: beliefs (e', t, candidates) of the episodes in which one of them was there,
    which one (e',), and the numbers (e',) of those episodes. Beliefs without weight on any of them become uniform.
    """
    match = np.asarray(truth)[:, None] == np.asarray(candidates)[None]
    rows = np.flatnonzero(match.any(1))
    kept = np.asarray(p, np.float64)[rows][..., candidates]
    total = kept.sum(-1, keepdims=True)
    kept = np.where(total > 0, kept / np.where(total > 0, total, 1), 1 / len(candidates))
    return kept, match[rows].argmax(1), rows


def decisions(p: np.ndarray) -> np.ndarray:
    """Share (..., c) of the decision that each class has: 1 for the most probable one, equal parts where several are
    it, so that no order of the classes is favoured.
    """
    p = np.asarray(p, np.float64)
    best = p >= p.max(-1, keepdims=True) - TIE
    return best / best.sum(-1, keepdims=True)


def hits(p: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Whether each decision is right, (e, t); 1/n where the truth ties with n - 1 others."""
    return _at(decisions(p), truth)


def accuracy(p: np.ndarray, truth: np.ndarray) -> Estimate:
    """Share of right decisions after each touch, (t,)."""
    return rate(hits(p, truth))


def mean_accuracy(p: np.ndarray, truth: np.ndarray) -> Estimate:
    """Share of right decisions, mean over touches 1 to t."""
    return student(hits(p, truth).mean(1))


def confusion(p: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How often (c, c) each class, in rows, was taken for each, in columns, by beliefs p (e, c)."""
    counts = np.zeros((np.shape(p)[-1],) * 2)
    np.add.at(counts, np.asarray(truth), decisions(p))
    return counts


class Paired(NamedTuple):
    """One method less another on the same episodes."""

    last: Estimate  # accuracy after the last touch
    last_p: float  # McNemar's exact test; where ties are shared, the sign test
    mean: Estimate  # mean accuracy over touches
    mean_p: float  # paired t test


def paired(hit: np.ndarray, other: np.ndarray) -> Paired:
    """Compare the `hits` (e, t) of a method with those of another on the same episodes."""
    hit, other = np.asarray(hit, np.float64), np.asarray(other, np.float64)
    if hit.shape != other.shape or len(hit) < 2:
        raise ValueError(f"paired: hits {hit.shape} and {other.shape} must be of the same episodes, two at least")
    last, mean = hit[:, -1] - other[:, -1], (hit - other).mean(1)
    return Paired(student(last), sign_test(last), student(mean), _t_test(mean))


def sign_test(difference: np.ndarray) -> float:
    """Two-sided exact p of as many differences above zero as below; of right-or-wrong answers it is McNemar's."""
    above, below = int((difference > 0).sum()), int((difference < 0).sum())
    return float(stats.binomtest(above, above + below).pvalue) if above + below else 1.0


def _t_test(difference: np.ndarray) -> float:
    mean, error = difference.mean(), difference.std(ddof=1) / np.sqrt(len(difference))
    if error == 0:
        return float(mean == 0)
    return float(2 * stats.t.sf(abs(mean) / error, len(difference) - 1))


# --- calibration ---


def confidence(p: np.ndarray) -> np.ndarray:
    """Probability (e, t) of the class decided for."""
    return np.asarray(p, np.float64).max(-1)


class Reliability(NamedTuple):
    """Decisions sorted by their confidence into b bins; NaN in those that are empty."""

    number: np.ndarray  # (b,) of decisions
    confidence: np.ndarray  # (b,) mean
    frequency: Estimate  # (b,) of right ones


def fit_temper(p: np.ndarray, truth: np.ndarray) -> Temper:
    """The temperature with which these beliefs would have had the least log loss over all touches."""
    touches = np.arange(1, p.shape[1] + 1, dtype=np.float64)
    logs = np.log(np.maximum(np.asarray(p, np.float64), belief.LEAST))

    def loss(x: np.ndarray) -> float:
        scaled = logs / Temper(np.exp(x[0]), np.exp(x[1])).temperature(touches)[None, :, None]
        right = np.take_along_axis(scaled, np.asarray(truth)[:, None, None], -1)[..., 0]
        return float(np.mean(logsumexp(scaled, axis=-1) - right))

    found = optimize.minimize(loss, (0.0, np.log(0.05)), method="Nelder-Mead", bounds=((-2.0, 2.0), (-12.0, 1.0)))
    return Temper(float(np.exp(found.x[0])), float(np.exp(found.x[1])))


def sobered(p: np.ndarray, temper: Temper = belief.TEMPER) -> np.ndarray:
    """Beliefs (e, t, c) of whole episodes, no surer than they should be (`i2t.recognition.belief.tempered`)."""
    touches = np.broadcast_to(np.arange(1, p.shape[1] + 1, dtype=np.float32), p.shape[:2])
    return np.asarray(belief.tempered(jnp.asarray(p), jnp.asarray(touches), temper), np.float64)


def reliability(sure: np.ndarray, hit: np.ndarray, bins: int = BINS, equal_mass: bool = False) -> Reliability:
    """Sort decisions of confidence `sure`, right or not by `hit` (arrays of one shape), into bins of equal width (as
    Guo et al., ICML 2017) or of equal count.

    The intervals take decisions as independent: one touch of each episode.
    """
    sure, hit = np.ravel(sure), np.ravel(hit)
    which = _bins(sure, bins, equal_mass)
    rows = [which == i for i in range(bins)]
    frequency = [rate(hit[row]) for row in rows]
    return Reliability(
        np.array([row.sum() for row in rows]),
        np.array([sure[row].mean() if row.any() else np.nan for row in rows]),
        Estimate(*(np.array(column) for column in zip(*frequency, strict=True))),
    )


class CalibrationError(NamedTuple):
    """Expected calibration error, beside what the same confidences give by chance if they are right."""

    error: float
    chance: float  # mean
    chance_high: float  # 95 % of its draws are below


def calibration_error(
    sure: np.ndarray, hit: np.ndarray, bins: int = BINS, equal_mass: bool = False, seed: int = 0
) -> CalibrationError:
    """Mean over decisions of |frequency - confidence| of their bin (Guo et al., ICML 2017; top class).

    Few decisions to a bin make it positive for any forecaster, so it comes with its distribution for decisions that
    are right as often as they claim (consistency resampling; Bröcker and Smith, Weather and Forecasting 22, 2007),
    independent of each other: give one touch of each episode.
    """
    sure, hit = np.ravel(np.asarray(sure, np.float64)), np.ravel(hit)
    which = _bins(sure, bins, equal_mass)
    drawn = np.random.default_rng(seed).random((RESAMPLES, len(sure))) < sure
    chance = [_gap(sure, draw, which, bins) for draw in drawn]
    return CalibrationError(_gap(sure, hit, which, bins), float(np.mean(chance)), float(np.quantile(chance, LEVEL)))


def _gap(sure: np.ndarray, hit: np.ndarray, which: np.ndarray, bins: int) -> float:
    return float(np.abs(np.bincount(which, hit - sure, minlength=bins)).sum() / len(sure))


def _bins(sure: np.ndarray, bins: int, equal_mass: bool) -> np.ndarray:
    if equal_mass:
        return np.argsort(np.argsort(sure, kind="stable"), kind="stable") * bins // len(sure)
    return np.clip((sure * bins).astype(int), 0, bins - 1)


def log_loss(p: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Minus the logarithm of the probability (e, t) of the truth, followed down to `LEAST`."""
    return -np.log(np.clip(_at(p, truth), LEAST, 1))


def brier(p: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Squared distance (e, t) of the probabilities from the truth, over all classes: 0 to 2 (Brier 1950)."""
    p = np.asarray(p, np.float64)
    return (p**2).sum(-1) - 2 * _at(p, truth) + 1


# --- conformal sets ---


class Conformal(NamedTuple):
    """Sets of classes that hold the truth with a given probability, after each touch."""

    threshold: np.ndarray  # (t,)
    coverage: Estimate  # (t,)
    size: Estimate  # (t,)


def conformal(
    p_validation: np.ndarray,
    truth_validation: np.ndarray,
    p: np.ndarray,
    truth: np.ndarray,
    level: float = 0.9,
    seed: int = 0,
) -> Conformal:
    """Randomised adaptive prediction sets (Romano, Sesia and Candès, NeurIPS 2020) with thresholds from validation
    episodes, tried on others; exact in expectation whatever the beliefs, at the price of empty sets where they are
    surer than `level`.
    """
    rng = np.random.default_rng(seed)
    scores = np.sort(_at(_masses(p_validation, rng), truth_validation), axis=0)
    rank = int(np.ceil((len(scores) + 1) * level))
    threshold = scores[rank - 1] if rank <= len(scores) else np.full(scores.shape[1], np.inf)
    sets = _masses(p, rng) <= threshold[None, :, None]
    return Conformal(threshold, rate(_at(sets, truth)), student(sets.sum(-1)))


def _masses(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Probability of the classes above each, plus a random part, the same for all, of its own; equal ones in random
    order.
    """
    p = np.asarray(p, np.float64)
    order = np.lexsort((rng.random(p.shape), -p), axis=-1)
    ranked = np.take_along_axis(p, order, -1)
    mass = np.cumsum(ranked, -1) - ranked * rng.random((*p.shape[:-1], 1))
    return np.take_along_axis(mass, np.argsort(order, -1), -1)


# --- stopping ---


class Stopping(NamedTuple):
    """Decisions taken at the first touch after which the belief is as sure as asked, else after the last one."""

    asked: float
    error: Estimate  # share of wrong decisions
    promised: float  # mean of 1 - the belief decided on, which `error` should equal
    stopped: Estimate  # share that was as sure as asked
    stopped_error: Estimate  # among those
    stopped_promised: float
    touches: Estimate


def stopping(p: np.ndarray, truth: np.ndarray, error: float) -> Stopping:
    """Stop as soon as the most probable class has at least 1 - `error`."""
    sure, hit = confidence(p), hits(p, truth)
    first = sure_at(p, 1 - error)
    stopped = np.isfinite(first)
    last = np.where(stopped, first, sure.shape[1]).astype(int)
    wrong, doubt = (np.take_along_axis(1 - x, last[:, None] - 1, 1)[:, 0] for x in (hit, sure))
    promised = float(doubt[stopped].mean()) if stopped.any() else float("nan")
    return Stopping(
        error, rate(wrong), float(doubt.mean()), rate(stopped), rate(wrong[stopped]), promised, student(last)
    )


def sure_at(p: np.ndarray, level: float = 0.95) -> np.ndarray:
    """Number (e,) of touches until some class has probability `level`; infinite where that never happens."""
    sure = confidence(p) >= level
    return np.where(sure.any(1), sure.argmax(1) + 1.0, np.inf)


def unsure(first: np.ndarray, touches: int) -> Estimate:
    """Share of episodes still unsure after 0, 1, ... `touches` touches, (touches + 1,), from `sure_at` (e,)."""
    return rate(np.asarray(first)[:, None] > np.arange(touches + 1)[None])


class Until(NamedTuple):
    """Touches until sure. The mean is restricted: an episode that never was sure counts as all its touches."""

    mean: Estimate
    median: Estimate  # infinite where the half were never sure; limits from order statistics
    never: Estimate  # share


def until(first: np.ndarray, touches: int) -> Until:
    """Summarise `sure_at` (e,) of episodes of so many touches."""
    first = np.asarray(first, np.float64)
    limits = stats.quantile_test(first, p=0.5).confidence_interval(LEVEL)
    middle = np.quantile(first, 0.5, method="inverted_cdf")
    return Until(
        student(np.minimum(first, touches)),
        Estimate(middle, np.asarray(limits.low), np.asarray(limits.high)),
        rate(np.isinf(first)),
    )


def saved(first: np.ndarray, other: np.ndarray, touches: int, seed: int = 0) -> Estimate:
    """By what share the restricted mean number of touches until sure is less than that of another policy on the same
    episodes; paired bootstrap. Episodes that neither ends count as equal, so a limit on touches hides part of it.
    """
    mine, theirs = (np.minimum(x, touches).astype(np.float64) for x in (first, other))
    return _bootstrap((mine, theirs), lambda a, b, axis=-1: 1 - a.mean(axis) / b.mean(axis), True, seed)


# --- unknown objects ---


class Odds(NamedTuple):
    """How odds of "none of these" are to be read: their logarithm after t touches times slope / (1 + growth (t - 1)),
    plus `offset`. What is wrong of the pad or the place at every touch, touches taken one by one do not know.
    """

    offset: float
    slope: float
    growth: float = 0.0

    def read(self, none: np.ndarray, touches: np.ndarray | float) -> np.ndarray:
        """Probabilities."""
        return expit(self.offset + self.slope / (1 + self.growth * (touches - 1)) * _log_odds(none))


def fit_odds(none: np.ndarray, unknown: np.ndarray) -> Odds:
    """The reading of "none of these" (e, t) that has the least log loss over all touches of episodes with and without
    an unknown object (e, bool): logistic regression (Platt, 1999).
    """
    at, touches = _log_odds(none), np.arange(1, np.shape(none)[1] + 1)
    sign = np.where(np.asarray(unknown, bool), 1.0, -1.0)[:, None]

    def loss(x: np.ndarray) -> float:
        return float(np.mean(np.logaddexp(0, -sign * (x[0] + x[1] / (1 + x[2] * (touches - 1)) * at))))

    bounds = (-20.0, 20.0), (0.01, 10.0), (0.0, 10.0)
    found = optimize.minimize(loss, (0.0, 1.0, 0.0), method="Nelder-Mead", bounds=bounds)
    return Odds(*(float(x) for x in found.x))


def with_odds(p: np.ndarray, none: np.ndarray, odds: Odds) -> tuple[np.ndarray, np.ndarray]:
    """Beliefs (e, t, objects) whose "none of these" (e, t) is read so; the objects keep their shares of the rest."""
    read = odds.read(none, np.arange(1, np.shape(none)[1] + 1))
    p = np.asarray(p, np.float64)
    total = p.sum(-1, keepdims=True)
    share = np.where(total > 0, p / np.where(total > 0, total, 1), 1 / p.shape[-1])
    return share * (1 - read)[..., None], read


def _log_odds(p: np.ndarray) -> np.ndarray:
    """Logarithm of the odds, at most as sure as single precision says."""
    return logit(np.clip(np.asarray(p, np.float64), LEAST, 1 - LEAST))


def auroc(none: np.ndarray, unknown: np.ndarray, seed: int = 0) -> Estimate:
    """Probability (t,) that "none of these" (e, t) is higher in an episode with an unknown object (e, bool) than in
    one without, equal ones counted half: the area under the receiver operating characteristic. Known and unknown
    episodes are resampled apart.
    """
    none, unknown = np.asarray(none, np.float64), np.asarray(unknown, bool)
    if unknown.all() or not unknown.any():
        raise ValueError("auroc: it needs episodes with and without an unknown object")
    areas = [_bootstrap((x[unknown], x[~unknown]), _area, False, seed) for x in none.T]
    return Estimate(*(np.array(column) for column in zip(*areas, strict=True)))


def _area(above: np.ndarray, below: np.ndarray, axis: int = -1) -> np.ndarray:
    n, m = above.shape[axis], below.shape[axis]
    ranks = stats.rankdata(np.concatenate([above, below], axis), axis=axis)
    return (np.take(ranks, np.arange(n), axis).sum(axis) - n * (n + 1) / 2) / (n * m)


class OpenSet(NamedTuple):
    """Right decisions after each touch, (t,), where "none of these" is a class."""

    known: Estimate  # of episodes with a known object
    unknown: Estimate  # of those without
    overall: Estimate  # of a mixture with the given share of unknown


def open_set(p: np.ndarray, none: np.ndarray, truth: np.ndarray, share: float, prior: float | None = None) -> OpenSet:
    """Decide among the objects and none of them, as if a `share` of the episodes had an unknown object.

    With the `prior` probability of unknown objects from which the beliefs started, they are first given `share` as
    prior instead. The overall interval combines the two others' (Zou and Donner, Statistics in Medicine 27, 2008).
    """
    truth = np.asarray(truth)
    if prior is not None:
        p, none = with_prior(p, none, prior, share)
    hit = hits(*with_none(p, none, truth))
    known, unknown = rate(hit[truth >= 0]), rate(hit[truth < 0])
    parts = [(part, weight) for part, weight in ((known, 1 - share), (unknown, share)) if weight > 0]
    mean = np.sum([weight * part.mean for part, weight in parts], 0)
    below = np.sqrt(np.sum([(weight * (part.mean - part.low)) ** 2 for part, weight in parts], 0))
    above = np.sqrt(np.sum([(weight * (part.high - part.mean)) ** 2 for part, weight in parts], 0))
    return OpenSet(known, unknown, Estimate(mean, mean - below, mean + above))


def _at(values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Values (e, t, c) of the classes that were there, (e, t)."""
    values, truth = np.asarray(values, np.float64), np.asarray(truth)
    if values.ndim != 3 or truth.shape != values.shape[:1]:
        raise ValueError(
            f"beliefs {values.shape} must be (episodes, touches, classes), truth {truth.shape} (episodes,)"
        )
    if truth.size and not (truth.min() >= 0 and truth.max() < values.shape[-1]):
        raise ValueError(
            f"truth: {truth.min()} to {truth.max()} are not classes 0 to {values.shape[-1] - 1}; "
            "add the unknown one with `with_none`"
        )
    return np.take_along_axis(values, truth[:, None, None], -1)[..., 0]


def _bootstrap(samples: tuple[np.ndarray, np.ndarray], statistic, paired: bool, seed: int) -> Estimate:
    found = stats.bootstrap(
        samples,
        statistic,
        paired=paired,
        method="percentile",
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        batch=100,
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Estimate(statistic(*samples), np.asarray(found.low), np.asarray(found.high))
