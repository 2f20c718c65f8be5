"""What in recorded presses contradicts any model of a sound skin, and what to do about it. NumPy only."""

from typing import NamedTuple

import numpy as np


class Faults(NamedTuple):
    """Where recorded presses contradict the model."""

    stale: np.ndarray  # (n,) bool: rows that repeat the reading before them
    lag: int  # rows by which the labels come late; best explains the readings
    lag_r2: dict[int, float]  # R2 of neighbours for each lag
    change: float  # squared difference of neighbours in other halves of time over that in the same half
    changed: bool  # beyond chance; False where the halves do not overlap (change is then NaN)

    def sentences(self) -> list[str]:
        """What to tell a person; empty where nothing is wrong."""
        told = []
        if self.stale.any():
            told.append(
                f"{self.stale.sum()} rows repeat the reading before them: the board sent nothing new; drop them"
            )
        if self.lag:
            told.append(
                f"readings agree best with labels of {self.lag:+d} rows (R2 of neighbours {self.lag_r2[self.lag]:.2f}, "
                f"{self.lag_r2[0]:.2f} as recorded): the label column is shifted"
            )
        if self.changed:
            told.append(
                f"neighbours from the other half of the session differ {self.change:.1f} times as much as from the "
                "same half: the skin slipped or changed; calibrate the halves apart"
            )
        return told


def check(place: np.ndarray, load: np.ndarray, readings: np.ndarray, lags: int = 4, gain: float = 0.05) -> Faults:
    """Look for repeated rows, a shifted label column and a changed skin in presses in the order of time (NumPy).

    A lag is reported if the R2 of neighbours grows by more than `gain`. With lag k the reading of row i belongs to the
    labels of row i + k. Needs about 100 presses; with fewer nothing but repeated rows is looked for.
    """
    stale = np.concatenate([[False], (np.diff(readings, axis=0) == 0).all(1)])
    at = np.column_stack([place / np.maximum(place.std(0), 1e-9), load / max(load.std(), 1e-9)])
    if np.sum(~stale) < 100:
        return Faults(stale, 0, {}, float("nan"), False)
    r2 = {}
    for lag in range(-lags, lags + 1):
        rows = np.arange(max(0, -lag), len(at) - max(0, lag))
        r2[lag] = _neighbours_r2(at[rows + lag][~stale[rows]], readings[rows][~stale[rows]])
    best = max(r2, key=lambda lag: r2[lag])
    lag = best if r2[best] > r2[0] + gain else 0
    rows = np.arange(max(0, -lag), len(at) - max(0, lag))
    change, changed = _change(at[rows + lag][~stale[rows]], readings[rows][~stale[rows]])
    return Faults(stale, lag, r2, change, changed)


def _neighbours_r2(at: np.ndarray, readings: np.ndarray, k: int = 4) -> float:
    """R2 of the mean of the k nearest other presses."""
    from scipy.spatial import cKDTree

    near = cKDTree(at).query(at, k + 1)[1]
    error = readings - readings[near[:, 1:]].mean(1)
    return float(1 - (error**2).sum() / ((readings - readings.mean(0)) ** 2).sum())


def _change(at: np.ndarray, readings: np.ndarray) -> tuple[float, bool]:
    """Compare the nearest neighbour in the other half of time with the nearest in the same half, where they are about
    as far.
    """
    from scipy.spatial import cKDTree

    late = np.arange(len(at)) >= len(at) // 2
    trees = {half: (np.flatnonzero(late == half), cKDTree(at[late == half])) for half in (False, True)}
    same, other = [], []
    for half, (rows, tree) in trees.items():
        far_same, near_same = tree.query(at[rows], 2)
        there, other_tree = trees[not half]
        far_other, near_other = other_tree.query(at[rows])
        alike = (far_other > 0.5 * far_same[:, 1]) & (far_other < 2 * far_same[:, 1])
        same.append(((readings[rows] - readings[rows[near_same[:, 1]]]) ** 2).sum(1)[alike])
        other.append(((readings[rows] - readings[there[near_other]]) ** 2).sum(1)[alike])
    a, b = np.concatenate(same), np.concatenate(other)
    if len(a) < 40:
        return float("nan"), False
    # Neighbours come in pairs, so that half as many differences are independent.
    sure = (b - a).mean() > 4 * (b - a).std() / np.sqrt(len(a) / 2)
    return float(b.sum() / a.sum()), bool(sure and b.sum() > 1.2 * a.sum())
