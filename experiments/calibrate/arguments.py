"""Presets and options of `python -m experiments.calibrate`, without JAX."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from experiments.common.checks import require_dataset
from experiments.common.options import RunOptions
from experiments.common.presets import choose_preset
from experiments.common.runs import METRICS
from i2t.cli.options import Count, Limits, require_with

TARGET_NAMES = ("position", "travel", "force", "shear")  # as `i2t.heads.heads` has them
PressCount: TypeAlias = Annotated[int, Limits(2)]


@dataclass(frozen=True)
class Preset:
    """Sizes of the comparison of methods on a recording."""

    draws: int = 20
    counts: tuple[int, ...] = (5, 10, 20, 50, 100, 300, 1000)
    held_out_presses: int = 1000  # at random
    block_mm: float = 6.0
    block_share: float = 0.2  # of blocks held out
    saved_presses: int = 1500  # in the calibration that is saved


PRESETS: dict[str, Preset] = {
    "paper": Preset(),
    "short": Preset(counts=(5, 10, 20, 50, 100, 300)),
    "debug": Preset(2, (5, 20)),
}


@dataclass(frozen=True)
class CalibrateArgs(RunOptions):
    """How many presses does a skin need, and by which method?"""

    dataset: Path | None = None  # a data set of one tip on one skin
    skin_name: str | None = None  # with --dataset: of several skins that were read in each touch, the one that is meant
    simulated: bool = False  # compare methods on simulated skins of several kinds
    recovery: bool = False  # fit pads to presses of simulated pads, and count how often their ranges hold the truth
    prior: bool = False  # make the prior over kernels, prior.npz, from simulated skins
    save_pad: Path | None = None  # do not compare methods: fit a pad to the presses and write it, a file for --pad
    targets: tuple[str, ...] = ()  # heads of position, travel, force, shear (docs/fidelity.md)
    tip: str | None = None  # with --save-pad: sphere:RADIUS or cylinder:RADIUS in mm; by default what the data set says
    pad_name: str | None = None  # with --save-pad: of the skin; by default what the data set says
    out: Path = Path("runs/calibrate")  # folder for everything that is made
    preset: Literal["paper", "short", "debug"] = "paper"
    load: Literal["auto", "travel", "force"] = "auto"  # what says how hard was pressed; auto: travel where measured
    presses: tuple[PressCount, ...] = ()  # how many to calibrate with; by default what the preset says
    draws: Count | None = None  # of the presses to calibrate with, in place of the preset's

    @property
    def folder(self) -> Path | None:
        """Folder for everything that is made; none where a pad is written to a file."""
        return None if self.save_pad else self.out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run: a pad of the presses, where a pad can be fitted with the tip."""
        if self.dataset is None:
            return ""
        metrics = Path(self.out) / METRICS
        if metrics.exists() and json.loads(metrics.read_text()).get("tip"):
            asked = "" if self.skin_name is None else f" --skin-name {self.skin_name}"
            return f"python -m experiments.calibrate --dataset {self.dataset}{asked} --save-pad pad.npz"
        return "" if self.skin_name else f"python -m experiments.fidelity --dataset {self.dataset}"

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there."""
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
            raise ValueError("--save-pad and --targets ask for different things; pass one")
        compares = self.dataset is not None and not self.save_pad and not self.targets
        for flag, given in (("--presses", bool(self.presses)), ("--draws", self.draws is not None)):
            if given and not compares:
                raise ValueError(f"{flag} is for comparing methods on a data set; leave it out")
        if unknown := [target for target in self.targets if target not in TARGET_NAMES]:
            raise ValueError(f"--targets {' '.join(unknown)}: is no target; choose of {', '.join(TARGET_NAMES)}")
        require_dataset("--dataset", self.dataset, tables=bool(self.targets))
        if self.save_pad is not None and self.save_pad.is_dir():
            raise ValueError(f"--save-pad {self.save_pad}: is a folder; name a file, such as pad.npz")


def preset_of(args: CalibrateArgs) -> Preset:
    """The preset, changed by the options that are given."""
    cfg = choose_preset(PRESETS, args.preset, draws=args.draws)
    return replace(cfg, counts=tuple(sorted(set(args.presses))) or cfg.counts)
