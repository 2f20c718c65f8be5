"""Regressions from readings to targets: baselines and a Gaussian process (GP).

All methods are functions of features of a reading. The best features depend on the skin: a press twice as deep reads
several times as much in nearly the same direction, so the direction of a reading encodes position and its length
encodes load. `FeatureKind` lists four ways to express that. Each method chooses its features and its other settings by
the error on whole folds of the rows at hand.

The methods are the mean; ridge regression on the plain reading; the k nearest readings, weighted by inverse distance;
and a GP with a rational quadratic or squared exponential covariance and a linear part (Rasmussen and Williams,
"Gaussian Processes for Machine Learning", 2006, algorithm 2.1, equations 4.9 and 4.19).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, auto
from functools import partial
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve

from i2t.leave_one_out import leave_out_blocks
from i2t.recordings.diagnose.smooth import subsample

# methods that predict a target, such as the position, from a reading
MEAN_TARGET, LINEAR_MAP, NEAREST_READINGS = "mean", "linear", "k nearest readings"
READINGS_GP = "Gaussian process"  # method that predicts a target by a Gaussian process on readings
BASELINE_HEADS = (MEAN_TARGET, LINEAR_MAP, NEAREST_READINGS)  # simple methods, for comparison with the Gaussian process
HEAD_METHODS = (*BASELINE_HEADS, READINGS_GP)  # all methods of heads; files store indices into this order
Settings: TypeAlias = tuple[float, ...]


class FeatureKind(IntEnum):
    """Kinds of features of a reading: plain, scaled by channel, compressed by arcsinh, or direction and log length.

    Files store their numbers.
    """

    PLAIN = 0
    BY_CHANNEL = auto()
    COMPRESSED = auto()
    DIRECTION = auto()


@dataclass(frozen=True)
class SearchGrid:
    """Settings of the regression methods that `choose_settings` tries; features have mean square length 1.

    Attributes:
        penalties: Penalties of the ridge regression.
        neighbours: Numbers of nearest readings that are averaged.
        lengths: Length scales of the Gaussian process (GP).
        noises: Noise variances of the GP, relative to the target's variance.
        shapes: Shape parameters of the rational quadratic; infinity is the squared exponential.
        linear_variances: Variances of the GP's linear part, relative to the target's variance.
        rounds: Number of rounds of the search over the settings of the GP, one setting after the other.
    """

    penalties: tuple[float, ...] = tuple(10.0 ** np.arange(-6.0, 2.0))
    neighbours: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0)
    lengths: tuple[float, ...] = (1.0, 0.5, 0.25, 2.0, 4.0, 8.0)
    noises: tuple[float, ...] = (1e-3, 1e-4, 1e-2, 3e-2, 1e-1)
    shapes: tuple[float, ...] = (2.0, 0.5, np.inf)
    linear_variances: tuple[float, ...] = (1.0, 0.0)
    rounds: int = 2


class HeadBudget(NamedTuple):
    """Largest numbers of rows that a fit of a head uses: for choosing settings, in a Gaussian process, and in all."""

    selection_rows: int = 700  # largest number of rows for the choice of settings, whose cost grows with the cube
    known_rows: int = 2500  # largest number of rows that a Gaussian process keeps
    rows: int = 12000  # largest number of rows of the recording that are used


class FeatureMap(NamedTuple):
    """Map from readings (uT) to features of a regression: the kind of features, scales (uT), mean and spread."""

    kind: Int[np.ndarray, ""]  # kind of the features, a `FeatureKind`
    channel: Float[np.ndarray, " c"]  # uT, root mean square of each channel
    overall: Float[np.ndarray, ""]  # uT, root mean square of all channels
    middle: Float[np.ndarray, " k"]  # mean of the features before they are scaled
    spread: Float[np.ndarray, ""]  # root mean square distance of the features from their mean

    def __call__(self, readings: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n k"]:
        """Compute the features of readings.

        Args:
            readings: `(n, c)` readings in uT.

        Returns:
            `(n, k)` features, with mean square length 1 over the rows that the map was fitted to.
        """
        return (_unscaled(self, readings) - self.middle) / self.spread


class Regression(NamedTuple):
    """A fitted regression method: settings, feature map, mean and scale of the targets, known rows and weights.

    Fields that a method does not use are None.
    """

    method: Int[np.ndarray, ""]  # index of the method in HEAD_METHODS
    settings: Float[np.ndarray, " s"]  # settings of the method, from `choose_settings`
    features: FeatureMap
    centre: Float[np.ndarray, " d"]  # mean of the targets
    scale: Float[np.ndarray, " d"]  # standard deviation of the targets
    known: Float[np.ndarray, "m k"] | None = None  # features of the rows that the method keeps
    weights: Float[np.ndarray, "m d"] | None = None  # weights of the known rows, or of the features


def make_feature_map(kind: int, readings: Float[np.ndarray, "n c"]) -> FeatureMap:
    """Make a feature map whose scales are fitted to readings.

    Args:
        kind: A `FeatureKind` or its number.
        readings: `(n, c)` readings in uT.

    Returns:
        The feature map, whose features of these readings have mean 0 and mean square length 1.
    """
    channel = np.sqrt(np.mean(readings**2, axis=0))
    overall = np.sqrt(np.mean(readings**2)) + 1e-9
    unscaled_map = FeatureMap(
        np.array(int(kind)), np.maximum(channel, 0.05 * overall), np.array(overall), np.zeros(1), np.array(1.0)
    )
    unscaled = _unscaled(unscaled_map, readings)
    middle = unscaled.mean(0)
    spread = np.sqrt(np.mean(np.sum((unscaled - middle) ** 2, axis=1))) + 1e-9
    return unscaled_map._replace(middle=middle, spread=np.array(spread))


def choose_settings(
    method: str,
    readings: Float[np.ndarray, "n c"],
    targets: Float[np.ndarray, "n d"],
    folds: Int[np.ndarray, "ways n"],
    budget: HeadBudget,
    *,
    grid: SearchGrid = SearchGrid(),
) -> Settings:
    """Choose the settings of a regression method that have the smallest squared error on held-out folds.

    Args:
        method: One of `HEAD_METHODS`.
        readings: `(n, c)` readings in uT.
        targets: `(n, d)` targets in any unit.
        folds: `(ways, n)` number of each row's fold, in each way of holding out.
        budget: Largest number of rows to use.
        grid: Settings to try.

    Returns:
        The number of the `FeatureKind`, followed by the settings of the method.
    """
    rows = subsample(len(readings), budget.selection_rows)
    readings, targets, folds = readings[rows], targets[rows], folds[:, rows]
    if method == READINGS_GP:
        return _choose_gp(readings, targets, folds, grid)
    candidates: Sequence[Settings] = [(float(FeatureKind.PLAIN),)]
    if method == LINEAR_MAP:
        candidates = [(float(FeatureKind.PLAIN), penalty) for penalty in grid.penalties]
    if method == NEAREST_READINGS:
        candidates = list(product(map(float, FeatureKind), grid.neighbours))
    return min(candidates, key=partial(_fold_error, method, readings, targets, folds))


def fit_regression(
    method: str,
    settings: Settings,
    readings: Float[np.ndarray, "n c"],
    targets: Float[np.ndarray, "n d"],
    *,
    budget: HeadBudget | None = None,
) -> Regression:
    """Fit a regression method with given settings.

    Args:
        method: One of `HEAD_METHODS`.
        settings: Settings of the method, from `choose_settings`.
        readings: `(n, c)` readings in uT.
        targets: `(n, d)` targets in any unit.
        budget: Largest number of rows to keep; None for the default.

    Returns:
        The fitted method, for `predict_regression`.
    """
    budget = HeadBudget() if budget is None else budget
    if method == READINGS_GP:
        rows = subsample(len(readings), budget.known_rows)
        readings, targets = readings[rows], targets[rows]
    centre, scale = targets.mean(0), np.maximum(targets.std(0), 1e-12)
    features = make_feature_map(int(settings[0]), readings)
    regression = Regression(np.array(HEAD_METHODS.index(method)), np.array(settings), features, centre, scale)
    if method == MEAN_TARGET:
        return regression
    x, y = features(readings), (targets - centre) / scale
    if method == LINEAR_MAP:
        system = x.T @ x + settings[1] * len(x) * np.eye(x.shape[1])
        return regression._replace(weights=np.linalg.solve(system, x.T @ y))
    if method == NEAREST_READINGS:
        return regression._replace(known=x, weights=y)
    factor = cho_factor(_noisy_covariance(settings, x), lower=True)
    return regression._replace(known=x, weights=cho_solve(factor, y))


def predict_regression(fitted: Regression, readings: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n d"]:
    """Predict targets from readings with a fitted regression method.

    Args:
        fitted: The fitted method.
        readings: `(n, c)` finite readings in uT.

    Returns:
        `(n, d)` predicted targets, in the unit of those it was fitted to.
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
        y = np.concatenate([_covariance(settings, batch, fitted.known) @ fitted.weights for batch in _batches(x)])
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
    """Predict the targets of each fold with a method that was fitted to all other folds.

    Args:
        method: One of `HEAD_METHODS`.
        settings: Settings of the method, from `choose_settings`.
        readings: `(n, c)` readings in uT.
        targets: `(n, d)` targets in any unit.
        folds: `(ways, n)` number of each row's fold, in each way of holding out.
        budget: Largest number of rows that a fit keeps; None for the default.

    Returns:
        `(ways, n, d)` predicted targets, in the unit of `targets`.
    """
    predicted = np.empty((len(folds), *targets.shape))
    for way, row_folds in enumerate(folds):
        for fold in np.unique(row_folds):
            held_out = row_folds == fold
            fitted = fit_regression(method, settings, readings[~held_out], targets[~held_out], budget=budget)
            predicted[way, held_out] = predict_regression(fitted, readings[held_out])
    return predicted


