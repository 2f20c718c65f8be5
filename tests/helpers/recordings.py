"""Recordings written as laboratories write them, and the converter's commands run on them."""

import gzip
from pathlib import Path

import numpy as np

from i2t.convert.commands import main
from i2t.dataset import load_dataset

READING_NAMES = [f"b{chip}{axis}_uT" for chip in range(5) for axis in "xyz"]


def run(*words):
    return main([str(word) for word in words])


def converted(command, source, target, *options):
    """The data set that a converter writes; it prints all of its notes."""
    verbose = () if command in ("pack", "lerobot") else ("--verbose",)
    assert run(command, source, target, *options, *verbose) == 0
    return load_dataset(target)


def refused(capsys, *words):
    """The one sentence with which a command ends."""
    capsys.readouterr()
    assert run(*words) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    sentence = printed.err.removesuffix("\n")
    assert sentence
    assert "\n" not in sentence
    assert "Traceback" not in sentence
    return sentence


def write_table(path: Path, names, rows, change=lambda text: text) -> Path:
    """A table of numbers and texts with or without a line of names, compressed if its name ends so."""
    cells = ([cell if isinstance(cell, str) else repr(float(cell)) for cell in row] for row in rows)
    text = change("\n".join(",".join(row) for row in [*([names] if len(names) else []), *cells]) + "\n").encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(text) if path.suffix == ".gz" else text)
    return path


def write_columns(path: Path, columns: dict) -> dict:
    """A table by its columns."""
    write_table(path, list(columns), zip(*columns.values(), strict=True))
    return columns


def write_session(folder: Path, place_mm, values, ending="csv"):
    """A session in eFlesh's layout: places (n, 3) mm of the robot and values (n, 15) uT."""
    time = 1.7e9 + 4.25 * np.arange(len(place_mm))
    for name, at, columns in (("states", time + 1e-3, place_mm), ("sensor_post_baselines", time, values)):
        write_table(folder / f"{name}.{ending}", (), np.column_stack([at, columns]))
