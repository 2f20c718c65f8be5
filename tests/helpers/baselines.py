"""Every baseline fitted to bare arrays, by its name on the command line."""

import jax
import numpy as np

from i2t.dataset import Dataset, Split
from i2t.prediction.methods import METHODS, TrainingTouches, find_method
from i2t.prediction.touch_model import Reading, TouchBatch, TouchModel
from i2t.types import Board, Touches

MEASURED = ("force", "nearest")


def bare_dataset(patches: np.ndarray, readings: np.ndarray, **columns: np.ndarray) -> Dataset:
    """Touches of one object, skin and session of which nothing else is known."""
    n, chips = len(patches), readings.shape[1] // 3
    still, zero = np.tile(np.eye(4), (n, 1, 1)), np.zeros(n)
    known = dict.fromkeys(("force", "nearest", "depth"), np.full(n, np.nan)) | columns
    touches = Touches(
        patch=patches, wide=patches, reading=readings, T_w_t=still, T_w_o=still, object=zero, pad=zero, session=zero,
        code=zero, **known,
    )  # fmt: skip
    board = Board(np.zeros((chips, 3)), np.tile(np.eye(3), (chips, 1, 1)))
    return Dataset(touches, ("tip",), ("skin",), ("run",), board, "real")


def fit_baselines(
    patches: np.ndarray, measured: np.ndarray, readings: np.ndarray, groups: np.ndarray
) -> dict[str, TouchModel]:
    """Patches (n, h, h) m, up to two measured values (n, k), readings (n, c) uT and groups (n,) that are held out
    together.
    """
    names, every = MEASURED[: measured.shape[1]], np.ones(len(patches), bool)
    dataset = bare_dataset(patches, readings, **dict(zip(names, measured.T, strict=True)))
    given = TrainingTouches(dataset, names)
    split = Split(every, ~every, ~every, groups, "object")
    methods = {name: method for name in METHODS if (method := find_method(name)).baseline}
    fitted = {name: method.fit(jax.random.key(0), given, split) for name, method in methods.items()}
    return {name: each.model for name, each in fitted.items() if each is not None}


def predict(model: TouchModel, patches: np.ndarray, measured: np.ndarray) -> Reading:
    """Readings of touches like those above."""
    unknown = np.full(len(patches), np.nan)
    columns = dict(zip(MEASURED, measured.T, strict=False))
    force, nearest = (columns.get(name, unknown) for name in MEASURED)
    return model.predict_batch(TouchBatch(patches, patches, 1e-3, force, nearest, unknown))
