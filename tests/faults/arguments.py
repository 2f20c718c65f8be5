"""The options of `python -m tests.faults`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

FaultSection = Literal["disk", "presses", "arm", "skin", "force", "rig", "sites", "links", "stalls", "kill"]
FAULT_SECTIONS: tuple[FaultSection, ...] = get_args(FaultSection)


@dataclass(frozen=True)
class FaultsArgs:
    """Inject faults while touches are collected, and count what is lost."""

    out: Path = Path("runs/faults")  # folder of the report; a later call resumes there
    sections: tuple[FaultSection, ...] = FAULT_SECTIONS  # sections of faults to run
    preset: Literal["paper", "debug"] = "paper"  # number of trials: as documented, or one trial of each fault
