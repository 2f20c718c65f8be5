"""Options of `python -m experiments.studies`, free of JAX so that help and refusals are immediate."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import tyro

from experiments.common.options import ResumableOptions
from i2t.cli.options import Count
from i2t.errors import require_extra
from i2t.models.finished import FORMER_NAMES, require_simulated_runs

StudyName = Literal["open_set", "mismatch", "physics", "stopping"]


@dataclass(frozen=True)
class StudyArgs(ResumableOptions):
    """Run one study of recognition by touch on finished training runs."""

    FORMER_NAMES: ClassVar = FORMER_NAMES

    study: tyro.conf.Positional[StudyName]
    out: Path | None = None  # output folder; default: runs/STUDY
    pad_model: Path = Path("runs/train")  # folder of one run of experiments.train, or of several pads and seeds
    pads: tuple[str, ...] = ()  # numbers of the pads to use; default: all
    preset: Literal["paper", "debug"] = "paper"  # size of the experiment; debug runs every part once
    episodes: Count = 20  # episodes per object and setting, for each pad and seed

    @property
    def folder(self) -> Path:
        """Output folder."""
        return self.out or Path("runs") / self.study

    def check(self) -> None:
        """Refuse missing packages and unusable training runs."""
        if self.study == "physics":
            require_extra("skfem", "a pad with free sides")
        require_simulated_runs(self.pad_model, self.pads)
