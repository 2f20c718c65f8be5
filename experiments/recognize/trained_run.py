"""The parts of a finished run of `experiments.train` that simulated episodes use."""

from typing import NamedTuple

import numpy as np

from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.models.finished import FinishedRun
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.skin.files import load_pad
from i2t.skin_models.pad_model import PadModel, load_pad_model
from i2t.types import Pad


class TrainedRun(NamedTuple):
    """A finished run with simulated touches."""

    dataset: Dataset
    rows: np.ndarray  # (n,) mask of the touches of training objects
    predictor: Predictor  # the best on predicted contact pressure, even if another was selected
    pad: Pad
    pad_model: PadModel

    @property
    def trained_objects(self) -> tuple[str, ...]:
        """Names of the training objects."""
        return tuple(self.dataset.objects[i] for i in np.unique(self.dataset.touches.object[self.rows]))


def load_trained_run(run: FinishedRun) -> TrainedRun:
    """Read a run with simulated touches.

    Args:
        run: The finished run.

    Returns:
        Its touches, predictor, pad and pad model.

    Raises:
        ValueError: The run used recorded touches, or has no pad model.
    """
    pad, fitted = load_pad(run.simulated_pad), load_pad_model(run.pad_model)
    dataset = data.load_dataset(run.touches)
    rows = np.isin(dataset.touches.object, [dataset.objects.index(name) for name in fitted.origin.objects])
    return TrainedRun(dataset, rows, load_predictor(run.on_pressure), pad, fitted.model)
