"""The options and presets of `python -m experiments.reconstruct_patch`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from experiments.common.presets import choose_preset
from i2t.cli import Count, Limits, Seed, require_path
from i2t.extras import require_extra


@dataclass(frozen=True)
class PatchSizes:
    """Sizes of the experiment."""

    patches: int = 12_000  # of the library
    shapes: int = 240  # drawn ones to train on, besides those of the catalogue; of validation and test a fifth each
    test: int = 160  # contacts with test objects, pressed with every pad
    validation: int = 64  # contacts with validation objects, likewise
    pads: int = 3
    steps: int = 3000  # of the network's training


PRESETS: dict[str, PatchSizes] = {
    "paper": PatchSizes(),
    "short": PatchSizes(patches=4000, shapes=150, test=100, validation=40, steps=800),
    "debug": PatchSizes(patches=120, shapes=6, test=8, validation=4, pads=1, steps=20),
}


@dataclass(frozen=True)
class RecordedSizes:
    """Largest numbers of recorded presses."""

    learnt: int = 800  # of which the skin is calibrated, with those by which constants are chosen
    test: int = 1200  # of all parts
    folds: int = 4  # parts of the blocks, each judged by what was learned in the others


RECORDED_PRESETS: dict[str, RecordedSizes] = {
    "paper": RecordedSizes(),
    "short": RecordedSizes(300, 600),
    "debug": RecordedSizes(60, 24, folds=2),
}


@dataclass(frozen=True)
class PatchArgs:
    """Infer what a skin met at single presses, and say how far that is right."""

    out: Path = Path("runs/reconstruct_patch")  # folder for what is made
    preset: Literal["paper", "short", "debug"] = "paper"
    dataset: Path | None = None  # recorded presses of one tip (a set, sessions of eFlesh, a table): where was it?
    meshes: Path | None = None  # folder of mesh files in metres that take the place of the drawn shapes
    patches: Annotated[int, Limits(64)] | None = None  # of the library, instead of the preset's
    test: Count | None = None  # contacts with test objects, instead of the preset's
    pads: Count | None = None  # instead of the preset's
    seed: Seed = 0
    overwrite: bool = False  # replace a finished run in --out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return "python -m experiments.reconstruct"

    def check(self) -> None:
        """Refuse what is not there, and options that recorded presses leave without effect."""
        require_extra("manifold3d", "a library of drawn shapes")
        require_path("--meshes", self.meshes, "folder")
        require_path("--dataset", self.dataset, "path")
        simulated = {"--meshes": self.meshes, "--patches": self.patches, "--test": self.test, "--pads": self.pads}
        given = [name for name, value in simulated.items() if value is not None]
        if self.dataset is not None and given:
            raise ValueError(f"{', '.join(given)} has no effect on recorded presses; leave it or --dataset out")

    @property
    def sizes(self) -> PatchSizes:
        """Sizes of the preset, except those given."""
        return choose_preset(PRESETS, self.preset, patches=self.patches, test=self.test, pads=self.pads)
