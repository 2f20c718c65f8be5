"""Arm, skins and camera of a collection, whoever's they are, from their arguments and a rig."""

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
    """Devices that have not been connected, and the clock that they share."""

    arm: GuardedArm
    skins: tuple[SkinOnTool, ...]  # first the one that presses
    camera: DepthCamera
    clock: Clock

    @property
    def source(self) -> str:
        """Source of touches that a data set states: real, simulated or mixed."""
        sources = [self.arm.features.source, self.camera.features.source]
        sources += [each.skin.features.source for each in self.skins]
        stated = {"real" if source == "real" else "simulated" for source in sources}
        return stated.pop() if len(stated) == 1 else "mixed"


def wanted_skins(args: CollectArgs, rig: Rig) -> list[CarriedSkin]:
    """The skins of a collection.

    Args:
        args: As on the command line, which names the skin at the tool.
        rig: With the further skins of the tool.

    Returns:
        First the one that presses; each with its name in the data set as its pad.
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
    return [pressing, *(replace(each, pad=each.pad or each.name) for each in rig.skins)]


def require_together(args: CollectArgs, rig: Rig) -> None:
    """Refuse skins that are not known, or feel nothing of what the arm does, before any device is made.

    Args:
        args: As on the command line.
        rig: With the further skins of the tool.

    Raises:
        ValueError: The message names the flag, or the field of the rig.
    """
    for each in wanted_skins(args, rig):
        plugin = find_plugin("skin", each.device, _option(each))
        if plugin.arms and args.arm.kind not in plugin.arms:
            raise ValueError(
                f"{_option(each)} is {each.device}, and feels nothing on this arm; pass --arm "
                f"{' or '.join(plugin.arms)}, or another skin"
            )
        if plugin.address_follows_arm and bool(args.arm.host) != bool(each.address):
            raise ValueError(
                f"{_option(each)} is {each.device}, and emulators that run already have a --host and a port; give "
                "both, or neither"
            )


def make_devices(args: CollectArgs, rig: Rig, stack: ExitStack, *, begin: float = 0.0) -> Devices:
    """Build the devices of a collection.

    Args:
        args: Which; options of each device are checked (`CollectArgs.check`).
        rig: Where everything is, with the further skins of the tool.
        stack: Ends what has to be started for them.
        begin: Unix time (s) at which virtual time may begin.

    Returns:
        The devices, not connected.

    Raises:
        ValueError: A name is not known, devices do not go together, a third party's device, an object or a pad cannot
            be used, or a skin does not say where its chips are.
        DeviceError: A driver is not installed.
    """
    require_together(args, rig)
    wanted = wanted_skins(args, rig)
    plugins = [find_plugin("arm", args.arm.kind), find_plugin("camera", args.camera.kind)]
    plugins += [find_plugin("skin", each.device, _option(each)) for each in wanted]
    clocks = {each.make_clock for each in plugins}
    clock = clocks.pop()(begin) if len(clocks) == 1 else MonotonicClock()
    setup = DeviceSetup(rig, board=args.skin.board, world=args.world, clock=clock, stack=stack)
    arm = load_device("arm", args.arm.kind, replace(setup, address=args.arm.host, watch=args.arm.watch))
    setup = replace(setup, arm=arm)
    skins = tuple(_make_skin(each, setup) for each in wanted)
    camera = load_device("camera", args.camera.kind, replace(setup, address=args.camera.camera_serial))
    return Devices(arm, skins, camera, clock)


def _option(skin: CarriedSkin) -> str:
    """What names a skin."""
    return "--skin" if skin.name == TOOL else f"skins.{skin.name}.device"


def _make_skin(wanted: CarriedSkin, setup: DeviceSetup) -> SkinOnTool:
    """A skin, not connected, with its board."""
    own = replace(setup, skin=wanted, address=wanted.address or None, board=wanted.board or None)
    skin = load_device("skin", wanted.device, own, _option(wanted))
    board = getattr(skin, "board", None) or (None if wanted.name == TOOL else make_board(wanted.board))
    if board is None:
        raise ValueError(
            f"{_option(wanted)} {wanted.device}: does not say where its chips are; give it an attribute board, such as "
            "i2t.skin.boards.reskin_board(), or grid_board() for chips in a square"
        )
    board, values = Board(*(np.asarray(part) for part in board)), len(skin.features.channels)
    if values != board.num_readings:
        raise ValueError(
            f"{skin.features.name} sends {values} values, and a board of {board.num_chips} chips has "
            f"{board.num_readings}; give the skin an attribute board with its own chips"
        )
    note = board_note(wanted.board or DEFAULT_BOARD)
    return SkinOnTool(wanted.name, skin, board, wanted.T_tool_skin, wanted.pad, note)
