"""The options of `python -m experiments.studies`, without JAX, so that its help and its refusals are there at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from experiments.common.checks import chosen_runs
from experiments.common.options import ResumableOptions
from i2t.cli.options import Count
from i2t.errors import require_extra

StudyName = Literal["open_set", "mismatch", "physics", "stopping"]


@dataclass(frozen=True)
class StudyArgs(ResumableOptions):
    """Study recognition by touch."""

    study: tyro.conf.Positional[StudyName]
    out: Path | None = None  # folder for everything that is made; runs/STUDY unless given
    trained_run: Path = Path("runs/train")  # a finished run of experiments.train, or a study's folder of several
    pads: tuple[str, ...] = ()  # of a study in --trained-run, those that are used, by number; all unless given
    preset: Literal["paper", "debug"] = "paper"
    episodes: Count = 20  # of each object and setting, for each pad and seed

    @property
    def debug(self) -> bool:
        """Tell whether this is a small run, too small to mean anything."""
        return self.preset == "debug"

    @property
    def folder(self) -> Path:
        """Folder for everything that is made."""
        return self.out or Path("runs") / self.study

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there."""
        if self.study == "physics":
            require_extra("skfem", "a pad with free sides")
        chosen_runs(self.trained_run, self.pads)
