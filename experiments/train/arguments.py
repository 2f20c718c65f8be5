"""The options of `python -m experiments.train`, without JAX, so that its help and its refusals are there at once."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from experiments.common.checks import require_dataset, require_objects
from experiments.common.options import ResumableOptions, UnitName
from i2t.cli.options import Count, Limits, Seed, require_path, require_with
from i2t.paper.config import PaperOptions

Registration = Literal["sessions", "camera"]


@dataclass(frozen=True)
class TrainArgs(ResumableOptions):
    """Train a touch predictor and report how well it does on unseen objects (or unseen places)."""

    out: Path = Path("runs/train")  # folder for everything that is made
    preset: Literal["paper", "debug", "study"] = "paper"
    dataset: Path | None = None  # a data set to train on instead of simulating one
    skin_name: str | None = None  # with --dataset: of several skins that were read in each touch, the one to train on
    objects: tuple[Path, ...] = ()  # mesh files of its objects that the catalogue does not have, for the pad model
    unit: UnitName | None = None  # of those files
    rig: Path | None = None  # with --dataset: of the lab; its object_covariance says how far poses may be off
    # sessions: find the poses of object and camera in each session (needs the meshes of the objects); camera: find the
    # offset of one camera from sessions on the training objects, and correct all views
    registered: Registration | None = None
    pad_model_of: Literal["train", "all"] = "train"  # touches of --dataset that the pad model is fitted to
    split: Literal["auto", "object", "session", "block", "time"] = "auto"  # what is held out of --dataset
    pad: Path | None = None  # a pad on disk (`i2t.skin.files`), say one fitted to a real skin, to simulate with
    pads: tuple[Seed, ...] | None = None  # numbers of simulated pads, in place of the preset's
    seeds: Count | None = None  # how many seeds, from --seed on; one unless given
    methods: tuple[str, ...] | None = None  # in place of the preset's; the mean reading is always among them
    method: tuple[str, ...] = ()  # of your own, beside those: my_package.module:Method
    paper: PaperOptions = field(default_factory=PaperOptions)  # of the paper's network
    epochs: Count | None = None  # of the networks, in place of the preset's
    softness: Annotated[float, Limits(0, 1000, above=True)] = 1.0  # of the skin; 4: E is a quarter of the nominal

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        if self.dataset is None:
            return f"python -m experiments.recognize --pad-model {self.out}"
        return "" if self.skin_name else f"python -m experiments.fidelity --dataset {self.dataset}"

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there."""
        if self.pads is not None and (self.pad or self.dataset):
            raise ValueError("--pads are simulated pads by number; pass it without --pad and --dataset")
        if self.pad and self.dataset:
            raise ValueError("--pad is for simulated touches, and --dataset brings its own; pass one of them")
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
