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
    """Model that predicts readings by a Gaussian process on predicted contact pressure.

    Attributes:
        gp: The fitted Gaussian process.
        pressure: Configuration of the predicted contact pressure.
    """

    gp: GP
    pressure: PressureModelConfig  # type: ignore[misc]

    @property
    def channels(self) -> int:
        """Number of values in a reading."""
        return self.gp.scale.shape[-1]

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `TouchModel.predict_batch`."""
        mean, std = self.gp.predict(touches.pressures(self.pressure))
        return Reading(np.asarray(mean), np.asarray(std))


class GaussianProcess(Method):
    """Method that fits a Gaussian process from predicted contact pressure to readings (`GPModel`).

    Its hyperparameters are chosen on held-out groups of the training touches.
    """

    title = "Gaussian process on predicted contact pressure"

    def fit(self, key: Key[Array, ""], touches: TrainingTouches, split: Split) -> Predictor | None:
        """Fit, as in `Method.fit`; return None if the touches lack predicted contact pressures."""
        if touches.pressure is None or touches.pressure_model is None:
            return None
        fitted = fit_gp(key, touches.pressure, touches.dataset.touches.reading, split)
        return touches.predictor(GPModel(fitted, touches.pressure_model), split)


def fit_gp(key: Key[Array, ""], pressure: ContactPressure, readings: np.ndarray, split: Split) -> GP:
    """Fit the Gaussian process to the training touches.

    Args:
        key: Random key of the folds.
        pressure: Contact pressures of all touches.
        readings: Readings (uT) of all touches.
        split: Split that selects the training touches.

    Returns:
        Fitted Gaussian process on contact pressure.
    """
    rows = np.flatnonzero(split.train)
    return PressureModel().fit(key, PressureTouches(select_rows(pressure, rows), readings[rows], split.groups[rows]))
