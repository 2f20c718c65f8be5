"""The table of safety limits: complete and sound, with defaults within their ranges."""

from dataclasses import fields

import numpy as np

from i2t.hardware.contract import refuse
from i2t.hardware.limits import SAFETY, SafetyLimits, range_of
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.rig import Rig


def test_each_limit_is_positive_and_has_a_unit_and_a_purpose():
    for limit in fields(SafetyLimits):
        values = np.atleast_1d(getattr(SAFETY, limit.name))
        assert np.isfinite(values).all()
        assert values[-1] > 0
        assert len(values) == 1 or values[0] < values[1]
        assert limit.metadata["unit"]
        assert limit.metadata["protects"].split()[0] in {
            "refuses", "stops", "reports", "ends", "is", "gives", "ignores", "converts", "lets",
        }  # fmt: skip


def test_the_defaults_are_within_their_ranges_and_nan_is_not():
    rig = Rig()
    for name in ("speed", "acceleration", "force", "torque", "approach_distance", "stiffness"):
        low, high, _ = range_of(name)
        assert low <= getattr(rig.limits, name) <= high
        refuse(ValueError, [(lambda name=name: MotionLimits((0, 0, 0), (1, 1, 1), **{name: np.nan}), (), name)])
    for name, value in (("state_timeout", SAFETY.state_timeout_s), ("watchdog_rate", SAFETY.watchdog_rate_hz)):
        low, high, _ = range_of(name)
        assert low <= value <= high
