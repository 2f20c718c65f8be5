"""Calibration of one skin from a few of its presses.

`calibrate` predicts all other presses of the same tip, `check_presses` finds what in recorded presses contradicts any
sound skin, and `segment_presses` finds presses in a continuous recording. Behind them: `population_gp` is the model,
`structured_gp` the same with hyperparameters that are given, and `model` what a user holds and keeps on disk; `physics`
fits a pad to presses, `localize` says where a known tip pressed, and `baseline_network` learns from many other skins.
"""

from i2t.calibration.checks import DataWarnings, check_presses
from i2t.calibration.model import Calibration, LoadKind, calibrate, load_calibration
from i2t.calibration.structured_gp import (
    DEPTH_HYPERPARAMETERS,
    FORCE_HYPERPARAMETERS,
    Presses,
    StructuredGPHyperparameters,
)
from i2t.unknowns.segmentation import SegmentedPresses, segment_presses

__all__ = [
    "DEPTH_HYPERPARAMETERS",
    "FORCE_HYPERPARAMETERS",
    "Calibration",
    "DataWarnings",
    "LoadKind",
    "Presses",
    "SegmentedPresses",
    "StructuredGPHyperparameters",
    "calibrate",
    "check_presses",
    "load_calibration",
    "segment_presses",
]
