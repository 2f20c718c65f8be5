"""Arguments of a collection, without JAX and NumPy, so that its command line shows them at once, and refuses files that
are missing and options without effect before anything large is imported.

The arguments of an arm, a skin and a camera are their whole configuration: `i2t.collect.devices` builds from them.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from i2t.cli.options import Count, Limits, check_options, require_path
from i2t.collect.settings import TouchSettings
from i2t.hardware.limits import SAFETY
from i2t.hardware.world import WorldArgs
from i2t.simulation.site_limits import SiteLimits

SIMULATED = "simulated"
MAX_OBJECT_M = 3.0  # of an object's pose in the world


@dataclass(frozen=True)
class ArmArgs:
    """The arm."""

    FLAT: ClassVar[bool] = True  # flags are --host, not --arm.host

    # ur, simulated, emulated (the real driver with an emulated controller), or another package's: the name that it
    # registers, or package.module:Class
    kind: Annotated[str, tyro.conf.arg(name="arm")] = SIMULATED
    host: str | None = None  # address of the arm's controller
    # s without a state after which a UR arm is taken for lost, real or emulated: 0.1 by default
    state_timeout: Annotated[float, Limits(*SAFETY.state_timeout_range)] | None = None
    # Hz, how often a UR controller must hear from us, real or emulated: 10 by default
    watchdog_rate: Annotated[float, Limits(*SAFETY.watchdog_rate_range)] | None = None

    def check(self) -> None:
        """Refuse options that do not go together (ValueError, which names the flag)."""
        from i2t.hardware.plugins import check_device

        check_device("arm", self.kind, {"address": self.host, **self.watch})

    @property
    def watch(self) -> dict[str, float]:
        """Times of the arm's watch that are given."""
        given = {"state_timeout": self.state_timeout, "watchdog_rate": self.watchdog_rate}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class SkinArgs:
    """The skin that presses; further skins on the tool are tables of the rig."""

    FLAT: ClassVar[bool] = True

    # reskin, simulated, emulated, or another package's
    kind: Annotated[str, tyro.conf.arg(name="skin")] = SIMULATED
    port: str | None = None  # serial port of the skin; by default the one board that is plugged in
    # serial number of the skin's board, in place of its port, where several are plugged in
    skin_serial: str | None = None
    # of the skin: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a board file (.toml); by
    # default reskin, and for simulated skins the board of --pad. Another package's skin knows its own
    board: str | None = None

    def check(self) -> None:
        """Refuse options that do not go together, and a board that is not there (ValueError, which names the flag)."""
        from i2t.hardware.plugins import check_device
        from i2t.skin.boards import make_board

        if self.board is not None:
            make_board(self.board)
        options = {"address": self.port, "skin_serial": self.skin_serial, "board": self.board}
        check_device("skin", self.kind, options)
        if self.skin_serial and self.port:
            raise ValueError("--skin-serial and --port both say which board it is; leave one of them out")


@dataclass(frozen=True)
class CameraArgs:
    """The depth camera."""

    FLAT: ClassVar[bool] = True

    # realsense, simulated, or another package's
    kind: Annotated[str, tyro.conf.arg(name="camera")] = SIMULATED
    # serial number of a RealSense, where several are plugged in; the address of another package's camera
    camera_serial: str | None = None

    def check(self) -> None:
        """Refuse options that do not go together (ValueError, which names the flag)."""
        from i2t.hardware.plugins import check_device

        check_device("camera", self.kind, {"address": self.camera_serial})


@dataclass(frozen=True)
class LabArgs:
    """The lab: places of arm, camera and object."""

    FLAT: ClassVar[bool] = True

    # calibration of the lab (python -m i2t.hardware.rig); a real arm needs one, others take the emulated lab's
    rig: Path | None = None
    # of the object in the world: x y z in m, then turns about x y z in degrees; by default that of the rig
    pose: tuple[float, float, float, float, float, float] | None = None
    trust_rig: bool = False  # go on although the rig looks wrong: it is not, only unusual

    def check(self) -> None:
        """Refuse a missing rig, and a pose beyond any lab (ValueError, which names the flag)."""
        require_path("--rig", self.rig, "file or folder")
        limits = 3 * (MAX_OBJECT_M,) + 3 * (360.0,)
        if self.pose and not all(abs(value) <= most for value, most in zip(self.pose, limits, strict=True)):
            raise ValueError(
                f"--pose is {' '.join(f'{value:g}' for value in self.pose)}; give x y z in m, each within "
                f"{MAX_OBJECT_M:g} m, and turns about x y z in degrees, each within 360"
            )


@dataclass(frozen=True)
class CollectArgs:
    """Collect touches of an object."""

    out: Path = Path("runs/collect")  # folder of the touches; a collection that was begun there goes on
    touches: Count = 36  # how many there are to be
    arm: Annotated[ArmArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=ArmArgs)
    skin: Annotated[SkinArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=SkinArgs)
    camera: Annotated[CameraArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=CameraArgs)
    world: Annotated[WorldArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=WorldArgs)
    lab: Annotated[LabArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=LabArgs)
    name: str | None = None  # of the object in the data set; by default the catalogue's or the file's
    pad_name: str | None = None  # of the skin in the data set
    # name of the session in the data set; by default the object and the time at which it was begun
    session: str | None = None
    dry_run: bool = False  # check everything and draw the rig; move nothing and write no touch
    skip_first_touch: bool = False  # leave out the looks and the slow touches that try the rig before the first touch
    settings: TouchSettings = field(default_factory=TouchSettings)  # how a touch is made
    sites: SiteLimits = field(default_factory=SiteLimits)  # what makes a site safe

    def check(self) -> None:
        """Refuse what does not go together, and files that are not there (ValueError, which names the flag)."""
        from i2t.hardware.plugins import check_device
        from i2t.objects.named import require_object

        check_options(self)
        if self.out.exists() and not self.out.is_dir():
            raise ValueError(f"--out {self.out}: is a file; name a folder")
        require_path("--pad", self.world.pad, "file or folder")
        for part in (self.lab, self.arm, self.camera, self.skin):
            part.check()
        check_device("skin", self.skin.kind, {"pad": self.world.pad})
        require_object(self.world.object, self.world.unit, flag="--object")
