"""Arm, skin and camera of a collection, real, emulated, simulated or a third party's, from their configurations.

Each kind has a frozen configuration next to its driver, and here a small function that builds it, not connected.
Emulated devices are the real drivers with emulators (`i2t.emulators.lab`) in processes of their own; where no address
is given, one is started. Simulated devices share a lab (`i2t.emulators.in_process`); where only simulated devices take
part, its time is virtual and nobody waits for it. Drivers are imported only where they are asked for.
"""

import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, singledispatch
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from i2t.collect.carried import SkinOnTool
from i2t.depth.camera import Distortion
from i2t.emulators.world import (
    EmulatedArmConfig,
    EmulatedSkinConfig,
    SimulatedArmConfig,
    SimulatedCameraConfig,
    SimulatedSkinConfig,
    WorldConfig,
    carried_scene,
    make_scene,
    read_pad,
)
from i2t.hardware.camera_folder import CameraFolderConfig
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.named_devices import make_ur_arm
from i2t.hardware.plugins import DeviceSetup, PluginConfig, load_plugin
from i2t.hardware.protocols import DepthCamera, GuardedArm, Skin
from i2t.hardware.realsense import RealSenseConfig
from i2t.hardware.reskin.config import ReplayConfig, ReSkinConfig
from i2t.hardware.rig import Rig
from i2t.hardware.ur.config import UrConfig
from i2t.skin import boards
from i2t.skin.boards import DEFAULT_BOARD
from i2t.types import Board

if TYPE_CHECKING:
    from i2t.emulators.in_process import SimulatedLab
    from i2t.emulators.scene import ObjectScene

ArmConfig: TypeAlias = UrConfig | EmulatedArmConfig | SimulatedArmConfig | PluginConfig
SkinConfig: TypeAlias = ReSkinConfig | ReplayConfig | EmulatedSkinConfig | SimulatedSkinConfig | PluginConfig
CameraConfig: TypeAlias = RealSenseConfig | CameraFolderConfig | SimulatedCameraConfig | PluginConfig


class Devices(NamedTuple):
    """Devices that have not been connected, and the clock that they share."""

    arm: GuardedArm
    skin: Skin
    camera: DepthCamera
    clock: Clock
    board: Board
    carried: tuple[SkinOnTool, ...] = ()  # further skins of the rig


class CarriedSkinConfig(NamedTuple):
    """A further skin of the rig, and its device."""

    place: CarriedSkin
    device: SkinConfig


@dataclass(frozen=True)
class DeviceConfig:
    """Configuration of the devices. Raises ValueError for what does not go together."""

    arm: ArmConfig
    skin: SkinConfig
    camera: CameraConfig
    world: WorldConfig  # what simulated and emulated devices meet
    begin: float = 0.0  # Unix time (s) at which virtual time may begin
    carried: tuple[CarriedSkinConfig, ...] = ()  # further skins of the rig

    def __post_init__(self) -> None:
        arm, skin = self.arm, self.skin
        for place, device in self.carried:
            if isinstance(device, ReSkinConfig) and isinstance(skin, ReSkinConfig):
                own, other = (each.serial_number or each.port for each in (skin, device))
                if own == other:
                    raise ValueError(f"the board {own} is named for two skins; correct --port, or skins.{place.name}")
            if isinstance(device, SimulatedSkinConfig) and not isinstance(arm, SimulatedArmConfig):
                raise ValueError(
                    f"skins.{place.name}.device is simulated, and the arm is not; make it emulated, or reskin"
                )
            if isinstance(device, EmulatedSkinConfig) and isinstance(arm, UrConfig | PluginConfig):
                raise ValueError(
                    f"skins.{place.name}.device is emulated, and feels nothing on this arm; make it reskin"
                )
            if isinstance(device, EmulatedSkinConfig) and isinstance(arm, EmulatedArmConfig) and arm.host:
                raise ValueError(
                    f"skins.{place.name}.device is emulated, and the emulators of {arm.host} run already; make it "
                    "reskin, with the link of its board as address"
                )
        if isinstance(skin, SimulatedSkinConfig) and not isinstance(arm, SimulatedArmConfig):
            raise ValueError("a simulated skin feels only what a simulated arm does; choose --skin emulated, or reskin")
        if isinstance(skin, EmulatedSkinConfig):
            if isinstance(arm, UrConfig | PluginConfig) and not skin.port:
                raise ValueError(
                    "an emulated skin on a real arm feels nothing; choose --skin reskin, or name its --port"
                )
            if isinstance(arm, EmulatedArmConfig) and bool(arm.host) != bool(skin.port):
                raise ValueError("emulators that run already have a --host and a --port; pass both, or neither")
            if isinstance(arm, SimulatedArmConfig) and skin.port:
                raise ValueError(
                    "a simulated arm starts the emulated board that shows what it feels; leave out --port, or choose "
                    "--arm emulated"
                )
            if self.world.board not in (None, skin.board):
                raise ValueError(
                    f"the pad is on the board {self.world.board} and the emulated skin on {skin.board}; name one board"
                )


