"""Methods that recognise the label of a series of readings. They are fitted to training rows only.

A classifier predicts p(label | reading) for each touch. The paper's rules (`i2t.paper.rules`), votes, average and
product, combine several touches, with -log p as the distance of a touch from a label. The calibrated belief is the
product at a temperature that grows with the number of touches (`i2t.recognition.calibrated`), because errors that the
touches of a session share do not average out.

The classifier is chosen, and the temperature fitted, on two folds of the training rows in the proportion of the test:
the first rows of each label are for training and the last for validation, and the reverse. Rows are not shuffled,
because errors that a session's touches share would be on both sides. If readings later drift faster, the calibration is
off.
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
class ClassifierConfig:
    """Settings of the classifiers, fixed before testing."""

    trees: int = 200
    neighbours: int = 5
    quantiles: int = 100  # of each column, for the normalisation before the logistic regression
    inverse_penalty: float = 0.3  # of the logistic regression


CONFIG = ClassifierConfig()
TREES, LOGISTIC, BOTH, KNN = "extra trees", "logistic regression", "trees and logistic regression", "neighbours"
CANDIDATES = (TREES, LOGISTIC, BOTH, KNN)

Rows = Int[np.ndarray, " k"]
LogP = Float[np.ndarray, "n classes"]


class Labelled(NamedTuple):
    """Readings and their labels, 0 to classes - 1, in chronological order."""

    reading: Float[np.ndarray, "n d"]
    label: Int[np.ndarray, " n"]

    def at(self, rows: Rows) -> "Labelled":
        """Select rows."""
        return Labelled(self.reading[rows], self.label[rows])

    def without(self, labels: Rows) -> "Labelled":
        """Select the rows of the other labels, which are renumbered."""
        kept = self.at(np.flatnonzero(~np.isin(self.label, labels)))
        return Labelled(kept.reading, np.unique(kept.label, return_inverse=True)[1])


class TouchSeries(NamedTuple):
    """Rows of the touches of each episode, and its label."""

    rows: Int[np.ndarray, "e t"]
    truth: Int[np.ndarray, " e"]


class ClassifierChoice(NamedTuple):
    """The classifier and temperature that were chosen on the folds."""

    classifier: str
    temperature: TemperatureScaling
    losses: dict[str, float]  # log loss of the calibrated belief in the folds, by classifier


def draw_series(label: Int[np.ndarray, " n"], each: int, most: int, seed: int) -> TouchSeries:
    """Draw episodes without replacement from the rows of one label at a time.

    Args:
        label: Label of each row, `(n,)`.
        each: Number of episodes of each label.
        most: Number of touches in an episode; fewer if a label has fewer rows.
        seed: Seed of the draws.

    Returns:
        The episodes, with the same number of touches each.
    """
    rng = np.random.default_rng(seed)
    of_label = [np.flatnonzero(label == c) for c in np.unique(label)]
    count = min(most, *map(len, of_label))
    drawn = [rng.permutation(rows)[:count] for rows in of_label for _ in range(each)]
    return TouchSeries(np.array(drawn), np.repeat(np.unique(label), each))


def folds_in_time(label: Int[np.ndarray, " n"], share: float) -> Iterator[tuple[Rows, Rows]]:
    """Split rows into training and validation: first with the first share of each label's rows for training, then with
    the last share.
    """
    for step in (1, -1):
        of_label = [np.flatnonzero(label == c)[::step] for c in np.unique(label)]
        parts = [np.split(rows, [count_for_training(len(rows), share)]) for rows in of_label]
        yield np.sort(np.concatenate([p[0] for p in parts])), np.sort(np.concatenate([p[1] for p in parts]))


# --- one touch ---


def log_probabilities(name: str, train: Labelled, reading: Float[np.ndarray, "n d"], seed: int) -> LogP:
    """Fit a classifier, and predict log p(label | reading) with a share of outliers.

    Args:
        name: One of `CANDIDATES`.
        train: Training rows of every label.
        reading: Readings to classify, `(n, d)`.
        seed: Seed of the classifier's random choices.

    Returns:
        Normalised log probabilities, `(n, classes)`.
    """
    if name == BOTH:
        trees, logistic = (log_probabilities(part, train, reading, seed) for part in (TREES, LOGISTIC))
        return _geometric_mean(trees, logistic)
    rows = len(train.label)
    model: Any = {
        TREES: lambda: ExtraTreesClassifier(CONFIG.trees, random_state=seed),
        LOGISTIC: lambda: make_pipeline(
            QuantileTransformer(
                n_quantiles=min(CONFIG.quantiles, rows), output_distribution="normal", random_state=seed
            ),
            LogisticRegression(C=CONFIG.inverse_penalty, max_iter=1000),
        ),
        KNN: lambda: make_pipeline(
            StandardScaler(), KNeighborsClassifier(min(CONFIG.neighbours, rows), weights="distance")
        ),
    }[name]()  # fmt: skip
    p = model.fit(train.reading, train.label).predict_proba(reading)
    return np.log(with_outliers(p))


def novelty(train: Labelled, reading: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Compute the distance of each reading from the nearest training reading, in standard deviations of the columns."""
    scale = StandardScaler().fit(train.reading)
    nearest = NearestNeighbors(n_neighbors=1).fit(scale.transform(train.reading))
    return nearest.kneighbors(scale.transform(reading))[0][:, 0]


