"""Scores with unknown objects: the unknown class, its prior, and its recognition.

Beliefs and truths are as in `i2t.recognition.metrics`, intervals as in `i2t.recognition.intervals`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from i2t.recognition.intervals import Clusters, Estimate, bootstrap_clusters, rate_interval, rows_of
from i2t.recognition.metrics import hits
from i2t.types import Array


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


def auroc(
    p_unknown: Shaped[Array, "e t"], unknown: Bool[Array, " e"], *, clusters: Clusters = (), seed: int = 0
) -> Estimate:
    """Area under the receiver operating characteristic of detecting unknown objects: the probability that an episode
    with an unknown object has more in the unknown class than one without, equal ones counted half.

    Args:
        p_unknown: Probability of the unknown class.
        unknown: Whether the object was unknown.
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.
        seed: Of the bootstrap.

    Returns:
        Estimates (t,).

    Raises:
        ValueError: Episodes of one kind are missing.
    """
    p_unknown, unknown = np.asarray(p_unknown, np.float64), np.asarray(unknown, bool)
    if unknown.all() or not unknown.any():
        raise ValueError("auroc: it needs episodes with and without an unknown object")

    def areas(weight: np.ndarray) -> np.ndarray:
        return np.array([_area(x[unknown], x[~unknown], weight[unknown], weight[~unknown]) for x in p_unknown.T])

    found = bootstrap_clusters(areas, clusters, len(unknown), seed=seed)
    # Few clusters make intervals of Student's t wider than what an area can be.
    return found._replace(low=np.maximum(found.low, 0.0), high=np.minimum(found.high, 1.0))


def _area(above: np.ndarray, below: np.ndarray, w_above: np.ndarray, w_below: np.ndarray) -> float:
    """Mann and Whitney's statistic of weighted values, as a share of all pairs; NaN where a side has no weight."""
    values, place = np.unique(np.concatenate([above, below]), return_inverse=True)
    up = np.bincount(place[: len(above)], w_above, len(values))
    down = np.bincount(place[len(above) :], w_below, len(values))
    pairs = up.sum() * down.sum()
    return float(np.sum(up * (np.cumsum(down) - down / 2)) / pairs) if pairs else float("nan")


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
    *,
    prior: float | None = None,
    clusters: Clusters = (),
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
        clusters: Factors in which episodes are alike, as of `cluster_interval`; none if they are independent.

    Returns:
        Rates of right decisions.
    """
    truth = np.asarray(truth)
    if prior is not None:
        p, p_unknown = with_unknown_prior(p, p_unknown, prior, share)
    hit = hits(*with_unknown_class(p, p_unknown, truth))
    known, unknown = (rate_interval(hit[rows], rows_of(clusters, rows)) for rows in (truth >= 0, truth < 0))
    parts = [(part, weight) for part, weight in ((known, 1 - share), (unknown, share)) if weight > 0]
    mean = np.sum([weight * part.mean for part, weight in parts], 0)
    below = np.sqrt(np.sum([(weight * (part.mean - part.low)) ** 2 for part, weight in parts], 0))
    above = np.sqrt(np.sum([(weight * (part.high - part.mean)) ** 2 for part, weight in parts], 0))
    return OpenSetAccuracy(known, unknown, Estimate(mean, mean - below, mean + above))
