"""The options of `python -m experiments.fidelity`, without JAX, so that its help and its refusals are there at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import require_dataset
from experiments.common.options import RunOptions


@dataclass(frozen=True)
class FidelityArgs(RunOptions):
    """Judge recordings of a skin: checks, noise, calibration curves, heads and repeatability in one report."""

    dataset: tuple[Path, ...]  # data sets, sessions of eFlesh as recorded, or tables; sessions of a skin together
    out: Path = Path("runs/fidelity")  # folder for report.txt, figures, metrics.json and config.json
    preset: Literal["paper", "short", "debug"] = "paper"

    def check(self) -> None:
        """Refuse a recording that is not there."""
        if not self.dataset:
            raise ValueError("pass --dataset with one or more recordings")
        if len(self.dataset) == 1:  # of several, those that cannot be read are left out and named
            require_dataset("--dataset", self.dataset[0], tables=True)
