"""Recordings made wrong on purpose, one mistake each: what an estimator must find, and nothing else may fall over on.

`press` makes sound presses of a lattice of four magnets (a closed form of its own, not the project's generated skins);
`VARIANTS` damages presses that it made, or real ones.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

CHIPS_M = 7e-3 * np.array([[0, 0], [1, 0], [0, 1], [0, -1], [-1, 0]])
MAGNETS_UNDER = 6e-3  # m, chips below the magnets


class Recorded(NamedTuple):
    """Presses in the order of time, as a lab would write them down."""

    position: np.ndarray  # (n, 2) m
    height: np.ndarray  # (n,) m, of the tip over the skin
    force: np.ndarray  # (n,) N
    readings: np.ndarray  # (n, 15) uT


def press(seed: int, n: int, *, free: float = 0.15, noise: float = 2.0, half: float = 14e-3) -> Recorded:
    """Presses of a skin of four magnets over five chips, a share of them above first contact, where z is 0."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-half, half, (n, 2))
    height = np.where(rng.random(n) < free, rng.uniform(0, 1e-3, n), rng.uniform(-3e-3, 0, n))
    travel = np.maximum(-height, 0)
    rest = 7e-3 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) + rng.normal(0, 0.5e-3, (4, 2))
    moment = rng.normal(size=(4, 3)) + np.array([0, 0, 2])
    offset = rest[None] - position[:, None]
    sunk = 0.5 * (travel / 3e-3)[:, None] ** 0.75 * travel[:, None] * np.exp(-(offset**2).sum(-1) / (2 * 9e-3**2))
    moved = np.concatenate([0.2 * sunk[..., None] * offset / 9e-3, -sunk[..., None]], -1)
    at = np.concatenate([rest, np.zeros((4, 1))], 1)
    chips = np.column_stack([CHIPS_M, np.full(5, -MAGNETS_UNDER)])
    field = _dipoles(chips[None, :, None] - (at + moved)[:, None], moment).sum(2)
    readings = (field - _dipoles(chips[:, None] - at[None], moment).sum(1)).reshape(n, 15)
    readings *= 120 / np.sqrt(np.mean(readings[travel > 0] ** 2))
    return Recorded(position, height, 2e3 * travel**1.1, readings + noise * rng.normal(size=readings.shape))


def _dipoles(offset: np.ndarray, moment: np.ndarray) -> np.ndarray:
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    along = (offset * moment).sum(-1, keepdims=True)
    return 3 * offset * along / distance**5 - moment / distance**3


def lagged(recorded: Recorded, rows: int) -> Recorded:
    """Labels that come so many rows late: the reading of row i has the labels of row i - rows."""
    n = len(recorded.force)
    labels, readings = (slice(0, n - rows), slice(rows, n)) if rows > 0 else (slice(-rows, n), slice(0, n + rows))
    return Recorded(*(part[readings] for part in recorded[:3]), recorded.readings[labels])


def five_heights(recorded: Recorded) -> Recorded:
    """Presses to five heights only."""
    levels = np.linspace(recorded.height.min(), 0, 5)
    nearest = levels[np.abs(recorded.height[:, None] - levels).argmin(1)]
    kept = np.abs(recorded.height - nearest) < 0.1e-3
    return Recorded(*(part[kept] for part in recorded))._replace(height=nearest[kept])


def one_height(recorded: Recorded) -> Recorded:
    """Presses to one height, as deep as the median."""
    travel = np.median(-recorded.height[recorded.height < 0])
    kept = np.abs(recorded.height + travel) < 0.2e-3
    return Recorded(*(part[kept] for part in recorded))._replace(height=np.full(kept.sum(), -travel))


VARIANTS: dict[str, Callable[[Recorded], Recorded]] = {
    "sound": lambda one: one,
    "another height zero": lambda one: one._replace(height=one.height + 0.1426),
    "height into the skin": lambda one: one._replace(height=-one.height),
    "force that pulls": lambda one: one._replace(force=-one.force),
    "x mirrored": lambda one: one._replace(position=one.position * [-1, 1]),
    "x and y exchanged": lambda one: one._replace(position=one.position[:, ::-1]),
    "labels a row late": lambda one: lagged(one, 1),
    "labels two rows early": lambda one: lagged(one, -2),
    "positions in millimetres": lambda one: one._replace(position=1e3 * one.position),
    "readings in millitesla": lambda one: one._replace(readings=1e-3 * one.readings),
    "five heights": five_heights,
    "one height": one_height,
    "force with 0.1 N of noise": lambda one: one._replace(
        force=one.force + np.random.default_rng(0).normal(0, 0.1, len(one.force))
    ),
}
