"""Input of every method: the touches, their measured conditions and their predicted contact pressures."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from experiments.train.configs import TrainExperiment
from experiments.train.loads import PressLoad, press_load, several_skins, with_known_load
from experiments.train.splitting import conditions_of, selection_touches, split_dataset
from i2t.contact.pressure import PressureModelConfig, predict_pressures
from i2t.dataset import Dataset, Split
from i2t.prediction.methods import ASSUMED_FORCE_N, TrainingTouches, views_of
from i2t.recordings.sets import corrected_dataset


class Prepared(NamedTuple):
    """Touches with their split."""

    touches: TrainingTouches
    split: Split
    notes: tuple[str, ...]  # sentences about problems of the recording
    selection: np.ndarray | None = None  # (n,) mask of further touches for choosing the method

    @property
    def selection_rows(self) -> np.ndarray:
        """Mask (n,) of all touches by which the method is chosen."""
        return self.split.validation if self.selection is None else self.split.validation | self.selection


def prepare(dataset: Dataset, cfg: TrainExperiment, split_by: str, seed: int, softness: float = 1.0) -> Prepared:
    """Split touches, and predict the contact pressure of each.

    Args:
        dataset: Recorded or simulated touches.
        cfg: Settings of the experiment.
        split_by: What is held out: object, session, block, time, or auto.
        seed: Seed of the split.
        softness: Softness of the skin, relative to the nominal skin.

    Returns:
        The input of the methods, with notes for the user.

    Raises:
        DataError: A part of the split would hold too few touches.
    """
    dataset, corrected = corrected_dataset(dataset)
    dataset, left_out = with_known_load(dataset)
    split = split_dataset(dataset, cfg, split_by, seed)
    load = press_load(dataset.select(split.train | split.validation | split.test).touches)
    notes = (*corrected, *([left_out] if left_out else []), *several_skins(dataset), *load.notes)
    touches = TrainingTouches(dataset, conditions_of(dataset.touches, split))
    prepared = Prepared(touches, split, notes, selection_touches(dataset, cfg))
    model = pressure_model_of(dataset, load, cfg, softness)
    return prepared if model is None else with_pressure(prepared, model, load)


def pressure_model_of(
    dataset: Dataset, load: PressLoad, cfg: TrainExperiment, softness: float, *, noisy_curvature: float = 20e-6
) -> PressureModelConfig | None:
    """Choose the model of contact pressure for a data set, or None if no load is known. Noisy views, whose median
    second difference of pixels exceeds `noisy_curvature` (m), are smoothed.
    """
    if load.control is None:
        return None
    patches = dataset.touches.patch
    curvature = patches[:, 2:] - 2 * patches[:, 1:-1] + patches[:, :-2]
    noisy = float(np.median(np.abs(curvature))) > noisy_curvature
    tilted = noisy or cfg.registered is not None  # a rendered view has no noise, but does not show the tilt either
    large = dataset.window > 25e-3  # then the skin is assumed to be as large as the window, and cells are coarser
    return PressureModelConfig(
        pitch=dataset.window / patches.shape[1],
        window=round(dataset.window * 500) / 500 if large else PressureModelConfig.window,
        smooth=noisy,
        tilt=cfg.hidden_tilt if tilted else 0.0,
        control=load.control,
        softness=softness,
        cell=1e-3 if large else PressureModelConfig.cell,
    )


def with_pressure(
    prepared: Prepared, model: PressureModelConfig, load: PressLoad, *, min_share: float = 0.1
) -> Prepared:
    """Add the predicted contact pressures, unless less than a share of those for training are positive."""
    split, dataset, notes = prepared.split, prepared.touches.dataset, prepared.notes
    print(f"predicting the contact pressures of {len(dataset)} touches", flush=True)
    force = np.full(len(dataset), ASSUMED_FORCE_N, np.float32) if load.constant else dataset.touches.force
    pressure = predict_pressures(model, views_of(dataset), force, dataset.touches.travel)
    total = np.asarray(pressure.pressure)[split.train].sum((1, 2))
    pressed = float(np.mean(total > model.floor / 10))
    if np.isfinite(total).all() and pressed >= min_share:
        return prepared._replace(touches=replace(prepared.touches, pressure_model=model, pressure=pressure))
    share = f"{100 * (1 - pressed):.0f} % of the predicted contact pressures are zero or not finite"
    return prepared._replace(notes=(*notes, f"{share}: methods on them are left out"))
