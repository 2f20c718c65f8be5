"""List of hypotheses about a recording. Each one is tested on presses that the findings before it have corrected."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from i2t.recordings.diagnose.board import find_board
from i2t.recordings.diagnose.findings import Finding, FindingName, corrected_presses, find
from i2t.recordings.diagnose.height import HeightZeroConfig, find_height_zero
from i2t.recordings.diagnose.lag import find_lag
from i2t.recordings.diagnose.signs import find_force_sign, find_height_axis
from i2t.recordings.diagnose.units import find_units
from i2t.recordings.presses import Presses
from i2t.types import Board


class _Stated(NamedTuple):
    """What a recording states besides its columns."""

    board: Board | None = None
    zero: float | None = None  # m, height of first contact


def diagnose(presses: Presses, board: Board | None = None, *, stated_zero: float | None = None) -> list[Finding]:
    """Test all hypotheses on a recording.

    Args:
        presses: Presses as recorded, in the order of time. Rows with a non-finite position or reading are ignored, and
            so are channels that are missing in more than a fifth of the rows.
        board: Board as described. Its rotation is not tested without it, or if a channel is missing.
        stated_zero: Height of first contact that the recording states, in m; None if it states none.

    Returns:
        A finding for each hypothesis that the recording has columns for: units, sign of the force, direction of the
        height, lag, height zero and rotation of the board. `corrected_presses` applies them.
    """
    missing = np.isnan(presses.readings).mean(0) > 0.2
    if missing.any():
        presses, board = presses._replace(readings=presses.readings[:, ~missing]), None
    presses = presses.rows(np.isfinite(presses.position).all(1) & np.isfinite(presses.readings).all(1))
    empty: dict[str, Any] = {name: None for name in ("height", "force") if _is_empty(getattr(presses, name))}
    if len(presses.readings) < 5 or not presses.readings.shape[1]:
        return []
    return _test(HYPOTHESES, presses._replace(**empty), _Stated(board, stated_zero))


def diagnose_labels(presses: Presses) -> list[Finding]:
    """Test only the fast hypotheses: units, signs and lag.

    Args:
        presses: Presses as recorded, in the order of time, with finite values only.

    Returns:
        A finding for each of these hypotheses that the recording has columns for.
    """
    return _test(LABEL_HYPOTHESES, presses, _Stated())


def _relative_motion(presses: Presses, zero: Finding) -> np.ndarray | None:
    """Estimate how much each press moves the skin, relative to the mean, from height or force; None without either."""
    if presses.height is not None and zero.estimate is not None:
        load, power = zero.estimate - np.nan_to_num(presses.height, nan=np.inf), HeightZeroConfig().power
    elif presses.force is not None and np.isfinite(presses.force).all() and (presses.force > 0).mean() > 0.9:
        load, power = presses.force, 1.2  # the power by which readings grow with force
    else:
        return None
    load = np.maximum(load, 0)
    return (load / max(float(load.mean()), 1e-9)) ** power


def _is_empty(column: np.ndarray | None) -> bool:
    return column is None or not np.isfinite(column).any()


def _units(presses: Presses, stated: _Stated) -> Finding:
    height, travel = presses.height, None
    if height is not None and not _is_empty(height):
        top = float(np.nanmax(height))
        # Presses to one height show their travel only if the height of first contact is stated.
        is_level = top == np.nanmin(height) and stated.zero is not None
        travel = np.abs(height - (stated.zero if is_level else top))
    return find_units(presses.position, presses.readings, travel=travel, force=presses.force)


def _board(presses: Presses, stated: _Stated, findings: Sequence[Finding]) -> Finding | None:
    zero = find(findings, FindingName.HEIGHT_ZERO)
    if stated.board is None or zero is None:
        return None
    return find_board(presses, stated.board, growth=_relative_motion(presses, zero))


# Takes presses, what the recording states and the findings so far; returns None if the recording lacks the columns.
Hypothesis: TypeAlias = Callable[[Presses, _Stated, Sequence[Finding]], Finding | None]
# Tests of the labels of a recording: units, force sign, height axis and lag.
LABEL_HYPOTHESES: tuple[Hypothesis, ...] = (
    lambda presses, stated, _: _units(presses, stated),
    lambda presses, *_: None if presses.force is None else find_force_sign(presses.force, presses.readings),
    lambda presses, *_: None if presses.height is None else find_height_axis(presses),
    lambda presses, *_: find_lag(presses),
)
# All tests of a recording, those of its labels first.
HYPOTHESES = (*LABEL_HYPOTHESES, lambda presses, stated, _: find_height_zero(presses, stated.zero), _board)


def _test(hypotheses: Sequence[Hypothesis], presses: Presses, stated: _Stated) -> list[Finding]:
    findings: list[Finding] = []
    for hypothesis in hypotheses:
        finding = hypothesis(presses, stated, findings)
        if finding is not None:
            findings.append(finding)
            presses = corrected_presses(presses, [finding])
    return findings
