"""Regressions from a reading to a target: the baselines and a Gaussian process (GP).

Every method is a function of features of a reading. What the features should be depends on the skin: a press twice as
deep reads several times as much in much the same direction, so that position is written in a reading's direction and
load in its length. `FEATURE_KINDS` names four ways to say that, and each method chooses one, with its other settings,
by the error on whole folds of the rows at hand.

Methods: the mean; ridge regression on the plain reading; the k nearest readings, weighted by their distance; and a GP
with a rational quadratic or a squared exponential covariance and a linear part (Rasmussen and Williams, "Gaussian
Processes for Machine Learning", 2006, algorithm 2.1, equations 4.9 and 4.19). NumPy.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve

from i2t.leave_one_out import leave_out_blocks
from i2t.recordings.diagnose.smooth import subsample

MEAN_TARGET, LINEAR_MAP, NEAREST_READINGS = "mean", "linear", "k nearest readings"
READINGS_GP = "Gaussian process"
HEAD_METHODS = (MEAN_TARGET, LINEAR_MAP, NEAREST_READINGS, READINGS_GP)
BASELINE_HEADS = (MEAN_TARGET, LINEAR_MAP, NEAREST_READINGS)
FEATURE_KINDS = ("plain", "by channel", "compressed", "direction")
PLAIN_FEATURES, COMPRESSED_FEATURES, DIRECTION_FEATURES = (
    FEATURE_KINDS.index(name) for name in ("plain", "compressed", "direction")
)

LINEAR_PENALTIES = tuple(10.0 ** np.arange(-6.0, 2.0))
READING_NEIGHBOURS = (1.0, 2.0, 4.0, 8.0, 16.0)
COVARIANCE_LENGTHS = (1.0, 0.5, 0.25, 2.0, 4.0, 8.0)  # of the covariance; features have mean square length 1
HEAD_NOISES = (1e-3, 1e-4, 1e-2, 3e-2, 1e-1)  # variance, of a target's
COVARIANCE_SHAPES = (2.0, 0.5, np.inf)  # of the rational quadratic; infinite is the squared exponential
LINEAR_PARTS = (1.0, 0.0)  # variance of the linear part, of a target's
COMPRESSION = 0.3  # of the readings' root mean square, where the inverse hyperbolic sine turns from linear to log
DIRECTION_FLOOR = 0.05  # of the readings' root mean square: a shorter reading has hardly a direction
JITTER_VARIANCE = 1e-9
SEARCH_ROUNDS = 2  # over the settings of a GP, one after the other

Settings: TypeAlias = tuple[float, ...]


class HeadBudget(NamedTuple):
    """Limits of a fit."""

    selection_rows: int = 700  # on which settings are chosen: the cost grows with the cube
    known_rows: int = 2500  # of a GP
    rows: int = 12000  # of a recording that are looked at


class FeatureMap(NamedTuple):
    """Map from readings to features, as arrays that a file can hold."""

    kind: Int[np.ndarray, ""]  # index into FEATURE_KINDS
    channel: Float[np.ndarray, " c"]  # uT, root mean square of each
    overall: Float[np.ndarray, ""]  # uT, root mean square of all
    middle: Float[np.ndarray, " k"]  # of the features before they are scaled
    spread: Float[np.ndarray, ""]  # root mean square distance from the middle

    def __call__(self, readings: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n k"]:
        """Features of readings, of mean square length 1 over the rows that the map was made of.

        Args:
            readings: uT.

        Returns:
            The features.
        """
        return (_unscaled(self, readings) - self.middle) / self.spread


class Regression(NamedTuple):
    """A fitted method, as arrays that a file can hold; None where a method has no such thing."""

    method: Int[np.ndarray, ""]  # index into HEAD_METHODS
    settings: Float[np.ndarray, " s"]  # as `choose_settings` gives them
    features: FeatureMap
    centre: Float[np.ndarray, " d"]  # of the targets
    scale: Float[np.ndarray, " d"]
    known: Float[np.ndarray, "m k"] | None = None  # features of the rows it remembers
    weights: Float[np.ndarray, "m d"] | None = None  # of these rows, or of the features


def make_feature_map(kind: int, readings: Float[np.ndarray, "n c"]) -> FeatureMap:
    """Feature map of a kind, scaled by the rows at hand.

    Args:
        kind: index into FEATURE_KINDS.
        readings: uT.

    Returns:
        The map.
    """
    channel = np.sqrt(np.mean(readings**2, axis=0))
    overall = np.sqrt(np.mean(readings**2)) + 1e-9
    bare = FeatureMap(
        np.array(kind), np.maximum(channel, 0.05 * overall), np.array(overall), np.zeros(1), np.array(1.0)
    )
    raw = _unscaled(bare, readings)
    middle = raw.mean(0)
    spread = np.sqrt(np.mean(np.sum((raw - middle) ** 2, axis=1))) + 1e-9
    return bare._replace(middle=middle, spread=np.array(spread))


def choose_settings(
    method: str,
    readings: Float[np.ndarray, "n c"],
    targets: Float[np.ndarray, "n d"],
    folds: Int[np.ndarray, "ways n"],
    budget: HeadBudget,
) -> Settings:
    """The settings of a method with the least squared error on whole folds.

    Args:
        method: one of HEAD_METHODS.
        readings: uT.
        targets: in any unit.
        folds: number of the fold of each row, in each way of holding out.
        budget: how many rows it may take.

    Returns:
        The settings: index of the features first, then those of the method.
    """
    rows = subsample(len(readings), budget.selection_rows)
    readings, targets, folds = readings[rows], targets[rows], folds[:, rows]
    if method == READINGS_GP:
        return _choose_gp(readings, targets, folds)
    candidates = _candidates(method)
    error: Callable[[Settings], float] = partial(_fold_error, method, readings, targets, folds)
    return min(candidates, key=error)


def fit_regression(
    method: str,
    settings: Settings,
    readings: Float[np.ndarray, "n c"],
    targets: Float[np.ndarray, "n d"],
    *,
    budget: HeadBudget | None = None,
) -> Regression:
    """Fit a method with given settings.

    Args:
        method: one of HEAD_METHODS.
        settings: as `choose_settings` gives them.
        readings: uT.
        targets: in any unit.
        budget: how many rows it may remember.

    Returns:
        The fitted method.
    """
    budget = HeadBudget() if budget is None else budget
    if method == READINGS_GP:
        rows = subsample(len(readings), budget.known_rows)
        readings, targets = readings[rows], targets[rows]
    centre, scale = targets.mean(0), np.maximum(targets.std(0), 1e-12)
    bare = Regression(
        np.array(HEAD_METHODS.index(method)),
        np.array(settings),
        make_feature_map(int(settings[0]), readings),
        centre,
        scale,
    )
    if method == MEAN_TARGET:
        return bare
    x, y = bare.features(readings), (targets - centre) / scale
    if method == LINEAR_MAP:
        system = x.T @ x + settings[1] * len(x) * np.eye(x.shape[1])
        return bare._replace(weights=np.linalg.solve(system, x.T @ y))
    if method == NEAREST_READINGS:
        return bare._replace(known=x, weights=y)
    factor = cho_factor(_covariance(settings, x, x) + (settings[2] + JITTER_VARIANCE) * np.eye(len(x)), lower=True)
    return bare._replace(known=x, weights=cho_solve(factor, y))


def predict_regression(fitted: Regression, readings: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n d"]:
    """Predict targets by a fitted method.

    Args:
        fitted: the method.
        readings: uT, finite.

    Returns:
        The targets, in their unit.
    """
    method, settings = HEAD_METHODS[int(fitted.method)], tuple(map(float, fitted.settings))
    if method == MEAN_TARGET:
        return np.broadcast_to(fitted.centre, (len(readings), len(fitted.centre))).copy()
    x = fitted.features(readings)
    if method == LINEAR_MAP:
        y = x @ fitted.weights
    elif method == NEAREST_READINGS:
        y = _nearest(fitted, x, int(settings[1]))
    else:
        assert fitted.known is not None
        y = np.concatenate([_covariance(settings, part, fitted.known) @ fitted.weights for part in _parts(x)])
    return fitted.centre + fitted.scale * y


def cross_predict(
    method: str,
    settings: Settings,
    readings: Float[np.ndarray, "n c"],
    targets: Float[np.ndarray, "n d"],
    folds: Int[np.ndarray, "ways n"],
    *,
    budget: HeadBudget | None = None,
) -> Float[np.ndarray, "ways n d"]:
    """Each fold as predicted from all others.

    Args:
        method: one of HEAD_METHODS.
        settings: of it.
        readings: uT.
        targets: in any unit.
        folds: number of the fold of each row, in each way of holding out.
        budget: as in `fit_regression`.

    Returns:
        The targets, in their unit, by each way.
    """
    predicted = np.empty((len(folds), *targets.shape))
    for way, of in enumerate(folds):
        for fold in np.unique(of):
            out = of == fold
            fitted = fit_regression(method, settings, readings[~out], targets[~out], budget=budget)
            predicted[way, out] = predict_regression(fitted, readings[out])
    return predicted


def nearest_known(
    known: Float[np.ndarray, "m k"], x: Float[np.ndarray, "n k"], count: int
) -> tuple[Float[np.ndarray, "n j"], Int[np.ndarray, "n j"]]:
    """The nearest known rows of each row, by products: in as many dimensions as a skin has channels no tree is faster.

    Args:
        known: features.
        x: features.
        count: how many are wanted; all where there are fewer.

    Returns:
        Distances in no order, and the rows of `known`.
    """
    count = min(count, len(known))
    length, distances, rows = np.sum(known**2, axis=1), [], []
    for part in _parts(x):
        square = np.sum(part**2, axis=1)[:, None] + length[None] - 2 * part @ known.T
        near = np.argpartition(square, count - 1, axis=1)[:, :count]
        distances.append(np.sqrt(np.maximum(np.take_along_axis(square, near, axis=1), 0)))
        rows.append(near)
    return np.concatenate(distances), np.concatenate(rows)


def _unscaled(features: FeatureMap, readings: np.ndarray) -> np.ndarray:
    kind = int(features.kind)
    if kind == PLAIN_FEATURES:
        return readings / features.overall
    if kind == COMPRESSED_FEATURES:
        return np.arcsinh(readings / (COMPRESSION * features.overall))
    if kind == DIRECTION_FEATURES:
        relative = readings / (features.overall * np.sqrt(readings.shape[1]))
        length = np.sqrt(np.sum(relative**2, axis=1, keepdims=True) + DIRECTION_FLOOR**2)
        return np.column_stack([relative / length, 0.5 * np.log(length)])
    return readings / features.channel


def _candidates(method: str) -> Sequence[Settings]:
    if method == LINEAR_MAP:
        return [(float(PLAIN_FEATURES), penalty) for penalty in LINEAR_PENALTIES]
    if method == NEAREST_READINGS:
        return list(product(map(float, range(len(FEATURE_KINDS))), READING_NEIGHBOURS))
    return [(float(PLAIN_FEATURES),)]


def _fold_error(method: str, readings: np.ndarray, targets: np.ndarray, folds: np.ndarray, settings: Settings) -> float:
    predicted = cross_predict(method, settings, readings, targets, folds)
    return float(np.mean(((predicted - targets) / np.maximum(targets.std(0), 1e-12)) ** 2))


def _choose_gp(readings: np.ndarray, targets: np.ndarray, folds: np.ndarray) -> Settings:
    """Choose one setting after the other, by the error of whole folds in closed form."""
    y = (targets - targets.mean(0)) / np.maximum(targets.std(0), 1e-12)
    features = [make_feature_map(kind, readings)(readings) for kind in range(len(FEATURE_KINDS))]
    blocks = [np.flatnonzero(of == fold) for of in folds for fold in np.unique(of)]

    def error(settings: Settings) -> float:
        x = features[int(settings[0])]
        K = _covariance(settings, x, x) + (settings[2] + JITTER_VARIANCE) * np.eye(len(x))
        try:
            precision = cho_solve(cho_factor(K, lower=True), np.eye(len(x)))
            weights = precision @ y
            left_out = [leave_out_blocks(precision[np.ix_(block, block)], weights[block]) for block in blocks]
        except np.linalg.LinAlgError:
            return np.inf
        return float(sum(np.sum(fold.error**2) for fold in left_out))

    kinds = tuple(map(float, range(len(FEATURE_KINDS))))
    grid = ((float(COMPRESSED_FEATURES), *kinds), COVARIANCE_LENGTHS, HEAD_NOISES, COVARIANCE_SHAPES, LINEAR_PARTS)
    best: Settings = tuple(values[0] for values in grid)
    seen = {best: error(best)}
    for _ in range(SEARCH_ROUNDS):
        for i, values in enumerate(grid):
            tries = [(*best[:i], value, *best[i + 1 :]) for value in values]
            for settings in tries:
                if settings not in seen:
                    seen[settings] = error(settings)
            best = min(tries, key=lambda one: seen[one])
    return best


def _covariance(settings: Settings, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    _, length, _, shape, linear = settings
    inner = a @ b.T
    square = np.maximum(np.sum(a**2, 1)[:, None] + np.sum(b**2, 1)[None] - 2 * inner, 0) / (2 * length**2)
    near = np.exp(-square) if np.isinf(shape) else (1 + square / shape) ** -shape
    return near + linear * inner


def _nearest(fitted: Regression, x: np.ndarray, k: int) -> np.ndarray:
    assert fitted.known is not None
    assert fitted.weights is not None
    distance, near = nearest_known(fitted.known, x, k)
    share = 1 / (distance + 1e-6)
    return np.einsum("nk,nkd->nd", share / share.sum(1, keepdims=True), fitted.weights[near])


def _parts(x: np.ndarray, rows: int = 1000) -> list[np.ndarray]:
    return [x[start : start + rows] for start in range(0, max(len(x), 1), rows)]
