"""What in recorded presses contradicts any model of a sound skin, and what to do about it. NumPy only."""

from typing import NamedTuple

import numpy as np

STEEL = 500.0  # uT/N: real boards show 78-122 with a plastic tip, 6-10 times more with one of steel


class Faults(NamedTuple):
    """Where recorded presses contradict the model."""

    stale: np.ndarray  # (n,) bool: rows that repeat the reading before them
    lag: int  # rows by which the labels come late; best explains the readings
    lag_r2: dict[int, float]  # R2 of neighbours for each lag
    change: float  # squared difference of neighbours in other halves of time over that in the same half
    changed: bool  # beyond chance; False where the halves do not overlap (change is then NaN)
    chips: tuple[int, ...] = ()  # chips that changed by themselves, where the whole skin did not
    sensitivity: float = float("nan")  # uT/N, median norm of a reading per force; only where the load is a force

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
        if self.chips:
            told.append(
                f"chip {', '.join(map(str, self.chips))} changed between the halves of the session and the others did "
                "not: the skin slipped over it, or it remembers presses; calibrate the halves apart"
            )
        if self.sensitivity > STEEL:
            told.append(
                f"readings are {self.sensitivity:.0f} uT per newton, beyond {STEEL:g} of any such skin: a tip of steel "
                "or another magnet disturbs the field; press with plastic or aluminium"
            )
        return told


def check(
    place: np.ndarray,
    load: np.ndarray,
    readings: np.ndarray,
    lags: int = 4,
    gain: float = 0.05,
    by_force: bool = False,
) -> Faults:
    """Look for repeated rows, a shifted label column and a changed skin in presses in the order of time (NumPy).

    A lag is reported if the R2 of neighbours grows by more than `gain`. With lag k the reading of row i belongs to the
    labels of row i + k. Needs about 100 presses; with fewer nothing but repeated rows and, where the load is a force
    (`by_force`, N), a tip of steel is looked for.
    """
    stale = np.concatenate([[False], (np.diff(readings, axis=0) == 0).all(1)])
    at = np.column_stack([place / np.maximum(place.std(0), 1e-9), load / max(load.std(), 1e-9)])
    firm = (load > 0.1 * load.max()) & ~stale
    sensitivity = float(np.median(np.linalg.norm(readings[firm], axis=1) / load[firm])) if by_force else float("nan")
    if np.sum(~stale) < 100:
        return Faults(stale, 0, {}, float("nan"), False, (), sensitivity)
    r2 = {}
    for lag in range(-lags, lags + 1):
        rows = np.arange(max(0, -lag), len(at) - max(0, lag))
        r2[lag] = _neighbours_r2(at[rows + lag][~stale[rows]], readings[rows][~stale[rows]])
    best = max(r2, key=lambda lag: r2[lag])
    lag = best if r2[best] > r2[0] + gain else 0
    rows = np.arange(max(0, -lag), len(at) - max(0, lag))
    labels, values = at[rows + lag][~stale[rows]], readings[rows][~stale[rows]]
    change, changed = _change(labels, values)
    alone = (
        [] if changed else [i // 3 for i in range(0, values.shape[1], 3) if _change(labels, values[:, i : i + 3])[1]]
    )
    return Faults(stale, lag, r2, change, changed, tuple(alone), sensitivity)


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
