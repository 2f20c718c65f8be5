"""Signs: whether forces push, depths count into the skin, and heights grow out of it.

A tip can only push a skin, so that all its presses have one sign of force, and of depth. Where a recording has another
sign in some of them, it is noise or a force along another axis. Two explanations compete: the sign is that of the
recording's convention, or the values do not measure the press at all and have signs at random. Signs are turned where
four in five presses or more are negative and chance would give as many in one of twenty recordings at most. Four in
five, because noise makes a fifth of the signs wrong where it is as large as the usual force (its standard deviation is
1.2 times the median): with more wrong signs than that, the numbers hold no load, turned or not. The rule is symmetric:
between a fifth and four fifths neither sign is right, which is told and nothing is turned.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import binom, rankdata

from i2t.recordings.diagnose.findings import Finding
from i2t.recordings.presses import Presses

HEIGHT_AXIS, FORCE_SIGN, DEPTH_SIGN = "height axis", "sign of the force", "sign of the depth"
TURNED_SHARE = 0.8  # of the presses that must be negative for the sign to be turned (the ground is told above)
TURNED_CHANCE = 0.05  # at most, of as many negative ones among signs at random: 5 of 5, 7 of 8, 16 of 20
MIN_PUSH_N = 0.05  # less is no press
MIN_PUSH_M = 1e-5  # likewise, of a depth
MIN_PUSH_READING = 0.2  # of the median size of readings: less is no press
MIN_RANK_ROWS = 20
SURE_ERRORS = 4.0  # standard errors of a rank correlation
MIN_RANKS = 0.15  # rank correlation, at least


def find_force_sign(force: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"] | None = None) -> Finding:
    """Ask whether a press pushes: the force along tool z is positive when pressing.

    Args:
        force: Of presses (N); NaN where it was not read.
        readings: Of the same presses (uT); those that read nothing are no presses.

    Returns:
        The finding; the estimate is -1 where the forces must be turned.
    """
    firm = np.isfinite(force) & (np.abs(force) > MIN_PUSH_N)
    if readings is not None and firm.any():
        norm = np.linalg.norm(np.nan_to_num(readings), axis=1)
        firm &= norm >= MIN_PUSH_READING * np.median(norm[firm])
    pressing = force[firm]
    if not len(pressing):
        return Finding(FORCE_SIGN, "The sign of the force is not identifiable: hardly any force was recorded.", False)
    pulls, median = float(np.mean(pressing < 0)), float(np.median(pressing))
    evidence = {"share_negative": pulls, "median_force_N": median, "presses": len(pressing)}
    negative = f"Forces along tool z are negative in {100 * pulls:.0f} % of the presses (median {median:.2f} N)"
    if is_turned(pressing < 0):
        return Finding(
            FORCE_SIGN, f"{negative}, as if they pulled: they are turned.", identifiable=True, wrong=True,
            estimate=-1.0, evidence=evidence, correction={"force_sign": -1.0},
        )  # fmt: skip
    if pulls > 1 - TURNED_SHARE:
        few = pulls >= TURNED_SHARE
        why = "too few to tell a turned axis from chance" if few else "they are hardly along tool z"
        return Finding(FORCE_SIGN, f"{negative}: {why}; check the axes that they were recorded in.", False,
                       evidence=evidence)  # fmt: skip
    sentence = f"Presses push: the median force along tool z is {median:.2f} N."
    return Finding(FORCE_SIGN, sentence, identifiable=True, estimate=1.0, evidence=evidence)


def find_depth_sign(depth: Float[np.ndarray, " n"]) -> Finding:
    """Ask whether depths count into the skin, as travel past first contact does, or are negative as heights are.

    Args:
        depth: Of presses (m); NaN where it is not known.

    Returns:
        The finding; the estimate is -1 where the depths must be turned.
    """
    pressed = depth[np.isfinite(depth) & (np.abs(depth) > MIN_PUSH_M)]
    negative = pressed < 0
    if not negative.any():
        return Finding(DEPTH_SIGN, "Depths count into the skin.", bool(len(pressed)), estimate=1.0)
    sentence = f"Depths are negative in {100 * negative.mean():.0f} % of the presses"
    evidence = {"share_negative": float(negative.mean()), "presses": len(pressed)}
    if not is_turned(negative):
        return Finding(DEPTH_SIGN, f"{sentence}, which is damage.", False, evidence=evidence)
    return Finding(
        DEPTH_SIGN, f"{sentence}, as heights are: they are turned.", identifiable=True, wrong=True, estimate=-1.0,
        evidence=evidence, correction={"height_sign": -1.0},
    )  # fmt: skip


def is_turned(negative: Bool[np.ndarray, " n"]) -> bool:
    """Decide whether loads of presses are counted with the other sign.

    Args:
        negative: Which of the loads, all clear of zero, are below it.

    Returns:
        True where nearly all are, and more than chance gives.
    """
    n, count = len(negative), int(negative.sum())
    return bool(count >= TURNED_SHARE * n and n and binom.sf(count - 1, n, 0.5) <= TURNED_CHANCE)


def find_height_axis(presses: Presses) -> Finding:
    """Ask whether the height grows out of the skin or into it: readings grow with the depth.

    Args:
        presses: With heights along what is taken for the outward normal.

    Returns:
        The finding; the estimate is 1 where heights point out of the skin and -1 where they point into it.
    """
    if presses.height is None or not np.isfinite(presses.height).any():
        return Finding(HEIGHT_AXIS, "The direction of the height is not identifiable: none was recorded.", False)
    firm = np.isfinite(presses.height)
    depth, norm = -presses.height[firm], np.linalg.norm(presses.readings[firm], axis=1)
    if len(norm) < MIN_RANK_ROWS or np.ptp(depth) == 0 or np.ptp(norm) == 0:
        few = f"{len(norm)} presses are too few ({MIN_RANK_ROWS} are enough)"
        why = few if len(norm) < MIN_RANK_ROWS else "all heights, or all readings, are alike"
        return Finding(HEIGHT_AXIS, f"The direction of the height is not identifiable: {why}.", False)
    ranks = float(np.corrcoef(rankdata(depth), rankdata(norm))[0, 1])
    evidence = {"rank_correlation": ranks, "presses": len(norm)}
    found = f"(rank correlation with the depth {ranks:+.2f})"
    if abs(ranks) < max(SURE_ERRORS / np.sqrt(len(norm) - 1), MIN_RANKS):
        said = f"The direction of the height is not identifiable: readings hardly change with it {found}."
        return Finding(HEIGHT_AXIS, said, False, evidence=evidence)
    if ranks < 0:
        said = f"Readings grow where the height grows: the height points into the skin and is turned {found}."
        return Finding(
            HEIGHT_AXIS, said, identifiable=True, wrong=True, estimate=-1.0, evidence=evidence,
            correction={"height_sign": -1.0},
        )  # fmt: skip
    said = f"Readings grow as the height falls: the height points out of the skin {found}."
    return Finding(HEIGHT_AXIS, said, identifiable=True, estimate=1.0, evidence=evidence)
