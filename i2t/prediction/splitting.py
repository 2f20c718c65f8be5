"""Choice of a split of touches into training, validation and test by whole objects, sessions, places or times."""

from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np

from i2t.dataset import Dataset, Split, holdout_blocks, holdout_last, holdout_names, spatial_blocks
from i2t.errors import DataError
from i2t.types import ReturnCode, Touches

SplitKind: TypeAlias = Literal["auto", "object", "session", "block", "time"]

MIN_SPLIT_BLOCKS = 12  # minimum number of spatial blocks for holding out blocks


def choose_split(
    dataset: Dataset,
    kind: SplitKind | str = "auto",
    *,
    seed: int = 0,
    names: tuple[Sequence[str], Sequence[str]] | None = None,
    rows: np.ndarray | None = None,
    block: float = 6e-3,
    min_touches: int = 2,
) -> Split:
    """Hold out objects, sessions, spatial blocks or the last touches in time, for validation and for the test.

    Failed presses and presses without contact are in no part.

    Args:
        dataset: n touches.
        kind: What is held out: "object", "session", "block", "time", or "auto": objects if there are at least three,
            otherwise spatial blocks, sessions if all touches are at a few places, or times if there are few sessions.
        seed: Seed of the random choice of names and blocks.
        names: Names of the objects to validate on and of those to test on; by default, they are drawn. "auto" then
            holds out objects.
        rows: `(n,)` mask of the touches that may be used; all by default.
        block: Largest edge (m) of a spatial block.
        min_touches: Minimum number of touches in each part.

    Returns:
        The split, with sessions, blocks or stretches of 20 touches as groups.

    Raises:
        DataError: A part would have fewer than `min_touches`.

    Example:
        split = i2t.prediction.choose_split(dataset, "session")
    """
    usable = touches_with_contact(dataset.touches) & (True if rows is None else rows)
    if kind == "auto":
        kind = "object" if names or len(dataset.objects) >= 3 else _kind_for_one_object(dataset, block)
    rng = np.random.default_rng(seed)
    groups = dataset.touches.session.copy()
    if kind == "object":
        validation, test = names or _drawn_objects(dataset.objects, rng)
        tuning, held = (holdout_names(dataset, "object", part) for part in (validation, test))
        if len(np.unique(groups)) < 4:  # in one long session, neighbouring touches stay together
            groups = spatial_blocks(dataset, block)
    elif kind == "session":
        order = [dataset.sessions[i] for i in rng.permutation(len(dataset.sessions))]
        fifth = max(len(order) // 5, 1)
        held = holdout_names(dataset, "session", order[:fifth])
        tuning = holdout_names(dataset, "session", order[fifth : 2 * fifth])
    elif kind == "block":
        edge = block_edge(dataset, block)
        groups = spatial_blocks(dataset, edge)
        held = holdout_blocks(dataset, edge, 0.2, seed)
        rest = np.flatnonzero(~held)
        tuning = np.zeros(len(dataset), bool)
        if len(rest):
            tuning[rest[holdout_blocks(dataset.select(rest), edge, 0.1, seed)]] = True
    else:
        groups = np.arange(len(dataset)) // 20
        held = holdout_last(dataset, 0.2)
        tuning = holdout_last(dataset, 0.3) & ~held
    split = Split(usable & ~held & ~tuning, usable & tuning & ~held, usable & held, groups, kind)
    missing = {"object": "touches of other objects", "session": "other sessions", "block": "touches at other places"}
    for part in ("train", "validation", "test"):
        if (count := int(getattr(split, part).sum())) < min_touches:
            raise DataError(
                f"of {int(usable.sum())} usable touches, splitting by {kind} leaves {count} to {part}, which needs "
                f"{min_touches}; choose another --split, or add {missing.get(kind, 'touches')}"
            )
    return split


def touches_with_contact(touches: Touches) -> np.ndarray:
    """Mark the touches that neither failed nor ended without contact.

    Args:
        touches: n touches.

    Returns:
        `(n,)` mask of the touches with contact.
    """
    return ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR])


def block_edge(dataset: Dataset, edge: float, min_edge: float = 1.5e-3) -> float:
    """Halve the edge of spatial blocks until there are enough blocks for holding some out.

    Args:
        dataset: The touches.
        edge: Largest edge (m) of a block.
        min_edge: Edge (m) below which blocks are not made.

    Returns:
        The edge (m).
    """
    while len(np.unique(spatial_blocks(dataset, edge))) < MIN_SPLIT_BLOCKS and edge >= 2 * min_edge:
        edge /= 2
    return edge


def _drawn_objects(names: Sequence[str], rng: np.random.Generator) -> tuple[list[str], list[str]]:
    """Draw the objects to validate on and a third of all to test on."""
    order = [names[i] for i in rng.permutation(len(names))]
    third = max(len(names) // 3, 1)
    # Of six or more remaining objects, two are for validation, because one does not represent the others well.
    return order[third : third + 1 + (len(names) - third >= 6)], order[:third]


def _kind_for_one_object(dataset: Dataset, edge: float) -> str:
    """Choose spatial blocks, or sessions or times if all touches are at a few places."""
    if len(np.unique(spatial_blocks(dataset, block_edge(dataset, edge)))) >= MIN_SPLIT_BLOCKS:
        return "block"
    return "session" if len(np.unique(dataset.touches.session)) >= 5 else "time"
