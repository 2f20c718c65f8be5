"""Arguments of a collection, without JAX and NumPy, so that its command line shows them at once."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from i2t.collect.settings import AmbientSettings, TouchSettings
from i2t.simulation.site_limits import SiteLimits, check_site_limits

OPTION_RANGES = {  # the least and the greatest of each that make sense, and the unit
    "touches": (1, 1_000_000, "touches"),
    "seed": (0, 2**31 - 1, ""),
    "stiffness": (100.0, 1e6, "N/m"),
}
MAX_OBJECT_M = 3.0  # of an object's pose in the world


@dataclass(frozen=True)
class ArmArgs:
    """The arm."""

    FLAT: ClassVar[bool] = True  # flags are --host, not --arm.host

    kind: Annotated[str, tyro.conf.arg(name="arm")] = "simulated"
    """ur, simulated, emulated (the real driver with an emulated controller), or another package's: the name that it
    registers, or package.module:Class."""
    host: str | None = None
    """Address of the arm's controller."""
    state_timeout: float | None = None
    """s without a state after which a UR arm is taken for lost, real or emulated: 0.1 by default."""
    watchdog_rate: float | None = None
    """Hz, how often a UR controller must hear from us, real or emulated: 10 by default."""


@dataclass(frozen=True)
class SkinArgs:
    """The skin that presses; further skins on the tool are tables of the rig."""

    FLAT: ClassVar[bool] = True

    kind: Annotated[str, tyro.conf.arg(name="skin")] = "simulated"
    """reskin, simulated, emulated, replay, or another package's."""
    port: str | None = None
    """Serial port of the skin; by default the one board that is plugged in."""
    skin_serial: str | None = None
    """Serial number of the skin's board, in place of its port, where several are plugged in."""
    board: str | None = None
    """Of the skin: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a board file (.toml); by
    default reskin, and for simulated skins the board of --pad. Another package's skin knows its own."""
    replay: Path | None = None
    """Recording to play as the skin."""


@dataclass(frozen=True)
class CameraArgs:
    """The depth camera."""

    FLAT: ClassVar[bool] = True

    kind: Annotated[str, tyro.conf.arg(name="camera")] = "simulated"
    """realsense, simulated, folder, or another package's."""
    views: Path | None = None
    """Folder of views to show as the camera."""
    camera_serial: str | None = None
    """Serial number of a RealSense, where several are plugged in; the address of another package's camera."""


@dataclass(frozen=True)
class WorldArgs:
    """The object, and the world of simulated and emulated devices."""

    FLAT: ClassVar[bool] = True

    object: str = "hexagon"
    """Of the catalogue, or a mesh file."""
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Of a mesh file, which does not say it itself; so there is no default."""
    pad: Path | None = None
    """A pad on disk, for simulated skins."""
    seed: int = 0
    """Of the sites, and of what is simulated."""
    no_pose_error: bool = False
    """Simulated: object and camera are where they are believed to be."""
    stiffness: float = 10e3
    """Simulated: of arm and mount, N/m."""


@dataclass(frozen=True)
class LabArgs:
    """The lab: places of arm, camera and object."""

    FLAT: ClassVar[bool] = True

    rig: Path | None = None
    """Calibration of the lab (python -m i2t.hardware.rig); a real arm needs one, others take the emulated lab's."""
    pose: tuple[float, float, float, float, float, float] | None = None
    """Of the object in the world: x y z in m, then turns about x y z in degrees; by default that of the rig."""
    trust_rig: bool = False
    """Go on although the rig looks wrong: it is not, only unusual."""


@dataclass(frozen=True)
class CollectArgs:
    """Collect touches of an object."""

    out: Path = Path("runs/collect")
    """Folder of the touches; a collection that was begun there goes on."""
    touches: int = 36
    """How many there are to be."""
    arm: Annotated[ArmArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=ArmArgs)
    skin: Annotated[SkinArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=SkinArgs)
    camera: Annotated[CameraArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=CameraArgs)
    world: Annotated[WorldArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=WorldArgs)
    lab: Annotated[LabArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=LabArgs)
    name: str | None = None
    """Of the object in the data set; by default the catalogue's or the file's."""
    pad_name: str | None = None
    """Of the skin in the data set."""
    session: str | None = None
    """Name of the session in the data set; by default the object and the time at which it was begun."""
    dry_run: bool = False
    """Check everything and draw the plan; move nothing and write no touch."""
    skip_first_touch: bool = False
    """Leave out the slow touch before the first one, which must meet the object where the rig has it."""
    settings: TouchSettings = field(default_factory=TouchSettings)
    sites: SiteLimits = field(default_factory=SiteLimits)
    ambient: AmbientSettings = field(default_factory=AmbientSettings)

    def __post_init__(self) -> None:
        for name, value in (("touches", self.touches), ("seed", self.world.seed), ("stiffness", self.world.stiffness)):
            least, most, unit = OPTION_RANGES[name]
            if not least <= value <= most:
                raise ValueError(f"--{name} is {value:g}; give {least:g} to {most:g} {unit}".strip())
        check_site_limits(self.sites)
        pose = self.lab.pose
        if pose is not None:
            at, turns = pose[:3], pose[3:]
            if not all(abs(value) <= MAX_OBJECT_M for value in at) or not all(abs(value) <= 360 for value in turns):
                raise ValueError(
                    f"--pose is {' '.join(f'{value:g}' for value in pose)}; give x y z in m, each within "
                    f"{MAX_OBJECT_M:g} m, and turns about x y z in degrees, each within 360"
                )
