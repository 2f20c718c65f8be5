"""Signs: tests whether forces push, whether travel counts into the skin, and whether heights point out of it.

A tip can only push a skin, so the forces of all presses have one sign, and so has their travel. Negative loads have
two explanations: the recording uses the other sign, or its values do not measure the press and have random signs.
Signs are reversed if at least four in five presses are negative and chance would give as many in at most one of twenty
recordings. Noise makes a fifth of the signs wrong when its standard deviation is 1.2 times the median force; with more
wrong signs the numbers hold no load in either direction. Between a fifth and four fifths of negative loads the finding
reports that neither sign fits, and nothing is reversed.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import binom, rankdata

from i2t.recordings.diagnose.findings import Finding, FindingName, not_identifiable
from i2t.recordings.presses import Presses


@dataclass(frozen=True)
class SignConfig:
    """Thresholds of the tests of the signs of recorded forces, travels and heights.

    Attributes:
        min_negative_share: Share of negative presses from which a sign is reversed; the module explains the value.
        max_chance: Highest probability of as many negative presses among random signs, for a sign to be reversed. It
            allows 5 of 5, 7 of 8 or 16 of 20.
        min_force_n: Force up to which a row is not a press.
        min_travel_m: Travel up to which a row is not a press.
        min_reading_share: Share of the median norm of readings below which a row is not a press.
        min_rows: Number of presses below which the direction of the height is not identifiable.
        min_correlation: Rank correlation of readings with travel below which the direction is not identifiable.
        min_standard_errors: The same threshold in standard errors of the rank correlation; the larger one applies.
    """

    min_negative_share: float = 0.8
    max_chance: float = 0.05
    min_force_n: float = 0.05
    min_travel_m: float = 1e-5
    min_reading_share: float = 0.2
    min_rows: int = 20
    min_correlation: float = 0.15
    min_standard_errors: float = 4.0


def find_force_sign(
    force: Float[np.ndarray, " n"],
    readings: Float[np.ndarray, "n c"] | None = None,
    *,
    config: SignConfig = SignConfig(),
) -> Finding:
    """Test whether forces are positive when the tip presses, as forces along tool z should be.

    Args:
        force: `(n,)` forces of the presses, in N; NaN where none was recorded.
        readings: `(n, c)` readings of the same presses, in uT. Rows with hardly any reading are ignored.
        config: Thresholds of the test.

    Returns:
        Finding whose estimate is -1 if the forces must change sign.
    """
    is_press = np.isfinite(force) & (np.abs(force) > config.min_force_n)
    if readings is not None and is_press.any():
        norm = np.linalg.norm(np.nan_to_num(readings), axis=1)
        is_press &= norm >= config.min_reading_share * np.median(norm[is_press])
    pressing = force[is_press]
    if not len(pressing):
        return not_identifiable(FindingName.FORCE_SIGN, "hardly any force was recorded")
    negative_share, median = float(np.mean(pressing < 0)), float(np.median(pressing))
    evidence = {"share_negative": negative_share, "median_force_N": median, "presses": len(pressing)}
    negative = (
        f"Forces along tool z are negative in {100 * negative_share:.0f} % of the presses (median {median:.2f} N)"
    )
    if _is_reversed(pressing < 0, config):
        return Finding(
            FindingName.FORCE_SIGN, f"{negative}, as if they pulled: their sign is reversed.", identifiable=True,
            wrong=True, estimate=-1.0, evidence=evidence, correction={"force_sign": -1.0},
        )  # fmt: skip
    if negative_share > 1 - config.min_negative_share:
        is_mostly_negative = negative_share >= config.min_negative_share
        reason = "too few presses to exclude chance" if is_mostly_negative else "they hardly act along tool z"
        sentence = f"{negative}: {reason}; check the axes in which they were recorded."
        return Finding(FindingName.FORCE_SIGN, sentence, False, evidence=evidence)
    sentence = f"The presses push: the median force along tool z is {median:.2f} N."
    return Finding(FindingName.FORCE_SIGN, sentence, identifiable=True, estimate=1.0, evidence=evidence)


def find_travel_sign(travel: Float[np.ndarray, " n"], *, config: SignConfig = SignConfig()) -> Finding:
    """Test whether travel is positive into the skin, or negative like a height.

    Args:
        travel: `(n,)` travels (m) of the presses; NaN where unknown.
        config: Thresholds of the test.

    Returns:
        Finding whose estimate is -1 if travel must change sign.
    """
    pressed = travel[np.isfinite(travel) & (np.abs(travel) > config.min_travel_m)]
    negative = pressed < 0
    if not negative.any():
        return Finding(FindingName.TRAVEL_SIGN, "Travel counts into the skin.", bool(len(pressed)), estimate=1.0)
    sentence = f"Travel is negative in {100 * negative.mean():.0f} % of the presses"
    evidence = {"share_negative": float(negative.mean()), "presses": len(pressed)}
    if not _is_reversed(negative, config):
        return Finding(FindingName.TRAVEL_SIGN, f"{sentence}: the column is damaged.", False, evidence=evidence)
    return Finding(
        FindingName.TRAVEL_SIGN, f"{sentence}, like heights: their sign is reversed.", identifiable=True, wrong=True,
        estimate=-1.0, evidence=evidence, correction={"height_sign": -1.0},
    )  # fmt: skip


def find_height_axis(presses: Presses, *, config: SignConfig = SignConfig()) -> Finding:
    """Test, by the growth of readings with travel, whether recorded heights point out of the skin or into it.

    Args:
        presses: Presses with heights along the assumed outward normal.
        config: Thresholds of the test.

    Returns:
        Finding whose estimate is 1 if heights point out of the skin and -1 if they point into it.
    """
    if presses.height is None or not np.isfinite(presses.height).any():
        return not_identifiable(FindingName.HEIGHT_AXIS, "no height was recorded", untested=True)
    has_height = np.isfinite(presses.height)
    travel, norm = -presses.height[has_height], np.linalg.norm(presses.readings[has_height], axis=1)
    if len(norm) < config.min_rows:
        reason = f"{len(norm)} presses are too few ({config.min_rows} are enough)"
        return not_identifiable(FindingName.HEIGHT_AXIS, reason, untested=True)
    if np.ptp(travel) == 0 or np.ptp(norm) == 0:
        return not_identifiable(FindingName.HEIGHT_AXIS, "all heights, or all readings, are equal", untested=True)
    correlation = float(np.corrcoef(rankdata(travel), rankdata(norm))[0, 1])
    evidence = {"rank_correlation": correlation, "presses": len(norm)}
    number = f"(rank correlation with travel {correlation:+.2f})"
    if abs(correlation) < max(config.min_standard_errors / np.sqrt(len(norm) - 1), config.min_correlation):
        return not_identifiable(
            FindingName.HEIGHT_AXIS, f"readings hardly change with height {number}", evidence=evidence
        )
    if correlation < 0:
        sentence = f"Readings grow with height, so the height points into the skin: its sign is reversed {number}."
        correction = {"height_sign": -1.0}
        return Finding(
            FindingName.HEIGHT_AXIS, sentence, True, wrong=True, estimate=-1.0, evidence=evidence, correction=correction
        )
    sentence = f"Readings grow as the height falls, so the height points out of the skin {number}."
    return Finding(FindingName.HEIGHT_AXIS, sentence, identifiable=True, estimate=1.0, evidence=evidence)


def _is_reversed(negative: Bool[np.ndarray, " n"], config: SignConfig) -> bool:
    """Test whether nearly all loads are negative, and more of them than chance gives."""
    n, count = len(negative), int(negative.sum())
    is_chance = binom.sf(count - 1, n, 0.5) > config.max_chance
    return bool(n and count >= config.min_negative_share * n and not is_chance)