class DeviceContext:
    """Context that the devices of one collection share; each part is made when it is first asked for.

    Args:
        config: Which devices.
        rig: Where everything is.
        stack: Ends what has to be started.
    """

    def __init__(self, config: DeviceConfig, rig: Rig, stack: ExitStack) -> None:
        self.config, self.rig, self.stack = config, rig, stack
        self.arm: GuardedArm | None = None  # once it is made

    @cached_property
    def clock(self) -> Clock:
        """Clock: virtual where only simulated devices take part, else this machine's."""
        skins = [self.config.skin, *(device for _, device in self.config.carried)]
        simulated = all(isinstance(skin, SimulatedSkinConfig) for skin in skins)
        if isinstance(self.config.arm, SimulatedArmConfig) and simulated:
            from i2t.emulators.in_process import VirtualClock

            return VirtualClock(max(time.time(), self.config.begin))
        return MonotonicClock()

    @cached_property
    def world(self) -> WorldConfig:
        """World that simulated and emulated devices meet; a pad that is not on the emulated board is refused here."""
        world, skin = self.config.world, self.config.skin
        if not isinstance(skin, EmulatedSkinConfig):
            return world
        if world.pad:
            read_pad(world.pad, skin.board)  # before a process starts
        return replace(world, board=skin.board)

    @cached_property
    def scene(self) -> "ObjectScene":
        """Scene that simulated devices meet."""
        return make_scene(self.world, self.rig)

    @cached_property
    def simulated_lab(self) -> "SimulatedLab":
        """Lab of the simulated arm and skin; an emulated skin is told what is felt there."""
        from i2t.emulators.in_process import SimulatedLab
        from i2t.emulators.scene import ContactModel

        model: ContactModel | None = None
        if isinstance(self.config.skin, EmulatedSkinConfig):
            from i2t.emulators import lab

            _, process = self.emulated_board
            model = ContactModel(self.scene, to=lab.board_address(process))
            self.stack.callback(model.close)
        return SimulatedLab(self.scene, self.clock, seed=self.config.world.seed, contact_model=model)

    def carried_lab(self, place: CarriedSkin, number: int, *, emulated: bool) -> "SimulatedLab":
        """Lab of a further skin of a simulated arm, with a pad of its own.

        Args:
            place: The skin.
            number: Of the skin, from 1.
            emulated: Whether an emulated board shows what it feels.

        Returns:
            The lab of this skin.
        """
        from i2t.emulators.in_process import CarriedSkinLab

        lab, scene, model = self.simulated_lab, carried_scene(self.world, self.rig, place.board, number), None
        if emulated:
            from i2t.emulators.scene import ContactModel

            model = ContactModel(scene, to=self.carried_boards[place.name][1])
            self.stack.callback(model.close)
        return CarriedSkinLab(lab, scene, place.T_tool_skin, seed=self.world.seed + number, contact_model=model)

    @cached_property
    def carried_boards(self) -> dict[str, tuple[str, tuple[str, int]]]:
        """Ports of the emulated boards of further skins, and addresses that take their fields, by the skins' names."""
        from i2t.emulators import lab, reskin_board

        started = {}
        for place, device in self.config.carried:
            if isinstance(device, EmulatedSkinConfig):
                named = ("--link", str(self._folder / f"skin-{place.name}"), "--board", place.board)
                port, process = self.stack.enter_context(reskin_board.started(*reskin_board.SHOWS_FIELDS, *named))
                started[place.name] = port, lab.board_address(process)
        return started

    @cached_property
    def emulated_board(self) -> tuple[str, Any]:
        """Port and process of a board that shows what a simulated arm feels."""
        from i2t.emulators import reskin_board

        named = ("--link", str(self._folder / "skin"), "--board", self.world.board or DEFAULT_BOARD)
        return self.stack.enter_context(reskin_board.started(*reskin_board.SHOWS_FIELDS, *named))

    @cached_property
    def emulated_lab(self) -> tuple[str, str]:
        """The controller's address and the skin's port of an emulated lab that is started."""
        from i2t.emulators import lab, ur_controller

        world, folder = self.world, self._folder
        self.rig.write(folder / "rig.toml")
        host, link = ur_controller.loopback(200), folder / "skin"
        options = ["--host", host, "--link", str(link), "--object", world.object]
        options += ["--unit", world.unit] if world.unit else []
        options += ["--seed", str(world.seed), "--rig", str(folder / "rig.toml"), "--mount", str(world.stiffness)]
        options += ["--pad", str(world.pad)] if world.pad else []
        options += ["--no-pose-error"] if world.no_pose_error else []
        for name, (_, (heard_on, at)) in self.carried_boards.items():
            options += ["--carried", name, f"{heard_on}:{at}"]
        self.stack.enter_context(lab.started(*options, "--board", "--board", world.board or DEFAULT_BOARD))
        return host, str(link)

    @cached_property
    def _folder(self) -> Path:
        return Path(self.stack.enter_context(tempfile.TemporaryDirectory()))


