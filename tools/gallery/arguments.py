"""Options of `python -m tools.gallery`, free of JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, get_args

from i2t.models.finished import FORMER_NAMES, require_simulated_runs

FigureName = Literal[
    "overview", "patches", "press", "episode", "calibration_curve", "predictors", "registration", "rig",
    "monitor", "from_depth", "stamps",
]  # fmt: skip
FIGURE_NAMES: tuple[FigureName, ...] = get_args(FigureName)
FIGURES_OF_RUN = frozenset[FigureName](("overview", "predictors"))  # figures that need a trained run


@dataclass(frozen=True)
class GalleryArgs:
    """Draw the figures of the documents."""

    out: Path = Path("runs/gallery")  # output folder
    FORMER_NAMES: ClassVar = FORMER_NAMES

    pad_model: Path = Path("runs/train")  # folder of a run of experiments.train that simulated its touches
    only: tuple[FigureName, ...] = ()  # names of the figures to draw; default: all

    def check(self) -> None:
        """Refuse a missing run if a figure needs one."""
        if FIGURES_OF_RUN.isdisjoint(self.only or FIGURE_NAMES):
            return
        require_simulated_runs(self.pad_model)
