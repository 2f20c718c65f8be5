"""Forecasters whose calibration is known by construction."""

import numpy as np


def calibrated_forecaster(
    seed: int, episodes: int, classes: int = 5, touches: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """A forecaster that is right by construction: the truth is drawn from a Dirichlet p, and each touch adds a noisy
    view of the truth to the exact posterior.
    """
    rng = np.random.default_rng(seed)
    p = rng.dirichlet(np.full(classes, 1.0), episodes)
    truth = (rng.random(episodes)[:, None] > np.cumsum(p, 1)[:, :-1]).sum(1)
    seen = 0.45  # chance of the truth, the others share the rest
    beliefs = []
    for _ in range(touches):
        beliefs.append(p)
        wrong = (truth + rng.integers(1, classes, episodes)) % classes
        sight = np.where(rng.random(episodes) < seen, truth, wrong)
        p = p * np.where(np.arange(classes) == sight[:, None], seen, (1 - seen) / (classes - 1))
        p = p / p.sum(1, keepdims=True)
    return np.stack(beliefs, 1), truth
