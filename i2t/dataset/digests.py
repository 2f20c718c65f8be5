"""Digests of touches, with which a fitted model records the touches of its fit, so that a score can leave them out."""

from hashlib import blake2b

import numpy as np

from i2t.dataset.sets import Dataset


def touch_digests(dataset: Dataset) -> list[str]:
    """Compute a short digest of each touch's reading, which the corrections of forces and travels do not change.

    Args:
        dataset: n touches.

    Returns:
        n digests, as hexadecimal texts.
    """
    readings = np.ascontiguousarray(dataset.touches.reading, "<f4")
    # In 6 bytes, two of a million touches have the same digest with a probability of 0.2 %.
    return [blake2b(reading.tobytes(), digest_size=6).hexdigest() for reading in readings]
