"""Configurations of a collection's devices, from the options of its command line and the tables of its rig."""

from pathlib import Path

from i2t.collect.arguments import ArmArgs, CameraArgs, SkinArgs, WorldArgs
from i2t.collect.devices import ArmConfig, CameraConfig, CarriedSkinConfig, DeviceConfig, SkinConfig
from i2t.emulators.world import (
    EmulatedArmConfig,
    EmulatedSkinConfig,
    SimulatedArmConfig,
    SimulatedCameraConfig,
    SimulatedSkinConfig,
    WorldConfig,
)
from i2t.hardware.camera_folder import CameraFolderConfig
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.named_devices import require_named
from i2t.hardware.plugins import DeviceKind, PluginConfig, is_plugin
from i2t.hardware.realsense import RealSenseConfig
from i2t.hardware.reskin.config import ReplayConfig, ReSkinConfig
from i2t.hardware.rig import Rig
from i2t.hardware.ur.config import UrConfig
from i2t.skin.boards import DEFAULT_BOARD


def device_config(
    arm: ArmArgs, skin: SkinArgs, camera: CameraArgs, world: WorldArgs, *, begin: float = 0.0, rig: Rig | None = None
) -> DeviceConfig:
    """Configurations of the devices that a command line and a rig name.

    Args:
        arm: As on the command line.
        skin: Likewise.
        camera: Likewise.
        world: Likewise.
        begin: Unix time (s) at which virtual time may begin.
        rig: The lab's calibration, with its further skins; by default there are none.

    Returns:
        The configurations.

    Raises:
        ValueError: A name is not known, or what it needs is missing.
    """
    meets = WorldConfig(
        world.object,
        world.unit,
        world.pad,
        seed=world.seed,
        no_pose_error=world.no_pose_error,
        stiffness=world.stiffness,
        board=skin.board if skin.kind in ("simulated", "emulated") else None,
    )
    carried = tuple(CarriedSkinConfig(place, _carried_config(place)) for place in (rig.skins if rig else ()))
    return DeviceConfig(_arm_config(arm), _skin_config(skin), _camera_config(camera), meets, begin, carried=carried)


def _arm_config(args: ArmArgs) -> ArmConfig:
    given = {"state_timeout": args.state_timeout, "watchdog_rate": args.watchdog_rate}
    watched = {name: value for name, value in given.items() if value is not None}
    match args.kind:
        case "simulated":
            return SimulatedArmConfig()
        case "emulated":
            return EmulatedArmConfig(args.host, **watched)
        case "ur" if args.host:
            return UrConfig(args.host, **watched)
        case "ur":
            raise ValueError("a UR arm needs the address of its controller; pass --host")
    return _plugin_config("arm", args.kind, args.host, "ur, simulated, emulated")


def _skin_config(args: SkinArgs) -> SkinConfig:
    board = args.board or DEFAULT_BOARD
    match args.kind:
        case "simulated":
            return SimulatedSkinConfig()
        case "emulated":
            return EmulatedSkinConfig(args.port, board)
        case "reskin":
            return ReSkinConfig(args.port, board, args.skin_serial)
        case "replay" if args.replay:
            return ReplayConfig(args.replay, board)
        case "replay":
            raise ValueError("a replay needs a recording; pass --replay FILE")
    config = _plugin_config("skin", args.kind, args.port, "reskin, simulated, emulated, replay")
    if args.board:
        raise ValueError(f"--board {args.board} means nothing to --skin {args.kind}, which knows its own; leave it out")
    return config


def _carried_config(place: CarriedSkin) -> SkinConfig:
    match place.device:
        case "simulated":
            return SimulatedSkinConfig()
        case "emulated":
            return EmulatedSkinConfig(None, place.board)
        case "reskin":
            return ReSkinConfig(place.address or None, place.board, place.serial_number or None)
        case "replay":
            return ReplayConfig(Path(place.address), place.board)
    if not is_plugin("skin", place.device):
        raise ValueError(
            f"skins.{place.name}.device is {place.device!r}; give one of reskin, simulated, emulated, replay, a name "
            "that an installed package registers, or package.module:Class"
        )
    return PluginConfig(place.device, place.address or None)


def _camera_config(args: CameraArgs) -> CameraConfig:
    match args.kind:
        case "simulated":
            return SimulatedCameraConfig()
        case "realsense":
            return RealSenseConfig(args.camera_serial)
        case "folder" if args.views:
            return CameraFolderConfig(args.views)
        case "folder":
            raise ValueError("a folder of views must be named; pass --views DIR")
    return _plugin_config("camera", args.kind, args.camera_serial, "realsense, simulated, folder")


def _plugin_config(kind: DeviceKind, name: str, address: str | None, built_in: str) -> PluginConfig:
    require_named(kind, name, built_in)
    return PluginConfig(name, address)
