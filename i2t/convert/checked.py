"""Treatment of the unknowns of a session by a converter: it estimates them, says each in a sentence, puts right what
the session contradicts, and lets the findings travel with the data set.
"""

from typing import NamedTuple

import numpy as np

from i2t.convert.common import ConversionLog
from i2t.types import Board
from i2t.unknowns import Finding, RecordedPresses, estimate_unknowns, find, findings_to_meta, lag_rows
from i2t.unknowns.chip_field import turn_board
from i2t.unknowns.heights import HEIGHT_ZERO

AXES_OF_CHIP = 3


class SessionCheck(NamedTuple):
    """Findings in one session, ready to be applied to its arrays."""

    findings: tuple[Finding, ...]
    factors: dict[str, float]  # on lengths, depths, fields, forces, the sign of heights and of forces
    lag: int  # rows
    order: np.ndarray | None  # of the chips
    signs: np.ndarray | None  # of the channels
    board: Board
    meta: dict[str, str]

    def fields(self, readings: np.ndarray) -> np.ndarray:
        """Readings (n, c) in microtesla, their chips in order and their axes turned.

        Args:
            readings: As recorded.

        Returns:
            The same rows.
        """
        readings = readings * self.factors.get("field_factor", 1.0)
        if self.order is not None:
            readings = readings.reshape(len(readings), -1, AXES_OF_CHIP)[:, self.order].reshape(readings.shape)
        return readings if self.signs is None else readings * self.signs

    def rows(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the labels and of the readings that belong together.

        Args:
            n: Rows of the session.

        Returns:
            Indices, of one length.
        """
        return lag_rows(n, self.lag)

    @property
    def zero(self) -> Finding | None:
        """Finding on the height of first contact."""
        return find(self.findings, HEIGHT_ZERO)


def check_session(
    name: str,
    presses: RecordedPresses,
    board: Board,
    notes: ConversionLog,
    *,
    stated_zero: float | None = None,
    as_stated: bool = False,
) -> SessionCheck:
    """Estimate the unknowns of a session and note every sentence.

    Args:
        name: Of the session.
        presses: As recorded.
        board: As described.
        notes: That hear the sentences.
        stated_zero: Height of first contact (m) that the recording states.
        as_stated: Look for nothing and change nothing.

    Returns:
        What to apply; nothing where all is as it was stated.
    """
    if as_stated:
        return SessionCheck((), {}, lag=0, order=None, signs=None, board=board, meta={})
    findings = estimate_unknowns(presses, board, stated_zero=stated_zero)
    for finding in sorted(findings, key=lambda one: not one.wrong):
        notes.info(f"{'corrected' if finding.wrong else 'found'} in {name}: {finding.sentence}")
    factors: dict[str, float] = {}
    lag, order, signs = 0, None, None
    for finding in findings:
        todo = finding.correction
        factors |= {key: float(value) for key, value in todo.items() if key.endswith(("_factor", "_sign"))}
        lag = int(todo.get("label_lag_rows", lag))
        order = np.asarray(todo["chip_order"]) if "chip_order" in todo else order
        signs = np.asarray(todo["channel_signs"], np.float64) if "channel_signs" in todo else signs
        if "board_from_stage" in todo:
            board = turn_board(board, np.asarray(todo["board_from_stage"], np.float64))
    meta = findings_to_meta(name, findings)
    return SessionCheck(tuple(findings), factors, lag=lag, order=order, signs=signs, board=board, meta=meta)
