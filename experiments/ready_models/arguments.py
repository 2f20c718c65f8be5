"""The options of `python -m experiments.ready_models`, without JAX."""

from dataclasses import dataclass
from pathlib import Path

from experiments.common.checks import finished_runs


@dataclass(frozen=True)
class ReadyModelsArgs:
    """Make the ready models of the package: of a simulated pad from a finished run, or of a real skin."""

    out: Path = Path("runs/ready_models")  # folder for predictor/, pad_model.npz and metrics.json
    trained_run: Path = Path("runs/train")  # a finished run of experiments.train that simulated its touches
    eflesh: Path | None = None  # a session of eFlesh (states.csv ...): make the calibration of that skin instead
    seed: int = 0
    overwrite: bool = False  # replace an earlier run in --out

    def check(self) -> None:
        """Refuse a run or a session that is not there."""
        if self.eflesh is None:
            finished_runs(self.trained_run)
        elif not self.eflesh.is_dir():
            raise ValueError(f"--eflesh {self.eflesh}: no such folder; name a session's folder")
