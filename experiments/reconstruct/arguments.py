"""The options and presets of `python -m experiments.reconstruct`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.checks import require_dataset
from experiments.common.presets import choose_preset
from i2t.cli import Count, Positive, Seed, require_path, require_with
from i2t.extras import require_extra
from i2t.objects.named import require_object

MESH_ENDINGS = (".obj", ".stl", ".ply", ".glb")


@dataclass(frozen=True)
class ReconstructSizes:
    """Sizes of the experiment."""

    train: int = 80  # shapes of the library
    validation: int = 6  # objects, in neither, on which the width of the bands is chosen
    test: int = 4  # unseen objects
    touches: int = 20  # on each
    pads: int = 3  # simulated skins, in turn
    seeds: int = 1  # episodes of each object and condition
    patches: int = 600  # of the library of local surfaces
    oracle_touches: int = 5  # of the greedy oracle, which is slow
    oracle_sites: int = 4  # among which it looks ahead
    samples: int = 8000  # points of a surface, by which distances between surfaces are measured


PRESETS: dict[str, ReconstructSizes] = {
    "paper": ReconstructSizes(),
    "debug": ReconstructSizes(
        train=4, validation=1, test=2, touches=2, pads=1, patches=48, oracle_touches=1, oracle_sites=2, samples=2000
    ),
    "study": ReconstructSizes(train=300, validation=8, test=24, patches=2000, oracle_sites=8, samples=20000),
}


@dataclass(frozen=True)
class ReconstructArgs:
    """Reconstruct unseen objects from simulated touches and say how good and sure the surface is, or one recorded."""

    out: Path = Path("runs/reconstruct")  # folder for what is made
    preset: Literal["paper", "debug", "study"] = "paper"
    dataset: Path | None = None  # recorded touches of an object, whose surface is reconstructed in place of all else
    object: str | None = None  # of --dataset, where it holds several
    arm: Literal["simulated", "emulated"] | None = None  # explores an unknown object, whose surface is reconstructed
    true_object: str | None = None  # what stands before --arm, of the catalogue
    name: str = "reconstructed"  # of the mesh that is made of --dataset, or of what --arm touched
    meshes: Path | None = None  # folder of mesh files; without it random objects of the catalogue
    unit: Literal["m", "cm", "mm", "inch"] = "mm"  # of --meshes; each is scaled to a largest side of --side
    side: tuple[Positive, Positive] = (60e-3, 90e-3)  # m, drawn between these for each mesh
    reach: Literal["around", "table"] = "around"  # held, so that all sides are reached; or as in the paper's collection
    train: Count | None = None  # shapes of the library, instead of the preset's 80
    test: Count | None = None  # unseen objects, instead of the preset's 4
    touches: Count | None = None  # on each, instead of the preset's 20
    pads: Count | None = None  # simulated skins, instead of the preset's 3
    seeds: Count | None = None  # episodes of each object, instead of the preset's 1
    conditions: tuple[str, ...] = ()  # the names of those to run; all without it
    seed: Seed = 0
    overwrite: bool = False  # replace a finished run in --out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return "python -m experiments.reconstruct_patch"

    def check(self) -> None:
        """Refuse a folder that is not there, sides in the wrong order, and conditions that there are not."""
        require_path("--meshes", self.meshes, "folder")
        require_dataset("--dataset", self.dataset)
        one = self.dataset is not None or self.arm is not None
        require_with("--object", self.object is not None, "--dataset", self.dataset is not None)
        require_with("--true-object", self.true_object is not None, "--arm", self.arm is not None)
        require_with("--arm", self.arm is not None, "--true-object", self.true_object is not None)
        require_with("--arm", self.arm is not None, "touches of its own (no --dataset)", self.dataset is None)
        require_with("--name", self.name != "reconstructed", "--dataset or --arm", one)
        require_with("--touches", self.touches is not None, "an arm (no --dataset)", self.dataset is None)
        for flag in ("test", "pads", "seeds", "conditions"):
            given = getattr(self, flag) not in (None, ())
            require_with(f"--{flag}", given, "simulated objects (no --dataset, no --arm)", not one)
        if self.true_object is not None:
            require_object(self.true_object, None, flag="--true-object")
        if not self.name or Path(self.name).name != self.name:
            raise ValueError(f"--name {self.name}: is no name of a file; give a word")
        if self.side[0] > self.side[1]:
            raise ValueError(f"--side {self.side[0]:g} {self.side[1]:g}: give the smaller one first")
        if unknown := sorted(set(self.conditions) - set(CONDITIONS)):
            raise ValueError(f"--conditions {unknown[0]}: is none of {', '.join(CONDITIONS)}")
        require_extra("skimage", "a surface")
        require_extra("manifold3d", "a library of random objects")

    @property
    def sizes(self) -> ReconstructSizes:
        """Sizes of the preset, except those given."""
        given = {name: getattr(self, name) for name in ("train", "test", "touches", "pads", "seeds")}
        return choose_preset(PRESETS, self.preset, **given)


@dataclass(frozen=True)
class ExplorationCondition:
    """One way to explore and to read touches."""

    policy: str = "reduction"  # of `i2t.reconstruction.exploration`, or "oracle"
    evidence: Literal["contact", "reading", "image"] = "reading"  # what a touch says besides where it was
    library: bool = True  # whether shapes of the same family are known
    view: bool = False  # whether one depth view comes first


CONDITIONS: dict[str, ExplorationCondition] = {
    "random": ExplorationCondition("random"),
    "even": ExplorationCondition("even"),
    "uncertainty": ExplorationCondition("uncertainty"),
    "reduction": ExplorationCondition("reduction"),
    "oracle": ExplorationCondition("oracle"),
    "contact pose only": ExplorationCondition(evidence="contact"),
    "perfect tactile image": ExplorationCondition(evidence="image"),
    "smoothness alone": ExplorationCondition(library=False),
    "one view first": ExplorationCondition(view=True),
}
