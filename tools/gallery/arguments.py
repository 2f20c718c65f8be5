"""The options of `python -m tools.gallery`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, get_args

from experiments.train.finished import FORMER_NAMES, require_simulated_runs

FigureName = Literal[
    "overview", "patches", "press", "episode", "calibration_curve", "predictors", "registration", "rig",
    "monitor", "from_depth", "stamps",
]  # fmt: skip
FIGURE_NAMES: tuple[FigureName, ...] = get_args(FigureName)
OF_A_RUN = frozenset[FigureName](("overview", "episode", "predictors"))  # which the others do without


@dataclass(frozen=True)
class GalleryArgs:
    """Draw the figures of the documents."""

    out: Path = Path("runs/gallery")  # folder for the figures
    FORMER_NAMES: ClassVar = FORMER_NAMES

    pad_model: Path = Path("runs/train")  # folder of a run of experiments.train that simulated its touches
    only: tuple[FigureName, ...] = ()  # some of the figures, by name

    def check(self) -> None:
        """Refuse a run that is not there, where a figure needs one."""
        if OF_A_RUN.isdisjoint(self.only or FIGURE_NAMES):
            return
        require_simulated_runs(self.pad_model)
