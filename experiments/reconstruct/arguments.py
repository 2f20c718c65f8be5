"""Options and presets of `python -m experiments.reconstruct` and of its part `patch`, free of JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.options import RunOptions, UnitName
from experiments.common.presets import choose_preset
from i2t.cli.options import Count, require_path, require_with
from i2t.errors import require_extra
from i2t.models.checks import require_dataset

Sensing = Literal["reading", "pose", "patch"]  # a touch measures its reading, its pose alone, or the whole patch


@dataclass(frozen=True)
class ReconstructSizes:
    """Sizes of the experiment on surfaces."""

    train: int = 200  # shapes in the library
    validation: int = 10  # objects on which the width of the bands is chosen, disjoint from the others
    test: int = 40  # unknown objects
    touches: int = 20  # per object
    pads: int = 10  # simulated skins, used in turn
    patches: int = 2400  # local surfaces in the library
    samples: int = 60_000  # points on a surface for distances between surfaces
    fit_presses: int = 300  # presses of a ball to which a pad of unknown physics is fitted


SURFACE_PRESETS = {
    "paper": ReconstructSizes(),
    "debug": ReconstructSizes(
        train=4, validation=1, test=2, touches=2, pads=1, patches=48, samples=16_000, fit_presses=12
    ),
}


@dataclass(frozen=True)
class ExplorationCondition:
    """A way of choosing touches, and what is measured and known."""

    policy: Literal["random", "uncertainty", "reduction", "oracle"] = "reduction"  # the oracle uses the true object
    sensing: Sensing = "reading"
    view: bool = False  # whether a depth camera views the object from one side before the first touch
    likeliest: bool = False  # whether the library is reduced to its likeliest shapes, instead of shapes drawn by weight
    fitted: bool = False  # whether the pad's physics is fitted to presses of a ball instead of known
    loose: bool = (
        False  # whether the object's pose is known to 3 mm and 5 degrees per axis, instead of 1 mm and 1 degree
    )


READING, POSE, PATCH = "reading", "contact pose only", "perfect patch"
POSE_LIKELIEST = f"{POSE}, likeliest shapes"
LOOSE, LOOSE_POSE, LOOSE_LIKELIEST = (
    f"{name}, 3 mm and 5 degrees" for name in ("reading, fitted pad", POSE, POSE_LIKELIEST)
)
RANDOM, ORACLE, VIEW = "random sites", "oracle", "after a view"
CONDITIONS = {
    READING: ExplorationCondition(),
    POSE: ExplorationCondition(sensing="pose"),
    POSE_LIKELIEST: ExplorationCondition(sensing="pose", likeliest=True),
    PATCH: ExplorationCondition(sensing="patch"),
    LOOSE: ExplorationCondition(fitted=True, loose=True),
    LOOSE_POSE: ExplorationCondition(sensing="pose", loose=True),
    LOOSE_LIKELIEST: ExplorationCondition(sensing="pose", likeliest=True, loose=True),
    RANDOM: ExplorationCondition("random"),
    "uncertainty": ExplorationCondition("uncertainty"),
    ORACLE: ExplorationCondition("oracle"),
    VIEW: ExplorationCondition(view=True),
}
DEFAULT_CONDITIONS = (READING, POSE, PATCH, VIEW)
POSE_BASELINES = {READING: (POSE, POSE_LIKELIEST), PATCH: (POSE, POSE_LIKELIEST), LOOSE: (LOOSE_POSE, LOOSE_LIKELIEST)}


@dataclass(frozen=True)
class ReconstructArgs(RunOptions):
    """Reconstruct unknown objects from simulated touches, or an object from recorded ones, with uncertainty bands."""

    out: Path = Path("runs/reconstruct")  # output folder
    preset: Literal["paper", "debug"] = "paper"  # size of the experiment; debug runs every part once
    objects: Path | None = None  # folder of closed meshes for library and test, instead of random objects
    unit: UnitName | None = None  # unit of the lengths in --objects
    across_mm: tuple[float, float] | None = None  # range of largest edges to which --objects are scaled at random
    dataset: Path | None = None  # recorded touches of an object to reconstruct, instead of simulated ones
    object: str | None = None  # object of --dataset, if it holds several
    name: str = "reconstructed"  # name of the mesh file reconstructed from --dataset
    train: Count | None = None  # shapes in the library, instead of the preset's 200
    test: Count | None = None  # unknown objects, instead of the preset's 40
    touches: Count | None = None  # touches per object, instead of the preset's 20
    conditions: tuple[str, ...] = ()  # names of the conditions to run; default: reading, pose only, perfect patch, view

    def check(self) -> None:
        """Refuse conflicting options, missing files and unknown conditions."""
        require_dataset("--dataset", self.dataset)
        recorded, folder = self.dataset is not None, self.objects is not None
        require_path("--objects", self.objects, "folder")
        require_with("--object", self.object is not None, "--dataset", recorded)
        require_with("--name", self.name != "reconstructed", "--dataset", recorded)
        require_with("--unit", self.unit is not None, "--objects", folder)
        require_with("--objects", folder, "--unit", self.unit is not None)
        require_with("--across-mm", self.across_mm is not None, "--objects", folder)
        if self.across_mm is not None and not 10 <= self.across_mm[0] <= self.across_mm[1] <= 300:
            raise ValueError(f"--across-mm {self.across_mm}: give two sizes of 10 to 300 mm, ascending")
        for flag, given in (
            ("--touches", self.touches),
            ("--test", self.test),
            ("--conditions", self.conditions or None),
        ):
            require_with(flag, given is not None, "simulated objects (no --dataset)", not recorded)
        if Path(self.name).name != self.name or not 0 < len(self.name.strip(".")) <= 100:
            raise ValueError(f"--name {self.name}: is not a file name; give a word")
        if unknown := sorted(set(self.conditions) - set(CONDITIONS)):
            raise ValueError(f"--conditions {unknown[0]}: is none of {', '.join(CONDITIONS)}")
        require_extra("skimage", "a surface")
        if not folder:
            require_extra("manifold3d", "a library of random objects")

    @property
    def sizes(self) -> ReconstructSizes:
        """Sizes of the preset, with the given options applied."""
        return choose_preset(SURFACE_PRESETS, self.preset, train=self.train, test=self.test, touches=self.touches)


@dataclass(frozen=True)
class PatchSizes:
    """Sizes of the experiment on patches."""

    patches: int = 12_000  # patches in the library
    shapes: int = 240  # random training shapes next to the catalogue's; a fifth as many for each of validation and test
    test: int = 160  # contacts with test objects, pressed with every pad
    validation: int = 64  # contacts with validation objects, pressed with every pad
    pads: int = 3
    fit_presses: int = 300  # presses of a ball to which each pad is fitted


PATCH_PRESETS = {
    "paper": PatchSizes(),
    "short": PatchSizes(patches=4000, shapes=150, test=100, validation=40),
    "debug": PatchSizes(patches=120, shapes=6, test=8, validation=4, pads=1, fit_presses=12),
}


@dataclass(frozen=True)
class PatchArgs(RunOptions):
    """Infer the patch below single presses, and score the estimate and its stated uncertainty."""

    out: Path = Path("runs/reconstruct_patch")  # output folder
    preset: Literal["paper", "short", "debug"] = "paper"  # size of the experiment; debug runs every part once
    exact: bool = False  # presses without noise, slant or other error, which leaves the limits of the pad itself
