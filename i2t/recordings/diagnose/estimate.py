"""All unknowns of a recording, one after the other, each from what the ones before have put right."""

from collections.abc import Callable

import numpy as np

from i2t.recordings.diagnose.chip_field import find_board
from i2t.recordings.diagnose.findings import Finding, RecordedPresses, corrected_presses
from i2t.recordings.diagnose.heights import POWER, find_height_zero
from i2t.recordings.diagnose.labels import find_force_sign, find_height_axis, find_lag, find_units
from i2t.types import Board

FORCE_POWER = 1.2  # by which readings grow with the force
MIN_ESTIMATE_ROWS = 5
MISSING_SHARE = 0.2  # of the rows in which a channel may be missing


def estimate_unknowns(
    presses: RecordedPresses, board: Board | None = None, *, stated_zero: float | None = None
) -> list[Finding]:
    """Estimate what a recording does not say, or says wrongly.

    Args:
        presses: As recorded, in the order of time; rows whose position or reading is not finite are left out, and so
            are chips that are missing in many of them.
        board: As it is described; without one, and where a chip is missing, nothing is said of its chips.
        stated_zero: Height of first contact (m) that the recording states, where it does.

    Returns:
        A finding for each unknown: units, sign of the force, direction of the height, lag, height zero and the
        board's turn.
    """
    missing = np.isnan(presses.readings).mean(0) > MISSING_SHARE
    if missing.any():
        presses, board = presses._replace(readings=presses.readings[:, ~missing]), None
    presses = presses.rows(np.isfinite(presses.position).all(1) & np.isfinite(presses.readings).all(1))
    if len(presses.readings) < MIN_ESTIMATE_ROWS or not presses.readings.shape[1]:
        return []
    findings = estimate_labels(presses)
    presses = corrected_presses(presses, findings)
    zero = find_height_zero(presses, stated_zero)
    findings.append(zero)
    return findings if board is None else [*findings, find_board(presses, board, growth=growth_of(presses, zero))]


def estimate_labels(presses: RecordedPresses) -> list[Finding]:
    """The part of `estimate_unknowns` that takes a moment: units, signs and lag.

    Args:
        presses: As recorded, in the order of time, all finite.

    Returns:
        The findings.
    """
    findings: list[Finding] = []
    for hypothesis in LABEL_HYPOTHESES:
        found = hypothesis(presses)
        if found is not None:
            findings.append(found)
            presses = corrected_presses(presses, [found])
    return findings


def growth_of(presses: RecordedPresses, zero: Finding) -> np.ndarray | None:
    """Motion of the skin by each press, relative to the others, as well as is known.

    Args:
        presses: With heights or forces, or neither.
        zero: About the height of first contact.

    Returns:
        (n,), or None where nothing is known of how hard was pressed.
    """
    if presses.height is not None and zero.estimate is not None:
        load, power = zero.estimate - np.nan_to_num(presses.height, nan=np.inf), POWER
    elif presses.force is not None and np.isfinite(presses.force).all() and (presses.force > 0).mean() > 0.9:
        load, power = presses.force, FORCE_POWER
    else:
        return None
    load = np.maximum(load, 0)
    return (load / max(float(load.mean()), 1e-9)) ** power


def _units(presses: RecordedPresses) -> Finding:
    height = presses.height
    depth = None if height is None or not np.isfinite(height).any() else np.abs(height - np.nanmax(height))
    return find_units(presses.position, presses.readings, depth=depth, force=presses.force)


# What labels and readings tell together, in this order: each sees what those before have put right.
LABEL_HYPOTHESES: tuple[Callable[[RecordedPresses], Finding | None], ...] = (
    _units,
    lambda presses: None if presses.force is None else find_force_sign(presses.force, presses.readings),
    lambda presses: None if presses.height is None else find_height_axis(presses),
    find_lag,
)
