"""Shapes to touch, split by object: those of the catalogue, drawn ones of the same scale, or a folder of meshes."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from i2t.objects import Mesh, catalogue, primitives, read_mesh
from i2t.objects.drawing import disk, outline, rectangle

SUFFIXES = (".obj", ".ply", ".stl")
SMALLEST_SCALE = 0.25  # of the size of a drawn object: from a stamp's to a hand's
FIRST_SEED = {"train": 0, "validation": 1_000_000, "test": 2_000_000}  # of drawn shapes
HELD_OUT_PART = 5  # as many drawn shapes to train on as there are to test, and to validate


class Shapes(NamedTuple):
    """Shapes of one part of the split."""

    names: list[str]
    meshes: list[Mesh]
    named: int  # the first so many are of the catalogue


def list_shapes(part: str, drawn: int, folder: Path | None) -> Shapes:
    """The shapes of a part: "train", "validation" or "test"; `drawn` is the number of those drawn to train on.

    Raises:
        ValueError: The folder holds too few meshes.
    """
    if folder is not None:
        return _of_folder(part, folder)
    named = [name for i, name in enumerate(catalogue.NAMES) if _part_of(i) == part]
    count = drawn if part == "train" else max(drawn // HELD_OUT_PART, 1)
    seeds = [FIRST_SEED[part] + i for i in range(count)]
    meshes = [catalogue.make_object(name).mesh for name in named] + [draw_shape(seed) for seed in seeds]
    return Shapes(named + [f"drawn-{seed}" for seed in seeds], meshes, len(named))


def draw_shape(seed: int) -> Mesh:
    """A random primitive of any size from a stamp's to a hand's, or a stamp with up to three strokes."""
    rng = np.random.default_rng(seed)
    if rng.random() < 0.5:
        mesh = catalogue.random_object(int(rng.integers(2**31))).mesh
        return Mesh(mesh.vertices * SMALLEST_SCALE ** rng.random(), mesh.faces)
    region = None
    for _ in range(rng.integers(1, 4)):
        size, turn = rng.uniform(2.0, 12.0, 2), rng.uniform(0, 180)
        kind = rng.integers(3)
        if kind == 0:
            part = rectangle(size[0], min(size[1], 5.0))
        elif kind == 1:
            part = disk(size[0] / 2)
        else:
            part = outline([(-size[0] / 2, -size[1] / 3), (size[0] / 2, -size[1] / 3), (0, 2 * size[1] / 3)])
        part = part.rotate(turn).translate(rng.uniform(-3, 3, 2))
        region = part if region is None else region + part
    return primitives.stamp(region)


def _part_of(index: int) -> str:
    """Part of an object of the catalogue: a quarter to test, an eighth to validate, every family in each part."""
    return "test" if index % 4 == 2 else "validation" if index % 8 == 5 else "train"


def _of_folder(part: str, folder: Path) -> Shapes:
    """Meshes of a folder in the order of their names, every tenth to test, and every tenth to validate."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    remainder = {"test": (0,), "validation": (5,), "train": (1, 2, 3, 4, 6, 7, 8, 9)}[part]
    kept = [path for i, path in enumerate(files) if i % 10 in remainder]
    if len(files) < 10:
        raise ValueError(f"--meshes {folder}: holds {len(files)} meshes ({', '.join(SUFFIXES)}); give at least 10")
    return Shapes([path.stem for path in kept], [read_mesh(path, "m")[0].mesh for path in kept], 0)
