"""Calibration of one skin from a few of its presses.

`structured` predicts all other presses of the same tip, `calibration` is what a user holds and keeps on disk, `physics`
fits a pad, `network` learns from many other skins, and `checks` finds what contradicts them.
"""

from i2t.calibration.checks import Faults, check
from i2t.calibration.model import Calibration, calibrate, load, numbers
from i2t.calibration.structured_gp import (
    DEPTH,
    FEW,
    FORCE,
    JITTER,
    WITHIN,
    Hyper,
    LeftOut,
    Presses,
    Process,
    choose,
    errors,
    fit,
    growth,
    left_out,
    options,
    predict,
    widening,
)

__all__ = [
    "DEPTH", "FEW", "FORCE", "JITTER", "WITHIN", "Calibration", "Faults", "Hyper", "LeftOut", "Presses", "Process",
    "calibrate", "check", "choose", "errors", "fit", "growth", "left_out", "load", "numbers", "options", "predict",
    "widening",
]  # fmt: skip