def nearest_known(
    reference: Float[np.ndarray, "m k"], x: Float[np.ndarray, "n k"], count: int
) -> tuple[Float[np.ndarray, "n j"], Int[np.ndarray, "n j"]]:
    """Find the known rows whose features are nearest to those of each row, by matrix products.

    No tree is faster in as many dimensions as a skin has channels.

    Args:
        reference: `(m, k)` features of the known rows.
        x: `(n, k)` features of the rows to look up.
        count: Number of neighbours to find; all m if there are fewer.

    Returns:
        `(n, j)` distances of the j neighbours in no particular order, and their row numbers in `reference`.
    """
    count = min(count, len(reference))
    squared_length, distances, rows = np.sum(reference**2, axis=1), [], []
    for batch in _batches(x):
        square = np.sum(batch**2, axis=1)[:, None] + squared_length[None] - 2 * batch @ reference.T
        nearest = np.argpartition(square, count - 1, axis=1)[:, :count]
        distances.append(np.sqrt(np.maximum(np.take_along_axis(square, nearest, axis=1), 0)))
        rows.append(nearest)
    return np.concatenate(distances), np.concatenate(rows)


def _unscaled(features: FeatureMap, readings: np.ndarray) -> np.ndarray:
    kind = int(features.kind)
    if kind == FeatureKind.PLAIN:
        return readings / features.overall
    if kind == FeatureKind.COMPRESSED:
        # The inverse hyperbolic sine changes from linear to logarithmic at 0.3 of the root mean square.
        return np.arcsinh(readings / (0.3 * features.overall))
    if kind == FeatureKind.DIRECTION:
        relative = readings / (features.overall * np.sqrt(readings.shape[1]))
        # A reading shorter than 0.05 of the root mean square has hardly a direction.
        length = np.sqrt(np.sum(relative**2, axis=1, keepdims=True) + 0.05**2)
        return np.column_stack([relative / length, 0.5 * np.log(length)])
    return readings / features.channel


