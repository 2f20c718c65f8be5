"""Baselines that every model has to beat, and that are kept if no model does: the mean reading, the nearest touches and
ridge regression, from an image of a touch with or without measurements at contact.

The image is the depth patch or the predicted contact pressure. A touch becomes a vector x: principal components of its
image, and the measurements, both scaled to unit mean square length over the training touches. With readings y,

  mean               y_bar
  nearest touches    mean of y over the k training touches nearest in x, and over those as near as the k-th
  ridge              y_bar + (x - x_bar) W, W minimising |y - y_bar - (x - x_bar) W|^2 / n + penalty |W|^2

k and the penalty have the smallest squared error on held-out groups of the training touches. These errors also give the
standard deviations: the variance of neighbours grows with their squared distance as held-out errors do (non-negative
least squares), that of ridge regression with the leverage (Hoerl and Kennard, Technometrics 12, 1970; Hastie,
Tibshirani and Friedman, "The Elements of Statistical Learning", sections 3.4 and 13.3).

This module uses NumPy because nothing in it is differentiated.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Array, Float, Int, Key
from scipy.optimize import nnls

from i2t.contact.pressure import PressureModelConfig
from i2t.dataset import Split
from i2t.prediction.methods import Method, TrainingTouches
from i2t.prediction.metrics import near_rows, nearest_neighbours
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import Reading, TouchBatch, TouchModel, stacked
from i2t.types import in_one_line


@dataclass(frozen=True)
class BaselineConfig:
    """Options from which the baselines choose on held-out groups, and lower bounds of their standard deviations."""

    max_components: int = 30  # largest number of principal components of images
    neighbour_counts: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
    penalties: tuple[float, ...] = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0)
    folds: int = 5
    # smallest variance relative to the mean held-out variance, even for a neighbour at distance zero
    min_relative_variance: float = 0.05
    # smallest standard deviation of a channel relative to that of all channels, for dead channels
    min_relative_std: float = 1e-3
    min_std: float = 1e-6  # uT, smallest standard deviation


# options from which the baseline predictors choose, and lower bounds of their standard deviations
_BASELINES = BaselineConfig()


@in_one_line
class TouchFeatures(NamedTuple):
    """Map from a touch to features: principal components of its patch (m) or contact pressure (N), and measurements.

    The measurements at contact are any of force (N), nearest and travel (m). Both parts are scaled.
    """

    image_mean: Float[np.ndarray, " pixels"]  # mean training image: m, or N for contact pressures
    basis: Float[np.ndarray, "k pixels"]
    length: Float[np.ndarray, ""]  # m or N, root mean square length of the training images' components
    measured_mean: Float[np.ndarray, " m"]  # mean of the measurement over the training touches: N or m
    measured_std: Float[np.ndarray, " m"]  # standard deviation of the measurement over the training touches: N or m


@dataclass(frozen=True)
class MeanReading(TouchModel):
    """Model that predicts, for every touch, the mean and the standard deviation (uT) of the training readings."""

    mean: Float[np.ndarray, " c"]  # uT, mean of the training readings
    spread: Float[np.ndarray, " c"]  # uT, standard deviation of the training readings

    @property
    def channels(self) -> int:
        """Number of values in a reading."""
        return len(self.mean)

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `TouchModel.predict_batch`."""
        shape = (len(touches.patch), len(self.mean))
        return Reading(np.broadcast_to(self.mean, shape).copy(), np.broadcast_to(self.spread, shape).copy())


@dataclass(frozen=True)
class OnFeatures(TouchModel):
    """Base of models that predict from principal components of a touch's image and from measurements at contact.

    The image is the patch or the predicted contact pressure; the measurements are any of force, nearest and travel.
    """

    features: TouchFeatures
    spread: Float[np.ndarray, " c"]  # uT, root mean square error on held-out groups, at the smallest variance
    conditions: tuple[str, ...]  # those of force, nearest and travel that it uses
    pressure: PressureModelConfig | None = field(default=None, kw_only=True)  # type: ignore[misc]  # None for patches

    @property
    def channels(self) -> int:
        """Number of values in a reading."""
        return len(self.spread)

    def _features(self, touches: TouchBatch) -> np.ndarray:
        pixels = round(len(self.features.image_mean) ** 0.5)
        images = touches.patch if self.pressure is None else np.asarray(touches.pressures(self.pressure).pressure)
        if images.shape[1] != pixels:
            name = "patch" if self.pressure is None else "contact pressure"
            raise ValueError(f"{name} has {images.shape[1]} pixels an edge; this model takes {pixels}")
        return features_of(self.features, images, touches.conditions(self.conditions))

    def _reading(self, mean: np.ndarray, growth: np.ndarray) -> Reading:
        return Reading(_plain(mean), _plain(np.sqrt(growth)[:, None] * self.spread))


