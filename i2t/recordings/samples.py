"""Samples of one contact as one touch: they share its errors, so that they are no independent touches."""

import numpy as np
from jaxtyping import Bool, Float, Int


def first_samples(follows: Bool[np.ndarray, " m"]) -> Int[np.ndarray, " k"]:
    """Rows with which another contact begins.

    Args:
        follows: Which rows from the second on are of the same contact as the row before.

    Returns:
        Row numbers, the first row among them.
    """
    return np.flatnonzero(np.append(True, ~follows))


def mean_samples(values: Float[np.ndarray, "n ..."], starts: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k ..."]:
    """The mean over the samples of each contact.

    Args:
        values: Of n rows, in the order of time.
        starts: As of `first_samples`.

    Returns:
        A row for each contact.
    """
    counts = np.diff(np.append(starts, len(values)))
    return np.add.reduceat(values, starts, axis=0) / counts.reshape(-1, *[1] * (values.ndim - 1))
