"""The options of `python -m experiments.ready_models`, without JAX."""

from dataclasses import dataclass
from pathlib import Path

from experiments.common.checks import finished_runs


@dataclass(frozen=True)
class ReadyModelsArgs:
    """Make the ready models of the package from a finished run."""

    out: Path = Path("runs/ready_models")  # folder for predictor/, pad_model.npz and metrics.json
    trained_run: Path = Path("runs/train")  # a finished run of experiments.train that simulated its touches
    seed: int = 0
    overwrite: bool = False  # replace an earlier run in --out

    def check(self) -> None:
        """Refuse a run that is not there."""
        finished_runs(self.trained_run)
