"""Presses of a made-up skin with five chips, and of nothing that the library makes."""

import numpy as np

from i2t.recordings.read import SkinRecording


def presses_of_a_skin(n: int, *, channels: int = 15, seed: int = 0, noise_ut: float = 0.5) -> SkinRecording:
    """n presses at random positions and travels."""
    rng = np.random.default_rng(seed)
    position, travel = rng.uniform(-10e-3, 10e-3, (n, 2)), rng.uniform(0.5e-3, 4e-3, n)
    centres = rng.uniform(-15e-3, 15e-3, (20, 2))
    maps = np.exp(-((position[:, None] - centres) ** 2).sum(-1) / 2 / 9e-3**2) @ rng.normal(
        scale=60, size=(20, channels)
    )
    readings = maps * ((travel + 3e-3) / 5e-3)[:, None] ** 1.75 + noise_ut * rng.normal(size=(n, channels))
    return SkinRecording(
        name="skin",
        readings=readings,
        targets={"position": position, "travel": travel[:, None]},
        session=np.zeros(n, int),
        time=np.full(n, np.nan),
    )
