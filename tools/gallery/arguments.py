"""The options of `python -m tools.gallery`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

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
    trained_run: Path = Path("runs/train")  # a finished run of experiments.train that simulated its touches
    only: tuple[FigureName, ...] = ()  # some of the figures, by name

    def check(self) -> None:
        """Refuse a run that is not there, where a figure needs one."""
        if OF_A_RUN.isdisjoint(self.only or FIGURE_NAMES):
            return
        if not (self.trained_run / "metrics.json").is_file():
            raise ValueError(
                f"--trained-run {self.trained_run}: no finished run; python -m experiments.train makes one"
            )
