"""Input of every method: touches, what of them was measured, and their predicted contact pressures."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from experiments.train.configs import TrainExperiment
from experiments.train.loads import (
    PressLoad,
    press_load,
    several_skins,
    with_known_load,
)
from experiments.train.splitting import conditions_of, judging_touches, split_dataset
from i2t.contact.pressure import PressureModelConfig, predict_pressures
from i2t.dataset import Dataset, Split
from i2t.prediction.methods import ASSUMED_FORCE_N, TrainingTouches, views_of
from i2t.recordings.sets import corrected_dataset

NOISY_CURVATURE_M = 20e-6  # median second difference of pixels that a surface without noise stays below
LARGE_WINDOW_M = 25e-3  # from here on the skin is taken to be as large as the window, and cells are coarser
LEAST_PRESSED_SHARE = 0.1  # of training touches that must have a predicted pressure


class Prepared(NamedTuple):
    """Touches to learn from, and what is held out of them."""

    touches: TrainingTouches
    split: Split
    notes: tuple[str, ...]  # what is odd about the recording, a sentence each
    judging: np.ndarray | None = None  # (n,) bool, touches that choose the method beside those that validate

    @property
    def judging_rows(self) -> np.ndarray:
        """Mask (n,) of all touches that choose the method."""
        return self.split.validation if self.judging is None else self.split.validation | self.judging


def prepare(dataset: Dataset, cfg: TrainExperiment, how: str, seed: int, softness: float = 1.0) -> Prepared:
    """Split touches, and predict the contact pressure of each.

    Args:
        dataset: Recorded or simulated.
        cfg: Of the experiment.
        how: To split: object, session, block, time, or auto.
        seed: Of the split.
        softness: Of the skin, in units of the nominal one's.

    Returns:
        What methods are given; a person should be told its notes.

    Raises:
        DataError: A part of the split would hold too few touches.
    """
    dataset, corrected = corrected_dataset(dataset)
    dataset, left_out = with_known_load(dataset)
    split = split_dataset(dataset, cfg, how, seed)
    load = press_load(dataset.select(split.train | split.validation | split.test).touches)
    notes = (*corrected, *([left_out] if left_out else []), *several_skins(dataset), *load.notes)
    touches = TrainingTouches(dataset, conditions_of(dataset.touches, split))
    prepared = Prepared(touches, split, notes, judging_touches(dataset, cfg))
    model = pressure_model_of(dataset, load, cfg, softness)
    return prepared if model is None else with_pressure(prepared, model, load)


def pressure_model_of(
    dataset: Dataset, load: PressLoad, cfg: TrainExperiment, softness: float
) -> PressureModelConfig | None:
    """Model of contact pressure on this set: from its load, and from views that are smoothed where they are noisy; None
    where nothing says how hard touches were pressed.
    """
    if load.control is None:
        return None
    patches = dataset.touches.patch
    curvature = patches[:, 2:] - 2 * patches[:, 1:-1] + patches[:, :-2]
    noisy = float(np.median(np.abs(curvature))) > NOISY_CURVATURE_M
    tilted = noisy or cfg.registered is not None  # a rendered view has no noise, but does not show the tilt either
    large = dataset.window > LARGE_WINDOW_M
    return PressureModelConfig(
        pitch=dataset.window / patches.shape[1],
        window=round(dataset.window * 500) / 500 if large else PressureModelConfig.window,
        smooth=noisy,
        tilt=cfg.hidden_tilt if tilted else 0.0,
        control=load.control,
        softness=softness,
        cell=1e-3 if large else PressureModelConfig.cell,
    )


def with_pressure(prepared: Prepared, model: PressureModelConfig, load: PressLoad) -> Prepared:
    """Predict the contact pressure of each touch; none where almost all predicted pressures are zero."""
    split, dataset, notes = prepared.split, prepared.touches.dataset, prepared.notes
    print("predicting contact pressures")
    force = np.full(len(dataset), ASSUMED_FORCE_N, np.float32) if load.constant else dataset.touches.force
    pressure = predict_pressures(model, views_of(dataset), force, dataset.touches.travel)
    total = np.asarray(pressure.pressure)[split.train].sum((1, 2))
    pressed = float(np.mean(total > model.floor / 10))
    if np.isfinite(total).all() and pressed >= LEAST_PRESSED_SHARE:
        return prepared._replace(touches=replace(prepared.touches, pressure_model=model, pressure=pressure))
    said = f"{100 * (1 - pressed):.0f} % of the predicted contact pressures are zero or not finite"
    return prepared._replace(notes=(*notes, f"{said}: methods on them are left out"))
