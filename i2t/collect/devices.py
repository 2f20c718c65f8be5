"""Which device is meant by a name: builds arm, skin and camera for `i2t.collect.session`, real, emulated or simulated.

Emulated devices are the real drivers before stand-ins (`i2t.emulators.lab`), in processes of their own; where
neither address nor port is given, one is started. Simulated ones share a lab (`i2t.emulators.in_process`); where
nothing else takes part, its time need not be waited for.
"""

import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from i2t.collect.procedure import GuardedArm
from i2t.depth.camera import Camera
from i2t.emulators.scene import Feeler, Scene
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.protocols import DepthCamera, Skin
from i2t.hardware.reskin.driver import Replay, ReSkin
from i2t.hardware.rig import Rig
from i2t.hardware.ur.driver import UrArm
from i2t.objects import catalogue
from i2t.objects.solids import Object
from i2t.simulation.touches import Errors
from i2t.skin import boards
from i2t.skin.files import load_pad
from i2t.skin.pad import sample_pad
from i2t.types import Board

PAD = 1000  # key of the random pad, the same as pad 0 of experiments.train


class Devices(NamedTuple):
    """Devices that have not been connected, and the clock that they share."""

    arm: GuardedArm
    skin: Skin
    camera: DepthCamera
    clock: Clock
    board: Board


@dataclass(frozen=True)
class Wanted:
    """Which devices; see `i2t.collect.session.Args`."""

    arm: str
    skin: str
    camera: str
    host: str | None
    port: str | None
    replay: Path | None
    views: Path | None
    pad: Path | None
    seed: int
    exact: bool
    stiffness: float
    stale: float | None
    watchdog: float | None
    begin: float  # Unix time at which simulated time may begin


def read_rig(path: Path | None) -> Rig:
    """The rig in a file, or that of the stand-ins."""
    return Rig() if path is None else Rig.read(path)


def read_object(name: str, unit: str) -> Object:
    """An object of the catalogue, or a mesh file. Raises ValueError or FileNotFoundError."""
    return catalogue.make_object(name) if name in catalogue.NAMES else catalogue.load_mesh(name, unit)[0]


def scene_of(
    name: str, unit: str, rig: Rig, pad: Path | None, seed: int, exact: bool = False, stiffness: float = 10e3
) -> Scene:
    """A simulated lab's object, with the errors of a run of that seed (`exact`: none of placement and camera)."""
    errors = Errors().scaled(0.0) if exact else Errors()
    skin = sample_pad(jax.random.key(PAD)) if pad is None else load_pad(pad)
    T_b_o = rig.T_base_world @ rig.T_world_object
    return Scene(read_object(name, unit).mesh, T_b_o, skin, errors, stiffness, seed)


def build(wanted: Wanted, rig: Rig, name: str, unit: str, stack: ExitStack) -> Devices:
    """The devices; what has to be started for them ends with the stack. Raises ValueError for what does not go
    together, and DeviceError.
    """
    _check(wanted)
    host, port = wanted.host, wanted.port
    if "emulated" in (wanted.arm, wanted.skin) and wanted.arm != "simulated" and not (host and port):
        host, port = _rehearse(wanted, rig, name, unit, stack)
    scene = None
    if "simulated" in (wanted.arm, wanted.camera):
        scene = scene_of(name, unit, rig, wanted.pad, wanted.seed, wanted.exact, wanted.stiffness)
    clock: Clock = MonotonicClock()
    arm: Any
    skin: Any
    if wanted.arm == "simulated":
        from i2t.emulators.in_process import Lab, SimulatedArm, SimulatedSkin, VirtualClock

        assert scene is not None
        if wanted.skin == "simulated":
            clock = VirtualClock(max(time.time(), wanted.begin))
        feeler: Feeler | None = None
        if wanted.skin == "emulated":
            from i2t.emulators import lab as rehearsal
            from i2t.emulators import reskin_board

            link = ["--link", str(Path(stack.enter_context(tempfile.TemporaryDirectory())) / "skin")]
            port, process = stack.enter_context(reskin_board.started("--field", *link))
            feeler = rehearsal.BoardPublishingContactModel(scene, rehearsal.address(process), wait=True)
        lab = Lab(scene, clock, seed=wanted.seed, feeler=feeler)
        arm = SimulatedArm(lab, rig.limits)
        skin = SimulatedSkin(lab) if wanted.skin == "simulated" else None
    else:
        assert host is not None
        stale, watchdog = (0.1, 10.0) if wanted.arm == "ur" else (0.5, 4.0)
        arm = UrArm(
            host,
            rig.limits,
            rig.T_flange_tool,
            (rig.mass, rig.centre),
            state_timeout=wanted.stale or stale,
            watchdog_rate=wanted.watchdog or watchdog,
        )
        skin = None
    if skin is None:
        skin = Replay(wanted.replay) if wanted.skin == "replay" and wanted.replay else ReSkin(port)
    camera = _camera(wanted, rig, scene, arm, clock)
    board = scene.board if scene is not None and wanted.skin == "simulated" else boards.reskin_board()
    return Devices(arm, skin, camera, clock, Board(*(np.asarray(part) for part in board)))


