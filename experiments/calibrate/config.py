"""Presets and arguments of the calibration experiment."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from experiments.common.checks import require_dataset
from experiments.common.presets import choose_preset
from experiments.common.runs import METRICS
from i2t.cli import Count, Limits, NotNegative, Seed, require_path, require_with

TARGET_NAMES = ("position", "depth", "force", "shear", "contact", "slip")  # as `i2t.calibration.heads` has them
PressCount: TypeAlias = Annotated[int, Limits(2)]


@dataclass(frozen=True)
class Preset:
    """Sizes of the experiment."""

    draws: int = 20
    counts: tuple[int, ...] = (5, 10, 20, 50, 100, 300, 1000)
    held_out_presses: int = 1000  # at random
    block_mm: float = 6.0
    block_share: float = 0.2  # of blocks held out
    generated_skins: int = 300  # to pretrain on
    pretraining_steps: int = 4000
    scratch_steps: int = 500
    saved_presses: int = 1500  # in the calibration that is saved


PRESETS: dict[str, Preset] = {
    "paper": Preset(),
    "short": Preset(counts=(5, 10, 20, 50, 100, 300)),
    "debug": Preset(2, (5, 20), generated_skins=16, pretraining_steps=50, scratch_steps=50),
}


@dataclass(frozen=True)
class CalibrateArgs:
    """Learning curves of calibration on real (or simulated) presses."""

    dataset: Path | None = None  # a data set of one tip on one skin
    skin_name: str | None = None  # with --dataset: of several skins that were read in each touch, the one that is meant
    save_pad: Path | None = None  # do not compare methods: fit a pad to the presses and write it, a file for --pad
    calibration: Path | None = None  # with --save-pad: a calibration, whose presses are taken in place of --dataset
    targets: tuple[str, ...] = ()  # heads of position, depth, force, shear, contact, slip (docs/fidelity.md)
    tip: str | None = None  # with --save-pad: sphere:RADIUS or cylinder:RADIUS in mm; by default what the data set says
    board: str | None = None  # with --calibration: reskin, anyskin or grid-RxC; by default what its file says
    pad_name: str | None = None  # with --save-pad: of the skin; by default what the data set says
    out: Path = Path("runs/calibrate")  # folder for everything that is made
    preset: Literal["paper", "short", "debug"] = "paper"
    load: Literal["auto", "depth", "force"] = "auto"  # what says how hard was pressed; auto: depth where measured
    previous_session: Path | None = None  # a data set of an earlier session of the same skin with the same tip
    presses: tuple[PressCount, ...] = ()  # how many to calibrate with; by default what the preset says
    draws: Count | None = None  # of the presses to calibrate with, in place of the preset's
    period_mm: NotNegative = 0.0  # of a lattice along x and y, where it is known: another row of the table; 0: none
    seed: Seed = 0  # of what is held out and of the draws
    overwrite: bool = False  # replace a run in --out

    @property
    def folder(self) -> Path | None:
        """Folder for everything that is made; none where a pad is written to a file."""
        return None if self.save_pad else self.out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run: a pad of the presses, where a pad can be fitted with the tip."""
        metrics = Path(self.out) / METRICS
        if metrics.exists() and json.loads(metrics.read_text()).get("tip"):
            asked = "" if self.skin_name is None else f" --skin-name {self.skin_name}"
            return f"python -m experiments.calibrate --dataset {self.dataset}{asked} --save-pad pad.npz"
        return "" if self.skin_name else f"python -m experiments.fidelity --dataset {self.dataset}"

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there."""
        if self.calibration and not self.save_pad:
            raise ValueError("--calibration is for --save-pad FILE, which says where the pad is written")
        if (self.dataset is None) == (self.calibration is None):
            raise ValueError(
                "pass --dataset DIR with presses of one tip on one skin, or --calibration FILE --save-pad FILE"
            )
        require_with("--tip", self.tip is not None, "--save-pad", self.save_pad is not None)
        require_with("--pad-name", self.pad_name is not None, "--save-pad", self.save_pad is not None)
        require_with("--board", self.board is not None, "--calibration", self.calibration is not None)
        asked = {
            "--save-pad": self.save_pad is not None,
            "--previous-session": self.previous_session is not None,
            "--targets": bool(self.targets),
        }
        if sum(asked.values()) > 1:
            raise ValueError(
                f"{' and '.join(flag for flag in asked if asked[flag])} ask for different things; pass one"
            )
        for flag, given in (("--presses", self.presses), ("--draws", self.draws), ("--period-mm", self.period_mm)):
            if given and (self.save_pad or self.targets):
                other = "--save-pad" if self.save_pad else "--targets"
                raise ValueError(f"{flag} is for comparing methods, and {other} compares none; leave it out")
        if unknown := [target for target in self.targets if target not in TARGET_NAMES]:
            raise ValueError(f"--targets {' '.join(unknown)}: is no target; choose of {', '.join(TARGET_NAMES)}")
        require_with("--skin-name", self.skin_name is not None, "--dataset", self.dataset is not None)
        require_dataset("--dataset", self.dataset, tables=bool(self.targets))
        require_dataset("--previous-session", self.previous_session)
        require_path("--calibration", self.calibration, "file")
        if self.save_pad is not None and self.save_pad.is_dir():
            raise ValueError(f"--save-pad {self.save_pad}: is a folder; name a file, such as pad.npz")


def preset_of(args: CalibrateArgs) -> Preset:
    """The preset, changed by the options that are given."""
    cfg = choose_preset(PRESETS, args.preset, draws=args.draws)
    return replace(cfg, counts=tuple(sorted(set(args.presses))) or cfg.counts)
