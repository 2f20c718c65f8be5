"""Arguments of a collection, without JAX and NumPy, so that its command line shows them at once.

The arguments of an arm, a skin and a camera are their whole configuration: `i2t.collect.devices` builds from them.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from i2t.cli import Count, Limits, Seed
from i2t.collect.settings import AmbientSettings, TouchSettings
from i2t.simulation.site_limits import SiteLimits


@dataclass(frozen=True)
class ArmArgs:
    """The arm."""

    FLAT: ClassVar[bool] = True  # flags are --host, not --arm.host

    # ur, simulated, emulated (the real driver with an emulated controller), or another package's: the name that it
    # registers, or package.module:Class
    kind: Annotated[str, tyro.conf.arg(name="arm")] = "simulated"
    host: str | None = None  # address of the arm's controller
    # s without a state after which a UR arm is taken for lost, real or emulated: 0.1 by default
    state_timeout: float | None = None
    # Hz, how often a UR controller must hear from us, real or emulated: 10 by default
    watchdog_rate: float | None = None


@dataclass(frozen=True)
class SkinArgs:
    """The skin that presses; further skins on the tool are tables of the rig."""

    FLAT: ClassVar[bool] = True

    # reskin, simulated, emulated, or another package's
    kind: Annotated[str, tyro.conf.arg(name="skin")] = "simulated"
    port: str | None = None  # serial port of the skin; by default the one board that is plugged in
    # serial number of the skin's board, in place of its port, where several are plugged in
    skin_serial: str | None = None
    # of the skin: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a board file (.toml); by
    # default reskin, and for simulated skins the board of --pad. Another package's skin knows its own
    board: str | None = None


@dataclass(frozen=True)
class CameraArgs:
    """The depth camera."""

    FLAT: ClassVar[bool] = True

    # realsense, simulated, or another package's
    kind: Annotated[str, tyro.conf.arg(name="camera")] = "simulated"
    # serial number of a RealSense, where several are plugged in; the address of another package's camera
    camera_serial: str | None = None


@dataclass(frozen=True)
class WorldArgs:
    """The object, and the world of simulated and emulated devices."""

    FLAT: ClassVar[bool] = True

    object: str = "hexagon"  # of the catalogue, or a mesh file
    # of a mesh file, which does not say it itself; so there is no default
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    pad: Path | None = None  # a pad on disk, for simulated skins
    seed: Seed = 0  # of the sites, and of what is simulated
    no_pose_error: bool = False  # simulated: object and camera are where they are believed to be
    stiffness: Annotated[float, Limits(100, 1e6)] = 10e3  # simulated: of arm and mount, N/m


@dataclass(frozen=True)
class LabArgs:
    """The lab: places of arm, camera and object."""

    FLAT: ClassVar[bool] = True

    # calibration of the lab (python -m i2t.hardware.rig); a real arm needs one, others take the emulated lab's
    rig: Path | None = None
    # of the object in the world: x y z in m, then turns about x y z in degrees; by default that of the rig
    pose: tuple[float, float, float, float, float, float] | None = None
    trust_rig: bool = False  # go on although the rig looks wrong: it is not, only unusual


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
    skip_first_touch: bool = False  # leave out the looks and the slow touch that try the rig before the first touch
    settings: TouchSettings = field(default_factory=TouchSettings)  # how a touch is made
    sites: SiteLimits = field(default_factory=SiteLimits)  # what makes a site safe
    ambient: AmbientSettings = field(default_factory=AmbientSettings)  # free poses, for the ambient field