def source_of(devices: Devices) -> str:
    """What a data set must say of touches that connected devices make: real, simulated or mixed."""
    each = (device.features.source for device in (devices.arm, devices.skin, devices.camera))
    sources = {"real" if source in ("real", "folder") else "simulated" for source in each}
    return sources.pop() if len(sources) == 1 else "mixed"


def _camera(wanted: Wanted, rig: Rig, scene: Scene | None, arm: Any, clock: Clock) -> Any:
    if wanted.camera == "simulated":
        from i2t.emulators.in_process import SimulatedCamera

        assert scene is not None
        lens = Camera(*(getattr(rig.camera, each) for each in ("width", "height", "fx", "fy", "cx", "cy")))
        return SimulatedCamera(scene, lens, rig.T_tool_camera, lambda: arm.state().T_b_t, clock, wanted.seed)
    if wanted.camera == "folder":
        from i2t.hardware.camera_folder import RecordedDepthCamera

        assert wanted.views is not None
        return RecordedDepthCamera(wanted.views, loop=True)
    from i2t.hardware.realsense import RealSense

    return RealSense(size=(rig.camera.width, rig.camera.height), distance=rig.looking_distance)


def _check(wanted: Wanted) -> None:
    if wanted.skin == "simulated" and wanted.arm != "simulated":
        raise ValueError("a simulated skin feels only what a simulated arm does; choose --skin emulated, or reskin")
    if wanted.arm == "ur" and wanted.skin == "emulated" and not wanted.port:
        raise ValueError("an emulated skin on a real arm feels nothing; choose --skin reskin, or name its --port")
    if wanted.arm == "ur" and not wanted.host:
        raise ValueError("a UR arm needs the address of its controller; pass --host")
    if wanted.skin == "replay" and not wanted.replay:
        raise ValueError("a replay needs a recording; pass --replay FILE")
    if wanted.camera == "folder" and not wanted.views:
        raise ValueError("a folder of views must be named; pass --views DIR")
    if (wanted.arm == "emulated") and bool(wanted.host) != bool(wanted.port) and wanted.skin == "emulated":
        raise ValueError("stand-ins that run already have a --host and a --port; pass both, or neither")


def _rehearse(wanted: Wanted, rig: Rig, name: str, unit: str, stack: ExitStack) -> tuple[str, str]:
    """Start the stand-ins; returns the controller's address and the skin's port."""
    from i2t.emulators import lab as rehearsal
    from i2t.emulators import ur_controller

    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    rig.write(folder / "rig.toml")
    host, link = ur_controller.loopback(200), folder / "skin"
    options = ["--host", host, "--link", str(link), "--object", name, "--unit", unit, "--seed", str(wanted.seed)]
    options += ["--rig", str(folder / "rig.toml"), "--mount", str(wanted.stiffness)]
    options += ["--pad", str(wanted.pad)] if wanted.pad else []
    stack.enter_context(rehearsal.started(*options, *(["--exact"] if wanted.exact else [])))
    return host, str(link)
