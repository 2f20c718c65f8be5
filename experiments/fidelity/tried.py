"""Touches for testing likely causes of a poor predictor, and the score of a Gaussian process on them."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from i2t.contact.pressure import PressureModelConfig, predict_pressures
from i2t.dataset import Dataset
from i2t.prediction.touch_model import views_of
from i2t.skin_models import pressure_gp as gp

MIN_GAIN = 0.05  # minimum gain of R2 by a correction that is reported as a likely cause
TRIED_TOUCHES = 200  # maximum number of touches for trying corrections


class Tried(NamedTuple):
    """Inputs of n touches for a method on predicted pressure."""

    views: np.ndarray  # (n, w, w) m
    force: np.ndarray  # (n,) N
    travel: np.ndarray  # (n,) m
    readings: np.ndarray  # (n, 3 chips) uT
    groups: np.ndarray  # (n,)


def tried_touches(dataset: Dataset, which: np.ndarray, groups: np.ndarray) -> Tried:
    """Select touches for a method on predicted pressure."""
    touches, views = dataset.touches, np.asarray(views_of(dataset)[which])
    return Tried(views, touches.force[which], touches.travel[which], touches.reading[which], groups[which])


def explained(seen: Tried, cfg: PressureModelConfig) -> float:
    """Compute R2 of the Gaussian process on held-out groups; minus infinity if it cannot be fitted."""
    pressure = predict_pressures(cfg, seen.views, seen.force, seen.travel)
    try:
        _, r2 = gp.choose_hyperparameters(
            pressure, jnp.asarray(seen.readings), seen.groups, steps=20, limit=TRIED_TOUCHES
        )
    except ValueError:
        return float("-inf")
    return float(np.nanmax(np.asarray(r2)))


def some_groups(which: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    """Select rows of whole groups in random order, up to a number of rows."""
    rng = np.random.default_rng(0)
    names, of = np.unique(groups[which], return_inverse=True)
    rank = rng.permutation(len(names))[of.ravel()]
    return np.sort(which[np.argsort(rank, kind="stable")[:count]])
