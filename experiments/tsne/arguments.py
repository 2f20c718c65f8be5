"""Options of `python -m experiments.tsne`. This module has no slow imports."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.options import RunOptions
from i2t.errors import require_extra
from i2t.models.checks import require_dataset


@dataclass(frozen=True)
class TsneArgs(RunOptions):
    """Map and cluster touches, and measure how far views and readings agree."""

    out: Path = Path("runs/tsne")  # folder for the results
    preset: Literal["paper", "debug"] = "paper"  # size of the experiment; debug runs every part once
    dataset: Path | None = None  # recorded touches instead of simulated ones
    kind: Literal["mask", "depth"] = "mask"  # view of a touch: contact mask or depth patch

    def check(self) -> None:
        """Refuse a data set that does not exist, and a missing scikit-learn (ValueError)."""
        require_dataset("--dataset", self.dataset)
        require_extra("sklearn", "a map of touches")
