"""The unknowns of a recording, where users of calibration look for them: everything is in `i2t.unknowns`."""

from i2t.unknowns import *  # noqa: F403
from i2t.unknowns import __all__ as __all__
