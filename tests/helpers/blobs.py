"""Points in five groups far apart."""

import numpy as np


def blobs(seed: int = 0, n: int = 40, d: int = 6) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    label = np.repeat(np.arange(5), n)
    centres = 20 * np.eye(5, d)
    return centres[label] + rng.normal(size=(5 * n, d)), label
