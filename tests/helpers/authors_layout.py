"""Writes recordings of known contents in the layout of the Imagine2touch code, for the tests of its converter."""

import math
import sys
from collections import namedtuple
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import tifffile
from scipy.spatial.transform import Rotation

# The class that the authors' driver pickles, in a module that the reader does not have.
ReSkinData = namedtuple("ReSkinData", ["time", "acquisition_delay", "data", "dev_id"])
ReSkinData.__module__ = "reskin_sensor.sensor"
for _name in ("reskin_sensor", "reskin_sensor.sensor"):
    sys.modules.setdefault(_name, ModuleType(_name)).ReSkinData = ReSkinData

AMBIENT = ("means", "vectors", "records", "tuples", "tens", "tens of records")


class Contents(NamedTuple):
    """Values that a converter should find."""

    reading: np.ndarray  # (n, 15) uT
    depth: np.ndarray  # (n, size, size) mm
    final: np.ndarray  # (n, 3) m
    rotation: np.ndarray  # (n, 3, 3)
    approach: np.ndarray  # (n,) m
    force: np.ndarray  # (n,) N
    code: np.ndarray  # (n,)


def save(path: Path, values) -> None:
    """Save as the authors do, with `np.save` and a name without suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.save(file, values, allow_pickle=True)


def sample(rng, field, order):
    """[time, delay, 20 values, device] of one field of 15 values."""
    temperature = 27 + np.linspace(-1, 1, 5)[:, None] + rng.normal(0, 0.1, (5, 1))
    chips = field.reshape(5, 3)
    values = np.hstack([temperature, chips] if order == "binary" else [chips, temperature])
    return ReSkinData(1.6e9 + rng.random(), 0.01, values.ravel().tolist(), 2)


def ambient_of(kind, rng, n, order):
    """The contents of an ambient file, and the means (n, 15) that it represents."""
    count = math.ceil(n / 10) if kind.startswith("tens") else n
    groups = rng.normal(0, 5, (count, 10, 15)) + rng.normal(0, 300, (count, 1, 15))
    means = groups.mean(1) if count == n else groups.mean(1)[np.arange(n) // 10]
    if kind == "means":
        return groups.mean(1), means
    if kind in ("vectors", "tens"):
        return groups, means
    records = [[[sample(rng, field, order)] for field in group] for group in groups]
    if kind == "tuples":  # an object array of lists of named tuples
        listed = np.empty(n, object)
        listed[:] = [[record[0] for record in group] for group in records]
        return listed, means
    return np.array(records, dtype=object), means


def write(root: Path, name: str, run: str, n: int, *, order="binary", ambient="means", size=48, seed=0) -> Contents:
    """One run of n touches of the object `name` under `root`."""
    rng = np.random.default_rng(seed)
    folder = root / name
    field = rng.normal(0, 400, (n, 15))
    samples = np.array([[sample(rng, one, order)] for one in field], dtype=object)
    assert samples.shape == (n, 1, 4)
    stem = folder / f"{name}_tactile" / f"experiment_{run}_reskin"
    save(stem, samples)
    stored, means = ambient_of(ambient, rng, n, order)
    save(stem.with_name(stem.name + "_ambient"), stored)

    final = rng.uniform(-0.3, 0.3, (n, 3))
    rotation = Rotation.random(n, rng)
    approach = rng.uniform(0.02, 0.06, n)
    axis = rotation.as_matrix()[:, :, 2]
    force = rng.uniform(0, 8, n)
    code = rng.integers(-1, 5, n)
    poses = folder / f"{name}_poses" / f"experiment_{run}"
    forces = folder / f"{name}_forces" / f"experiment_{run}"
    for stem, values in (
        (f"{poses}_final_contact", final),
        (f"{poses}_prepare_contact", final - approach[:, None] * axis),
        (f"{poses}_rotations", rotation.as_quat()),
        (f"{poses}_joints_state", rng.normal(size=(n, 6))),
        (f"{forces}_forces_torques", np.hstack([-force[:, None] * axis, rng.normal(size=(n, 3))])),
        (f"{forces}_contact_returns", code),
        (f"{forces}_reskin_contact_magnitudes", rng.uniform(25, 60, n)),
    ):
        save(Path(stem), values)

    depth = rng.integers(100, 115, (n, size, size)).astype(np.uint16)
    images = folder / f"{name}_images" / "depth"
    images.mkdir(parents=True, exist_ok=True)
    for k in range(n):
        tifffile.imwrite(images / f"experiment_{run}_depth_{k + 1}.tif", depth[k])
    remarks = folder / "meta_data" / f"{name}_experiment_{run}.txt"
    remarks.parent.mkdir(exist_ok=True)
    remarks.write_text("skin 3, warm day")
    return Contents(field - means, depth, final, rotation.as_matrix(), approach, force, code)
