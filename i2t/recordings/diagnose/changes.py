"""Rows that repeat, a skin that changed during a recording, and a tip of steel: contradictions to any sound skin.

Presses are compared with their nearest neighbours in position and load, so that no model is needed.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from i2t.recordings.diagnose.findings import Finding
from i2t.skin.boards import AXES_OF_CHIP

REPEATED_ROWS, CHANGED_SKIN, STEEL_TIP = "repeated rows", "changed skin", "tip of steel"
MAX_SENSITIVITY_UT_PER_N = 500.0  # real boards show 78-122 with a plastic tip, 6-10 times more with one of steel
FIRM_SHARE = 0.1  # of the largest load, that a press must have to tell a sensitivity
MIN_CHANGE_PRESSES = 100
MIN_PAIRS = 40  # of neighbours
MIN_CHANGE_RATIO = 1.2  # of squared differences
SURE_ERRORS = 4.0  # standard errors of a mean difference


def check_presses(
    positions: Float[np.ndarray, "n 2"],
    loads: Float[np.ndarray, " n"],
    readings: Float[np.ndarray, "n c"],
    *,
    by_force: bool = False,
) -> list[Finding]:
    """Look for repeated rows, a changed skin and, where the load is a force, a tip of steel.

    Args:
        positions: Positions of the tip (m), in the order of time.
        loads: Depths (m) or forces (N), positive.
        readings: Readings (uT), three channels for each chip.
        by_force: Whether the loads are forces.

    Returns:
        A finding for each. Nothing corrects them; `repeated_rows` says which rows to drop.
    """
    new = ~repeated_rows(readings)
    findings = [_repeats(new), find_change(positions[new], loads[new], readings[new])]
    return [*findings, find_steel_tip(loads[new], readings[new])] if by_force else findings


def repeated_rows(readings: Float[np.ndarray, "n c"]) -> Bool[np.ndarray, " n"]:
    """Rows that repeat the reading before them.

    Args:
        readings: In the order of time.

    Returns:
        A mask of these rows.
    """
    return np.concatenate([[False], (np.diff(readings, axis=0) == 0).all(1)])


def find_steel_tip(loads: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"]) -> Finding:
    """Ask whether readings are stronger for their force than those of any skin of this kind.

    Args:
        loads: Forces (N), positive.
        readings: Readings (uT).

    Returns:
        The finding; the estimate is the median sensitivity (uT/N).
    """
    firm = loads > FIRM_SHARE * loads.max()
    sensitivity = float(np.median(np.linalg.norm(readings[firm], axis=1) / loads[firm]))
    strong = sensitivity > MAX_SENSITIVITY_UT_PER_N
    sentence = f"Readings are {sensitivity:.0f} uT per newton"
    if strong:
        sentence += (
            f", beyond {MAX_SENSITIVITY_UT_PER_N:g} of any such skin: a tip of steel or another magnet disturbs the "
            "field; press with plastic or aluminium"
        )
    return Finding(STEEL_TIP, sentence, bool(np.isfinite(sensitivity)), wrong=strong, estimate=sensitivity, unit="uT/N")


def find_change(
    positions: Float[np.ndarray, "n 2"], loads: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"]
) -> Finding:
    """Ask whether the skin, or one of its chips, changed between the halves of a recording.

    Args:
        positions: Positions of the tip (m), in the order of time.
        loads: Depths (m) or forces (N).
        readings: Readings (uT), three channels for each chip.

    Returns:
        The finding; the estimate is the squared difference of neighbours in other halves of time over that in the same
        half. It is not identifiable from fewer than 100 presses, or where the halves do not overlap.
    """
    if len(readings) < MIN_CHANGE_PRESSES:
        sentence = f"No change is identifiable: {len(readings)} presses are too few ({MIN_CHANGE_PRESSES} are enough)"
        return Finding(CHANGED_SKIN, sentence, False)
    labels = np.column_stack([positions / np.maximum(positions.std(0), 1e-9), loads / max(loads.std(), 1e-9)])
    ratio, changed = _change(labels, readings)
    by_chip = np.split(readings, readings.shape[1] // AXES_OF_CHIP, axis=1)
    chips = [] if changed else [i for i, chip in enumerate(by_chip) if _change(labels, chip)[1]]
    apart = "calibrate the halves apart"
    sentence = "The halves of the session agree"
    if changed:
        sentence = (
            f"Neighbours from the other half of the session differ {ratio:.1f} times as much as from the same half: "
            f"the skin slipped or changed; {apart}"
        )
    elif chips:
        sentence = (
            f"Chip {', '.join(map(str, chips))} changed between the halves of the session and the others did not: the "
            f"skin slipped over it, or it has hysteresis; {apart}"
        )
    return Finding(
        CHANGED_SKIN, sentence, identifiable=bool(np.isfinite(ratio)), wrong=bool(changed or chips), estimate=ratio,
        evidence={"changed_chips": chips},
    )  # fmt: skip


def _repeats(new: np.ndarray) -> Finding:
    count = int((~new).sum())
    sentence = f"{count} rows repeat the reading before them"
    sentence += ": the board sent nothing new; drop them" if count else ""
    return Finding(REPEATED_ROWS, sentence, identifiable=True, wrong=count > 0, estimate=float(count))


def _change(labels: np.ndarray, readings: np.ndarray) -> tuple[float, bool]:
    """Compare the nearest neighbour in the other half of time with the nearest in the same half, where they are about
    as far: the ratio of squared differences, and whether it is beyond chance.
    """
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
    sure = (b - a).mean() > SURE_ERRORS * (b - a).std() / np.sqrt(len(a) / 2)
    ratio = float(b.sum() / a.sum()) if a.any() else float("nan")  # a chip that does not answer repeats itself
    return ratio, bool(sure and b.sum() > MIN_CHANGE_RATIO * a.sum())
