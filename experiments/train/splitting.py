"""Split of touches into training, validation and test by whole objects, sessions, places or times."""

import numpy as np

from experiments.train.configs import TrainExperiment
from i2t import dataset as data
from i2t.dataset import Dataset, Split
from i2t.errors import DataError
from i2t.types import ReturnCode, Touches

MIN_SPLIT_BLOCKS = 12  # minimum number of spatial blocks for holding out blocks


def split_dataset(dataset: Dataset, cfg: TrainExperiment, split_by: str, seed: int, *, min_touches: int = 2) -> Split:
    """Hold out objects, sessions, spatial blocks or the last touches in time, for validation and for the test. Failed
    presses, presses without contact and the objects that serve only to select a method are left out. DataError: A part
    would have fewer than `min_touches`.
    """
    touches = dataset.touches
    usable = _usable(touches) & ~selection_touches(dataset, cfg)
    plan = cfg.simulation
    planned = set(plan.objects) <= set(dataset.objects)
    if split_by == "auto":
        many_objects = planned or len(dataset.objects) >= 3
        split_by = "object" if many_objects else _split_of_one_object(dataset, cfg.block)
    rng = np.random.default_rng(seed)
    groups = touches.session.copy()
    if split_by == "object":
        names = dataset.objects
        if planned:
            test, validation = plan.test, plan.validation
        else:
            order = [names[i] for i in rng.permutation(len(names))]
            third = max(len(names) // 3, 1)
            # Of six or more remaining objects, two are for validation, because one does not represent the others well.
            test, validation = tuple(order[:third]), tuple(order[third : third + 1 + (len(names) - third >= 6)])
        held, tuning = data.holdout_names(dataset, "object", test), data.holdout_names(dataset, "object", validation)
        if len(np.unique(groups)) < 4:  # in one long session, neighbouring touches stay together
            groups = data.spatial_blocks(dataset, cfg.block)
    elif split_by == "session":
        order = [dataset.sessions[i] for i in rng.permutation(len(dataset.sessions))]
        fifth = max(len(order) // 5, 1)
        held = data.holdout_names(dataset, "session", order[:fifth])
        tuning = data.holdout_names(dataset, "session", order[fifth : 2 * fifth])
    elif split_by == "block":
        edge = block_edge(dataset, cfg.block)
        groups = data.spatial_blocks(dataset, edge)
        held = data.holdout_blocks(dataset, edge, 0.2, seed)
        rest = np.flatnonzero(~held)
        tuning = np.zeros(len(dataset), bool)
        if len(rest):
            tuning[rest[data.holdout_blocks(dataset.select(rest), edge, 0.1, seed)]] = True
    else:
        groups = np.arange(len(dataset)) // 20
        held = data.holdout_last(dataset, 0.2)
        tuning = data.holdout_last(dataset, 0.3) & ~held
    split = Split(usable & ~held & ~tuning, usable & tuning & ~held, usable & held, groups, split_by)
    for part in ("train", "validation", "test"):
        if (count := int(getattr(split, part).sum())) < min_touches:
            more = {
                "object": "touches of other objects",
                "session": "other sessions",
                "block": "touches at other places",
            }
            raise DataError(
                f"of {int(usable.sum())} usable touches, splitting by {split_by} leaves {count} to {part}, which needs "
                f"{min_touches}; choose another --split, or add {more.get(split_by, 'touches')}"
            )
    return split


def selection_touches(dataset: Dataset, cfg: TrainExperiment) -> np.ndarray:
    """Mark the touches that serve only to select a method, as a mask (n,). Only a data set with all objects of the
    preset has any.
    """
    plan = cfg.simulation
    if not set(plan.objects) <= set(dataset.objects):
        return np.zeros(len(dataset), bool)
    selection = [dataset.objects.index(name) for name in plan.selection]
    return np.isin(dataset.touches.object, selection) & _usable(dataset.touches)


def _usable(touches: Touches) -> np.ndarray:
    return ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR])


def block_edge(dataset: Dataset, edge: float, min_edge: float = 1.5e-3) -> float:
    """Halve the edge (m) of spatial blocks until there are enough blocks for holding some out."""
    while len(np.unique(data.spatial_blocks(dataset, edge))) < MIN_SPLIT_BLOCKS and edge >= 2 * min_edge:
        edge /= 2
    return edge


def _split_of_one_object(dataset: Dataset, edge: float) -> str:
    """Choose spatial blocks, or sessions or times if all touches are at a few places."""
    if len(np.unique(data.spatial_blocks(dataset, block_edge(dataset, edge)))) >= MIN_SPLIT_BLOCKS:
        return "block"
    return "session" if len(np.unique(dataset.touches.session)) >= 5 else "time"


def conditions_of(touches: Touches, split: Split) -> tuple[str, ...]:
    """List which of force, nearest and travel were measured at every touch."""
    used = split.train | split.validation | split.test
    return tuple(name for name in ("force", "nearest", "travel") if np.isfinite(getattr(touches, name)[used]).all())
