"""Unknowns and wrong statements of a recording of a skin: estimated, with evidence and a sentence each.

    from i2t.recordings import diagnose as unknowns

    presses = unknowns.RecordedPresses(position, readings, height=height)  # m, uT, m
    for finding in unknowns.estimate_unknowns(presses, board):
        print(finding.sentence)

`estimate` runs the hypotheses: `labels` a lag, signs and units, `heights` the height of first contact, `chip_field` how
the board lies under the skin. `segmentation` finds the presses in a stream of readings. Every function is pure and
takes arrays; what estimates returns a `Finding`, which says whether the recording can tell at all. NumPy and SciPy
only, so that converters can use it.
"""

from i2t.recordings.diagnose.chip_field import find_board, turn_board
from i2t.recordings.diagnose.estimate import estimate_labels, estimate_unknowns
from i2t.recordings.diagnose.findings import (
    Correction,
    Finding,
    RecordedPresses,
    corrected_presses,
    correction_of,
    find,
    findings_from_meta,
    findings_to_meta,
    lag_rows,
    metrics_of,
)
from i2t.recordings.diagnose.heights import find_approaches, find_height_zero
from i2t.recordings.diagnose.labels import find_force_sign, find_height_axis, find_lag, find_units

__all__ = [
    "Correction",
    "Finding",
    "RecordedPresses",
    "corrected_presses",
    "correction_of",
    "estimate_labels",
    "estimate_unknowns",
    "find",
    "find_approaches",
    "find_board",
    "find_force_sign",
    "find_height_axis",
    "find_height_zero",
    "find_lag",
    "find_units",
    "findings_from_meta",
    "findings_to_meta",
    "lag_rows",
    "metrics_of",
    "turn_board",
]
