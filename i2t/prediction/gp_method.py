"""The Gaussian process on predicted contact pressure (`i2t.skin_models.pressure_gp`) as a method."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Key

from i2t.contact.pressure import PressureModelConfig
from i2t.dataset import Split
from i2t.prediction.methods import Method, TrainingTouches
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import Reading, TouchBatch, TouchModel
from i2t.runtime.batching import select_rows
from i2t.skin_models.pressure_gp import GP, ContactPressure, PressureModel, PressureTouches


@dataclass(frozen=True)
class GPModel(TouchModel):
    """A Gaussian process on predicted contact pressure.

    Attributes:
        gp: Fitted.
        pressure: How contact pressure is predicted.
    """

    gp: GP
    pressure: PressureModelConfig  # type: ignore[misc]

    @property
    def channels(self) -> int:
        """Values of a reading."""
        return self.gp.scale.shape[-1]

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `TouchModel.predict_batch`."""
        mean, std = self.gp.predict(touches.pressures(self.pressure))
        return Reading(np.asarray(mean), np.asarray(std))


class GaussianProcess(Method):
    """Hyperparameters from held-out groups of the training touches."""

    title = "Gaussian process on predicted contact pressure"

    def fit(self, key: Key[Array, ""], touches: TrainingTouches, split: Split) -> Predictor | None:
        """Fit, as in `Method.fit`; it needs predicted pressures."""
        if touches.pressure is None or touches.pressure_model is None:
            return None
        fitted = fit_gp(key, touches.pressure, touches.dataset.touches.reading, split)
        return touches.predictor(GPModel(fitted, touches.pressure_model), split)


def fit_gp(key: Key[Array, ""], pressure: ContactPressure, readings: np.ndarray, split: Split) -> GP:
    """The Gaussian process on the training touches.

    Args:
        key: Of the folds.
        pressure: Of all touches.
        readings: uT, of all touches.
        split: Which of them train.

    Returns:
        Fitted.
    """
    rows = np.flatnonzero(split.train)
    return PressureModel().fit(key, PressureTouches(select_rows(pressure, rows), readings[rows], split.groups[rows]))
