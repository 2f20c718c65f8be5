"""Predictors that every model has to beat, and that are kept where none does: the mean reading, the nearest patches and
ridge regression, from patches alone or together with what was measured at contact.

A touch becomes a vector x: principal components of its patch, and what was measured, both scaled to unit mean square
length over the training touches. With readings y,

  mean               y_bar
  nearest patches    mean of y over the k training touches nearest in x, and those as near as the k-th
  ridge              y_bar + (x - x_bar) W, W minimising |y - y_bar - (x - x_bar) W|^2 / n + penalty |W|^2

k and the penalty have the least squared error on held-out groups of the training touches. Errors on these held-out
groups are also what standard deviations are made of: the variance of neighbours grows with their squared distance as
held-out errors do (non-negative least squares), that of ridge regression with the leverage (Hoerl and Kennard,
Technometrics 12, 1970; Hastie, Tibshirani and Friedman, "The Elements of Statistical Learning", sections 3.4 and 13.3).

NumPy, because nothing here is differentiated.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls

from i2t.prediction.metrics import near_rows, nearest_neighbours
from i2t.types import in_one_line

MEAN, NEAREST, RIDGE, WITH_MEASURED = "mean reading", "k nearest patches", "ridge on PCA", " + measured"
COMPONENTS = 30  # of patches, at most
BASELINE_NEIGHBOUR_COUNTS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
PENALTIES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0)
FOLDS = 5
MIN_VARIANCE_SHARE = 0.05  # of the mean held-out variance, however near a neighbour is
MIN_SPREAD_SHARE = 1e-3  # of the spread over all channels: a dead channel has none of its own
MIN_SPREAD_UT = 1e-6


@in_one_line
class TouchFeatures(NamedTuple):
    """What turns a touch into a vector."""

    patch_mean: Float[np.ndarray, " pixels"]  # m
    basis: Float[np.ndarray, "k pixels"]
    length: Float[np.ndarray, ""]  # m, root mean square length of the training patches' components
    measured_mean: Float[np.ndarray, " m"]  # N or m
    measured_std: Float[np.ndarray, " m"]  # N or m


@in_one_line
class MeanReading(NamedTuple):
    """The mean of the training readings, whatever is touched."""

    mean: Float[np.ndarray, " c"]  # uT
    spread: Float[np.ndarray, " c"]  # uT, standard deviation of the training readings


@in_one_line
class NearestPatches(NamedTuple):
    """The mean reading of the nearest training touches."""

    features: TouchFeatures
    points: Float[np.ndarray, "n d"]
    readings: Float[np.ndarray, "n c"]  # uT
    neighbours: Float[np.ndarray, ""]
    spread: Float[np.ndarray, " c"]  # uT, root mean square error on held-out groups
    growth: Float[np.ndarray, "2"]  # of the variance, in spread^2: at distance zero, and by squared distance


@in_one_line
class RidgeOnPatches(NamedTuple):
    """Linear regression with a squared penalty."""

    features: TouchFeatures
    centre: Float[np.ndarray, " d"]
    weights: Float[np.ndarray, "d c"]  # uT
    mean: Float[np.ndarray, " c"]  # uT
    inverse: Float[np.ndarray, "d d"]  # of the system, for the leverage
    spread: Float[np.ndarray, " c"]  # uT, root mean square error on held-out groups where the leverage is zero


Baseline: TypeAlias = MeanReading | NearestPatches | RidgeOnPatches
Method: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray, float], np.ndarray]  # (x, y, at, option) -> (m, c)


def fit_baselines(
    patches: Float[np.ndarray, "n h w"],
    measured: Float[np.ndarray, "n m"],
    readings: Float[np.ndarray, "n c"],
    groups: Int[np.ndarray, " n"],
) -> dict[str, Baseline]:
    """Every baseline, fitted to training touches.

    Args:
        patches: m.
        measured: What was measured at contact (N, m), without NaN; with no column, no baseline is given any.
        readings: uT.
        groups: The run or spatial block of each touch, which cross-validation leaves whole.

    Returns:
        Baselines by name.
    """
    readings = np.asarray(readings, np.float64)
    fold = fold_of(groups)
    found: dict[str, Baseline] = {MEAN: MeanReading(_plain(readings.mean(0)), _floored(readings.std(0)))}
    variants = {"": measured[:, :0], WITH_MEASURED: measured}
    of_patches = touch_features(patches, measured[:, :0])
    for suffix, columns in variants.items():
        if suffix and not measured.shape[1]:
            continue
        features = _with_measured(of_patches, columns)
        points = _plain(features_of(features, patches, columns))
        found[NEAREST + suffix] = _fit_nearest(features, points, readings, fold)
        found[RIDGE + suffix] = _fit_ridge(features, points, readings, fold)
    order = (MEAN, *(name + suffix for name in (NEAREST, RIDGE) for suffix in variants))
    return {name: found[name] for name in order if name in found}


def predict(
    baseline: Baseline, patches: Float[np.ndarray, "n h w"], measured: Float[np.ndarray, "n m"]
) -> tuple[Float[np.ndarray, "n c"], Float[np.ndarray, "n c"]]:
    """Readings of touches.

    Args:
        baseline: A fitted baseline.
        patches: m, as many pixels as it was fitted to.
        measured: What it was given in fitting, in the same order; no column where it was given none.

    Returns:
        Mean and standard deviation, uT.
    """
    if isinstance(baseline, MeanReading):
        shape = (len(patches), len(baseline.mean))
        return np.broadcast_to(baseline.mean, shape).copy(), np.broadcast_to(baseline.spread, shape).copy()
    x = features_of(baseline.features, patches, measured)
    if isinstance(baseline, NearestPatches):
        points, k = np.asarray(baseline.points, np.float64), int(baseline.neighbours)
        mean = nearest_neighbours(points, np.asarray(baseline.readings, np.float64), x, k)
        factor = _grown(baseline.growth, _mean_square_distance(points, x, k))
    else:
        from_centre = x - baseline.centre
        mean = from_centre @ np.asarray(baseline.weights, np.float64) + baseline.mean
        factor = 1 + _leverage(np.asarray(baseline.inverse, np.float64), from_centre)
    return _plain(mean), _plain(np.sqrt(factor)[:, None] * baseline.spread)


def measured_count(baseline: Baseline) -> int:
    """How many measured values a baseline is given with the patch.

    Args:
        baseline: A fitted baseline.

    Returns:
        Their number.
    """
    return 0 if isinstance(baseline, MeanReading) else len(baseline.features.measured_mean)


def touch_features(patches: Float[np.ndarray, "n h w"], measured: Float[np.ndarray, "n m"]) -> TouchFeatures:
    """What turns touches like these into vectors.

    Args:
        patches: m, of the training touches.
        measured: What was measured at their contacts.

    Returns:
        Principal components of the patches and scales.
    """
    flat = patches.reshape(len(patches), -1).astype(np.float64)
    mean = flat.mean(0)
    # Eigenvectors of the smaller of the two covariance matrices.
    basis = np.linalg.svd(flat - mean, full_matrices=False)[2][:COMPONENTS]
    length = np.sqrt((((flat - mean) @ basis.T) ** 2).sum(1).mean()) or 1.0  # all patches alike
    nothing = np.zeros(0, np.float32)
    seen = TouchFeatures(
        _plain(mean), _plain(basis), _plain(np.asarray(length)), measured_mean=nothing, measured_std=nothing
    )
    return _with_measured(seen, measured)


def _with_measured(features: TouchFeatures, measured: np.ndarray) -> TouchFeatures:
    """The same components, with scales of what was measured."""
    std = measured.astype(np.float64).std(0)
    scale = _plain(np.where(std > 0, std, 1))
    return features._replace(measured_mean=_plain(measured.mean(0)), measured_std=scale)


def features_of(
    features: TouchFeatures, patches: Float[np.ndarray, "n h w"], measured: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "n d"]:
    """Touches as vectors.

    Args:
        features: Of the training touches.
        patches: m.
        measured: What was measured at contact.

    Returns:
        Components of the patches and what was measured, which weigh alike.
    """
    flat = patches.reshape(len(patches), -1).astype(np.float64) - features.patch_mean
    seen = flat @ features.basis.T.astype(np.float64) / float(features.length)
    standard = (measured - features.measured_mean) / features.measured_std
    return np.c_[seen, standard / np.sqrt(max(standard.shape[1], 1))]


def fold_of(groups: Int[np.ndarray, " n"], folds: int = FOLDS) -> Int[np.ndarray, " n"]:
    """Parts of cross-validation that leave groups whole; rows by themselves where there is but one group.

    Args:
        groups: The run or spatial block of each touch.
        folds: How many parts, at most as many as groups.

    Returns:
        The number of each touch's part, from 0.
    """
    names, group = np.unique(groups, return_inverse=True)
    if len(names) < 2:
        names = group = np.arange(len(groups))
    return np.random.default_rng(0).permutation(len(names))[group.ravel()] % min(folds, len(names))


def ridge(
    x: Float[np.ndarray, "n d"], y: Float[np.ndarray, "n c"], at: Float[np.ndarray, "m d"], penalty: float
) -> Float[np.ndarray, "m c"]:
    """Linear regression with an intercept and a squared penalty per training touch.

    Args:
        x: Features of the training touches.
        y: Their readings.
        at: Features of the touches to predict.
        penalty: On the squared weights, in units of the mean squared error.

    Returns:
        Readings, in the unit of `y`.
    """
    mean_x, mean_y = x.mean(0), y.mean(0)
    return (at - mean_x) @ np.linalg.solve(_system(x, penalty), (x - mean_x).T @ (y - mean_y)) + mean_y


def held_out(
    method: Method,
    option: float,
    x: Float[np.ndarray, "n d"],
    y: Float[np.ndarray, "n c"],
    fold: Int[np.ndarray, " n"],
) -> Float[np.ndarray, "n c"]:
    """Each part of cross-validation predicted from all others.

    Args:
        method: `method(x, y, at, option)` predicts.
        option: Its number of neighbours, or penalty.
        x: Features.
        y: Readings.
        fold: Part of each row.

    Returns:
        Readings, in the unit of `y`.
    """
    predicted = np.empty_like(y)
    for i in np.unique(fold):
        known, asked = fold != i, fold == i
        predicted[asked] = method(x[known], y[known], x[asked], option)
    return predicted


def _best_option(
    method: Method, options: Sequence[float], x: np.ndarray, y: np.ndarray, fold: np.ndarray
) -> tuple[float, np.ndarray]:
    """The option with the least squared error on held-out parts, and these errors (n, c)."""
    if fold.max() == 0:  # nothing can be held out of a single touch
        return options[0], y - y.mean(0)
    errors = [y - held_out(method, option, x, y, fold) for option in options]
    best = int(np.argmin([(error**2).sum() for error in errors]))
    return options[best], errors[best]


def _fit_nearest(features: TouchFeatures, points: np.ndarray, readings: np.ndarray, fold: np.ndarray) -> NearestPatches:
    x = np.asarray(points, np.float64)

    def mean(x: np.ndarray, y: np.ndarray, at: np.ndarray, k: float) -> np.ndarray:
        return nearest_neighbours(x, y, at, int(k))

    k, error = _best_option(mean, BASELINE_NEIGHBOUR_COUNTS, x, readings, fold)
    spread = _floored(np.sqrt((error**2).mean(0)))
    away = np.empty(len(x))
    for i in np.unique(fold):
        known = fold != i if (fold != i).any() else fold == i
        away[fold == i] = _mean_square_distance(x[known], x[fold == i], int(k))
    growth = nnls(np.c_[np.ones(len(x)), away], ((error / spread) ** 2).mean(1))[0]
    return NearestPatches(
        features, points, _plain(readings), _plain(np.asarray(k)), spread=spread, growth=_plain(growth)
    )


def _fit_ridge(features: TouchFeatures, points: np.ndarray, readings: np.ndarray, fold: np.ndarray) -> RidgeOnPatches:
    x = np.asarray(points, np.float64)
    penalty, error = _best_option(ridge, PENALTIES, x, readings, fold)
    centre, mean, inverse = x.mean(0), readings.mean(0), np.linalg.inv(_system(x, penalty))
    weights = inverse @ (x - centre).T @ (readings - mean)
    known = 1 + _leverage(inverse, x - centre)
    spread = _floored(np.sqrt((error**2 / known[:, None]).mean(0)))
    centre, weights, mean, inverse = (_plain(value) for value in (centre, weights, mean, inverse))
    return RidgeOnPatches(features, centre, weights, mean, inverse=inverse, spread=spread)


def _system(x: np.ndarray, penalty: float) -> np.ndarray:
    from_centre = x - x.mean(0)
    return from_centre.T @ from_centre + penalty * len(x) * np.eye(x.shape[1])


def _leverage(inverse: np.ndarray, from_centre: np.ndarray) -> np.ndarray:
    return np.einsum("nd,de,ne->n", from_centre, inverse, from_centre)


def _mean_square_distance(points: np.ndarray, at: np.ndarray, k: int) -> np.ndarray:
    near, square = near_rows(points, at, k)
    return (near * square).sum(1) / near.sum(1)


def _grown(growth: np.ndarray, square: np.ndarray) -> np.ndarray:
    return np.maximum(growth[0] + growth[1] * square, MIN_VARIANCE_SHARE)


def _floored(spread: np.ndarray) -> np.ndarray:
    return _plain(np.maximum(spread, max(MIN_SPREAD_SHARE * float(np.sqrt((spread**2).mean())), MIN_SPREAD_UT)))


def _plain(values: np.ndarray) -> np.ndarray:
    """As on disk, so that what is loaded predicts the same."""
    return np.asarray(values, np.float32)
