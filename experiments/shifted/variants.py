"""A recording shifted and damaged in one way at a time, and skins of other kinds."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.calibrate.skins import SKIN_KINDS, simulate_skins
from i2t.calibration import LoadKind
from i2t.calibration.heads import read_recordings

ROWS_TAKEN = 1500  # of the recording, one after the other
DEEPER_M = 2e-3  # depths count from the highest press, which lies below first contact
SIMULATED_PRESSES = 400
SKIN_SEED = 77  # added to the seed: the population was made of other skins


class Variant(NamedTuple):
    """Presses with what is stated of them, right or wrong."""

    position: np.ndarray  # (n, 2) m
    load: np.ndarray | None  # (n,) m or N
    readings: np.ndarray  # (n, c) uT
    load_kind: LoadKind


def make_variants(path: Path, seed: int) -> dict[str, Variant]:
    """All variants by name.

    Args:
        path: Of the recording.
        seed: Of everything.

    Returns:
        The variants.
    """
    (recording, *_), rng = read_recordings(path), np.random.default_rng(seed + 1)
    start = int(np.random.default_rng(seed).integers(0, max(len(recording) - ROWS_TAKEN, 1)))
    rows = recording.rows(slice(start, start + ROWS_TAKEN))
    at, depth, y = rows.targets["position"], rows.targets["depth"][:, 0] + DEEPER_M, rows.readings
    n, share = len(y), depth / depth.max()

    def real(position=at, load=depth, readings=y, kind: LoadKind = "depth") -> Variant:
        return Variant(position, load, readings, kind)

    levels = np.linspace(depth.min(), depth.max(), 5)
    bad = np.random.default_rng(3).random(n) < 0.05
    outliers = np.where(bad[:, None], -3 * y, y)
    again = np.repeat(np.arange(n // 5), 5)
    found = {
        "real": real(),
        "no load": real(load=None, kind="none"),
        "height zero 3 mm off": real(load=depth + 3e-3),
        "height zero 3.5 mm the other way": real(load=np.maximum(depth - 3.5e-3, 0) + 1e-5),
        "labels a row late": real(at[1:], depth[1:], y[:-1]),
        "labels two rows late": real(at[2:], depth[2:], y[:-2]),
        "five heights": real(load=levels[np.abs(depth[:, None] - levels).argmin(1)]),
        "depths with 0.5 mm of noise": real(load=np.abs(depth + 0.5e-3 * rng.normal(size=n))),
        "forces with a tenth of noise": real(load=np.abs(share**1.5 + 0.1 * rng.normal(size=n)), kind="force"),
        "positions with 2 mm of noise": real(at + 2e-3 * rng.normal(size=at.shape)),
        "positions a thousandth": real(1e-3 * at),
        "x not known": real(at * [0, 1]),
        "an ambient field that wanders": real(readings=y + np.cumsum(rng.normal(0, 2, y.shape), 0)),
        "gains of 0.3 to 3": real(readings=y * np.repeat([0.3, 0.6, 1, 2, 3], 3)),
        "5 % of the readings wrong": real(readings=outliers),
        "each press five times": real(
            at[again], depth[again], y[again] + 2 * rng.normal(size=(len(again), y.shape[1]))
        ),
    }
    for kind in SKIN_KINDS:
        skin = simulate_skins(kind, seed + SKIN_SEED, 1, SIMULATED_PRESSES)[0]
        if kind != "lattice":
            found[f"simulated {kind}, force"] = Variant(skin.position, skin.force, skin.readings, "force")
        found[f"simulated {kind}, depth"] = Variant(skin.position, skin.depth, skin.readings, "depth")
    skin = simulate_skins("bonded", seed + SKIN_SEED + 1, 1, SIMULATED_PRESSES)[0]
    noise = rng.normal(size=skin.readings.shape)
    return found | {
        "simulated bonded, no load": Variant(skin.position, None, skin.readings, "none"),
        "simulated bonded, two rows late": Variant(skin.position[2:], skin.force[2:], skin.readings[:-2], "force"),
        "nothing but noise": Variant(skin.position, skin.force, noise, "force"),
    }
