"""Options of `python -m experiments.shapes`. This module has no slow imports."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.options import ResumableOptions
from i2t.cli.options import require_path, require_with
from i2t.errors import require_extra
from i2t.models.checks import require_dataset


@dataclass(frozen=True)
class ShapesArgs(ResumableOptions):
    """Classify stamps by touch, at new positions, travels and rotations and on new skins."""

    out: Path = Path("runs/shapes")  # folder for the results
    preset: Literal["paper", "debug"] = "paper"  # size of the experiment; debug runs every part once
    dataset: Path | None = None  # recorded presses instead of simulated ones; its objects are the shapes
    readings: Path | None = None  # table of labelled readings instead (.csv or .csv.gz), with one row per touch
    label: str | None = None  # with --readings: column of the label
    ignore: tuple[str, ...] = ()  # with --readings: columns that are not part of the reading, such as row numbers
    samples: int = 1  # with --readings: samples of a touch over time, all values of the first sample first

    def check(self) -> None:
        """Refuse options that exclude each other, and data that do not exist (ValueError)."""
        require_dataset("--dataset", self.dataset)
        if self.readings is None:
            flags = {"--label": self.label is not None, "--ignore": bool(self.ignore), "--samples": self.samples != 1}
            for flag, given in flags.items():
                require_with(flag, given, "--readings", False)
            return
        if self.dataset is not None:
            raise ValueError("--dataset and --readings are two sources of touches; pass one of them")
        require_path("--readings", self.readings, "table")
        if self.label is None:
            raise ValueError("--readings needs --label; name the table's column of labels")
        if self.samples < 1:
            raise ValueError(f"--samples is {self.samples}; a touch has at least one sample")
        require_extra("sklearn", "a table of readings")
