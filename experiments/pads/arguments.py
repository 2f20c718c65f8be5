"""The options of `python -m experiments.pads`, without JAX."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from experiments.common.tasks import TaskOptions
from i2t.cli import Limits, Seed


@dataclass(frozen=True)
class PadsArgs:
    """Locate presses on pads that were never seen."""

    out: Path = Path("runs/pads")  # folder for everything that is made
    preset: Literal["study", "debug"] = "study"
    skins: Annotated[int, Limits(2)] | None = None  # 18 in the study, 2 in debug; a multiple of the boards is best
    seed: Seed = 0
    resume: bool = False  # go on with an unfinished run in --out
    overwrite: bool = False  # replace a finished or unfinished run in --out
    tasks: Annotated[TaskOptions, tyro.conf.OmitArgPrefixes] = field(default_factory=TaskOptions)

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return "python -m experiments.calibrate_pads"

    def check(self) -> None:
        """Refuse what does not go together."""
