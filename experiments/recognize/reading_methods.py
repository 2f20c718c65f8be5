"""Methods that recognise the label of a series of readings, fitted to training rows alone.

A classifier gives p(label | reading) of each touch. The paper's rules (`i2t.paper.rules`) make one belief of several
touches, with -log p for the distance of a touch from a label: votes, average and product. The calibrated belief is the
product at a temperature that grows with the number of touches (`i2t.recognition.calibrated`), as errors that the
touches of a session share do not average out.

The classifier is chosen, and the temperature fitted, by two folds of the training rows in the proportion of the test:
the first rows of each label teach and the last ones judge, and the reverse. Rows are never mixed, as errors that a
session's touches share would then be on both sides; where they drift faster later than before, calibration is off.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import softmax
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.neighbors import KNeighborsClassifier, NearestNeighbors
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import QuantileTransformer, StandardScaler

from experiments.common.reading_tables import count_for_training, with_outliers
from i2t.recognition.calibrated import TemperatureScaling, calibrated_beliefs, fit_temperature_to_sets
from i2t.recognition.metrics import log_loss


@dataclass(frozen=True)
class Fixed:
    """What was fixed before testing."""

    trees: int = 200
    neighbours: int = 5
    quantiles: int = 100  # to which the columns are mapped for the logistic regression
    inverse_penalty: float = 0.3  # of the logistic regression


FIXED = Fixed()
TREES_NAME, LOGISTIC, BOTH, KNN = "extra trees", "logistic regression", "trees and logistic regression", "neighbours"
CANDIDATES = (TREES_NAME, LOGISTIC, BOTH, KNN)

Rows = Int[np.ndarray, " k"]
LogP = Float[np.ndarray, "n classes"]


class Labelled(NamedTuple):
    """Readings and their labels, 0 to classes - 1, in order of time."""

    reading: Float[np.ndarray, "n d"]
    label: Int[np.ndarray, " n"]

    def at(self, rows: Rows) -> "Labelled":
        """Some of the rows."""
        return Labelled(self.reading[rows], self.label[rows])

    def without(self, labels: Rows) -> "Labelled":
        """The rows of the other labels, which are counted anew."""
        kept = self.at(np.flatnonzero(~np.isin(self.label, labels)))
        return Labelled(kept.reading, np.unique(kept.label, return_inverse=True)[1])


class TouchSeries(NamedTuple):
    """Episodes: the rows of their touches, and the label of each."""

    rows: Int[np.ndarray, "e t"]
    truth: Int[np.ndarray, " e"]


class ClassifierChoice(NamedTuple):
    """What the folds chose."""

    classifier: str
    temperature: TemperatureScaling
    losses: dict[str, float]  # log loss of the calibrated belief in the folds, by classifier


def draw_series(label: Int[np.ndarray, " n"], each: int, most: int, seed: int) -> TouchSeries:
    """Draw episodes without replacement from the rows of one label at a time.

    Args:
        label: Of the rows.
        each: Episodes of each label.
        most: Touches of an episode; fewer if a label has fewer rows.
        seed: Of the draws.

    Returns:
        The episodes.
    """
    rng = np.random.default_rng(seed)
    of_label = [np.flatnonzero(label == c) for c in np.unique(label)]
    count = min(most, *map(len, of_label))
    drawn = [rng.permutation(rows)[:count] for rows in of_label for _ in range(each)]
    return TouchSeries(np.array(drawn), np.repeat(np.unique(label), each))


def folds_in_time(label: Int[np.ndarray, " n"], share: float) -> Iterator[tuple[Rows, Rows]]:
    """Rows that teach and rows that judge: the first share of each label's and the others, then the last share."""
    for step in (1, -1):
        of_label = [np.flatnonzero(label == c)[::step] for c in np.unique(label)]
        parts = [np.split(rows, [count_for_training(len(rows), share)]) for rows in of_label]
        yield np.sort(np.concatenate([p[0] for p in parts])), np.sort(np.concatenate([p[1] for p in parts]))


# --- one touch ---