@dataclass(frozen=True)
class NearestTouches(OnFeatures):
    """Model that predicts the mean reading of the k training touches nearest in image components and measurements."""

    points: Float[np.ndarray, "n d"]
    readings: Float[np.ndarray, "n c"]  # uT, readings of the training touches
    neighbours: Float[np.ndarray, ""]
    growth: Float[np.ndarray, "2"]  # variance in spread^2: at distance zero, and per squared distance

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `TouchModel.predict_batch`."""
        x, points, k = self._features(touches), np.asarray(self.points, np.float64), float(self.neighbours)
        mean = nearest_neighbours(points, np.asarray(self.readings, np.float64), x, k)
        return self._reading(mean, _grown(self.growth, _mean_square_distance(points, x, k)))


@dataclass(frozen=True)
class RidgeOnImages(OnFeatures):
    """Model that predicts readings by ridge regression on principal components of a touch's image and on measurements.

    The image is the patch or the contact pressure; the measurements are any of force, nearest distance and travel.
    """

    centre: Float[np.ndarray, " d"]
    weights: Float[np.ndarray, "d c"]  # uT, weights of the features
    mean: Float[np.ndarray, " c"]  # uT, mean of the training readings
    inverse: Float[np.ndarray, "d d"]  # inverse of the system's matrix, for the leverage

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `TouchModel.predict_batch`."""
        from_centre = self._features(touches) - self.centre
        mean = from_centre @ np.asarray(self.weights, np.float64) + self.mean
        return self._reading(mean, 1 + _leverage(np.asarray(self.inverse, np.float64), from_centre))


Components: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]  # mean image, components, their typical length
Option = TypeVar("Option")
Regression: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray, Option], np.ndarray]  # x, y, at, option


def mean_model(readings: Float[np.ndarray, "n c"]) -> MeanReading:
    """Build the model that predicts the mean reading.

    Args:
        readings: Readings (uT) of the training touches.

    Returns:
        Model with the mean and the standard deviation of the readings.
    """
    plain = readings.astype(np.float64)
    return MeanReading(_plain(plain.mean(0)), _floored(plain.std(0)))


def image_components(images: Float[np.ndarray, "n h w"]) -> Components:
    """Compute principal components of images. They take seconds and do not depend on the measurements.

    Args:
        images: Patches (m) or contact pressures (N) of the training touches.

    Returns:
        `(pixels,)` mean image, `(k, pixels)` components (k is at most 30), and the root mean square length of the
        images in these components.
    """
    flat = images.reshape(len(images), -1).astype(np.float64)
    mean = flat.mean(0)
    basis = np.linalg.svd(flat - mean, full_matrices=False)[2][: _BASELINES.max_components]
    length = np.sqrt((((flat - mean) @ basis.T) ** 2).sum(1).mean()) or 1.0  # 1 if all images are equal
    return _plain(mean), _plain(basis), _plain(np.asarray(length))


def touch_features(components: Components, measured: Float[np.ndarray, "n m"]) -> TouchFeatures:
    """Build the map from touches to feature vectors.

    Args:
        components: Components of the training touches' images (`image_components`).
        measured: `(n, m)` measurements at the contacts of the training touches: force (N), nearest or travel (m).

    Returns:
        Map with the components and the scales of the measurements.
    """
    std = measured.astype(np.float64).std(0)
    return TouchFeatures(*components, _plain(measured.mean(0)), _plain(np.where(std > 0, std, 1)))


def features_of(
    features: TouchFeatures, images: Float[np.ndarray, "n h w"], measured: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "n d"]:
    """Convert touches to feature vectors.

    Args:
        features: The map from touches to vectors.
        images: Patches (m) or contact pressures (N), as for the training touches.
        measured: `(n, m)` measurements at contact, as for the training touches.

    Returns:
        `(n, d)` vectors of image components and measurements, both with unit mean square length in training.
    """
    flat = images.reshape(len(images), -1).astype(np.float64) - features.image_mean
    seen = flat @ features.basis.T.astype(np.float64) / float(features.length)
    standard = (measured - features.measured_mean) / features.measured_std
    return np.c_[seen, standard / np.sqrt(max(standard.shape[1], 1))]


