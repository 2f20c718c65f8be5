"""The options of `python -m experiments.tsne`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import require_dataset
from i2t.cli import Seed
from i2t.errors import require_extra


@dataclass(frozen=True)
class TsneArgs:
    """A map of touches, their clusters, and how far views and readings agree."""

    out: Path = Path("runs/tsne")  # folder for everything that is made
    preset: Literal["paper", "debug"] = "paper"
    dataset: Path | None = None  # touches in place of simulated ones
    kind: Literal["mask", "depth"] = "mask"  # what a view is
    seed: Seed = 0
    overwrite: bool = False  # replace a run in --out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return "python -m experiments.notebooks"

    def check(self) -> None:
        """Refuse a data set that is not there, and scikit-learn where it is missing."""
        require_dataset("--dataset", self.dataset)
        require_extra("sklearn", "a map of touches")
