"""Calibration of one skin from a few of its presses.

`structured` predicts all other presses of the same tip, `checks` finds what contradicts it.
"""

from i2t.calibrate.checks import Faults, check
from i2t.calibrate.structured import (
    DEPTH,
    FEW,
    FORCE,
    JITTER,
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
)

__all__ = [
    "DEPTH", "FEW", "FORCE", "JITTER", "Faults", "Hyper", "LeftOut", "Presses", "Process", "check", "choose", "errors",
    "fit", "growth", "left_out", "options", "predict",
]  # fmt: skip
