"""Data sets of bare arrays, and every baseline fitted to them, by its name on the command line."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from i2t.contact.pressure import ContactPressure, PressureModelConfig
from i2t.dataset import Dataset, Split, missing_views
from i2t.prediction.methods import METHODS, TrainingTouches, find_method
from i2t.prediction.touch_model import Reading, TouchBatch, TouchModel
from i2t.types import Board, ReturnCode, Touches

MEASURED = ("force", "nearest")
PRESSURE = PressureModelConfig(pitch=1e-3, smooth=False, tilt=0.0)


def bare_dataset(
    patches: np.ndarray, readings: np.ndarray, board: Board | None = None, source: str = "real", **columns: np.ndarray
) -> Dataset:
    """Touches of one object, skin and session, of which only the given columns are known."""
    n, chips = len(patches), readings.shape[1] // 3
    still, zero, unknown = np.tile(np.eye(4), (n, 1, 1)), np.zeros(n), np.full(n, np.nan)
    others: dict[str, Any] = {
        "view": patches, "force": unknown, "nearest": unknown, "travel": unknown, "T_w_t": still, "T_w_o": still,
        "object": zero, "pad": zero, "session": zero, "code": zero,
    }  # fmt: skip
    touches = Touches(patch=patches, reading=readings, **(others | columns))
    board = board or Board(np.zeros((chips, 3)), np.tile(np.eye(3), (chips, 1, 1)))
    return Dataset(touches, ("tip",), ("skin",), ("run",), board, source)


def placed_dataset(place: np.ndarray, patches: np.ndarray, readings: np.ndarray, **more: Any) -> Dataset:
    """Touches as in `bare_dataset`, with the tip at positions (n, 2) m and no surroundings."""
    T_w_o = np.tile(np.eye(4), (len(place), 1, 1))
    T_w_o[:, :2, 3] = place
    code = np.full(len(place), ReturnCode.UNDEFINED)
    return bare_dataset(patches, readings, view=missing_views(len(place)), T_w_o=T_w_o, code=code, **more)


def round_tip(place: np.ndarray, pixels: int) -> np.ndarray:
    """Patches (n, pixels, pixels) m of a tip of 4 mm radius at places of the skin."""
    at = ((np.arange(pixels) + 0.5) / pixels - 0.5) * 17e-3
    r2 = (at[None, :, None] - place[:, 1, None, None]) ** 2 + (at[None, None, :] - place[:, 0, None, None]) ** 2
    return np.minimum(r2 / 8e-3, 4e-3)


def fit_baselines(
    patches: np.ndarray,
    measured: np.ndarray,
    readings: np.ndarray,
    groups: np.ndarray,
    pressure: np.ndarray | None = None,
) -> dict[str, TouchModel]:
    """Patches (n, h, h) m, up to two measured values (n, k), readings (n, c) uT, groups (n,) that are held out together
    and, for baselines on them, contact pressures (n, m, m) N.
    """
    names, every = MEASURED[: measured.shape[1]], np.ones(len(patches), bool)
    dataset = bare_dataset(patches, readings, **dict(zip(names, measured.T, strict=True)))
    given = TrainingTouches(dataset, names)
    if pressure is not None:
        given = replace(
            given,
            pressure_model=PRESSURE,
            pressure=ContactPressure(jnp.asarray(pressure), jnp.asarray(pressure.sum((1, 2)))),
        )
    split = Split(every, ~every, ~every, groups, "object")
    methods = {name: method for name in METHODS if (method := find_method(name)).baseline}
    fitted = {name: method.fit(jax.random.key(0), given, split) for name, method in methods.items()}
    return {name: each.model for name, each in fitted.items() if each is not None}


def predict(
    model: TouchModel, patches: np.ndarray, measured: np.ndarray, pressure: np.ndarray | None = None
) -> Reading:
    """Readings of touches like those above."""
    unknown = np.full(len(patches), np.nan)
    columns = dict(zip(MEASURED, measured.T, strict=False))
    force, nearest = (columns.get(name, unknown) for name in MEASURED)
    touches = TouchBatch(patches, patches, 1e-3, force, nearest, unknown)
    if pressure is not None:
        predicted = ContactPressure(jnp.asarray(pressure), jnp.asarray(pressure.sum((1, 2))))
        touches = touches._replace(pressure=predicted, pressure_model=PRESSURE)
    return model.predict_batch(touches)
