"""The options of `python -m experiments.calibrate_pads`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from i2t.cli import Seed


@dataclass(frozen=True)
class CalibratePadsArgs:
    """Calibration of simulated pads by force."""

    out: Path = Path("runs/calibrate_pads")  # folder for everything that is made
    preset: Literal["paper", "short", "debug"] = "paper"
    population: bool = False  # choose hyperparameters on a population of pads instead
    prior: bool = False  # make the prior over kernels instead
    kinds: bool = False  # calibrate simulated skins of many kinds instead
    seed: Seed = 0
    overwrite: bool = False  # replace a run in --out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return "python -m experiments.pads"

    def check(self) -> None:
        """Refuse what does not go together."""
        if self.population + self.prior + self.kinds > 1:
            raise ValueError("--population, --prior and --kinds are one or the other; pass one of them")
        if self.seed and (self.prior or self.kinds):
            raise ValueError("--seed has no effect on --prior and --kinds, whose seeds are their own; leave it out")
