"""What simulated episodes need of a finished run of `experiments.train` (`experiments.train.finished`)."""

from typing import NamedTuple

import numpy as np

from experiments.train.finished import FinishedRun
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.prediction.predictor import Predictor, load_predictor
from i2t.skin.files import load_pad
from i2t.skin_models.pad_model import PadModel, load_pad_model
from i2t.types import Pad


class TrainedRun(NamedTuple):
    """A finished run that simulated its touches."""

    dataset: Dataset
    rows: np.ndarray  # (n,) bool, of the touches of the objects that it trained on
    predictor: Predictor  # the best on predicted contact pressure, also where another was kept
    pad: Pad
    pad_model: PadModel

    @property
    def trained_objects(self) -> tuple[str, ...]:
        """Names of the catalogue's objects that it trained on."""
        return tuple(self.dataset.objects[i] for i in np.unique(self.dataset.touches.object[self.rows]))


def load_trained_run(run: FinishedRun) -> TrainedRun:
    """Read a run that simulated its touches.

    Args:
        run: Whose folder is read.

    Returns:
        Its touches, predictor, pad and pad model.

    Raises:
        ValueError: It trained on recorded touches, or has no pad model.
    """
    pad, known = load_pad(run.simulated_pad), load_pad_model(run.pad_model)
    dataset = data.load_dataset(run.touches)
    rows = np.isin(dataset.touches.object, [dataset.objects.index(name) for name in known.origin.objects])
    return TrainedRun(dataset, rows, load_predictor(run.on_pressure), pad, known.model)
