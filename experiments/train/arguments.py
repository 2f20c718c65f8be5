"""Options of `python -m experiments.train`. This module has no slow imports."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from experiments.common.options import ResumableOptions, UnitName
from i2t.cli.options import Count, Limits, Seed, require_path, require_with
from i2t.models.checks import require_dataset
from i2t.objects.named import require_objects
from i2t.paper.config import PaperOptions

Registration = Literal["sessions", "camera"]


@dataclass(frozen=True)
class TrainArgs(ResumableOptions):
    """Train touch predictors, and score them on objects or places that were not used for training."""

    out: Path = Path("runs/train")  # folder for the results
    preset: Literal["paper", "debug", "study"] = "paper"  # size: study has six pads, debug a few touches
    dataset: Path | None = None  # data set to train on instead of simulated touches
    skin_name: str | None = None  # with --dataset: skin to train on, if each touch has readings of several
    objects: tuple[Path, ...] = ()  # with --dataset: mesh files of objects outside the catalogue, for the pad model
    unit: UnitName | None = None  # unit of the mesh files whose names have none (mug.stl:mm)
    rig: Path | None = None  # with --dataset: description of the lab; object_covariance gives the pose errors
    # sessions: estimate the poses of object and camera in each session, which needs the meshes of all objects; camera:
    # estimate the offset of a single camera from sessions on the training objects, and correct all views
    registered: Registration | None = None
    pad_model_of: Literal["train", "all"] = "train"  # with --dataset: touches that the pad model is fitted to
    split: Literal["auto", "object", "session", "block", "time"] = "auto"  # with --dataset: what is held out
    pad: Path | None = None  # file of a pad to simulate with, such as one fitted to a real skin
    pads: tuple[Seed, ...] | None = None  # numbers of the simulated pads, instead of the preset's
    seeds: Count | None = None  # number of seeds, starting at --seed; by default that of the preset
    methods: tuple[str, ...] | None = None  # methods instead of the preset's; the mean reading is always added
    method: tuple[str, ...] = ()  # additional methods of your own, such as my_package.module:Method
    paper: PaperOptions = field(default_factory=PaperOptions)  # options of the paper's network
    epochs: Count | None = None  # epochs of the networks, instead of the preset's
    # Softness of the skin; 4 means a quarter of the nominal Young's modulus.
    softness: Annotated[float, Limits(0, 1000, above=True)] = 1.0

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        if self.dataset is None:
            return f"python -m experiments.recognize --pad-model {self.out}"
        return "" if self.skin_name else f"python -m experiments.fidelity --dataset {self.dataset}"

    def check(self) -> None:
        """Refuse options that exclude each other, and files that do not exist (ValueError)."""
        if self.pads is not None and (self.pad or self.dataset):
            raise ValueError("--pads gives numbers of simulated pads; pass it without --pad and --dataset")
        if self.pad and self.dataset:
            raise ValueError("--pad simulates touches, and --dataset reads recorded ones; pass one of them")
        if self.objects and not self.dataset:
            raise ValueError("--objects are meshes of the objects in --dataset; pass both, or neither")
        require_with(f"--split {self.split}", self.split != "auto", "--dataset", self.dataset is not None)
        require_with("--rig", self.rig is not None, "--dataset", self.dataset is not None)
        require_with("--pad-model-of all", self.pad_model_of == "all", "--dataset", self.dataset is not None)
        require_with("--skin-name", self.skin_name is not None, "--dataset", self.dataset is not None)
        require_dataset("--dataset", self.dataset)
        require_path("--pad", self.pad, "file")
        require_path("--rig", self.rig, "file")
        require_objects(self.objects, self.unit, minimum=1, catalogue=False)
