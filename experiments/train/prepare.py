"""Input of every method: the touches, their measured conditions and their predicted contact pressures."""

import numpy as np

from experiments.train.configs import TrainExperiment
from i2t.dataset import Dataset, Split
from i2t.prediction.fit import PreparedTouches, correct_touches, prepare_touches
from i2t.prediction.splitting import choose_split, touches_with_contact


def prepare(dataset: Dataset, cfg: TrainExperiment, split_by: str, seed: int, softness: float = 1.0) -> PreparedTouches:
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
    corrected = correct_touches(dataset)
    split = split_dataset(corrected.dataset, cfg, split_by, seed)
    prepared = prepare_touches(
        corrected, split, softness=softness, rendered=cfg.registered is not None, hidden_tilt=cfg.hidden_tilt
    )
    return prepared._replace(selection=selection_touches(corrected.dataset, cfg))


def split_dataset(dataset: Dataset, cfg: TrainExperiment, split_by: str, seed: int) -> Split:
    """Split touches as `choose_split` does, with the preset's objects held out if the data set has all of them. The
    objects that serve only to select a method are left out.
    """
    plan = cfg.simulation
    planned = set(plan.objects) <= set(dataset.objects)
    return choose_split(
        dataset, split_by, seed=seed, names=(plan.validation, plan.test) if planned else None,
        rows=~selection_touches(dataset, cfg), block=cfg.block,
    )  # fmt: skip


def selection_touches(dataset: Dataset, cfg: TrainExperiment) -> np.ndarray:
    """Mark the touches that serve only to select a method, as a mask (n,). Only a data set with all objects of the
    preset has any.
    """
    plan = cfg.simulation
    if not set(plan.objects) <= set(dataset.objects):
        return np.zeros(len(dataset), bool)
    selection = [dataset.objects.index(name) for name in plan.selection]
    return np.isin(dataset.touches.object, selection) & touches_with_contact(dataset.touches)
