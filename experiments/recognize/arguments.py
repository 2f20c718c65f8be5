"""The options of `python -m experiments.recognize`, without JAX, so that help and refusals are there at once."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from experiments.common.checks import require_dataset, require_objects
from experiments.common.options import ResumableOptions, RunOptions, UnitName
from experiments.train.finished import FORMER_NAMES, require_pad_model, require_simulated_runs
from i2t.cli.options import Count, Limits, Probability, Seed, require_path
from i2t.collect.arguments import ArmArgs, CameraArgs, SkinArgs
from i2t.errors import did_you_mean, require_extra

PresetName = Literal["short", "paper", "debug"]
NOT_REAL = ("simulated", "emulated")


@dataclass(frozen=True)
class SimulateArgs(ResumableOptions):
    """Recognise objects by simulated touches and report how often and how sure."""

    FORMER_NAMES: ClassVar = FORMER_NAMES

    out: Path = Path("runs/recognize")  # folder for everything that is made
    pad_model: Path = Path("runs/train")  # folder of a run of experiments.train, or of several pads and seeds
    pads: tuple[str, ...] = ()  # of several, those that are used, by number; all unless given
    method: Literal["all", "paper"] = "all"  # every method on the same episodes, or the paper's own loop by itself
    preset: PresetName = "short"  # episodes and poses
    objects: tuple[Path, ...] = ()  # to tell apart: names of the catalogue and mesh files
    unit: UnitName | None = None  # of those files
    episodes: Count | None = None  # of each object, for each pad and seed
    paper_episodes: Count | None = None  # the same in the paper's sets, twice as many unless given
    num_particles: Count | None = None  # poses of each object, in place of the preset's

    @property
    def next_command(self) -> str:
        """Command to try with a finished run: a study."""
        return f"python -m experiments.studies open_set --pad-model {self.pad_model}"

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there."""
        if self.method == "paper" and self.objects:
            raise ValueError("--method paper plays the paper's own sets; pass it without --objects")
        if self.objects and self.paper_episodes is not None:
            raise ValueError("--paper-episodes is for the paper's sets, and --objects are others; pass --episodes")
        require_objects(self.objects, self.unit)
        require_simulated_runs(self.pad_model, self.pads)


@dataclass(frozen=True)
class DatasetArgs(RunOptions):
    """Recognise the objects of recorded sessions and report how often and how sure."""

    FORMER_NAMES: ClassVar = FORMER_NAMES

    dataset: Path  # recorded touches; its objects are the catalogue's or those of --objects
    out: Path = Path("runs/recognize")  # folder for everything that is made
    pad_model: Path = Path("runs/train")  # of the skin: folder of a run of experiments.train, a file, or nominal
    preset: PresetName = "paper"  # poses, and touches that a session must have
    objects: tuple[Path, ...] = ()  # to tell apart: names of the catalogue and mesh files
    unit: UnitName | None = None  # of those files
    skin_name: str | None = None  # of several skins that were read in each touch, the one that is meant
    other_skin: bool = False  # judge touches of another skin all the same, and say so
    max_touches: Count | None = None  # of each session; by default as many as all long enough ones have
    rig: Path | None = None  # of the lab that recorded them: its object_covariance says how far poses may be off
    num_particles: Count | None = None  # poses of each object, in place of the preset's

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return "" if self.skin_name else f"python -m experiments.fidelity --dataset {self.dataset}"

    def check(self) -> None:
        """Refuse files that are not there."""
        require_objects(self.objects, self.unit)
        require_dataset("--dataset", self.dataset)
        require_path("--rig", self.rig, "file")
        require_pad_model(self.pad_model)


