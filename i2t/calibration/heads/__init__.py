"""Heads of a skin: from its readings the contact's position, depth, normal force and shear, with their spread; contact
and slip as probabilities.

`read_recordings` takes a recording in whatever form it has, `fit_head` fits a head to it. Behind them: `recording` is
what was read and known, `corrected` puts its mistakes right, `regression` the methods that a head is chosen of, `head`
the choice, spread and file.
"""

from i2t.calibration.heads.corrected import corrected_recording
from i2t.calibration.heads.head import Head, HeadPrediction, fit_head, load_head
from i2t.calibration.heads.recording import TARGETS, SkinRecording, from_dataset, is_dataset, read_recordings
from i2t.calibration.heads.regression import BASELINE_HEADS, HEAD_METHODS, HeadBudget

__all__ = [
    "BASELINE_HEADS",
    "HEAD_METHODS",
    "TARGETS",
    "Head",
    "HeadBudget",
    "HeadPrediction",
    "SkinRecording",
    "corrected_recording",
    "fit_head",
    "from_dataset",
    "is_dataset",
    "load_head",
    "read_recordings",
]
