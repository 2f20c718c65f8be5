"""The options of `python -m tests.faults`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

FaultSection = Literal["disk", "presses", "arm", "skin", "force", "rig", "sites", "links", "stalls", "kill"]
FAULT_SECTIONS: tuple[FaultSection, ...] = get_args(FaultSection)


@dataclass(frozen=True)
class FaultsArgs:
    """Break things while touches are collected, and count what is lost."""

    out: Path = Path("runs/faults")  # folder for the report, in which a later call goes on
    sections: tuple[FaultSection, ...] = FAULT_SECTIONS  # which
    preset: Literal["paper", "debug"] = "paper"  # how often: as the documents say, or each fault once