def log_probabilities(name: str, train: Labelled, reading: Float[np.ndarray, "n d"], seed: int) -> LogP:
    """log p(label | reading) of a classifier, with a share of outliers.

    Args:
        name: One of `CANDIDATES`.
        train: With rows of every label.
        reading: To judge.
        seed: Of what is random in the classifier.

    Returns:
        Log probabilities, normalised.
    """
    if name == BOTH:
        one, other = (log_probabilities(part, train, reading, seed) for part in (TREES_NAME, LOGISTIC))
        return _both(one, other)
    rows = len(train.label)
    model: Any = {
        TREES_NAME: lambda: ExtraTreesClassifier(FIXED.trees, random_state=seed),
        LOGISTIC: lambda: make_pipeline(
            QuantileTransformer(
                n_quantiles=min(FIXED.quantiles, rows), output_distribution="normal", random_state=seed
            ),
            LogisticRegression(C=FIXED.inverse_penalty, max_iter=1000),
        ),
        KNN: lambda: make_pipeline(
            StandardScaler(), KNeighborsClassifier(min(FIXED.neighbours, rows), weights="distance")
        ),
    }[name]()  # fmt: skip
    p = model.fit(train.reading, train.label).predict_proba(reading)
    return np.log(with_outliers(p))


def novelty(train: Labelled, reading: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Distance of each reading from the nearest training reading, in standard deviations of the columns."""
    scale = StandardScaler().fit(train.reading)
    nearest = NearestNeighbors(n_neighbors=1).fit(scale.transform(train.reading))
    return nearest.kneighbors(scale.transform(reading))[0][:, 0]


def _both(one: LogP, other: LogP) -> LogP:
    """The geometric mean of two classifiers' probabilities."""
    mean = (one + other) / 2
    return mean - np.log(np.exp(mean).sum(1, keepdims=True))


def all_log_probabilities(train: Labelled, reading: Float[np.ndarray, "n d"], seed: int) -> dict[str, LogP]:
    """Those of all `CANDIDATES`, by name."""
    found = {name: log_probabilities(name, train, reading, seed) for name in CANDIDATES if name != BOTH}
    return {**found, BOTH: _both(found[TREES_NAME], found[LOGISTIC])}


# --- several touches ---


def product(log_p: Float[np.ndarray, "e t classes"]) -> Float[np.ndarray, "e t classes"]:
    """Normalised product of the probabilities of the touches so far."""
    return softmax(np.cumsum(log_p, axis=1), axis=-1)


class Fold(NamedTuple):
    """One fold's episodes: log probabilities of their touches by every classifier, and their labels."""

    log_p: Mapping[str, Float[np.ndarray, "e t classes"]]
    truth: Int[np.ndarray, " e"]

    def without(self, labels: Int[np.ndarray, " k"]) -> "Fold":
        """The same without episodes of some labels, which are not considered either; others are counted anew."""
        kept = np.setdiff1d(np.arange(next(iter(self.log_p.values())).shape[-1]), labels)
        rows = np.isin(self.truth, kept)
        log_p = {name: values[rows][..., kept] for name, values in self.log_p.items()}
        return Fold(log_p, np.searchsorted(kept, self.truth[rows]))


def judge_folds(train: Labelled, share: float, each: int, most: int, seed: int) -> list[Fold]:
    """Let every classifier judge the folds of training rows.

    Args:
        train: Rows in order of time.
        share: Of a label's rows, those that teach.
        each: Episodes of each label in each fold.
        most: Touches of an episode.
        seed: Of classifiers and draws.

    Returns:
        The folds.
    """
    folds = []
    for taught, judged in folds_in_time(train.label, share):
        test = train.at(judged)
        series = draw_series(test.label, each, most, seed)
        log_p = all_log_probabilities(train.at(taught), test.reading, seed)
        folds.append(Fold({name: values[series.rows] for name, values in log_p.items()}, series.truth))
    return folds


def choose(folds: Sequence[Fold], among: Sequence[str] = CANDIDATES) -> ClassifierChoice:
    """Choose the classifier whose calibrated belief has the least log loss in the folds of all groups.

    Args:
        folds: Of all groups.
        among: Names of classifiers.

    Returns:
        The classifier, with the temperature for its product.
    """
    found: dict[str, tuple[float, TemperatureScaling]] = {}
    smoothing = 1 / (1 + sum(len(np.unique(fold.truth)) for fold in folds))  # as of one session more, of any label
    for name in among:
        sets = [(product(fold.log_p[name]), fold.truth) for fold in folds]
        temperature = fit_temperature_to_sets(sets, smoothing=smoothing)
        losses = [log_loss(calibrated_beliefs(p, temperature), truth) for p, truth in sets]
        found[name] = float(np.concatenate([each.ravel() for each in losses]).mean()), temperature
    best = min(found, key=lambda name: found[name][0])
    return ClassifierChoice(best, found[best][1], {name: loss for name, (loss, _) in found.items()})
