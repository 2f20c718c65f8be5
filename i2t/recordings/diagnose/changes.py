"""Faults that nothing corrects: repeated rows, a skin that changed during a recording, and a steel tip.

Each press is compared with its nearest neighbours in position and load, so no model of the skin is needed.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from i2t.recordings.diagnose.findings import Finding, FindingName, not_identifiable
from i2t.skin.boards import AXES_OF_CHIP


@dataclass(frozen=True)
class PressCheckConfig:
    """Thresholds of the tests of a recording for a skin that changed and for a steel tip.

    Attributes:
        min_presses: Number of presses below which no change is identifiable.
        min_pairs: Number of pairs of neighbours below which no change is identifiable.
        min_change_ratio: Ratio of squared differences that a change must exceed.
        min_standard_errors: Standard errors by which the mean squared differences must differ.
        max_sensitivity_ut_per_n: Median sensitivity that only a steel tip exceeds. Real boards show 78 to 122 uT/N with
            a plastic tip, and 6 to 10 times as much with a steel one.
        min_load_share: Share of the largest load from which a press contributes to the sensitivity.
    """

    min_presses: int = 100
    min_pairs: int = 40
    min_change_ratio: float = 1.2
    min_standard_errors: float = 4.0
    max_sensitivity_ut_per_n: float = 500.0
    min_load_share: float = 0.1


def check_presses(
    positions: Float[np.ndarray, "n 2"],
    loads: Float[np.ndarray, " n"],
    readings: Float[np.ndarray, "n c"],
    *,
    by_force: bool = False,
    config: PressCheckConfig = PressCheckConfig(),
) -> list[Finding]:
    """Test a recording for repeated rows, a skin that changed and, if the loads are forces, a steel tip.

    Args:
        positions: `(n, 2)` positions of the tip in m, in the order of time.
        loads: `(n,)` positive travels in m, or forces in N.
        readings: `(n, c)` readings in uT, three channels for each chip.
        by_force: Whether the loads are forces.
        config: Thresholds of the tests.

    Returns:
        A finding for each test, without corrections. `repeated_rows` finds the rows to drop.
    """
    new = ~repeated_rows(readings)
    findings = [_find_repeats(new), _find_change(positions[new], loads[new], readings[new], config)]
    return [*findings, _find_steel_tip(loads[new], readings[new], config)] if by_force else findings


def repeated_rows(readings: Float[np.ndarray, "n c"]) -> Bool[np.ndarray, " n"]:
    """Find rows that repeat the reading before them in every channel.

    Args:
        readings: `(n, c)` readings in the order of time.

    Returns:
        `(n,)` mask that is True for these rows.
    """
    return np.concatenate([[False], (np.diff(readings, axis=0) == 0).all(1)])


def _find_repeats(new: np.ndarray) -> Finding:
    count = int((~new).sum())
    sentence = f"{count} rows repeat the reading before them"
    sentence += ": the board sent nothing new; drop them" if count else ""
    return Finding(FindingName.REPEATED_ROWS, sentence, identifiable=True, wrong=count > 0, estimate=float(count))


def _find_steel_tip(loads: np.ndarray, readings: np.ndarray, config: PressCheckConfig) -> Finding:
    """Test whether readings are too strong for their force; the estimate is the median sensitivity in uT/N."""
    pressing = loads > config.min_load_share * loads.max()
    sensitivity = float(np.median(np.linalg.norm(readings[pressing], axis=1) / loads[pressing]))
    too_strong = sensitivity > config.max_sensitivity_ut_per_n
    sentence = f"The readings are {sensitivity:.0f} uT per newton"
    if too_strong:
        sentence += (
            f", more than the {config.max_sensitivity_ut_per_n:g} that any such skin gives: a steel tip or another "
            "magnet disturbs the field; press with plastic or aluminium"
        )
    return Finding(
        FindingName.STEEL_TIP, sentence, bool(np.isfinite(sensitivity)), wrong=too_strong, estimate=sensitivity,
        unit="uT/N",
    )  # fmt: skip


def _find_change(positions: np.ndarray, loads: np.ndarray, readings: np.ndarray, config: PressCheckConfig) -> Finding:
    """Test whether the skin, or one of its chips, changed between the halves of a recording.

    The estimate is the squared difference of neighbours in different halves of the time, relative to that of neighbours
    in the same half. Nothing is identifiable if the halves do not overlap.
    """
    if len(readings) < config.min_presses:
        reason = f"{len(readings)} presses are too few ({config.min_presses} are enough)"
        return not_identifiable(FindingName.CHANGED_SKIN, reason, untested=True)
    labels = np.column_stack([positions / np.maximum(positions.std(0), 1e-9), loads / max(loads.std(), 1e-9)])
    ratio, changed = _compare_halves(labels, readings, config)
    by_chip = np.split(readings, readings.shape[1] // AXES_OF_CHIP, axis=1)
    chips = [] if changed else [i for i, chip in enumerate(by_chip) if _compare_halves(labels, chip, config)[1]]
    remedy = "calibrate each half separately"
    sentence = "The halves of the session agree"
    if changed:
        sentence = (
            f"Neighbours from different halves of the session differ {ratio:.1f} times as much as neighbours from the "
            f"same half: the skin slipped or changed; {remedy}"
        )
    elif chips:
        sentence = (
            f"Chip {', '.join(map(str, chips))} changed between the halves of the session and the others did not: the "
            f"skin slipped over it, or has hysteresis; {remedy}"
        )
    return Finding(
        FindingName.CHANGED_SKIN, sentence, identifiable=bool(np.isfinite(ratio)), wrong=bool(changed or chips),
        estimate=ratio, evidence={"changed_chips": chips},
    )  # fmt: skip


def _compare_halves(labels: np.ndarray, readings: np.ndarray, config: PressCheckConfig) -> tuple[float, bool]:
    """Compare the nearest neighbour in the other half of the time with the nearest in the same half, for rows whose two
    neighbours are about equally far: the ratio of squared differences, and whether it is beyond chance.
    """
    is_late = np.arange(len(labels)) >= len(labels) // 2
    trees = {half: (np.flatnonzero(is_late == half), cKDTree(labels[is_late == half])) for half in (False, True)}
    same, other = [], []
    for half, (rows, tree) in trees.items():
        same_distance, same_neighbour = tree.query(labels[rows], 2)
        other_rows, other_tree = trees[not half]
        other_distance, other_neighbour = other_tree.query(labels[rows])
        comparable = (other_distance > 0.5 * same_distance[:, 1]) & (other_distance < 2 * same_distance[:, 1])
        same.append(((readings[rows] - readings[rows[same_neighbour[:, 1]]]) ** 2).sum(1)[comparable])
        other.append(((readings[rows] - readings[other_rows[other_neighbour]]) ** 2).sum(1)[comparable])
    within, across = np.concatenate(same), np.concatenate(other)
    if len(within) < config.min_pairs:
        return float("nan"), False
    # Neighbours come in pairs, so only half of the differences are independent.
    standard_error = (across - within).std() / np.sqrt(len(within) / 2)
    significant = (across - within).mean() > config.min_standard_errors * standard_error
    ratio = float(across.sum() / within.sum()) if within.any() else float("nan")  # a silent chip repeats itself
    return ratio, bool(significant and across.sum() > config.min_change_ratio * within.sum())
