"""The options and presets of `python -m experiments.refine`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import with_trained_run
from experiments.common.presets import choose_preset
from i2t.cli import Count, NotNegative, Positive, Seed, require_path


@dataclass(frozen=True)
class CaseSizes:
    """Sizes of the experiment."""

    cases: int = 200  # shared among all objects
    objects: int = 40  # different ones, besides those of --data
    starts: int = 4  # of the methods with several


PRESETS: dict[str, CaseSizes] = {"paper": CaseSizes(), "debug": CaseSizes(cases=6, objects=3, starts=1)}


@dataclass(frozen=True)
class RefineArgs:
    """Seek poses from single patches and say how often they are found."""

    out: Path = Path("runs/refine")  # folder for what is made
    preset: Literal["paper", "debug"] = "paper"
    data: Path | None = None  # folder of mesh files in metres that join the objects
    cases: Count | None = None  # instead of the preset's: 200, of debug 6
    objects: Count | None = None  # instead of the preset's 40 (3) different ones; those of --data join them
    distance: NotNegative = 2e-3  # m off at the start
    angle: NotNegative = 4.0  # degrees off at the start
    noise: NotNegative = 0.3e-3  # m, of a camera's depth pixel
    close: Positive = 0.1e-3  # m, what counts as found
    close_angle: Positive = 0.3  # degrees, likewise
    starts: Count | None = None  # instead of the preset's 4 (1) of the methods with several; 1 leaves them out
    seed: Seed = 0
    overwrite: bool = False  # replace a finished run in --out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return with_trained_run("python -m experiments.studies policy")

    def check(self) -> None:
        """Refuse a folder that is not there."""
        require_path("--data", self.data, "folder")

    @property
    def sizes(self) -> CaseSizes:
        """Sizes of the preset, except those given."""
        return choose_preset(PRESETS, self.preset, cases=self.cases, objects=self.objects, starts=self.starts)
