"""Unknowns and wrong statements of a recording of a skin: estimated, with evidence and a sentence each.

    from i2t import unknowns

    presses = unknowns.RecordedPresses(position, readings, height=height)  # m, uT, m
    findings = unknowns.estimate_unknowns(presses, board)
    print("\\n".join(unknowns.sentences(findings)))

`heights` and `approaches` find the height of first contact, `labels` a lag, signs and units, `chip_field` how the
board lies under the skin, `tip` the tip's radius, `alignment` how an earlier session lies on this one, `segmentation`
where the presses are in a stream of readings. Every function is pure and takes arrays; what estimates returns a
`Finding`, which says whether the recording can tell at all. NumPy and SciPy only, so that converters can use it.
"""

from i2t.unknowns.alignment import (
    Alignment,
    SessionMap,
    align_session,
    aligned_prediction,
    alignment_findings,
    fit_session_map,
    lay_over,
    predict_session,
)
from i2t.unknowns.approaches import Approach, find_approaches
from i2t.unknowns.chip_field import correct_board, find_board, turn_board
from i2t.unknowns.estimate import (
    corrected_presses,
    estimate_labels,
    estimate_unknowns,
    growth_of,
    lag_rows,
    metrics_of,
    sentences,
)
from i2t.unknowns.findings import Finding, RecordedPresses, find, findings_from_meta, findings_to_meta
from i2t.unknowns.heights import find_height_drift, find_height_zero
from i2t.unknowns.labels import Scales, find_force_sign, find_height_axis, find_lag, find_units
from i2t.unknowns.tip import find_tip_radius

__all__ = [
    "Alignment",
    "Approach",
    "Finding",
    "RecordedPresses",
    "Scales",
    "SessionMap",
    "align_session",
    "aligned_prediction",
    "alignment_findings",
    "correct_board",
    "corrected_presses",
    "estimate_labels",
    "estimate_unknowns",
    "find",
    "find_approaches",
    "find_board",
    "find_force_sign",
    "find_height_axis",
    "find_height_drift",
    "find_height_zero",
    "find_lag",
    "find_tip_radius",
    "find_units",
    "findings_from_meta",
    "findings_to_meta",
    "fit_session_map",
    "growth_of",
    "lag_rows",
    "lay_over",
    "metrics_of",
    "predict_session",
    "sentences",
    "turn_board",
]
