"""Two pools of touch sites on which the paper's heuristic has one choice only."""

import numpy as np

from i2t.recognition.site_pool import SitePools


def facing(angle_deg: float, at: float) -> np.ndarray:
    """A tool pose on a line whose outward normal is tilted from the vertical."""
    a = np.radians(angle_deg)
    T = np.eye(4, dtype=np.float32)
    T[:3, :3] = np.array([[np.cos(a), 0, -np.sin(a)], [0, -1, 0], [-np.sin(a), 0, -np.cos(a)]])
    T[0, 3] = at
    return T


# Two pools of two objects with two sites each, a centimetre apart. In the first pool the second object faces 50 and 60
# degrees away, so only the second site is worth a touch on either object; in the second pool it is the other way round.
TWO_POOLS = SitePools(
    np.stack(
        [
            np.stack([[facing(0, 0), facing(0, 1e-2)], [facing(first, 0), facing(second, 1e-2)]])
            for first, second in ((50, 60), (60, 50))
        ]
    )
)
