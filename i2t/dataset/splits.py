"""Choice of touches to hold out. Every function returns a boolean mask of the touches held out, or labels to split by.

Neighbouring touches of one object share what they feel, and those of one session share their errors: rows are therefore
never shuffled singly, but held out by object, by pad, by session, by block of space, or from some time on.

    from i2t.dataset import holdout_blocks, holdout_names, load_dataset

    dataset = load_dataset("recordings")
    held_out = holdout_names(dataset, "session", ["monday"])  # or holdout_blocks(dataset, 3e-3, 0.2, seed=0)
    train, test = dataset.select(~held_out), dataset.select(held_out)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from i2t.dataset.sets import Dataset
from i2t.errors import DataError

# Of a block: a regular grid of presses may fall on block edges, and rounding must not scatter it to both sides.
EDGE_SLACK = 1e-3
PLACE_M = 0.2e-3  # largest distance between presses at one place


@dataclass(frozen=True)
class Split:
    """Touches to train on, to choose by and to test on, as masks (n,).

    Attributes:
        train: To fit to.
        validation: To choose between methods by.
        test: To report on.
        groups: (n,) session, spatial block or stretch of time of each touch, which is never torn apart.
        how: In words, what is held out.

    Example:
        session = dataset.touches.session
        held_out = session % 5 == 4
        split = i2t.Split(~held_out, held_out, np.zeros(len(session), bool), session, "every fifth session")
    """

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray
    groups: np.ndarray
    how: str


def by_group(labels: np.ndarray) -> dict[int, np.ndarray]:
    """The rows of each label.

    Args:
        labels: (n,) integers: an index array of the touches, or block numbers.

    Returns:
        Row numbers by label, in row order.
    """
    return {int(label): np.flatnonzero(labels == label) for label in np.unique(labels)}


def square_blocks(position: np.ndarray, edge: float, *, origin: tuple[float, float] | None = None) -> np.ndarray:
    """The square block in which each position lies. An edge belongs to the block above it.

    Args:
        position: (n, 2) m.
        edge: m, of a block.
        origin: (2,) m, a corner of blocks; by default the least position on each axis.

    Returns:
        Block number (n,) of each position, counted from 0.
    """
    if not len(position):
        return np.zeros(0, np.int64)
    cell = np.floor((position - (position.min(0) if origin is None else np.array(origin))) / edge + EDGE_SLACK)
    return np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1)


def same_places(position: np.ndarray) -> np.ndarray:
    """Group positions into places no wider than `PLACE_M` (complete linkage).

    Args:
        position: (n, 2) m.

    Returns:
        Number of the place (n,) of each position, counted from 0.
    """
    from scipy.cluster.hierarchy import fcluster, linkage  # which reading a data set does not need

    if len(position) < 2:
        return np.zeros(len(position), np.int64)
    return fcluster(linkage(position, "complete"), PLACE_M, "distance").astype(np.int64) - 1


def holdout_names(dataset: Dataset, kind: str, names: Sequence[str]) -> np.ndarray:
    """The touches of some objects, pads or sessions.

    Args:
        dataset: of n touches.
        kind: "object", "pad" or "session".
        names: whose touches are held out.

    Returns:
        Mask (n,).

    Raises:
        DataError: a name is not in the data set.
    """
    known = getattr(dataset, kind + "s")
    unknown = [name for name in names if name not in known]
    if unknown:
        raise DataError(f"no {kind} is called {', '.join(unknown)}; the data set has {', '.join(known)}")
    return np.isin(getattr(dataset.touches, kind), [known.index(name) for name in names])


def spatial_blocks(dataset: Dataset, size: float) -> np.ndarray:
    """Squares over x and y of the tool's position in its object's frame, object by object.

    An edge belongs to the block above it. Where the object's pose is unknown, the world's frame of its session stands
    in.

    Args:
        dataset: of n touches.
        size: m, edge of a square.

    Returns:
        Block number (n,) of each touch.
    """
    touches = dataset.touches
    unknown = np.isnan(touches.T_w_o).any((1, 2))
    T_w_o = np.where(unknown[:, None, None], np.eye(4), touches.T_w_o.astype(np.float64))
    from_object = touches.T_w_t[:, :3, 3].astype(np.float64) - T_w_o[:, :3, 3]
    position = np.einsum("nji,nj->ni", T_w_o[:, :3, :3], from_object)
    block = square_blocks(position[:, :2], size, origin=(0.0, 0.0))
    frame = np.where(unknown, touches.session, -1)
    return np.unique(np.column_stack([touches.object, frame, block]), axis=0, return_inverse=True)[1].reshape(-1)


def holdout_blocks(dataset: Dataset, size: float, fraction: float, seed: int) -> np.ndarray:
    """Whole random blocks of space that together hold at least a fraction of the touches, and not a block more.

    Args:
        dataset: of n touches.
        size: m, edge of a block.
        fraction: of the touches, 0 to 1.
        seed: of the choice of blocks.

    Returns:
        Mask (n,).
    """
    blocks = spatial_blocks(dataset, size)
    order = np.random.default_rng(seed).permutation(blocks.max(initial=-1) + 1)
    filled = np.cumsum(np.bincount(blocks, minlength=len(order))[order])
    needed = int(np.searchsorted(filled, fraction * len(dataset) - 1e-9)) + 1 if fraction > 0 else 0
    return np.isin(blocks, order[:needed])


def holdout_last(dataset: Dataset, fraction: float) -> np.ndarray:
    """The last touches of each pad in time (the order of rows).

    Args:
        dataset: of n touches.
        fraction: of each pad's touches, rounded to whole touches.

    Returns:
        Mask (n,).
    """
    held = np.zeros(len(dataset), bool)
    for rows in by_group(dataset.touches.pad).values():
        held[rows[len(rows) - round(fraction * len(rows)) :]] = True
    return held
