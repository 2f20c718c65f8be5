"""Heights of round tips over a skin."""

import numpy as np


def round_tip(x: np.ndarray, y: np.ndarray, at: tuple[float, float] | np.ndarray, radius: float = 2.3e-3) -> np.ndarray:
    """Heights (m) of a sphere at cells x, y (m), its lowest point 0 and at `at`; +inf beside it."""
    square = radius**2 - (x - at[0]) ** 2 - (y - at[1]) ** 2
    return np.where(square > 0, radius - np.sqrt(np.maximum(square, 0)), np.inf)