def _fold_error(method: str, readings: np.ndarray, targets: np.ndarray, folds: np.ndarray, settings: Settings) -> float:
    predicted = cross_predict(method, settings, readings, targets, folds)
    return float(np.mean(((predicted - targets) / np.maximum(targets.std(0), 1e-12)) ** 2))


def _choose_gp(readings: np.ndarray, targets: np.ndarray, folds: np.ndarray, grid: SearchGrid) -> Settings:
    """Choose one setting after the other, by the closed-form error on whole folds."""
    y = (targets - targets.mean(0)) / np.maximum(targets.std(0), 1e-12)
    features = [make_feature_map(kind, readings)(readings) for kind in FeatureKind]
    blocks = [np.flatnonzero(row_folds == fold) for row_folds in folds for fold in np.unique(row_folds)]

    def error(settings: Settings) -> float:
        x = features[int(settings[0])]
        try:
            precision = cho_solve(cho_factor(_noisy_covariance(settings, x), lower=True), np.eye(len(x)))
            weights = precision @ y
            held_out = [leave_out_blocks(precision[np.ix_(block, block)], weights[block]) for block in blocks]
        except np.linalg.LinAlgError:
            return np.inf
        return float(sum(np.sum(fold.error**2) for fold in held_out))

    kinds = (float(FeatureKind.COMPRESSED), *map(float, FeatureKind))
    axes = (kinds, grid.lengths, grid.noises, grid.shapes, grid.linear_variances)
    best: Settings = tuple(values[0] for values in axes)
    errors = {best: error(best)}
    for _ in range(grid.rounds):
        for i, values in enumerate(axes):
            candidates = [(*best[:i], value, *best[i + 1 :]) for value in values]
            for settings in candidates:
                if settings not in errors:
                    errors[settings] = error(settings)
            best = min(candidates, key=lambda settings: errors[settings])
    return best


def _covariance(settings: Settings, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    _, length, _, shape, linear_variance = settings
    inner = a @ b.T
    square = np.maximum(np.sum(a**2, 1)[:, None] + np.sum(b**2, 1)[None] - 2 * inner, 0) / (2 * length**2)
    stationary = np.exp(-square) if np.isinf(shape) else (1 + square / shape) ** -shape
    return stationary + linear_variance * inner


def _noisy_covariance(settings: Settings, x: np.ndarray) -> np.ndarray:
    return _covariance(settings, x, x) + (settings[2] + 1e-9) * np.eye(len(x))  # jitter of 1e-9


def _nearest(fitted: Regression, x: np.ndarray, k: int) -> np.ndarray:
    assert fitted.known is not None
    assert fitted.weights is not None
    distance, rows = nearest_known(fitted.known, x, k)
    share = 1 / (distance + 1e-6)
    return np.einsum("nk,nkd->nd", share / share.sum(1, keepdims=True), fitted.weights[rows])


def _batches(x: np.ndarray, rows: int = 1000) -> list[np.ndarray]:
    return [x[start : start + rows] for start in range(0, max(len(x), 1), rows)]
