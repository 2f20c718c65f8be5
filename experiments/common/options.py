"""Options that experiments share by inheritance. This module has no slow imports."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from i2t.cli.options import Count, Seed

UnitName = Literal["m", "cm", "mm", "inch"]  # unit of the coordinates in mesh files


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of an experiment that runs in one piece."""

    seed: Seed = 0  # seed of all random choices
    overwrite: bool = False  # replace a finished or unfinished run in --out
    config: Path | None = None  # config.json of an earlier run, whose options apply unless they are given here


@dataclass(frozen=True, kw_only=True)
class ResumableOptions(RunOptions):
    """Options of an experiment that runs in parts, such as pads and seeds."""

    resume: bool = False  # continue an unfinished run in --out
    workers: Count = 1  # number of processes that share the pads and seeds; 1 means no extra process
