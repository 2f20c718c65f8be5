"""Diagnosis of recordings: what a recording leaves out or states wrongly, with evidence, a sentence and a correction.

    from i2t.recordings.diagnose import corrected_presses, diagnose
    from i2t.recordings.presses import Presses

    presses = Presses(position, readings, height=height)  # m, uT, m
    findings = diagnose(presses, board)
    print(*(finding.sentence for finding in findings), sep="\n")
    presses = corrected_presses(presses, findings)

`hypotheses` tests them in order: `units`, `signs`, `lag`, `height` (of first contact) and `board` (its rotation under
the skin). `changes` finds what nothing corrects: repeated rows, a changed skin and a steel tip. Every function is pure,
takes arrays and returns a `Finding`, which also records whether the recording can answer the question at all. The
package needs only NumPy and SciPy, so that readers and converters can use it.
"""

from i2t.recordings.diagnose.board import find_board, rotate_board
from i2t.recordings.diagnose.changes import check_presses, repeated_rows
from i2t.recordings.diagnose.findings import (
    Correction,
    Finding,
    FindingName,
    corrected_presses,
    correction_of,
    find,
    findings_to_meta,
    lag_rows,
    metrics_of,
)
from i2t.recordings.diagnose.height import find_approaches, find_height_zero, first_contact
from i2t.recordings.diagnose.hypotheses import diagnose, diagnose_labels
from i2t.recordings.diagnose.lag import find_lag
from i2t.recordings.diagnose.signs import find_force_sign, find_height_axis, find_travel_sign
from i2t.recordings.diagnose.units import find_units

__all__ = [
    "Correction",
    "Finding",
    "FindingName",
    "check_presses",
    "corrected_presses",
    "correction_of",
    "diagnose",
    "diagnose_labels",
    "find",
    "find_approaches",
    "find_board",
    "find_force_sign",
    "find_height_axis",
    "find_height_zero",
    "find_lag",
    "find_travel_sign",
    "find_units",
    "findings_to_meta",
    "first_contact",
    "lag_rows",
    "metrics_of",
    "repeated_rows",
    "rotate_board",
]
