"""The options of `python -m experiments.shapes`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import require_dataset
from i2t.cli import Seed


@dataclass(frozen=True)
class ShapesArgs:
    """Tell stamps apart by touch, on new positions, depths, rotations and skins."""

    out: Path = Path("runs/shapes")  # folder for everything that is made
    preset: Literal["paper", "debug"] = "paper"
    dataset: Path | None = None  # recorded presses in place of simulated ones; its objects are the shapes
    seed: Seed = 0
    resume: bool = False  # go on with an unfinished run in --out
    overwrite: bool = False  # replace a finished or unfinished one

    def check(self) -> None:
        """Refuse a data set that is not there."""
        require_dataset("--dataset", self.dataset)
