"""Options that experiments share by inheritance. This module has no slow imports."""

from dataclasses import dataclass
from typing import Literal

from i2t.cli.options import Count, Seed

UnitName = Literal["m", "cm", "mm", "inch"]  # of the coordinates in mesh files


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of an experiment that runs in one piece."""

    seed: Seed = 0  # of everything random
    overwrite: bool = False  # replace a finished or unfinished run in --out


@dataclass(frozen=True, kw_only=True)
class ResumableOptions(RunOptions):
    """Options of an experiment that runs in parts, such as pads and seeds."""

    resume: bool = False  # go on with an unfinished run in --out
    workers: Count = 1  # processes that make pads and seeds side by side; 1 is this one
