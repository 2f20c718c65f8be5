"""Arguments of a collection, without JAX and NumPy.

The command line therefore appears at once, and refuses missing files and options without effect before anything large
is imported. The arguments of an arm, a skin and a camera are their complete configuration, from which
`i2t.collect.devices` builds them.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from i2t.cli.options import Count, Limits, check_options, require_path
from i2t.collect.out_folder import check_out
from i2t.collect.settings import TouchSettings
from i2t.hardware.limits import SAFETY
from i2t.hardware.world import WorldArgs
from i2t.simulation.site_limits import SiteLimits


@dataclass(frozen=True)
class ArmArgs:
    """Options of the arm that carries the skin."""

    FLAT: ClassVar[bool] = True  # flags are --host, not --arm.host

    # arm: ur, simulated, emulated (the real driver with an emulated controller), or an arm of another package by its
    # registered name or as package.module:Class
    kind: Annotated[str, tyro.conf.arg(name="arm")] = "simulated"
    host: str | None = None  # address of the arm's controller; required for a UR arm
    # time (s) without a state update after which the connection to a UR arm, real or emulated, counts as lost; by
    # default, 0.1, and 0.5 for an emulated arm on this computer
    state_timeout: Annotated[float, Limits(*SAFETY.state_timeout_range)] | None = None
    # minimum rate (Hz) of this program's heartbeats, below which a UR controller, real or emulated, ends its program;
    # by default, 10, and 2 for an emulated arm on this computer
    watchdog_rate: Annotated[float, Limits(*SAFETY.watchdog_rate_range)] | None = None

    def check(self) -> None:
        """Refuse options that contradict each other; raise a ValueError that names the flag."""
        from i2t.hardware.plugins import check_device

        check_device("arm", self.kind, {"address": self.host, **self.watch})

    @property
    def watch(self) -> dict[str, float]:
        """Return the given ones of `state_timeout` (s) and `watchdog_rate` (Hz), by name."""
        given = {"state_timeout": self.state_timeout, "watchdog_rate": self.watchdog_rate}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class SkinArgs:
    """Options of the skin that presses. Further skins on the tool are tables of the rig."""

    FLAT: ClassVar[bool] = True

    # skin: reskin, simulated, emulated, or a skin of another package, named as for --arm
    kind: Annotated[str, tyro.conf.arg(name="skin")] = "simulated"
    port: str | None = None  # serial port of the skin; by default, that of the only board plugged in
    # serial number of the skin's board; identifies it instead of --port if several boards are plugged in
    skin_serial: str | None = None
    # board of the skin: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a board file (.toml);
    # by default, reskin, and for simulated skins the board of --pad. A skin of another package has its own board
    board: str | None = None

    def check(self) -> None:
        """Refuse options that contradict each other, and a missing board; raise a ValueError that names the flag."""
        from i2t.hardware.plugins import check_device
        from i2t.skin.boards import make_board

        if self.board is not None:
            make_board(self.board)
        options = {"address": self.port, "skin_serial": self.skin_serial, "board": self.board}
        check_device("skin", self.kind, options)
        if self.skin_serial and self.port:
            raise ValueError("--skin-serial and --port both name the board; leave one of them out")


@dataclass(frozen=True)
class CameraArgs:
    """Options of the depth camera on the arm."""

    FLAT: ClassVar[bool] = True

    # depth camera: realsense, simulated, or a camera of another package, named as for --arm
    kind: Annotated[str, tyro.conf.arg(name="camera")] = "simulated"
    # serial number of a RealSense, if several are plugged in; or the address of a camera of another package
    camera_serial: str | None = None

    def check(self) -> None:
        """Refuse options that contradict each other; raise a ValueError that names the flag."""
        from i2t.hardware.plugins import check_device

        check_device("camera", self.kind, {"address": self.camera_serial})


@dataclass(frozen=True)
class LabArgs:
    """Options of the lab: the poses of arm, camera and object."""

    FLAT: ClassVar[bool] = True

    # the lab's calibration file (i2t rig); required for a real arm; by default, that of the emulated
    # lab
    rig: Path | None = None
    # pose of the object in the world: x y z in m, then rotations about x y z in degrees; by default, that of the rig
    pose: tuple[float, float, float, float, float, float] | None = None
    accept_unusual_rig: bool = False  # accept a rig whose values look wrong but are only unusual

    def check(self) -> None:
        """Refuse a missing rig, and a pose outside any lab; raise a ValueError that names the flag."""
        require_path("--rig", self.rig, "file or folder")
        max_m, max_degrees = 3.0, 360.0
        limits = 3 * (max_m,) + 3 * (max_degrees,)
        if self.pose and not all(abs(value) <= limit for value, limit in zip(self.pose, limits, strict=True)):
            raise ValueError(
                f"--pose is {' '.join(f'{value:g}' for value in self.pose)}; give x y z in m, each within "
                f"{max_m:g} m, and rotations about x y z in degrees, each within {max_degrees:g}"
            )


@dataclass(frozen=True)
class CollectArgs:
    """Collect touches of an object with a real or simulated arm, skin and camera."""

    FORMER_NAMES: ClassVar = {"--trust-rig": "--accept-unusual-rig", "--sites.half": "--sites.half-edge"}

    # folder in which the touches are written; a collection that was begun there is resumed
    out: Path = Path("runs/collect")
    touches: Count = 36  # number of touches to collect
    arm: Annotated[ArmArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=ArmArgs)
    skin: Annotated[SkinArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=SkinArgs)
    camera: Annotated[CameraArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=CameraArgs)
    world: Annotated[WorldArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=WorldArgs)
    lab: Annotated[LabArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=LabArgs)
    # name of the object in the data set; by default, its name in the catalogue or that of its file
    name: str | None = None
    pad_name: str | None = None  # name of the skin in the data set
    # name of the session in the data set; by default, the object's name and the time at which the session begins
    session: str | None = None
    dry_run: bool = False  # check everything and draw the rig, but move nothing and record no touch
    skip_first_touch: bool = False  # skip the camera views and slow touches that check the rig before the first touch
    settings: TouchSettings = field(default_factory=TouchSettings)  # distances, speeds and limits of a touch
    sites: SiteLimits = field(default_factory=SiteLimits)  # conditions under which a site is safe to touch

    def check(self) -> None:
        """Refuse options that contradict each other, and missing files; raise a ValueError that names the flag."""
        check_options(self)
        check_out(self.out)
        from i2t.hardware.plugins import check_device
        from i2t.objects.named import require_object

        require_path("--pad", self.world.pad, "file or folder")
        for part in (self.lab, self.arm, self.camera, self.skin):
            part.check()
        check_device("skin", self.skin.kind, {"pad": self.world.pad})
        require_object(self.world.object, self.world.unit, flag="--object")
