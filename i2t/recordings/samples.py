"""Samples of one contact merged to one touch: their errors are shared, so they are not independent touches."""

import numpy as np
from jaxtyping import Bool, Float, Int


def first_samples(follows: Bool[np.ndarray, " m"]) -> Int[np.ndarray, " k"]:
    """Find the first row of each contact in m + 1 samples.

    Args:
        follows: Mask over the rows from the second on: whether the row belongs to the contact of the row before.

    Returns:
        `(k,)` row numbers, beginning with 0.
    """
    return np.flatnonzero(np.append(True, ~follows))


def mean_samples(values: Float[np.ndarray, "n ..."], starts: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k ..."]:
    """Average the samples of each contact.

    Args:
        values: `(n, ...)` values of the samples, in the order of time.
        starts: `(k,)` first rows of the contacts, from `first_samples`.

    Returns:
        `(k, ...)` mean values of the contacts.
    """
    counts = np.diff(np.append(starts, len(values)))
    return np.add.reduceat(values, starts, axis=0) / counts.reshape(-1, *[1] * (values.ndim - 1))
