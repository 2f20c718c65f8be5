"""The options of `python -m experiments.shapes`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import require_dataset
from experiments.common.options import ResumableOptions
from i2t.cli.options import require_path, require_with
from i2t.errors import require_extra


@dataclass(frozen=True)
class ShapesArgs(ResumableOptions):
    """Tell stamps apart by touch, on new positions, travels, rotations and skins."""

    out: Path = Path("runs/shapes")  # folder for everything that is made
    preset: Literal["paper", "debug"] = "paper"
    dataset: Path | None = None  # recorded presses in place of simulated ones; its objects are the shapes
    readings: Path | None = None  # or a table of readings with labels: CSV, plain or gzip-ed, a row a touch
    label: str | None = None  # its column of labels
    ignore: tuple[str, ...] = ()  # its columns that are no part of the reading, such as row numbers
    samples: int = 1  # of a touch over time, all values of the first one first

    def check(self) -> None:
        """Refuse what does not go together, and data that are not there."""
        require_dataset("--dataset", self.dataset)
        if self.readings is None:
            given = {"--label": self.label is not None, "--ignore": bool(self.ignore), "--samples": self.samples != 1}
            for flag, has in given.items():
                require_with(flag, has, "--readings", False)
            return
        if self.dataset is not None:
            raise ValueError("--dataset and --readings are two sources of touches; pass one of them")
        require_path("--readings", self.readings, "table")
        if self.label is None:
            raise ValueError("--readings needs --label; name the table's column of labels")
        if self.samples < 1:
            raise ValueError(f"--samples is {self.samples}; a touch has one sample at least")
        require_extra("sklearn", "a table of readings")