def assign_folds(groups: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Assign touches to folds of cross-validation that keep groups whole.

    There are five folds, or as many as there are groups. The touches of a single group are assigned one by one.

    Args:
        groups: The run or spatial block of each touch.

    Returns:
        `(n,)` fold of each touch, from 0.
    """
    names, group = np.unique(groups, return_inverse=True)
    if len(names) < 2:
        names = group = np.arange(len(groups))
    return np.random.default_rng(0).permutation(len(names))[group.ravel()] % min(_BASELINES.folds, len(names))


def ridge(
    x: Float[np.ndarray, "n d"], y: Float[np.ndarray, "n c"], at: Float[np.ndarray, "m d"], penalty: float
) -> Float[np.ndarray, "m c"]:
    """Predict by linear regression with an intercept and a squared penalty per training touch.

    Args:
        x: Features of the training touches.
        y: Readings of the training touches.
        at: Features of the touches to predict.
        penalty: Penalty on the squared weights, in units of the mean squared error.

    Returns:
        `(m, c)` predicted readings of the m touches, in the unit of `y`.
    """
    mean_x, mean_y = x.mean(0), y.mean(0)
    return (at - mean_x) @ np.linalg.solve(_system(x, penalty), (x - mean_x).T @ (y - mean_y)) + mean_y


def predict_with_best_option(
    method: Regression[Option],
    options: Sequence[Option],
    x: Float[np.ndarray, "n d"],
    y: Float[np.ndarray, "n c"],
    groups: Int[np.ndarray, " n"],
    *,
    at: Float[np.ndarray, "m d"],
) -> Float[np.ndarray, "m c"]:
    """Predict with the option that has the smallest squared error on held-out groups of the training touches.

    Args:
        method: Function such that `method(x, y, at, option)` predicts readings at features `at`.
        options: Options to choose from.
        x: Features of the training touches.
        y: Readings of the training touches.
        groups: The run or spatial block of each training touch.
        at: Features of the touches to predict.

    Returns:
        `(m, c)` predicted readings of the m touches, in the unit of `y`.
    """
    return method(x, y, at, best_option(method, options, x, y, assign_folds(groups))[0])


def best_option(
    method: Regression[Option],
    options: Sequence[Option],
    x: Float[np.ndarray, "n d"],
    y: Float[np.ndarray, "n c"],
    fold: Int[np.ndarray, " n"],
) -> tuple[Option, Float[np.ndarray, "n c"]]:
    """Choose the option that has the smallest squared error on held-out folds of the training touches.

    Args:
        method: Function such that `method(x, y, at, option)` predicts.
        options: Options to choose from.
        x: Features of the training touches.
        y: Readings of the training touches.
        fold: Fold of each training touch, from `assign_folds`.

    Returns:
        Chosen option, and its `(n, c)` errors on held-out folds (measured minus predicted) in the unit of `y`.
    """
    if fold.max() == 0:  # nothing can be held out of a single touch
        return options[0], y - y.mean(0)

    def held_out_errors(option: Option) -> np.ndarray:
        """Compute the errors of each fold, predicted from all other folds."""
        error = np.empty_like(y)
        for held_out in (fold == i for i in np.unique(fold)):
            error[held_out] = y[held_out] - method(x[~held_out], y[~held_out], x[held_out], option)
        return error

    errors = [held_out_errors(option) for option in options]
    best = int(np.argmin([(error**2).sum() for error in errors]))
    return options[best], errors[best]


def _fit_nearest(
    features: TouchFeatures, conditions: tuple[str, ...], points: np.ndarray, readings: np.ndarray, fold: np.ndarray
) -> NearestTouches:
    x = np.asarray(points, np.float64)

    k, error = best_option(nearest_neighbours, _BASELINES.neighbour_counts, x, readings, fold)
    spread = _floored(np.sqrt((error**2).mean(0)))
    away = np.empty(len(x))
    for i in np.unique(fold):
        others = fold != i if (fold != i).any() else fold == i
        away[fold == i] = _mean_square_distance(x[others], x[fold == i], k)
    growth = nnls(np.c_[np.ones(len(x)), away], ((error / spread) ** 2).mean(1))[0]
    return NearestTouches(features, spread, conditions, points, _plain(readings), _plain(np.asarray(k)), _plain(growth))


def _fit_ridge(
    features: TouchFeatures, conditions: tuple[str, ...], points: np.ndarray, readings: np.ndarray, fold: np.ndarray
) -> RidgeOnImages:
    x = np.asarray(points, np.float64)
    penalty, error = best_option(ridge, _BASELINES.penalties, x, readings, fold)
    centre, mean, inverse = x.mean(0), readings.mean(0), np.linalg.inv(_system(x, penalty))
    weights = inverse @ (x - centre).T @ (readings - mean)
    growth = 1 + _leverage(inverse, x - centre)
    spread = _floored(np.sqrt((error**2 / growth[:, None]).mean(0)))
    centre, weights, mean, inverse = (_plain(value) for value in (centre, weights, mean, inverse))
    return RidgeOnImages(features, spread, conditions, centre, weights, mean, inverse)


def _system(x: np.ndarray, penalty: float) -> np.ndarray:
    from_centre = x - x.mean(0)
    return from_centre.T @ from_centre + penalty * len(x) * np.eye(x.shape[1])


def _leverage(inverse: np.ndarray, from_centre: np.ndarray) -> np.ndarray:
    return np.einsum("nd,de,ne->n", from_centre, inverse, from_centre)


def _mean_square_distance(points: np.ndarray, at: np.ndarray, k: float) -> np.ndarray:
    near, square = near_rows(points, at, k)
    return (near * square).sum(1) / near.sum(1)


def _grown(growth: np.ndarray, square: np.ndarray) -> np.ndarray:
    return np.maximum(growth[0] + growth[1] * square, _BASELINES.min_relative_variance)


def _floored(spread: np.ndarray) -> np.ndarray:
    lowest = _BASELINES.min_relative_std * float(np.sqrt((spread**2).mean()))
    return _plain(np.maximum(spread, max(lowest, _BASELINES.min_std)))


def _plain(values: np.ndarray) -> np.ndarray:
    """Round values to the precision on disk, so that a loaded model predicts the same."""
    return np.asarray(values, np.float32)


class Mean(Method):
    """Baseline method that predicts the mean reading of the training touches."""

    title = "mean reading"
    baseline = True

    def fit(self, key: Key[Array, ""], touches: TrainingTouches, split: Split) -> Predictor:
        """Fit, as in `Method.fit`."""
        return touches.predictor(mean_model(touches.dataset.touches.reading[split.train]), split)


class Nearest(Method):
    """Baseline method that predicts the mean reading of the k training touches nearest in components of the patch."""

    title = "k nearest patches"
    baseline = True
    measured: ClassVar[bool] = False  # whether the method uses the measurements at contact
    on_pressure: ClassVar[bool] = False  # whether its image is the predicted contact pressure
    fit_points: ClassVar[Callable[..., OnFeatures]] = staticmethod(_fit_nearest)

    def fit(self, key: Key[Array, ""], touches: TrainingTouches, split: Split) -> Predictor | None:
        """Fit, as in `Method.fit`; return None if the touches lack the measurements or pressures that it uses."""
        conditions = touches.measured if self.measured else ()
        if (self.measured and not conditions) or (self.on_pressure and touches.pressure is None):
            return None
        rows, seen = split.train, touches.dataset.touches
        measured = stacked(seen, conditions)[rows]
        pressure = touches.pressure if self.on_pressure else None
        images = seen.patch[rows] if pressure is None else np.asarray(pressure.pressure)[rows]
        name = "pressure components" if self.on_pressure else "patch components"
        components = touches.cached(name, rows, lambda: image_components(images))
        model = self.model(components, conditions, images, measured, seen.reading[rows], split.groups[rows])
        return touches.predictor(replace(model, pressure=touches.pressure_model if self.on_pressure else None), split)

    def model(
        self,
        components: Components,
        conditions: tuple[str, ...],
        images: Float[np.ndarray, "n h w"],
        measured: Float[np.ndarray, "n m"],
        readings: Float[np.ndarray, "n c"],
        groups: Int[np.ndarray, " n"],
    ) -> OnFeatures:
        """Fit the model to n training touches.

        Args:
            components: Components of the images.
            conditions: Names of the measurements.
            images: Patches (m) or contact pressures (N).
            measured: Measurements at contact.
            readings: Readings (uT).
            groups: Groups of touches that are held out together.

        Returns:
            Fitted model, which treats its images as patches.
        """
        features = touch_features(components, measured)
        points = _plain(features_of(features, images, measured))
        return self.fit_points(features, conditions, points, readings.astype(np.float64), assign_folds(groups))


class NearestMeasured(Nearest):
    """Baseline method that predicts the mean reading of the k training touches nearest in patch and measurements."""

    title = "k nearest patches + measured"
    measured = True


class NearestPressure(Nearest):
    """Baseline method that predicts the mean reading of the k training touches nearest in predicted pressure."""

    title = "k nearest predicted pressures"
    on_pressure = True


class NearestPressureMeasured(NearestPressure):
    """Baseline method that predicts the mean reading of the k training touches nearest in pressure and measurements."""

    title = "k nearest predicted pressures + measured"
    measured = True


class Ridge(Nearest):
    """Baseline method that predicts readings by ridge regression on principal components of patches."""

    title = "ridge on PCA"
    fit_points = staticmethod(_fit_ridge)


class RidgeMeasured(Ridge):
    """Baseline method that predicts readings by ridge regression on components of patches and on measurements."""

    title = "ridge on PCA + measured"
    measured = True


class RidgePressure(Ridge):
    """Baseline method that predicts readings by ridge regression on components of predicted contact pressures."""

    title = "ridge on PCA of predicted pressure"
    on_pressure = True


class RidgePressureMeasured(RidgePressure):
    """Baseline method that predicts readings by ridge regression on components of pressures and on measurements."""

    title = "ridge on PCA of predicted pressure + measured"
    measured = True
