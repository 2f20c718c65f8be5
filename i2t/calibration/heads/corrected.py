"""Correction of a recording by the findings of `i2t.unknowns`, so that fits to it are sound."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from i2t.calibration.heads.recording import VALUES_PER_CHIP, SkinRecording
from i2t.unknowns import Finding, lag_rows, turn_board


def corrected_recording(recording: SkinRecording, findings: Iterable[Finding]) -> SkinRecording:
    """Apply the corrections of findings: units, signs, a lag, the order and axes of chips, the board's turn.

    A height zero stays where it is. Depths that are turned and fall below zero count from the least of them.

    Args:
        recording: As it was read.
        findings: About it.

    Returns:
        The recording put right; with a lag it has fewer rows.
    """
    for finding in findings:
        if finding.correction:
            recording = _corrected(recording, finding)
    return recording


def _corrected(recording: SkinRecording, finding: Finding) -> SkinRecording:
    todo, targets = finding.correction, dict(recording.targets)
    force_unit = todo.get("force_factor", 1.0)
    factors = {
        "position": todo.get("length_factor", 1.0),
        "depth": todo.get("depth_factor", 1.0) * todo.get("height_sign", 1.0),
        "force": force_unit * todo.get("force_sign", 1.0),
        "shear": force_unit,
    }
    targets |= {name: factors[name] * targets[name] for name in factors if name in targets}
    if "height_sign" in todo and "depth" in targets and np.nanmin(targets["depth"]) < 0:
        targets["depth"] = targets["depth"] - np.nanmin(targets["depth"])
    baseline = recording.baseline
    recording = replace(
        recording,
        targets=targets,
        readings=_fields(recording.readings, finding),
        baseline=None if baseline is None else _fields(baseline, finding),
    )
    if "board_from_stage" in todo and recording.board is not None:
        board = turn_board(recording.board, np.asarray(todo["board_from_stage"], np.float64))
        recording = replace(recording, board=board)
    if lag := int(todo.get("label_lag_rows", 0)):
        # The lag counts rows whose position is known, as the estimate did.
        recording = recording.rows(recording.known("position"))
        label_rows, reading_rows = lag_rows(len(recording), lag)
        labels = {name: values[label_rows] for name, values in recording.targets.items()}
        recording = replace(recording.rows(reading_rows), targets=labels)
    return recording


def _fields(values: np.ndarray, finding: Finding) -> np.ndarray:
    """Channels (n, c) in microtesla, their chips in order and their axes turned."""
    todo = finding.correction
    values = values * todo.get("field_factor", 1.0)
    if "chip_order" in todo:
        chips = values.reshape(len(values), -1, VALUES_PER_CHIP)
        values = chips[:, list(todo["chip_order"])].reshape(values.shape)
    return values * np.asarray(todo["channel_signs"]) if "channel_signs" in todo else values
