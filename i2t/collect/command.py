"""Collect touches of an object: an arm looks, presses and retreats, and every touch becomes a file.

    python -m i2t.collect                                        all simulated: see how it goes
    python -m i2t.collect --arm emulated --skin emulated         the real drivers with emulators, in a lab's time
    python -m i2t.collect --arm ur --host 192.168.1.10 --skin reskin --camera realsense --rig lab.toml \\
        --object mug.stl --out DATA/mug --dry-run                checks everything, moves nothing
    python -m i2t.collect --arm acme_devices:AcmeArm ...         a device of another package

The same command again goes on where it stopped. Ctrl-C or SIGTERM stops the arm and keeps everything. What it writes is
a data set: `python -m experiments.train --dataset DATA`.
"""

import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from i2t.cli import ended, renamed_flags
from i2t.collect.settings import TouchSettings
from i2t.simulation.site_limits import SiteLimits

RENAMED_FLAGS = {
    "--run": "--session",
    "--exact": "--no-pose-error",
    "--stale": "--state-timeout",
    "--watchdog": "--watchdog-rate",
    "--settings.past-goal": "--settings.overtravel",
    "--settings.uneven": "--settings.nonuniform-share",
    "--settings.mean-of": "--settings.averaged-samples",
    "--settings.seen": "--settings.min-visible-share",
    "--settings.nearer": "--settings.surface-tolerance",
}


@dataclass(frozen=True)
class CollectArgs:
    """Collect touches of an object."""

    out: Path = Path("runs/collect")
    """Folder of the touches; a collection that was begun there goes on."""
    touches: int = 36
    """How many there are to be."""
    arm: str = "simulated"
    """ur, simulated, emulated (the real driver with an emulated controller), or another package's: the name that it
    registers, or package.module:Class."""
    skin: str = "simulated"
    """reskin, simulated, emulated, replay, or another package's."""
    camera: str = "simulated"
    """realsense, simulated, folder, or another package's."""
    host: str | None = None
    """Address of the arm's controller."""
    port: str | None = None
    """Serial port of the skin; by default the one board that is plugged in."""
    board: str = "reskin"
    """Of a real or replayed skin: reskin, anyskin, or grid-RxC for R rows and C columns of chips."""
    replay: Path | None = None
    """Recording to play as the skin."""
    views: Path | None = None
    """Folder of views to show as the camera."""
    rig: Path | None = None
    """Calibration of the lab (python -m i2t.hardware.rig); real devices need one."""
    object: str = "hexagon"
    """Of the catalogue, or a mesh file."""
    unit: Literal["m", "cm", "mm", "inch"] = "mm"
    """Of a mesh file."""
    pose: tuple[float, float, float, float, float, float] | None = None
    """Of the object in the world: x y z in m, then turns about x y z in degrees; by default that of the rig."""
    name: str | None = None
    """Of the object in the data set; by default the catalogue's or the file's."""
    pad: Path | None = None
    """A pad on disk, for simulated skins."""
    pad_name: str | None = None
    """Of the skin in the data set."""
    session: str | None = None
    """Name of the session in the data set; by default the object and the time at which it was begun."""
    seed: int = 0
    """Of the sites, and of what is simulated."""
    no_pose_error: bool = False
    """Simulated: object and camera are where they are believed to be."""
    stiffness: float = 10e3
    """Simulated: of arm and mount, N/m."""
    state_timeout: float | None = None
    """s without a state after which a UR arm is taken for lost: 0.1, and 0.5 for an emulated one beside other work."""
    watchdog_rate: float | None = None
    """Hz, how often a UR controller must hear from us: 10, and 4 for an emulated one."""
    dry_run: bool = False
    """Check everything and draw the plan; move nothing and write no touch."""
    settings: TouchSettings = field(default_factory=TouchSettings)
    sites: SiteLimits = field(default_factory=SiteLimits)

    def __post_init__(self) -> None:
        if self.touches < 1:
            raise ValueError(f"--touches is {self.touches}; give at least 1")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Without the program's name; by default that of this process.

    Returns:
        The exit code.
    """
    renamed_flags(sys.argv[1:] if argv is None else argv, RENAMED_FLAGS)
    args = tyro.cli(
        CollectArgs,
        args=argv,
        description=__doc__,
        prog="python -m i2t.collect",
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    from i2t.collect.session import collect  # not above: JAX takes seconds, which --help need not wait for

    before = signal.signal(signal.SIGTERM, end_by_signal)
    try:
        return ended(lambda: collect(args), f"stopped; everything is in {args.out}: the same command goes on")
    finally:
        signal.signal(signal.SIGTERM, before)


def end_by_signal(*_: Any) -> None:
    """Leave the program as SIGTERM does, but through every `finally`."""
    sys.exit(128 + signal.SIGTERM)
