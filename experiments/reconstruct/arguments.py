"""The options and presets of `python -m experiments.reconstruct` and of its parts `patch` and `tip`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import require_dataset
from experiments.common.options import RunOptions
from experiments.common.presets import choose_preset
from i2t.cli import Count, require_path, require_with
from i2t.errors import require_extra


@dataclass(frozen=True)
class ReconstructSizes:
    """Sizes of the experiment."""

    train: int = 80  # shapes of the library
    validation: int = 6  # objects, in neither, on which the width of the bands is chosen
    test: int = 4  # unseen objects
    touches: int = 20  # on each
    pads: int = 3  # simulated skins, in turn
    patches: int = 600  # of the library of local surfaces
    samples: int = 8000  # points of a surface, by which distances between surfaces are measured


SURFACE_PRESETS = {
    "paper": ReconstructSizes(),
    "debug": ReconstructSizes(train=4, validation=1, test=2, touches=2, pads=1, patches=48, samples=2000),
}


@dataclass(frozen=True)
class ExplorationCondition:
    """One way to explore and to read touches."""

    policy: Literal["random", "uncertainty", "reduction"] = "reduction"  # of `i2t.reconstruction.exploration`
    reading: bool = True  # whether a touch says more than where it was


CONDITIONS = {
    "random": ExplorationCondition("random"),
    "uncertainty": ExplorationCondition("uncertainty"),
    "reduction": ExplorationCondition("reduction"),
    "contact pose only": ExplorationCondition(reading=False),
}


@dataclass(frozen=True)
class ReconstructArgs(RunOptions):
    """Reconstruct unseen objects from simulated touches and say how good and sure the surface is, or one recorded."""

    out: Path = Path("runs/reconstruct")  # folder for what is made
    preset: Literal["paper", "debug"] = "paper"
    dataset: Path | None = None  # recorded touches of an object, whose surface is reconstructed in place of all else
    object: str | None = None  # of --dataset, where it holds several
    name: str = "reconstructed"  # of the mesh that is made of --dataset
    test: Count | None = None  # unseen objects, instead of the preset's 4
    touches: Count | None = None  # on each, instead of the preset's 20
    conditions: tuple[str, ...] = ()  # the names of those to run; all without it

    def check(self) -> None:
        """Refuse what does not go together, what is not there, and conditions that there are not."""
        require_dataset("--dataset", self.dataset)
        recorded = self.dataset is not None
        require_with("--object", self.object is not None, "--dataset", recorded)
        require_with("--name", self.name != "reconstructed", "--dataset", recorded)
        require_with("--touches", self.touches is not None, "simulated objects (no --dataset)", not recorded)
        for flag, given in (("--test", self.test is not None), ("--conditions", bool(self.conditions))):
            require_with(flag, given, "simulated objects (no --dataset)", not recorded)
        if not self.name or Path(self.name).name != self.name:
            raise ValueError(f"--name {self.name}: is no name of a file; give a word")
        if unknown := sorted(set(self.conditions) - set(CONDITIONS)):
            raise ValueError(f"--conditions {unknown[0]}: is none of {', '.join(CONDITIONS)}")
        require_extra("skimage", "a surface")
        require_extra("manifold3d", "a library of random objects")

    @property
    def sizes(self) -> ReconstructSizes:
        """Sizes of the preset, except those given."""
        return choose_preset(SURFACE_PRESETS, self.preset, test=self.test, touches=self.touches)


@dataclass(frozen=True)
class PatchSizes:
    """Sizes of the experiment on patches."""

    patches: int = 12_000  # of the library
    shapes: int = 240  # drawn ones to train on, besides those of the catalogue; of validation and test a fifth each
    test: int = 160  # contacts with test objects, pressed with every pad
    validation: int = 64  # contacts with validation objects, likewise
    pads: int = 3


PATCH_PRESETS = {
    "paper": PatchSizes(),
    "short": PatchSizes(patches=4000, shapes=150, test=100, validation=40),
    "debug": PatchSizes(patches=120, shapes=6, test=8, validation=4, pads=1),
}


@dataclass(frozen=True)
class PatchArgs(RunOptions):
    """Infer what a skin met at single presses, and say how far that is right."""

    out: Path = Path("runs/reconstruct_patch")  # folder for what is made
    preset: Literal["paper", "short", "debug"] = "paper"


@dataclass(frozen=True)
class TipSizes:
    """Largest numbers of recorded presses."""

    learnt: int = 800  # of which the skin is calibrated, with those by which constants are chosen
    test: int = 1200  # of all parts
    folds: int = 4  # parts of the blocks, each judged by what was learned in the others


TIP_PRESETS = {"paper": TipSizes(), "short": TipSizes(300, 600), "debug": TipSizes(60, 24, folds=2)}


@dataclass(frozen=True)
class TipArgs(RunOptions):
    """Tell from single readings where a skin's calibration tip was, on recorded presses."""

    dataset: Path  # recorded presses of one tip: a set, sessions of eFlesh, or a table
    out: Path = Path("runs/reconstruct_tip")  # folder for what is made
    preset: Literal["paper", "short", "debug"] = "paper"

    def check(self) -> None:
        """Refuse a recording that is not there."""
        require_path("--dataset", self.dataset, "path")
