"""The hypotheses on a recording, one after the other: each sees what those before have corrected."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from i2t.recordings.diagnose.board import find_board
from i2t.recordings.diagnose.findings import Finding, corrected_presses, find
from i2t.recordings.diagnose.height import HEIGHT_ZERO, POWER, find_height_zero
from i2t.recordings.diagnose.lag import find_lag
from i2t.recordings.diagnose.signs import find_force_sign, find_height_axis
from i2t.recordings.diagnose.units import find_units
from i2t.recordings.presses import Presses
from i2t.types import Board

FORCE_POWER = 1.2  # by which readings grow with the force
MIN_ROWS_TO_DIAGNOSE = 5
MISSING_SHARE = 0.2  # of the rows in which a channel may be missing


class _Stated(NamedTuple):
    """What a recording states of itself."""

    board: Board | None = None
    zero: float | None = None  # m, height of first contact


def diagnose(presses: Presses, board: Board | None = None, *, stated_zero: float | None = None) -> list[Finding]:
    """Find what a recording does not say, or says wrongly.

    Args:
        presses: As recorded, in the order of time; rows whose position or reading is not finite are left out, and so
            are chips that are missing in many of them.
        board: As it is described; without one, and where a chip is missing, nothing is said of its chips.
        stated_zero: Height of first contact (m) that the recording states, where it does.

    Returns:
        A finding for each hypothesis that the recording has columns for: units, sign of the force, direction of the
        height, lag, height zero and the board's turn. `corrected_presses` applies them.
    """
    missing = np.isnan(presses.readings).mean(0) > MISSING_SHARE
    if missing.any():
        presses, board = presses._replace(readings=presses.readings[:, ~missing]), None
    presses = presses.rows(np.isfinite(presses.position).all(1) & np.isfinite(presses.readings).all(1))
    unread: dict[str, Any] = {name: None for name in ("height", "force") if _is_unread(getattr(presses, name))}
    if len(presses.readings) < MIN_ROWS_TO_DIAGNOSE or not presses.readings.shape[1]:
        return []
    return _test(HYPOTHESES, presses._replace(**unread), _Stated(board, stated_zero))


def diagnose_labels(presses: Presses) -> list[Finding]:
    """The part of `diagnose` that takes a moment: units, signs and lag.

    Args:
        presses: As recorded, in the order of time, all finite.

    Returns:
        The findings.
    """
    return _test(LABEL_HYPOTHESES, presses, _Stated())


def growth_of(presses: Presses, zero: Finding) -> np.ndarray | None:
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


def _is_unread(column: np.ndarray | None) -> bool:
    return column is None or not np.isfinite(column).any()


def _units(presses: Presses) -> Finding:
    height = presses.height
    depth = None if height is None or _is_unread(height) else np.abs(height - np.nanmax(height))
    return find_units(presses.position, presses.readings, depth=depth, force=presses.force)


def _board(presses: Presses, stated: _Stated, found: Sequence[Finding]) -> Finding | None:
    zero = find(found, HEIGHT_ZERO)
    if stated.board is None or zero is None:
        return None
    return find_board(presses, stated.board, growth=growth_of(presses, zero))


# Of presses, what is stated, and the findings so far; None where the recording has no such column.
Hypothesis: TypeAlias = Callable[[Presses, _Stated, Sequence[Finding]], Finding | None]
LABEL_HYPOTHESES: tuple[Hypothesis, ...] = (
    lambda presses, *_: _units(presses),
    lambda presses, *_: None if presses.force is None else find_force_sign(presses.force, presses.readings),
    lambda presses, *_: None if presses.height is None else find_height_axis(presses),
    lambda presses, *_: find_lag(presses),
)
HYPOTHESES = (*LABEL_HYPOTHESES, lambda presses, stated, _: find_height_zero(presses, stated.zero), _board)


def _test(hypotheses: Sequence[Hypothesis], presses: Presses, stated: _Stated) -> list[Finding]:
    findings: list[Finding] = []
    for hypothesis in hypotheses:
        finding = hypothesis(presses, stated, findings)
        if finding is not None:
            findings.append(finding)
            presses = corrected_presses(presses, [finding])
    return findings
