"""The options of `python -m experiments.faults`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from i2t.cli import Limits

FaultSection = Literal[
    "disk", "presses", "ambient", "wire", "arm", "skin", "force", "volume", "rig", "sites", "links", "stalls", "kill"
]
FAULT_SECTIONS: tuple[FaultSection, ...] = get_args(FaultSection)


@dataclass(frozen=True)
class FaultsArgs:
    """Break things while touches are collected, and count what is lost."""

    out: Path = Path("runs/faults")  # folder for the report, in which a later call goes on
    sections: tuple[FaultSection, ...] = FAULT_SECTIONS  # which
    preset: Literal["paper", "debug"] = "paper"  # how often: as the documents say, or each fault once
    share: Annotated[float, Limits(0, 1, above=True)] = 1.0  # of that
    again: bool = False  # begin anew, whatever is kept in the folder
