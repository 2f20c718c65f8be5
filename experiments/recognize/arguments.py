"""Options of `python -m experiments.recognize`. This module has no slow imports."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from experiments.common.options import ResumableOptions, RunOptions, UnitName
from i2t.cli.options import Count, Limits, Probability, Seed, require_path
from i2t.collect.arguments import ArmArgs, CameraArgs, SkinArgs
from i2t.errors import did_you_mean, require_extra
from i2t.models.checks import require_dataset
from i2t.models.finished import FORMER_NAMES, require_pad_model, require_simulated_runs
from i2t.objects.named import object_name, require_objects

PresetName = Literal["short", "paper", "debug"]
NOT_REAL_KINDS = ("simulated", "emulated")
# Default objects of a live run: as high and about as wide as each other, so that the skin meets all of them and must
# feel their outlines. None of them is in the training set.
LIVE_OBJECTS = ("star", "cylinder", "flower")
LIVE_CONTACT_PROBABILITY = 0.95  # smallest probability of contact with each of them at a candidate site
LIVE_PAD_MODELS = (Path("runs/train"), Path("nominal"))  # the default pad model, and the one used if there is no run


@dataclass(frozen=True)
class SimulateArgs(ResumableOptions):
    """Recognise objects in simulated episodes, and report accuracy and calibration."""

    FORMER_NAMES: ClassVar = FORMER_NAMES

    out: Path = Path("runs/recognize")  # folder for the results
    pad_model: Path = Path("runs/train")  # folder of a run of experiments.train with one or several pads and seeds
    pads: tuple[str, ...] = ()  # numbers of the pads to use; all by default
    method: Literal["all", "paper"] = "all"  # all methods on the same episodes, or only the paper's own loop
    preset: PresetName = "short"  # numbers of episodes and poses
    objects: tuple[Path, ...] = ()  # objects to distinguish: names in the catalogue or mesh files
    unit: UnitName | None = None  # unit of the mesh files whose names have none (mug.stl:mm)
    episodes: Count | None = None  # episodes of each object, for each pad and seed
    paper_episodes: Count | None = None  # episodes of each object in the paper's sets; by default twice --episodes
    num_particles: Count | None = None  # poses of each object, instead of the preset's

    @property
    def next_command(self) -> str:
        """Command to try with a finished run: a study."""
        return f"python -m experiments.studies open_set --pad-model {self.pad_model}"

    def check(self) -> None:
        """Refuse options that exclude each other, and files that do not exist (ValueError)."""
        if self.method == "paper" and self.objects:
            raise ValueError("--method paper uses the paper's own objects; pass it without --objects")
        if self.objects and self.paper_episodes is not None:
            raise ValueError("--paper-episodes is for the paper's objects, not for --objects; pass --episodes")
        require_objects(self.objects, self.unit)
        require_simulated_runs(self.pad_model, self.pads)


@dataclass(frozen=True)
class DatasetArgs(RunOptions):
    """Recognise the objects of recorded sessions, and report accuracy and calibration."""

    FORMER_NAMES: ClassVar = FORMER_NAMES

    dataset: Path  # recorded touches of objects in the catalogue or of --objects
    out: Path = Path("runs/recognize")  # folder for the results
    # Pad model of the skin: folder of a run of experiments.train, file, or nominal.
    pad_model: Path = Path("runs/train")
    preset: PresetName = "paper"  # number of poses, and minimum number of touches in a session
    objects: tuple[Path, ...] = ()  # objects to distinguish: names in the catalogue or mesh files
    unit: UnitName | None = None  # unit of the mesh files whose names have none (mug.stl:mm)
    skin_name: str | None = None  # skin to use, if each touch has readings of several
    other_skin: bool = False  # allow touches of another skin than the pad model's, with a warning
    max_touches: Count | None = None  # touches of each session; by default as many as all long enough sessions have
    rig: Path | None = None  # description of the lab, whose object_covariance gives the pose errors
    num_particles: Count | None = None  # poses of each object, instead of the preset's

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return "" if self.skin_name else f"python -m experiments.fidelity --dataset {self.dataset}"

    def check(self) -> None:
        """Refuse files that do not exist (ValueError)."""
        require_objects(self.objects, self.unit)
        require_dataset("--dataset", self.dataset)
        require_path("--rig", self.rig, "file")
        require_pad_model(self.pad_model)


@dataclass(frozen=True)
class LiveArgs:
    """Recognise an object with an arm."""

    FORMER_NAMES: ClassVar = FORMER_NAMES | {"--worn-pad": "--pad-file"}

    out: Path = Path("runs/live")  # folder for touches/, result.json and story/
    # Pad model of this skin: folder of a run of experiments.train, file, or nominal (simulated pad 0). By default
    # runs/train; without that run, nominal for a skin that is not real.
    pad_model: Path | None = None
    # Objects to distinguish: names in the catalogue or mesh files; star, cylinder and flower by default.
    objects: tuple[Path, ...] = ()
    unit: UnitName | None = None  # unit of the mesh files whose names have none (mug.stl:mm)
    # Smallest probability of contact with each object at a candidate site; 0.95 by default, and 0 with --objects.
    min_contact_probability: Probability | None = None
    truth: str | None = None  # name of the object, under which its touches are saved; "unknown" by default
    true_object: str | None = None  # object for an arm that is not real, from the catalogue; random by default
    prior_unknown: float = 0.0  # prior probability of an unknown object
    num_surrogates: int = 16  # random objects similar to the known ones, which represent an unknown object
    max_touches: Count = 10
    min_touches: Count = (
        3  # minimum number before an early stop, because one touch without contact may be overconfident
    )
    # Stop when the most probable object is wrong with at most this probability.
    max_error_probability: Probability = 0.05
    num_sites: Count = 24  # candidate sites on each object
    num_particles: Count = 64  # poses of each object
    arm: Annotated[ArmArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=ArmArgs)
    skin: Annotated[SkinArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=SkinArgs)
    camera: Annotated[CameraArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=CameraArgs)
    pad_name: str | None = None  # name of a real skin in its data sets; "skin" by default
    pad_file: Path | None = None  # file of a pad, for simulated and emulated skins
    rig: Path | None = None  # calibration of the lab, with the expected pose of the object and its covariance
    seed: Seed = 0

    @property
    def real(self) -> bool:
        """Whether the arm is real."""
        return self.arm.kind not in NOT_REAL_KINDS

    @property
    def used_pad_model(self) -> Path:
        """Pad model to use. Without --pad-model and without a run, it is the ready one, unless the skin is real."""
        if self.pad_model is not None:
            return self.pad_model
        trained, ready = LIVE_PAD_MODELS
        return trained if trained.exists() or self.skin.kind not in NOT_REAL_KINDS else ready

    @property
    def contact_probability(self) -> float:
        """Smallest probability of contact with each object at a candidate site."""
        if self.min_contact_probability is not None:
            return self.min_contact_probability
        return 0.0 if self.objects else LIVE_CONTACT_PROBABILITY

    @property
    def mounted_pad(self) -> str:
        """Name of the skin in data sets."""
        if self.skin.kind not in NOT_REAL_KINDS:
            return self.pad_name or "skin"
        return self.pad_name or (f"simulated, {self.pad_file.stem}" if self.pad_file else "simulated pad 0")

    def check(self) -> None:
        """Refuse options that exclude each other, and files that do not exist (ValueError)."""
        if self.pad_file and self.skin.kind not in NOT_REAL_KINDS:
            raise ValueError(
                f"--pad-file is for simulated and emulated skins, and --skin is {self.skin.kind}; leave it out"
            )
        if self.true_object and self.real:
            raise ValueError(f"--true-object is for arms that are not real, and --arm is {self.arm.kind}; pass --truth")
        if not 0 <= self.prior_unknown < 1:
            raise ValueError(f"--prior-unknown {self.prior_unknown:g}: give a probability, from 0 to below 1")
        if self.prior_unknown > 0 and self.num_surrogates < 1:
            raise ValueError(f"--num-surrogates {self.num_surrogates}: --prior-unknown needs surrogates, such as 16")
        for device in (self.arm, self.skin, self.camera):
            device.check()
        require_objects(self.objects, self.unit)
        require_pad_model(self.used_pad_model)
        require_path("--pad-file", self.pad_file)
        require_path("--rig", self.rig, "file")
        self._check_true_object()

    def _check_true_object(self) -> None:
        if self.true_object is None:
            return
        from i2t.objects.catalogue import NAMES

        names = [object_name(str(path)) for path in self.objects] or LIVE_OBJECTS
        if self.true_object not in (*NAMES, *names):
            objects = ", ".join(names)
            remedy = did_you_mean(
                self.true_object, (*names, *NAMES), f"choose one of {objects}, or another object of the catalogue"
            )
            raise ValueError(f"--true-object {self.true_object}: is no object that can be touched; {remedy}")


@dataclass(frozen=True)
class RecordedArgs(ResumableOptions):
    """Recognise labels from tables of readings of any sensor."""

    readings: tuple[Path, ...]  # CSV files (or .csv.gz) with one row per touch in chronological order
    label: str  # column of the label, such as the touched object
    group: str | None = None  # column of the set-up within which rows are compared; by default each file is a group
    ignore: tuple[str, ...] = ()  # columns that are not part of the reading
    touch: str | None = None  # column that numbers touches; successive rows of one touch are averaged
    out: Path = Path("runs/recorded")  # folder for the results
    train_share: Annotated[float, Limits(0.2, 0.9)] = 0.6  # share of rows for training, the first of each label
    max_touches: Count = 10  # touches of an episode, drawn from a label's other rows
    episodes: Count = 10  # episodes of each label in each group
    unknown: Annotated[int, Limits(0)] = 10  # number of labels held out together as unknown; at most a third
    draws: Count = 5  # random choices of these labels

    def check(self) -> None:
        """Refuse tables that do not exist, and a missing library (ValueError)."""
        for path in self.readings:
            require_path("--readings", path, "file")
        require_extra("sklearn", "recognition from tables of readings")
