"""Presets and options of `python -m experiments.calibrate`. This module has no slow imports."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, TypeAlias

from experiments.common.options import RunOptions
from experiments.common.presets import choose_preset
from experiments.common.runs import METRICS
from i2t.cli.options import Count, Limits, require_with
from i2t.models.checks import require_dataset

TARGET_NAMES = ("position", "travel", "force", "shear")  # of `i2t.heads.heads`
PressCount: TypeAlias = Annotated[int, Limits(2)]


@dataclass(frozen=True)
class Preset:
    """Settings of the comparison of methods on a recording."""

    draws: int = 20  # random choices of the training presses
    counts: tuple[int, ...] = (5, 10, 20, 50, 100, 300, 1000)  # numbers of training presses
    held_out_presses: int = 1000  # maximum number of random presses held out
    block_mm: float = 6.0  # edge of a spatial block
    block_share: float = 0.2  # share of blocks held out
    saved_presses: int = 1500  # maximum number of presses for the saved calibration
    min_presses: int = 8  # for predicting each press from the others
    min_shared_presses: int = 60  # for holding out a share of the presses instead of each in turn
    max_cluster_share: float = 0.5  # maximum share of the presses that is held out as whole blocks or places


PRESETS: dict[str, Preset] = {
    "paper": Preset(),
    "short": Preset(counts=(5, 10, 20, 50, 100, 300)),
    "debug": Preset(2, (5, 20)),
}


@dataclass(frozen=True)
class CalibrateArgs(RunOptions):
    """Compare calibration methods by the number of presses that they need."""

    FORMER_NAMES: ClassVar = {"--load depth": "--load travel", "--targets depth": "--targets travel"}

    dataset: Path | None = None  # data set of one tip on one skin
    skin_name: str | None = None  # with --dataset: skin to calibrate, if each touch has readings of several
    simulated: bool = False  # compare methods on simulated skins of several kinds
    recovery: bool = False  # fit pads to simulated presses, and count how often the ranges hold the truth
    prior: bool = False  # make the prior over kernels (prior.npz) from simulated skins
    save_pad: Path | None = None  # fit a pad to the presses, and write it to this file instead of comparing methods
    targets: tuple[str, ...] = ()  # fit heads that predict position, travel, force or shear (docs/fidelity.md)
    tip: str | None = None  # with --save-pad: sphere:RADIUS or cylinder:RADIUS in mm; by default the data set's
    pad_name: str | None = None  # with --save-pad: name of the skin; by default the data set's
    out: Path = Path("runs/calibrate")  # folder for the results
    preset: Literal["paper", "short", "debug"] = "paper"  # size of the experiment; debug runs every part once
    load: Literal["auto", "travel", "force"] = "auto"  # load of a press; auto: travel if it was measured
    presses: tuple[PressCount, ...] = ()  # numbers of training presses; by default the preset's
    draws: Count | None = None  # random choices of the training presses; by default the preset's

    @property
    def folder(self) -> Path | None:
        """Folder for the results, or None if a pad is written to a file."""
        return None if self.save_pad else self.out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run: fitting a pad, if that is possible for the tip."""
        if self.dataset is None:
            return ""
        metrics = Path(self.out) / METRICS
        if metrics.exists() and json.loads(metrics.read_text()).get("tip"):
            skin = "" if self.skin_name is None else f" --skin-name {self.skin_name}"
            return f"python -m experiments.calibrate --dataset {self.dataset}{skin} --save-pad pad.npz"
        return "" if self.skin_name else f"python -m experiments.fidelity --dataset {self.dataset}"

    def check(self) -> None:
        """Refuse options that exclude each other, and files that do not exist (ValueError)."""
        sources = {"--dataset": self.dataset is not None, "--simulated": self.simulated}
        sources |= {"--recovery": self.recovery, "--prior": self.prior}
        if sum(sources.values()) != 1:
            raise ValueError(
                "pass one of --dataset DIR with presses of one tip on one skin, --simulated, --recovery and --prior"
            )
        for flag, given in (("--save-pad", self.save_pad is not None), ("--targets", bool(self.targets))):
            require_with(flag, given, "--dataset", self.dataset is not None)
        require_with("--tip", self.tip is not None, "--save-pad", self.save_pad is not None)
        require_with("--pad-name", self.pad_name is not None, "--save-pad", self.save_pad is not None)
        require_with("--skin-name", self.skin_name is not None, "--dataset", self.dataset is not None)
        if self.save_pad and self.targets:
            raise ValueError("--save-pad and --targets exclude each other; pass one of them")
        compares = self.dataset is not None and not self.save_pad and not self.targets
        for flag, given in (("--presses", bool(self.presses)), ("--draws", self.draws is not None)):
            if given and not compares:
                raise ValueError(f"{flag} is for comparing methods on a data set; leave it out")
        if unknown := [target for target in self.targets if target not in TARGET_NAMES]:
            raise ValueError(f"--targets {' '.join(unknown)}: is no target; choose from {', '.join(TARGET_NAMES)}")
        require_dataset("--dataset", self.dataset, tables=bool(self.targets))
        if self.save_pad is not None and self.save_pad.is_dir():
            raise ValueError(f"--save-pad {self.save_pad}: is a folder; name a file, such as pad.npz")


def preset_of(args: CalibrateArgs) -> Preset:
    """Apply the command line to the preset."""
    cfg = choose_preset(PRESETS, args.preset, draws=args.draws)
    return replace(cfg, counts=tuple(sorted(set(args.presses))) or cfg.counts)
