"""The options of `python -m experiments.studies`, without JAX, so that its help and its refusals are there at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import tyro

from experiments.common.options import ResumableOptions
from experiments.train.finished import FORMER_NAMES, require_simulated_runs
from i2t.cli.options import Count
from i2t.errors import require_extra

StudyName = Literal["open_set", "mismatch", "physics", "stopping"]


@dataclass(frozen=True)
class StudyArgs(ResumableOptions):
    """Study recognition by touch."""

    FORMER_NAMES: ClassVar = FORMER_NAMES

    study: tyro.conf.Positional[StudyName]
    out: Path | None = None  # folder for everything that is made; runs/STUDY unless given
    pad_model: Path = Path("runs/train")  # folder of a run of experiments.train, or of several pads and seeds
    pads: tuple[str, ...] = ()  # of several, those that are used, by number; all unless given
    preset: Literal["paper", "debug"] = "paper"
    episodes: Count = 20  # of each object and setting, for each pad and seed

    @property
    def folder(self) -> Path:
        """Folder for everything that is made."""
        return self.out or Path("runs") / self.study

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there."""
        if self.study == "physics":
            require_extra("skfem", "a pad with free sides")
        require_simulated_runs(self.pad_model, self.pads)
