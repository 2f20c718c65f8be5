"""Depth patches of a probe's tip: a body of revolution whose axis stands on the skin, seen from the skin along tool z.

A tip is its profile h(r), the height in metres of its surface above its lowest point at distance r from its axis;
infinite where there is nothing.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from i2t.types import PATCH_PIXELS

Profile: TypeAlias = Callable[[np.ndarray], np.ndarray]

ROWS_AT_ONCE = 512  # bounds the memory of the intermediate arrays


def sphere(radius: float) -> Profile:
    """The lower half of a sphere: h = R - sqrt(R^2 - r^2)."""

    def profile(r: np.ndarray) -> np.ndarray:
        return np.where(r < radius, radius - np.sqrt(np.maximum(radius**2 - r**2, 0)), np.inf)

    return profile


def cylinder(radius: float) -> Profile:
    """The flat end of a cylinder."""
    return lambda r: np.where(r <= radius, 0.0, np.inf)


def patches(profile: Profile, x: np.ndarray, y: np.ndarray, window: float, reach: float) -> np.ndarray:
    """Patches (n, 48, 48), float32 m, of a tip whose axis stands at x, y (n,) m of the tool frame, clipped to the
    reach.

    Depth counts from the tip's lowest point, which may lie between two pixels.
    """
    centres = ((np.arange(PATCH_PIXELS) + 0.5) / PATCH_PIXELS - 0.5) * window
    result = np.empty((len(x), PATCH_PIXELS, PATCH_PIXELS), np.float32)
    for start in range(0, len(x), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        r = np.hypot(centres[None, :, None] - y[rows, None, None], centres[None, None, :] - x[rows, None, None])
        result[rows] = np.minimum(profile(r), reach)
    return result
