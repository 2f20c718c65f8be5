"""The options of `python -m experiments.tsne`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import require_dataset
from experiments.common.options import RunOptions
from i2t.errors import require_extra


@dataclass(frozen=True)
class TsneArgs(RunOptions):
    """A map of touches, their clusters, and how far views and readings agree."""

    out: Path = Path("runs/tsne")  # folder for everything that is made
    preset: Literal["paper", "debug"] = "paper"
    dataset: Path | None = None  # touches in place of simulated ones
    kind: Literal["mask", "depth"] = "mask"  # what a view is

    def check(self) -> None:
        """Refuse a data set that is not there, and scikit-learn where it is missing."""
        require_dataset("--dataset", self.dataset)
        require_extra("sklearn", "a map of touches")
