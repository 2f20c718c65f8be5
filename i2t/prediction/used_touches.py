"""Record of the touches to which a predictor was fitted, so that a score shows whether any of them are in it."""

from hashlib import blake2b
from typing import Any

import numpy as np

from i2t.dataset import Dataset, Split


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


def describe_training(dataset: Dataset, split: Split) -> dict[str, Any]:
    """Describe the touches of a fit for the metadata of a predictor.

    Args:
        dataset: All touches.
        split: Split whose training touches are fitted to.

    Returns:
        Numbers of touches for training and validation, the objects of each, and what is held out.
    """
    parts = {"training": split.train, "validation": split.validation}
    objects = {part: np.unique(dataset.touches.object[rows]) for part, rows in parts.items()}
    return {
        **{part: int(rows.sum()) for part, rows in parts.items()},
        **{f"{part}_objects": [dataset.objects[i] for i in numbers] for part, numbers in objects.items()},
        "split": split.description,
    }
