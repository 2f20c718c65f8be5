"""What a recording of a skin leaves out or states wrongly: hypotheses, each with its evidence, sentence and correction.

    from i2t.recordings.diagnose import corrected_presses, diagnose
    from i2t.recordings.presses import Presses

    presses = Presses(position, readings, height=height)  # m, uT, m
    findings = diagnose(presses, board)
    print(*(finding.sentence for finding in findings), sep="\n")
    presses = corrected_presses(presses, findings)

`hypotheses` is the list: `units`, `signs`, `lag`, `height` (of first contact) and `board` (how it lies under the skin).
`changes` finds what nothing corrects: repeated rows, a skin that changed, a tip of steel.
Every function is pure and takes arrays; what it returns is a `Finding`, which says whether the recording can tell at
all. Each fault has one threshold, beside its hypothesis. NumPy and SciPy only, so that readers and converters can use
it.
"""

from i2t.recordings.diagnose.board import find_board, turn_board
from i2t.recordings.diagnose.changes import check_presses, repeated_rows
from i2t.recordings.diagnose.findings import (
    Correction,
    Finding,
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
from i2t.recordings.diagnose.signs import find_depth_sign, find_force_sign, find_height_axis
from i2t.recordings.diagnose.units import find_units

__all__ = [
    "Correction",
    "Finding",
    "check_presses",
    "corrected_presses",
    "correction_of",
    "diagnose",
    "diagnose_labels",
    "find",
    "find_approaches",
    "find_board",
    "find_depth_sign",
    "find_force_sign",
    "find_height_axis",
    "find_height_zero",
    "find_lag",
    "find_units",
    "findings_to_meta",
    "first_contact",
    "lag_rows",
    "metrics_of",
    "repeated_rows",
    "turn_board",
]
