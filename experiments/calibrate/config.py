"""Presets and arguments of the calibration experiment."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from experiments.common.presets import choose_preset


@dataclass(frozen=True)
class Preset:
    """How much is tried."""

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
    presses: tuple[int, ...] = ()  # how many to calibrate with; by default what the preset says
    draws: int = 0  # of the presses to calibrate with; 0: what the preset says
    period_mm: float = 0.0  # of a lattice along x and y, where it is known: another row of the table; 0: none
    seed: int = 0  # of what is held out and of the draws
    overwrite: bool = False  # replace a run in --out


def preset_of(args: CalibrateArgs) -> Preset:
    """The preset, with what is given instead."""
    cfg = choose_preset(PRESETS, args.preset)
    cfg = replace(cfg, draws=args.draws or cfg.draws, counts=tuple(sorted(set(args.presses))) or cfg.counts)
    if cfg.draws < 1 or min(cfg.counts) < 2:
        raise ValueError("--draws must be at least 1 and --presses at least 2")
    return cfg
