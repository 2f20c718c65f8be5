"""Options of `python -m experiments.fidelity`, free of JAX so that help and refusals are immediate."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.options import RunOptions
from i2t.models.checks import require_dataset


@dataclass(frozen=True)
class FidelityArgs(RunOptions):
    """Report on recordings of a skin: checks, noise, hysteresis, calibration curves, heads and limits of any model."""

    dataset: tuple[Path, ...]  # data sets, sessions of eFlesh, or tables; pass all sessions of one skin
    out: Path = Path("runs/fidelity")  # folder of report.txt, figures, metrics.json and config.json
    preset: Literal["paper", "short", "debug"] = "paper"  # size of the experiment; debug runs every part once

    def check(self) -> None:
        """Refuse a missing recording."""
        if not self.dataset:
            raise ValueError("pass --dataset with one or more recordings")
        if len(self.dataset) == 1:  # of several, the unreadable ones are skipped with a message
            require_dataset("--dataset", self.dataset[0], tables=True)
