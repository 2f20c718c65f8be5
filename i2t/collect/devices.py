"""Construction of the arm, skins and camera of a collection from its arguments and a rig."""

from contextlib import ExitStack
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from i2t.collect.arguments import CollectArgs
from i2t.collect.touch import TOOL, SkinOnTool
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.plugins import DeviceSetup, find_plugin, load_device
from i2t.hardware.protocols import DepthCamera, GuardedArm
from i2t.hardware.rig import Rig
from i2t.skin.boards import DEFAULT_BOARD, board_note, make_board
from i2t.types import Board


class Devices(NamedTuple):
    """Arm with its safety limits, skins on the tool and camera, not connected yet, and their common clock."""

    arm: GuardedArm
    skins: tuple[SkinOnTool, ...]  # skins on the tool; the first is the pressing skin
    camera: DepthCamera
    clock: Clock

    @property
    def source(self) -> str:
        """Source of the touches for the data set: real, simulated or mixed."""
        sources = [self.arm.features.source, self.camera.features.source]
        sources += [on_tool.skin.features.source for on_tool in self.skins]
        stated = {"real" if source == "real" else "simulated" for source in sources}
        return stated.pop() if len(stated) == 1 else "mixed"


def configured_skins(args: CollectArgs, rig: Rig) -> list[CarriedSkin]:
    """List the skins on the tool in a collection.

    Args:
        args: Arguments as on the command line, which name the pressing skin.
        rig: The rig, with the further skins of the tool.

    Returns:
        The pressing skin, followed by the further ones. The pad of each is its name in the data set.
    """
    skin, pad = args.skin, "skin"
    if "pad" in find_plugin("skin", skin.kind).takes:
        pad = f"simulated, {args.world.pad.stem}" if args.world.pad else "simulated pad 0"
    pressing = CarriedSkin(
        TOOL,
        skin.kind,
        board=skin.board or "",
        address=skin.port or "",
        serial_number=skin.skin_serial or "",
        pad=args.pad_name or pad,
    )
    return [pressing, *(replace(further, pad=further.pad or further.name) for further in rig.skins)]


def require_compatible(args: CollectArgs, rig: Rig) -> None:
    """Refuse unknown skins, and skins that do not work with the chosen arm, before any device is made.

    Args:
        args: Arguments as on the command line.
        rig: The rig, with the further skins of the tool.

    Raises:
        ValueError: If a skin cannot be used with the arm; the message names the flag, or the field of the rig.
    """
    for skin in configured_skins(args, rig):
        plugin = find_plugin("skin", skin.device, _option(skin))
        if plugin.arms and args.arm.kind not in plugin.arms:
            raise ValueError(
                f"{_option(skin)} is {skin.device}, which does not work with this arm; pass --arm "
                f"{' or '.join(plugin.arms)}, or another skin"
            )
        if plugin.address_follows_arm and bool(args.arm.host) != bool(skin.address):
            raise ValueError(
                f"{_option(skin)} {skin.device}: a running emulator needs both --host and a port; give both, or "
                "neither to start one"
            )


def make_devices(args: CollectArgs, rig: Rig, stack: ExitStack, *, begin: float = 0.0) -> Devices:
    """Build the arm, skins, camera and clock of a collection.

    Args:
        args: Arguments whose options were checked (`CollectArgs.check`).
        rig: The rig, with the further skins of the tool.
        stack: Exit stack that ends the processes that are started for the devices.
        begin: Unix time (s) at which virtual time may begin.

    Returns:
        The devices, not connected.

    Raises:
        ValueError: If a name is unknown, devices contradict each other, a third party's device, an object or a pad
            cannot be used, or a skin does not state the positions of its chips.
        DeviceError: If a driver is not installed.
    """
    require_compatible(args, rig)
    wanted = configured_skins(args, rig)
    plugins = [find_plugin("arm", args.arm.kind), find_plugin("camera", args.camera.kind)]
    plugins += [find_plugin("skin", skin.device, _option(skin)) for skin in wanted]
    clocks = {plugin.make_clock for plugin in plugins}
    clock = clocks.pop()(begin) if len(clocks) == 1 else MonotonicClock()
    setup = DeviceSetup(rig, board=args.skin.board, world=args.world, clock=clock, stack=stack)
    arm = load_device("arm", args.arm.kind, replace(setup, address=args.arm.host, watch=args.arm.watch))
    setup = replace(setup, arm=arm)
    skins = tuple(_make_skin(skin, setup) for skin in wanted)
    camera = load_device("camera", args.camera.kind, replace(setup, address=args.camera.camera_serial))
    return Devices(arm, skins, camera, clock)


def _option(skin: CarriedSkin) -> str:
    """Return the flag or the field of the rig that names a skin."""
    return "--skin" if skin.name == TOOL else f"skins.{skin.name}.device"


def _make_skin(wanted: CarriedSkin, setup: DeviceSetup) -> SkinOnTool:
    """Make a skin with its board, without connecting it."""
    own = replace(setup, skin=wanted, address=wanted.address or None, board=wanted.board or None)
    skin = load_device("skin", wanted.device, own, _option(wanted))
    board = getattr(skin, "board", None) or (None if wanted.name == TOOL else make_board(wanted.board))
    if board is None:
        raise ValueError(
            f"{_option(wanted)} {wanted.device}: has no positions of its chips; give it an attribute board, such as "
            "i2t.skin.boards.reskin_board(), or grid_board() for chips in a square"
        )
    board, values = Board(*(np.asarray(part) for part in board)), len(skin.features.channels)
    if values != board.num_readings:
        raise ValueError(
            f"{skin.features.name} sends {values} values, but a board of {board.num_chips} chips has "
            f"{board.num_readings}; give the skin an attribute board with its own chips"
        )
    note = board_note(wanted.board or DEFAULT_BOARD)
    return SkinOnTool(wanted.name, skin, board, wanted.T_tool_skin, wanted.pad, note)
