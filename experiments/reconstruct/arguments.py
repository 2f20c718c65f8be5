"""The options and presets of `python -m experiments.reconstruct` and of its part `patch`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import require_dataset
from experiments.common.options import RunOptions, UnitName
from experiments.common.presets import choose_preset
from i2t.cli.options import Count, require_path, require_with
from i2t.errors import require_extra

Felt = Literal["reading", "pose", "patch"]  # what a touch tells: what its reading says, no more than its pose, or all


@dataclass(frozen=True)
class ReconstructSizes:
    """Sizes of the experiment."""

    train: int = 200  # shapes of the library
    validation: int = 10  # objects, in neither, on which the width of the bands is chosen
    test: int = 40  # unseen objects
    touches: int = 20  # on each
    pads: int = 10  # simulated skins, in turn
    patches: int = 2400  # of the library of local surfaces
    samples: int = 60_000  # points of a surface, by which distances between surfaces are measured
    fit_presses: int = 300  # of a ball, to which a pad is fitted where its physics is not known


MIN_ACROSS_MM, MAX_ACROSS_MM = 10.0, 300.0
MAX_NAME = 100
SURFACE_PRESETS = {
    "paper": ReconstructSizes(),
    "debug": ReconstructSizes(
        train=4, validation=1, test=2, touches=2, pads=1, patches=48, samples=16_000, fit_presses=12
    ),
}


@dataclass(frozen=True)
class ExplorationCondition:
    """One way to explore and to read touches."""

    policy: Literal["random", "uncertainty", "reduction", "oracle"] = "reduction"  # the last knows the true object
    felt: Felt = "reading"
    view: bool = False  # whether a depth camera saw the object from one side before the first touch
    likeliest: bool = False  # whether the likeliest shapes alone stand for the library
    fitted: bool = False  # whether the pad is known from presses of a ball only
    loose: bool = False  # whether the object's middle is known to 3 mm and 5 degrees only


READING, POSE, PATCH = "reading", "contact pose only", "perfect patch"
POSE_LIKELIEST = f"{POSE}, likeliest shapes"
LOOSE, LOOSE_POSE, LOOSE_LIKELIEST = (
    f"{name}, 3 mm and 5 degrees" for name in ("reading, fitted pad", POSE, POSE_LIKELIEST)
)
RANDOM, ORACLE, VIEW = "random sites", "oracle", "after a view"
CONDITIONS = {
    READING: ExplorationCondition(),
    POSE: ExplorationCondition(felt="pose"),
    POSE_LIKELIEST: ExplorationCondition(felt="pose", likeliest=True),
    PATCH: ExplorationCondition(felt="patch"),
    LOOSE: ExplorationCondition(fitted=True, loose=True),
    LOOSE_POSE: ExplorationCondition(felt="pose", loose=True),
    LOOSE_LIKELIEST: ExplorationCondition(felt="pose", likeliest=True, loose=True),
    RANDOM: ExplorationCondition("random"),
    "uncertainty": ExplorationCondition("uncertainty"),
    ORACLE: ExplorationCondition("oracle"),
    VIEW: ExplorationCondition(view=True),
}
USUAL = (READING, POSE, PATCH, VIEW)  # the rest compares baselines, what is known beforehand, and policies
POSES_BESIDE = {READING: (POSE, POSE_LIKELIEST), PATCH: (POSE, POSE_LIKELIEST), LOOSE: (LOOSE_POSE, LOOSE_LIKELIEST)}


@dataclass(frozen=True)
class ReconstructArgs(RunOptions):
    """Reconstruct unseen objects from simulated touches and say how good and sure the surface is, or one recorded."""

    out: Path = Path("runs/reconstruct")  # folder for what is made
    preset: Literal["paper", "debug"] = "paper"
    objects: Path | None = None  # folder of closed meshes to learn from and to test on, instead of random objects
    unit: UnitName | None = None  # of --objects
    across_mm: tuple[float, float] | None = None  # to which the largest edges of --objects are scaled, at random
    dataset: Path | None = None  # recorded touches of an object, whose surface is reconstructed in place of all else
    object: str | None = None  # of --dataset, where it holds several
    name: str = "reconstructed"  # of the mesh that is made of --dataset
    train: Count | None = None  # shapes of the library, instead of the preset's 200
    test: Count | None = None  # unseen objects, instead of the preset's 40
    touches: Count | None = None  # on each, instead of the preset's 20
    conditions: tuple[str, ...] = ()  # the names of those to run; without it those that differ in what is known

    def check(self) -> None:
        """Refuse what does not go together, what is not there, and conditions that there are not."""
        require_dataset("--dataset", self.dataset)
        recorded, folder = self.dataset is not None, self.objects is not None
        require_path("--objects", self.objects, "folder")
        require_with("--object", self.object is not None, "--dataset", recorded)
        require_with("--name", self.name != "reconstructed", "--dataset", recorded)
        require_with("--unit", self.unit is not None, "--objects", folder)
        require_with("--objects", folder, "--unit", self.unit is not None)
        require_with("--across-mm", self.across_mm is not None, "--objects", folder)
        if self.across_mm is not None and not MIN_ACROSS_MM <= self.across_mm[0] <= self.across_mm[1] <= MAX_ACROSS_MM:
            raise ValueError(
                f"--across-mm {self.across_mm}: give two sizes of {MIN_ACROSS_MM:g} to {MAX_ACROSS_MM:g} mm, ascending"
            )
        for flag, given in (
            ("--touches", self.touches),
            ("--test", self.test),
            ("--conditions", self.conditions or None),
        ):
            require_with(flag, given is not None, "simulated objects (no --dataset)", not recorded)
        if Path(self.name).name != self.name or not 0 < len(self.name.strip(".")) <= MAX_NAME:
            raise ValueError(f"--name {self.name}: is no name of a file; give a word")
        if unknown := sorted(set(self.conditions) - set(CONDITIONS)):
            raise ValueError(f"--conditions {unknown[0]}: is none of {', '.join(CONDITIONS)}")
        require_extra("skimage", "a surface")
        if not folder:
            require_extra("manifold3d", "a library of random objects")

    @property
    def sizes(self) -> ReconstructSizes:
        """Sizes of the preset, except those given."""
        return choose_preset(SURFACE_PRESETS, self.preset, train=self.train, test=self.test, touches=self.touches)


@dataclass(frozen=True)
class PatchSizes:
    """Sizes of the experiment on patches."""

    patches: int = 12_000  # of the library
    shapes: int = 240  # drawn ones to train on, besides those of the catalogue; of validation and test a fifth each
    test: int = 160  # contacts with test objects, pressed with every pad
    validation: int = 64  # contacts with validation objects, likewise
    pads: int = 3
    fit_presses: int = 300  # of a ball, to which each pad is fitted


PATCH_PRESETS = {
    "paper": PatchSizes(),
    "short": PatchSizes(patches=4000, shapes=150, test=100, validation=40),
    "debug": PatchSizes(patches=120, shapes=6, test=8, validation=4, pads=1, fit_presses=12),
}


@dataclass(frozen=True)
class PatchArgs(RunOptions):
    """Infer what a skin met at single presses, and say how far that is right."""

    out: Path = Path("runs/reconstruct_patch")  # folder for what is made
    preset: Literal["paper", "short", "debug"] = "paper"
    exact: bool = False  # presses without noise, slant or any other error: what is left is what a pad cannot feel
