"""The options of `python -m experiments.shifted`, without JAX."""

from dataclasses import dataclass
from pathlib import Path

from experiments.common.checks import require_dataset
from i2t.cli import Count, Seed


@dataclass(frozen=True)
class ShiftedArgs:
    """Judge i2t.calibrate on recordings that are shifted, damaged or of other skins, next to baselines."""

    dataset: Path  # a recording of one skin that was pressed at many places and depths
    out: Path = Path("runs/shifted")  # folder for everything that is made
    draws: Count = 2  # of presses, of each variant
    seed: Seed = 29  # of the rows that are taken, the damage, the simulated skins and the draws
    only: tuple[str, ...] = ()  # variants whose names hold one of these; by default all
    overwrite: bool = False  # replace a run in --out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return f"python -m experiments.fidelity --dataset {self.dataset}"

    def check(self) -> None:
        """Refuse a recording that is not there."""
        require_dataset("--dataset", self.dataset)
