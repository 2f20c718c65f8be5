"""The options of `python -m experiments.faults`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from experiments.faults.rows import FaultCounts
from i2t.cli import Limits

FaultSection = Literal[
    "disk", "presses", "ambient", "wire", "arm", "skin", "force", "volume", "rig", "sites", "links", "stalls", "kill"
]
FAULT_SECTIONS: tuple[FaultSection, ...] = get_args(FaultSection)
DEBUG_COUNTS = FaultCounts(1.0, 600, 1, 1, 1, 1, 1, 1, 3, 2, 3, 2, 1, 1)
PRESETS: dict[str, FaultCounts] = {"paper": FaultCounts(), "debug": DEBUG_COUNTS}


@dataclass(frozen=True)
class FaultsArgs:
    """Break things while touches are collected, and count what is lost."""

    out: Path = Path("runs/faults")  # folder for the report, which a later call goes on in
    sections: tuple[FaultSection, ...] = FAULT_SECTIONS  # which
    preset: Literal["paper", "debug"] = "paper"  # how often
    share: Annotated[float, Limits(0, 1, above=True)] = 1.0  # of that
    again: bool = False  # begin anew, whatever is kept in the folder

    def check(self) -> None:
        """Refuse nothing: no option excludes another."""
