"""Calibration of one skin from a few of its presses.

`calibrate` predicts all other presses of the same tip, `check_presses` finds what in recorded presses contradicts any
sound skin, and `segment_presses` finds presses in a continuous recording. Behind them: `model` is what a user holds and
keeps on disk, `population_gp` the model (its covariance in `kernel`, its members in `prior`, what it weighs them by in
`left_out`), and `structured_gp` the same with hyperparameters that are given; `plain_gp` is their baseline. `physics`
fits a pad to presses. `heads` go from readings to position, depth and force, by the methods of `regression` and from
what `recordings` reads.
"""

from i2t.recordings.diagnose import check_presses
from i2t.recordings.segmentation import SegmentedPresses, segment_presses
from i2t.skin_models.calibration import Calibration, LoadKind, calibrate, load_calibration
from i2t.skin_models.tip_gp.structured import (
    DEPTH_HYPERPARAMETERS,
    FORCE_HYPERPARAMETERS,
    StructuredGPHyperparameters,
)

__all__ = [
    "DEPTH_HYPERPARAMETERS",
    "FORCE_HYPERPARAMETERS",
    "Calibration",
    "LoadKind",
    "SegmentedPresses",
    "StructuredGPHyperparameters",
    "calibrate",
    "check_presses",
    "load_calibration",
    "segment_presses",
]
