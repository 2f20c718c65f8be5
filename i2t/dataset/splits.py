"""Selection of touches to hold out, as boolean masks, and labels of groups that a split must keep together.

Neighbouring touches of an object have similar contacts, and touches of a session share their errors. Single rows are
therefore never shuffled: touches are held out by object, pad, session, spatial block, or from some time on.

    from i2t.dataset import holdout_blocks, holdout_names, load_dataset

    dataset = load_dataset("recordings")
    held_out = holdout_names(dataset, "session", ["monday"])  # or holdout_blocks(dataset, 3e-3, 0.2, seed=0)
    train, test = dataset.select(~held_out), dataset.select(held_out)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from i2t.dataset.sets import Dataset
from i2t.errors import DataError, did_you_mean

HOLDOUT_KINDS = ("object", "pad", "session")  # of names that a split can hold out
SAME_PLACE_M = 0.2e-3  # m, largest distance between presses that count as at the same place of the skin


@dataclass(frozen=True)
class Split:
    """Division of a data set of n touches into training, validation and test touches.

    Attributes:
        train: `(n,)` mask of the touches to fit to.
        validation: `(n,)` mask of the touches on which to choose between methods.
        test: `(n,)` mask of the touches on which to report results.
        groups: `(n,)` session, spatial block or stretch of time of each touch. A split never divides a group.
        description: Description of what is held out.

    Example:
        split = i2t.Split.hold_out(dataset, "object", validation=["cutter"])
    """

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray
    groups: np.ndarray
    description: str

    @classmethod
    def hold_out(
        cls, dataset: Dataset, kind: str, *, validation: Sequence[str] = (), test: Sequence[str] = ()
    ) -> "Split":
        """Hold out the touches of some objects, pads or sessions, and train on all others.

        Args:
            dataset: Data set of n touches.
            kind: "object", "pad" or "session".
            validation: Names of the objects, pads or sessions to validate on.
            test: Names of those to test on.

        Returns:
            The split, with sessions as groups.

        Raises:
            DataError: There is no such kind, the data set lacks a name, or a name is given for both.
        """
        validating, testing = (holdout_names(dataset, kind, names) for names in (validation, test))
        if both := [name for name in validation if name in test]:
            raise DataError(f"{kind} {', '.join(both)}: is held out for validation and for test; choose one of them")
        return cls(~(validating | testing), validating, testing, dataset.touches.session, kind)

    def __str__(self) -> str:
        """Count the touches and groups of each part."""
        parts = {"training": self.train, "validation": self.validation, "test": self.test}
        counts = (f"{rows.sum()} {name} ({len(np.unique(self.groups[rows]))} groups)" for name, rows in parts.items())
        return f"Split by {self.description}: {', '.join(counts)}"

    def select(self, rows: np.ndarray) -> "Split":
        """Select the split of some of the touches.

        Args:
            rows: `(n,)` mask, or indices, of touches.

        Returns:
            The split of the selected touches.
        """
        return Split(
            self.train[rows], self.validation[rows], self.test[rows], self.groups[rows], self.description
        )  # fmt: skip


def by_group(labels: np.ndarray) -> dict[int, np.ndarray]:
    """Group row numbers by an integer label of each row.

    Args:
        labels: `(n,)` integers, such as an index array of touches, or block numbers.

    Returns:
        Ascending row numbers of each label.
    """
    return {int(label): np.flatnonzero(labels == label) for label in np.unique(labels)}


def square_blocks(position: np.ndarray, edge: float, *, origin: tuple[float, float] | None = None) -> np.ndarray:
    """Number the square blocks in which positions are; one on an edge belongs to the block of larger coordinate.

    Args:
        position: `(n, 2)` positions (m).
        edge: Edge (m) of a block.
        origin: Corner (x, y) of a block, in m; by default the minimum of the positions on each axis.

    Returns:
        `(n,)` block numbers of the positions, counted from 0.
    """
    if not len(position):
        return np.zeros(0, np.int64)
    corner = position.min(0) if origin is None else np.array(origin)
    # Presses of a regular grid may lie on the edges of blocks, and rounding must not scatter them to both sides.
    cell = np.floor((position - corner) / edge + 1e-3)
    return np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1)


def same_places(position: np.ndarray) -> np.ndarray:
    """Group positions that count as the same place: groups no wider than `SAME_PLACE_M` (complete linkage).

    Args:
        position: `(n, 2)` positions (m).

    Returns:
        `(n,)` place numbers of the positions, counted from 0.
    """
    from scipy.cluster.hierarchy import fcluster, linkage  # slow to import

    if len(position) < 2:
        return np.zeros(len(position), np.int64)
    return fcluster(linkage(position, "complete"), SAME_PLACE_M, "distance").astype(np.int64) - 1


def holdout_names(dataset: Dataset, kind: str, names: Sequence[str]) -> np.ndarray:
    """Hold out the touches of some objects, pads or sessions.

    Args:
        dataset: Data set of n touches.
        kind: "object", "pad" or "session".
        names: Names of the objects, pads or sessions to hold out.

    Returns:
        `(n,)` mask of the touches held out.

    Raises:
        DataError: There is no such kind, the data set lacks a name, or `names` is a single text.
    """
    if kind not in HOLDOUT_KINDS:
        raise DataError(f"{kind!r} cannot be held out; {did_you_mean(kind, HOLDOUT_KINDS)}")
    if isinstance(names, str):
        raise DataError(f"{names!r} is a text; give a list of names, such as [{names!r}]")
    all_names = getattr(dataset, kind + "s")
    unknown = [name for name in names if name not in all_names]
    if unknown:
        raise DataError(f"no {kind} is called {', '.join(map(str, unknown))}; the data set has {', '.join(all_names)}")
    return np.isin(getattr(dataset.touches, kind), [all_names.index(name) for name in names])


def spatial_blocks(dataset: Dataset, size: float) -> np.ndarray:
    """Number square blocks over x and y of the tool's position in the object's frame, separately for each object.

    A position on an edge belongs to the block of larger coordinate. If the object's pose is unknown, the world frame
    of the touch's session is used instead.

    Args:
        dataset: Data set of n touches.
        size: Edge (m) of a block.

    Returns:
        `(n,)` number of each touch's block.
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
    """Hold out the touches in random whole blocks (`spatial_blocks`), as few as hold a fraction of the touches.

    Args:
        dataset: Data set of n touches.
        size: Edge (m) of a block.
        fraction: Fraction of the touches to hold out, from 0 to 1.
        seed: Seed of the random order of blocks.

    Returns:
        `(n,)` mask of the touches held out.
    """
    blocks = spatial_blocks(dataset, size)
    order = np.random.default_rng(seed).permutation(blocks.max(initial=-1) + 1)
    filled = np.cumsum(np.bincount(blocks, minlength=len(order))[order])
    needed = int(np.searchsorted(filled, fraction * len(dataset) - 1e-9)) + 1 if fraction > 0 else 0
    return np.isin(blocks, order[:needed])


def holdout_last(dataset: Dataset, fraction: float) -> np.ndarray:
    """Hold out the last touches of each pad, in the order of rows, which is that of time.

    Args:
        dataset: Data set of n touches.
        fraction: Fraction of each pad's touches to hold out, rounded to whole touches.

    Returns:
        `(n,)` mask of the touches held out.
    """
    held = np.zeros(len(dataset), bool)
    for rows in by_group(dataset.touches.pad).values():
        held[rows[len(rows) - round(fraction * len(rows)) :]] = True
    return held
