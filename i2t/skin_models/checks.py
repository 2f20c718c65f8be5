"""Diagnostics of recorded presses: contradictions to any model of a sound skin, and their remedies.

NumPy only. Presses are compared with their nearest neighbours in position and load, so that no model is needed.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

MAX_SENSITIVITY_UT_PER_N = 500.0  # real boards show 78-122 with a plastic tip, 6-10 times more with one of steel
MIN_PRESSES = 100  # for a change
MIN_PAIRS = 40  # of neighbours, for a change
AXES_PER_CHIP = 3  # of a chip


class DataWarnings(NamedTuple):
    """Conflicts of recorded presses with the model."""

    repeated: Bool[np.ndarray, " n"]  # rows that repeat the reading before them
    change_ratio: float  # squared difference of neighbours in other halves of time over that in the same half
    changed: bool  # beyond chance; False where the halves do not overlap (the ratio is then NaN)
    changed_chips: tuple[int, ...] = ()  # chips that changed by themselves, where the whole skin did not
    sensitivity_ut_per_n: float = float("nan")  # median norm of a reading per force; only where the load is a force

    def messages(self) -> list[str]:
        """Warnings for a person.

        Returns:
            One sentence for each finding; empty where nothing is wrong.
        """
        found = []
        if self.repeated.any():
            found.append(
                f"{self.repeated.sum()} rows repeat the reading before them: the board sent nothing new; drop them"
            )
        if self.changed:
            found.append(
                f"neighbours from the other half of the session differ {self.change_ratio:.1f} times as much as from "
                "the same half: the skin slipped or changed; calibrate the halves apart"
            )
        if self.changed_chips:
            found.append(
                f"chip {', '.join(map(str, self.changed_chips))} changed between the halves of the session and the "
                "others did not: the skin slipped over it, or it has hysteresis; calibrate the halves apart"
            )
        if self.sensitivity_ut_per_n > MAX_SENSITIVITY_UT_PER_N:
            found.append(
                f"readings are {self.sensitivity_ut_per_n:.0f} uT per newton, beyond {MAX_SENSITIVITY_UT_PER_N:g} of "
                "any such skin: a tip of steel or another magnet disturbs the field; press with plastic or aluminium"
            )
        return found


def check_presses(
    positions: Float[np.ndarray, "n 2"],
    loads: Float[np.ndarray, " n"],
    readings: Float[np.ndarray, "n c"],
    *,
    by_force: bool = False,
) -> DataWarnings:
    """Look for repeated rows, a changed skin and a tip of steel; `i2t.recordings.diagnose` looks for what is stated
    wrongly.

    With fewer than 100 presses nothing but repeated rows and, where the load is a force, a tip of steel is looked for.

    Args:
        positions: Positions of the tip (m), in the order of time.
        loads: Depths (m) or forces (N).
        readings: Readings (uT), three channels for each chip.
        by_force: Whether the loads are forces.

    Returns:
        What was found.
    """
    repeated = np.concatenate([[False], (np.diff(readings, axis=0) == 0).all(1)])
    labels = np.column_stack([positions / np.maximum(positions.std(0), 1e-9), loads / max(loads.std(), 1e-9)])
    firm = (loads > 0.1 * loads.max()) & ~repeated
    per_force = np.linalg.norm(readings[firm], axis=1) / loads[firm] if by_force else np.array(np.nan)
    sensitivity = float(np.median(per_force))
    if np.sum(~repeated) < MIN_PRESSES:
        return DataWarnings(repeated, float("nan"), changed=False, sensitivity_ut_per_n=sensitivity)

    at, values = labels[~repeated], readings[~repeated]
    ratio, changed = _change(at, values)
    by_chip = np.split(values, values.shape[1] // AXES_PER_CHIP, axis=1)
    alone = () if changed else tuple(i for i, chip in enumerate(by_chip) if _change(at, chip)[1])
    return DataWarnings(repeated, ratio, changed=changed, changed_chips=alone, sensitivity_ut_per_n=sensitivity)


def _change(labels: np.ndarray, readings: np.ndarray) -> tuple[float, bool]:
    """Compare the nearest neighbour in the other half of time with the nearest in the same half, where they are about
    as far: the ratio of squared differences, and whether it is beyond chance.
    """
    from scipy.spatial import cKDTree

    late = np.arange(len(labels)) >= len(labels) // 2
    trees = {half: (np.flatnonzero(late == half), cKDTree(labels[late == half])) for half in (False, True)}
    same, other = [], []
    for half, (rows, tree) in trees.items():
        far_same, near_same = tree.query(labels[rows], 2)
        there, other_tree = trees[not half]
        far_other, near_other = other_tree.query(labels[rows])
        alike = (far_other > 0.5 * far_same[:, 1]) & (far_other < 2 * far_same[:, 1])
        same.append(((readings[rows] - readings[rows[near_same[:, 1]]]) ** 2).sum(1)[alike])
        other.append(((readings[rows] - readings[there[near_other]]) ** 2).sum(1)[alike])
    a, b = np.concatenate(same), np.concatenate(other)
    if len(a) < MIN_PAIRS:
        return float("nan"), False
    # Neighbours come in pairs, so that half as many differences are independent.
    sure = (b - a).mean() > 4 * (b - a).std() / np.sqrt(len(a) / 2)
    ratio = float(b.sum() / a.sum()) if a.any() else float("nan")  # a chip that does not answer repeats itself
    return ratio, bool(sure and b.sum() > 1.2 * a.sum())