def make_devices(config: DeviceConfig, rig: Rig, stack: ExitStack) -> Devices:
    """Build the devices of a collection.

    Args:
        config: Which.
        rig: Where everything is.
        stack: Ends what has to be started for them.

    Returns:
        The devices, not connected.

    Raises:
        ValueError: A third party's device, an object or a pad cannot be used, a third party's skin does not say where
            its chips are, or a skin sends other values than its board has.
        DeviceError: A driver is not installed.
    """
    context = DeviceContext(config, rig, stack)
    arm = context.arm = make_arm(config.arm, context)
    skin = make_skin(config.skin, context)
    camera = make_camera(config.camera, context)
    board = Board(*(np.asarray(part) for part in _board(config.skin, skin, context)))
    _require_values(skin, board)
    carried = tuple(
        _carried_skin(place, device, context, number + 1) for number, (place, device) in enumerate(config.carried)
    )
    return Devices(arm, skin, camera, context.clock, board, carried=carried)


def _carried_skin(place: CarriedSkin, config: SkinConfig, context: DeviceContext, number: int) -> SkinOnTool:
    """A further skin, not connected."""
    if isinstance(config, SimulatedSkinConfig):
        from i2t.emulators.in_process import SimulatedSkin

        skin: Skin = SimulatedSkin(context.carried_lab(place, number, emulated=False))
    elif isinstance(config, EmulatedSkinConfig):
        if isinstance(context.config.arm, SimulatedArmConfig):
            context.carried_lab(place, number, emulated=True)
        else:
            _ = context.emulated_lab  # it is started with the lab
        skin = make_skin(ReSkinConfig(context.carried_boards[place.name][0], place.board), context)
    else:
        skin = make_skin(config, context)
    board = getattr(skin, "board", None) or boards.make_board(place.board)
    board = Board(*(np.asarray(part) for part in board))
    _require_values(skin, board)
    return SkinOnTool(place.name, skin, board, place.T_tool_skin, pad=place.pad or place.name)


def _require_values(skin: Skin, board: Board) -> None:
    """Refuse a skin that sends other values than its board has."""
    values = len(skin.features.channels)
    if values != board.num_readings:
        raise ValueError(
            f"{skin.features.name} sends {values} values, and a board of {board.num_chips} chips has "
            f"{board.num_readings}; give the skin an attribute board with its own chips"
        )


def _board(config: SkinConfig, skin: Skin, context: DeviceContext) -> Board:
    """Board of a skin."""
    if isinstance(config, SimulatedSkinConfig):
        return context.scene.board
    if isinstance(config, ReSkinConfig | ReplayConfig | EmulatedSkinConfig):
        return boards.make_board(config.board)
    board: Board | None = getattr(skin, "board", None)
    if board is None:
        raise ValueError(
            f"--skin {config.name}: does not say where its chips are; give it an attribute board, such as "
            "i2t.skin.boards.reskin_board(), or grid_board() for chips in a square"
        )
    return board


def source_of(devices: Devices) -> str:
    """Source of touches that a data set states for devices.

    Args:
        devices: Connected.

    Returns:
        real, simulated or mixed.
    """
    own = [device.features.source for device in (devices.arm, devices.skin, devices.camera)]
    carried = [each.skin.features.source for each in devices.carried]
    sources = {"real" if source in ("real", "folder") else "simulated" for source in own + carried}
    return sources.pop() if len(sources) == 1 else "mixed"


# Arms


@singledispatch
def make_arm(config: ArmConfig, context: DeviceContext) -> GuardedArm:
    """An arm by its configuration.

    Args:
        config: Which.
        context: What the devices share.

    Returns:
        The arm, not connected.

    Raises:
        ValueError: A third party's arm cannot be used.
        DeviceError: Its driver is not installed.
    """
    raise TypeError(f"{type(config).__name__} is no configuration of an arm")


