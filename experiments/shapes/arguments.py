"""The options of `python -m experiments.shapes`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import require_dataset
from experiments.common.options import ResumableOptions


@dataclass(frozen=True)
class ShapesArgs(ResumableOptions):
    """Tell stamps apart by touch, on new positions, depths, rotations and skins."""

    out: Path = Path("runs/shapes")  # folder for everything that is made
    preset: Literal["paper", "debug"] = "paper"
    dataset: Path | None = None  # recorded presses in place of simulated ones; its objects are the shapes

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return "python -m experiments.reconstruct patch"

    def check(self) -> None:
        """Refuse what does not go together, and a data set that is not there."""
        require_dataset("--dataset", self.dataset)
