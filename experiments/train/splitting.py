"""Split of touches into those that train, choose between methods, and test: whole objects, sessions, places or times,
never single touches of what was trained on.
"""

import numpy as np

from experiments.train.configs import TrainExperiment
from i2t import dataset as data
from i2t.dataset import Dataset, Split
from i2t.errors import DataError
from i2t.types import ReturnCode, Touches

MIN_SPLIT_BLOCKS, LEAST_BLOCK_M = 12, 1.5e-3  # blocks are made smaller for there to be as many, down to this edge
MIN_SESSIONS = 5  # that can be held out where places cannot
MIN_PART_TOUCHES = 2  # of each part of a split
MORE_TOUCHES = {
    "object": "touches of other objects", "session": "other sessions", "block": "touches at other places",
    "time": "touches",
}  # fmt: skip


def split_dataset(dataset: Dataset, cfg: TrainExperiment, how: str, seed: int) -> Split:
    """Hold out objects, sessions, blocks of places or the last touches in time; presses that failed or made no contact
    are left out, as are the objects that only choose the method. What validates is held out as what tests is.
    """
    touches = dataset.touches
    usable = _usable(touches) & ~judging_touches(dataset, cfg)
    plan = cfg.simulation
    if how == "auto":
        known = set(plan.objects) <= set(dataset.objects)
        how = "object" if known or len(dataset.objects) >= 3 else _split_of_one_object(dataset, cfg.block)
    rng = np.random.default_rng(seed)
    groups = touches.session.copy()
    if how == "object":
        names = dataset.objects
        if set(plan.objects) <= set(names):
            test, validation = plan.test, plan.validation
        else:
            order = [names[i] for i in rng.permutation(len(names))]
            third = max(len(names) // 3, 1)
            # Of six or more that are left, two validate: one object alone is a poor judge of methods.
            test, validation = tuple(order[:third]), tuple(order[third : third + 1 + (len(names) - third >= 6)])
        held, tuning = data.holdout_names(dataset, "object", test), data.holdout_names(dataset, "object", validation)
        if len(np.unique(groups)) < 4:  # one long run: neighbours in place stay together
            groups = data.spatial_blocks(dataset, cfg.block)
    elif how == "session":
        order = [dataset.sessions[i] for i in rng.permutation(len(dataset.sessions))]
        fifth = max(len(order) // 5, 1)
        held = data.holdout_names(dataset, "session", order[:fifth])
        tuning = data.holdout_names(dataset, "session", order[fifth : 2 * fifth])
    elif how == "block":
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
    split = Split(usable & ~held & ~tuning, usable & tuning & ~held, usable & held, groups, how)
    for part in ("train", "validation", "test"):
        if (count := int(getattr(split, part).sum())) < MIN_PART_TOUCHES:
            raise DataError(
                f"of {int(usable.sum())} usable touches, splitting by {how} leaves {count} to {part}, which needs "
                f"{MIN_PART_TOUCHES}; choose another --split, or add {MORE_TOUCHES[how]}"
            )
    return split


def judging_touches(dataset: Dataset, cfg: TrainExperiment) -> np.ndarray:
    """Mask (n,) of the touches that no method is fitted to or tested on, and by which the best is chosen, too: of the
    preset's objects, in a set that has them all.
    """
    plan = cfg.simulation
    if not set(plan.objects) <= set(dataset.objects):
        return np.zeros(len(dataset), bool)
    judging = [dataset.objects.index(name) for name in plan.judging]
    return np.isin(dataset.touches.object, judging) & _usable(dataset.touches)


def _usable(touches: Touches) -> np.ndarray:
    return ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR])


def block_edge(dataset: Dataset, edge: float) -> float:
    """The edge (m) of spatial blocks: halved where touches lie in too few to hold some out."""
    while len(np.unique(data.spatial_blocks(dataset, edge))) < MIN_SPLIT_BLOCKS and edge >= 2 * LEAST_BLOCK_M:
        edge /= 2
    return edge


def _split_of_one_object(dataset: Dataset, edge: float) -> str:
    """Blocks of places; sessions or times where all touches are at a few places."""
    if len(np.unique(data.spatial_blocks(dataset, block_edge(dataset, edge)))) >= MIN_SPLIT_BLOCKS:
        return "block"
    return "session" if len(np.unique(dataset.touches.session)) >= MIN_SESSIONS else "time"


def conditions_of(touches: Touches, split: Split) -> tuple[str, ...]:
    """Conditions among force, nearest and travel that were measured at every touch."""
    used = split.train | split.validation | split.test
    return tuple(name for name in ("force", "nearest", "travel") if np.isfinite(getattr(touches, name)[used]).all())