@make_arm.register
def _(config: UrConfig, context: DeviceContext) -> GuardedArm:
    return make_ur_arm(config, context.rig)


@make_arm.register
def _(config: EmulatedArmConfig, context: DeviceContext) -> GuardedArm:
    host = config.host or context.emulated_lab[0]
    return make_ur_arm(UrConfig(host, config.state_timeout, config.watchdog_rate), context.rig)


@make_arm.register
def _(config: SimulatedArmConfig, context: DeviceContext) -> GuardedArm:
    from i2t.emulators.in_process import SimulatedArm

    return SimulatedArm(context.simulated_lab, context.rig.limits)


@make_arm.register
def _(config: PluginConfig, context: DeviceContext) -> GuardedArm:
    return load_plugin("arm", config, DeviceSetup(context.rig, config.address))


def stall_watch_s(config: ArmConfig) -> float | None:
    """Time (s) after which an arm whose computer stalls stops by itself.

    Args:
        config: Of the arm.

    Returns:
        s; None where only the arm itself knows.
    """
    return 1 / config.watchdog_rate if isinstance(config, UrConfig | EmulatedArmConfig) else None


# Skins


@singledispatch
def make_skin(config: SkinConfig, context: DeviceContext) -> Skin:
    """A skin by its configuration.

    Args:
        config: Which.
        context: What the devices share.

    Returns:
        The skin, not connected.

    Raises:
        ValueError: A third party's skin cannot be used.
        DeviceError: Its driver is not installed.
    """
    raise TypeError(f"{type(config).__name__} is no configuration of a skin")


@make_skin.register
def _(config: ReSkinConfig, context: DeviceContext) -> Skin:
    from i2t.hardware.reskin.driver import ReSkin

    chips = boards.make_board(config.board).num_chips
    return ReSkin(config.port, chips=chips, serial_number=config.serial_number)


@make_skin.register
def _(config: ReplayConfig, context: DeviceContext) -> Skin:
    from i2t.hardware.reskin.driver import Replay

    return Replay(config.file, chips=boards.make_board(config.board).num_chips)


@make_skin.register
def _(config: EmulatedSkinConfig, context: DeviceContext) -> Skin:
    if isinstance(context.config.arm, SimulatedArmConfig):
        port, _ = context.emulated_board  # it shows what that arm feels
    else:
        port = config.port or context.emulated_lab[1]
    return make_skin(ReSkinConfig(port, config.board), context)


@make_skin.register
def _(config: SimulatedSkinConfig, context: DeviceContext) -> Skin:
    from i2t.emulators.in_process import SimulatedSkin

    return SimulatedSkin(context.simulated_lab)


@make_skin.register
def _(config: PluginConfig, context: DeviceContext) -> Skin:
    return load_plugin("skin", config, DeviceSetup(context.rig, config.address, context.arm))


# Cameras, of which the type cannot be asked before they are connected: only then is a lens known


@singledispatch
def make_camera(config: CameraConfig, context: DeviceContext) -> Any:
    """A camera by its configuration.

    Args:
        config: Which.
        context: What the devices share, with the arm.

    Returns:
        The camera, not connected.

    Raises:
        ValueError: A third party's camera cannot be used.
        DeviceError: Its driver is not installed.
    """
    raise TypeError(f"{type(config).__name__} is no configuration of a camera")


@make_camera.register
def _(config: RealSenseConfig, context: DeviceContext) -> Any:
    from i2t.hardware.realsense import RealSense

    lens = context.rig.camera
    return RealSense(config.serial, (lens.width, lens.height), distance=context.rig.looking_distance)


@make_camera.register
def _(config: CameraFolderConfig, context: DeviceContext) -> Any:
    from i2t.hardware.camera_folder import RecordedDepthCamera

    return RecordedDepthCamera(config.folder, loop=True)


@make_camera.register
def _(config: SimulatedCameraConfig, context: DeviceContext) -> Any:
    from i2t.emulators.in_process import SimulatedCamera

    arm, rig = context.arm, context.rig
    assert arm is not None
    lens = rig.camera
    return SimulatedCamera(
        context.scene,
        replace(lens, model=Distortion.NONE, coefficients=()),
        rig.T_tool_camera,
        lambda: arm.state().T_b_t,
        context.clock,
        seed=context.config.world.seed,
    )


@make_camera.register
def _(config: PluginConfig, context: DeviceContext) -> Any:
    return load_plugin("camera", config, DeviceSetup(context.rig, config.address, context.arm))
