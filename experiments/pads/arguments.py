"""The options of `python -m experiments.pads`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from i2t.cli import Limits, Seed


@dataclass(frozen=True)
class PadsArgs:
    """Locate presses on pads that were never seen."""

    out: Path = Path("runs/pads")  # folder for everything that is made
    preset: Literal["study", "debug"] = "study"
    skins: Annotated[int, Limits(2)] | None = None  # 18 in the study, 2 in debug; a multiple of the boards is best
    seed: Seed = 0
    overwrite: bool = False  # replace a run in --out

    def check(self) -> None:
        """All options go together."""