@dataclass(frozen=True)
class LiveArgs:
    """Recognise an object with an arm."""

    FORMER_NAMES: ClassVar = FORMER_NAMES | {"--worn-pad": "--pad-file"}

    out: Path = Path("runs/live")  # folder of touches/, result.json and story/
    pad_model: Path = Path("runs/train")  # of this skin: folder of a run of experiments.train, a file, or nominal
    objects: tuple[Path, ...] = ()  # to tell apart: names of the catalogue and mesh files
    unit: UnitName | None = None  # of those files
    truth: str | None = None  # name of what stands there, under which its touches are kept; "unknown" by default
    true_object: str | None = None  # what stands there if the arm is not real, any of the catalogue; drawn by default
    prior_unknown: float = 0.0  # probability beforehand that it is none of the objects
    num_surrogates: int = 16  # objects like those known, that stand for what else it might be then
    max_touches: Count = 10
    min_touches: Count = 3  # before it may end because it is sure: one touch without contact can already be sure
    max_error_probability: Probability = 0.05  # ends when the most probable object is wrong with at most this
    num_sites: Count = 24  # of each object, to choose among
    num_particles: Count = 64  # poses of each object
    arm: Annotated[ArmArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=ArmArgs)
    skin: Annotated[SkinArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=SkinArgs)
    camera: Annotated[CameraArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=CameraArgs)
    pad_name: str | None = None  # of a real skin, as it was collected; "skin" by default
    pad_file: Path | None = None  # a pad on disk, for simulated and emulated skins
    rig: Path | None = None  # calibration of the lab; says where the object is believed to stand, and how surely
    seed: Seed = 0

    @property
    def real(self) -> bool:
        """Tell whether the arm is a real one."""
        return self.arm.kind not in NOT_REAL

    @property
    def mounted_pad(self) -> str:
        """Name of the skin that touches, as a collection would have it."""
        if self.skin.kind not in NOT_REAL:
            return self.pad_name or "skin"
        return self.pad_name or (f"simulated, {self.pad_file.stem}" if self.pad_file else "simulated pad 0")

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there."""
        if self.pad_file and self.skin.kind not in NOT_REAL:
            raise ValueError(
                f"--pad-file is for simulated and emulated skins, and --skin is {self.skin.kind}; leave it out"
            )
        if self.true_object and self.real:
            raise ValueError(f"--true-object is for arms that are not real, and --arm is {self.arm.kind}; pass --truth")
        if not 0 <= self.prior_unknown < 1:
            raise ValueError(f"--prior-unknown {self.prior_unknown:g}: give a probability, from 0 to below 1")
        if self.prior_unknown > 0 and self.num_surrogates < 1:
            raise ValueError(f"--num-surrogates {self.num_surrogates}: --prior-unknown needs surrogates, 16 say")
        for device in (self.arm, self.skin, self.camera):
            device.check()
        require_objects(self.objects, self.unit)
        require_pad_model(self.pad_model)
        require_path("--pad-file", self.pad_file)
        require_path("--rig", self.rig, "file")
        self._check_true_object()

    def _check_true_object(self) -> None:
        if self.true_object is None:
            return
        from i2t.objects.catalogue import NAMES

        names = [path.stem for path in self.objects]
        if self.true_object not in (*NAMES, *names):
            known = ", ".join(names) or "the objects of the preset"
            remedy = did_you_mean(
                self.true_object, (*names, *NAMES), f"choose one of {known}, or another object of the catalogue"
            )
            raise ValueError(f"--true-object {self.true_object}: is no object that can be touched; {remedy}")


@dataclass(frozen=True)
class RecordedArgs(ResumableOptions):
    """Recognise what was touched from a table of readings of any sensor."""

    readings: tuple[Path, ...]  # CSV files (or .csv.gz): a row a touch, in the order in which they were made
    label: str  # column of what was touched
    group: str | None = None  # column of the set-up within which rows are compared; each file is one unless given
    ignore: tuple[str, ...] = ()  # columns that are no part of the reading
    touch: str | None = None  # column that numbers touches: rows in a row with one value are samples, of which the mean
    out: Path = Path("runs/recorded")  # folder for everything that is made
    train_share: Annotated[float, Limits(0.2, 0.9)] = 0.6  # of each label's rows, the first ones
    max_touches: Count = 10  # of an episode, drawn from a label's other rows
    episodes: Count = 10  # of each label in each group
    unknown: Annotated[int, Limits(0)] = 10  # labels that are held out at a time as unknown; at most a third
    draws: Count = 5  # of these labels

    def check(self) -> None:
        """Refuse tables that are not there, and a missing library."""
        for path in self.readings:
            require_path("--readings", path, "file")
        require_extra("sklearn", "recognition from tables of readings")
