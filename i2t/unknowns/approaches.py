"""Height zero from approaches that were recorded row by row: where on the way down the readings begin to change.

Within one approach each channel is y(z) = b + c t + g ((z0 - z)+)^p + noise: a constant, a slow creep along the rows t,
and a growth from first contact on. For a given zero and power that is linear; zero and power are those of the least
squared error near the contact. NumPy only.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

APPROACH_ROWS = 12  # at least, on one way down
APPROACH_SHARE = 0.3  # of the recording's range of heights that an approach covers at least
CONTACT_SHARE = 0.1  # of an approach's largest change: what is beyond says little of the contact
CONTACT_NOISES = 8.0  # standard deviations of a reading's norm: an onset must rise above its noise
REST_ROWS = 15  # before the tip moves
ONSET_POWERS = (1.0, 1.25, 1.5, 2.0)
ONSET_SHARE = 0.5  # of what a straight creep leaves unexplained, which an onset explains at least


class Approach(NamedTuple):
    """First contact in one approach."""

    rows: slice
    zero: float  # m, on the scale of the heights
    explained: float  # share of what a straight creep leaves that the onset explains


def find_approaches(height: Float[np.ndarray, " n"], readings: Float[np.ndarray, "n c"]) -> list[Approach]:
    """First contact in each approach of a recording that follows the tip.

    Args:
        height: Of the tip along the skin's outward normal (m), in the order of time.
        readings: At these rows (uT).

    Returns:
        One for each approach that shows its first contact; none where rows are single presses.
    """
    approaches = [onset(rows, height[rows], readings[rows]) for rows in _ways_down(height)]
    return [one for one in approaches if one is not None]


def _ways_down(height: np.ndarray) -> list[slice]:
    """Runs of rows along which the height only falls, of many rows over much of the range."""
    step = np.diff(height)
    jitter = 2e-5
    falling = step < jitter
    edges = np.flatnonzero(np.diff(np.concatenate([[False], falling, [False]]).astype(int)))
    least = APPROACH_SHARE * np.ptp(height)
    runs = [slice(start, stop + 1) for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
    moved = [int(np.argmax(height[run] < height[run.start] - 2 * jitter)) for run in runs]
    runs = [slice(run.start + max(rows - REST_ROWS, 0), run.stop) for run, rows in zip(runs, moved, strict=True)]
    return [
        run
        for run in runs
        if run.stop - run.start >= APPROACH_ROWS and height[run.start] - height[run.stop - 1] >= max(least, 1e-4)
    ]


def onset(rows: slice, height: np.ndarray, readings: np.ndarray) -> Approach | None:
    """Zero of one approach, or None where readings do not begin within it.

    Args:
        rows: Which rows of the recording these are.
        height: Of the tip (m), falling.
        readings: At these rows.

    Returns:
        The approach.
    """
    change = np.linalg.norm(readings - readings[:3].mean(0), axis=1)
    noise = np.sqrt((np.median(np.diff(readings[: 2 * REST_ROWS], axis=0) ** 2, axis=0) / 0.91).sum())
    beyond = np.flatnonzero(change > max(CONTACT_SHARE * change.max(), CONTACT_NOISES * noise))
    end = max(int(beyond[0]) + 1 if len(beyond) else len(height), APPROACH_ROWS)
    z, y = height[:end], readings[:end]
    if len(z) < APPROACH_ROWS or z[0] - z[-1] < 5e-5:
        return None
    creep = np.column_stack([np.ones(len(z)), np.arange(len(z)) / len(z)])
    bare = _squared_error(creep, y)
    candidates = np.linspace(z[-1], z[0], 161)[1:-1]
    errors = np.array(
        [
            [_squared_error(np.column_stack([creep, np.maximum(zero - z, 0) ** power / 1e-3**power]), y)
             for power in ONSET_POWERS]
            for zero in candidates
        ]
    )  # fmt: skip
    i = int(errors.min(1).argmin())
    explained = 1 - float(errors.min()) / max(bare, 1e-30)
    # A zero at the end of the way has no row above it that would show readings at rest.
    if explained < ONSET_SHARE or np.sum(z > candidates[i]) < 3:
        return None
    return Approach(rows, float(candidates[i]), explained)


def _squared_error(design: np.ndarray, values: np.ndarray) -> float:
    q = np.linalg.qr(design)[0]
    return float(((values - q @ (q.T @ values)) ** 2).sum())