def _geometric_mean(first: LogP, second: LogP) -> LogP:
    mean = (first + second) / 2
    return mean - np.log(np.exp(mean).sum(1, keepdims=True))


def all_log_probabilities(train: Labelled, reading: Float[np.ndarray, "n d"], seed: int) -> dict[str, LogP]:
    """Compute the log probabilities by all `CANDIDATES`, by name."""
    log_p = {name: log_probabilities(name, train, reading, seed) for name in CANDIDATES if name != BOTH}
    return {**log_p, BOTH: _geometric_mean(log_p[TREES], log_p[LOGISTIC])}


# --- several touches ---


def product(log_p: Float[np.ndarray, "e t classes"]) -> Float[np.ndarray, "e t classes"]:
    """Compute the normalised product of the probabilities of the touches so far."""
    return softmax(np.cumsum(log_p, axis=1), axis=-1)


class Fold(NamedTuple):
    """Log probabilities of the touches in a fold's episodes, by classifier, and the labels of the episodes."""

    log_p: Mapping[str, Float[np.ndarray, "e t classes"]]
    truth: Int[np.ndarray, " e"]

    def without(self, labels: Int[np.ndarray, " k"]) -> "Fold":
        """Remove labels with their episodes; the other labels are renumbered."""
        kept = np.setdiff1d(np.arange(next(iter(self.log_p.values())).shape[-1]), labels)
        rows = np.isin(self.truth, kept)
        log_p = {name: values[rows][..., kept] for name, values in self.log_p.items()}
        return Fold(log_p, np.searchsorted(kept, self.truth[rows]))


def judge_folds(train: Labelled, share: float, each: int, most: int, seed: int) -> list[Fold]:
    """Predict the validation rows of both folds with every classifier.

    Args:
        train: Training rows in chronological order.
        share: Share of a label's rows for training.
        each: Number of episodes of each label in each fold.
        most: Number of touches in an episode.
        seed: Seed of classifiers and draws.

    Returns:
        The two folds.
    """
    folds = []
    for training, validation in folds_in_time(train.label, share):
        test = train.at(validation)
        series = draw_series(test.label, each, most, seed)
        log_p = all_log_probabilities(train.at(training), test.reading, seed)
        folds.append(Fold({name: values[series.rows] for name, values in log_p.items()}, series.truth))
    return folds


def choose(folds: Sequence[Fold], among: Sequence[str] = CANDIDATES) -> ClassifierChoice:
    """Choose the classifier whose calibrated belief has the least log loss in the folds of all groups.

    Args:
        folds: Folds of all groups.
        among: Names of the candidate classifiers.

    Returns:
        The classifier, with the temperature for its product.
    """
    fits: dict[str, tuple[float, TemperatureScaling]] = {}
    smoothing = 1 / (1 + sum(len(np.unique(fold.truth)) for fold in folds))  # like one more session of any label
    for name in among:
        sets = [(product(fold.log_p[name]), fold.truth) for fold in folds]
        temperature = fit_temperature_to_sets(sets, smoothing=smoothing)
        losses = [log_loss(calibrated_beliefs(p, temperature), truth) for p, truth in sets]
        fits[name] = float(np.concatenate([loss.ravel() for loss in losses]).mean()), temperature
    best = min(fits, key=lambda name: fits[name][0])
    return ClassifierChoice(best, fits[best][1], {name: loss for name, (loss, _) in fits.items()})
