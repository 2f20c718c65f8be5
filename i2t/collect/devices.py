"""Arm, skins and camera of a collection, real, emulated, simulated or a third party's, from their arguments and a rig.

Emulated devices are the real drivers with emulators (`i2t.emulators.lab`) in processes of their own; where no address
is given, they are started. Simulated devices share a lab (`i2t.emulators.in_process`); where only simulated devices
take part, its time is virtual and nobody waits for it. Drivers are imported only where they are asked for.
"""

import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from i2t.collect.arguments import NOT_REAL, SIMULATED, SKINS, ArmArgs, CameraArgs, CollectArgs, SkinArgs
from i2t.collect.touch import TOOL, SkinOnTool
from i2t.depth.camera import Distortion
from i2t.emulators.world import make_scene, read_pad
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.plugins import DeviceSetup, load_plugin, named_arm, named_camera, require_named
from i2t.hardware.protocols import DepthCamera, GuardedArm, Skin
from i2t.hardware.rig import Rig
from i2t.skin.boards import DEFAULT_BOARD, board_note, make_board
from i2t.types import Array, Board

if TYPE_CHECKING:
    from i2t.emulators.in_process import SimulatedLab
    from i2t.emulators.scene import ObjectScene

EMULATED_ADDRESS = 200  # of the loopback network, at which an emulated controller is started


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


class WantedSkin(NamedTuple):
    """A skin that the command line asks for, or a table of the rig."""

    number: int  # 0 for the one at the tool
    name: str
    args: SkinArgs
    pad: str  # its name in the data set
    T_tool_skin: Array

    @property
    def option(self) -> str:
        """What names it."""
        return f"skins.{self.name}.device" if self.number else "--skin"


def wanted_skins(args: CollectArgs, rig: Rig) -> list[WantedSkin]:
    """The skins of a collection.

    Args:
        args: As on the command line.
        rig: With the further skins of the tool.

    Returns:
        First the one that presses.
    """
    pad = "skin"
    if args.skin.kind in NOT_REAL:
        pad = f"simulated, {args.world.pad.stem}" if args.world.pad else "simulated pad 0"
    wanted = [WantedSkin(0, TOOL, args.skin, args.pad_name or pad, np.eye(4))]
    for number, place in enumerate(rig.skins, start=1):
        own = SkinArgs(place.device, place.address or None, place.serial_number or None, place.board)
        wanted.append(WantedSkin(number, place.name, own, place.pad or place.name, place.T_tool_skin))
    return wanted


def require_together(args: CollectArgs, rig: Rig) -> None:
    """Refuse devices that are not known, or do not go together, before any of them is made.

    Args:
        args: As on the command line.
        rig: With the further skins of the tool.

    Raises:
        ValueError: The message names the flag, or the field of the rig.
    """
    require_named("arm", args.arm.kind, "ur, simulated, emulated")
    require_named("camera", args.camera.kind, "realsense, simulated")
    for each in wanted_skins(args, rig):
        _require_feeling(args.arm, each)


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
    lab = _Lab(args, rig, stack, begin)
    arm = _make_arm(args.arm, lab)
    skins = tuple(_make_skin(each, lab, arm) for each in lab.wanted)
    return Devices(arm, skins, _make_camera(args.camera, lab, arm), lab.clock)


def _require_feeling(arm: ArmArgs, wanted: WantedSkin) -> None:
    """Refuse a skin that is not known, or feels nothing of what this arm does."""
    skin, whose = wanted.args, wanted.option
    require_named("skin", skin.kind, SKINS, whose)
    if skin.kind == SIMULATED and arm.kind != SIMULATED:
        raise ValueError(
            f"{whose} is simulated, and a simulated skin feels only what a simulated arm does; make it emulated, or "
            "reskin"
        )
    if skin.kind == "emulated" and arm.kind != "emulated":
        raise ValueError(f"{whose} is emulated, and feels nothing on this arm; make it reskin, or pass --arm emulated")
    if skin.kind == "emulated" and bool(arm.host) != bool(skin.port):
        raise ValueError(
            f"{whose} is emulated, and emulators that run already have a --host and a port; give both, or neither"
        )


class _Lab:
    """World of simulated and emulated devices; each part is made when it is first asked for."""

    def __init__(self, args: CollectArgs, rig: Rig, stack: ExitStack, begin: float) -> None:
        self.args, self.rig, self.stack, self.begin = args, rig, stack, begin
        self.wanted = wanted_skins(args, rig)

    @cached_property
    def clock(self) -> Clock:
        """Clock: virtual where only simulated devices take part, else this machine's."""
        if {self.args.arm.kind, *(each.args.kind for each in self.wanted)} == {SIMULATED}:
            from i2t.emulators.in_process import VirtualClock

            return VirtualClock(max(time.time(), self.begin))
        return MonotonicClock()

    @cached_property
    def scene(self) -> "ObjectScene":
        """Scene that simulated devices meet."""
        skin = self.args.skin
        board = {SIMULATED: skin.board, "emulated": skin.board or DEFAULT_BOARD}.get(skin.kind)
        return make_scene(self.args.world, self.rig, board)

    @cached_property
    def simulated(self) -> "SimulatedLab":
        """Lab of the simulated arm and skins."""
        from i2t.emulators.in_process import SimulatedLab

        return SimulatedLab(self.scene, self.clock, seed=self.args.world.seed)

    def simulated_skin(self, wanted: WantedSkin) -> Skin:
        """A skin of the simulated arm; a further one has a pad of its own."""
        from i2t.emulators.in_process import SimulatedSkin, SkinInLab

        if not wanted.number:
            return SimulatedSkin(self.simulated)
        world, number = self.args.world, wanted.number
        scene = make_scene(world, self.rig, wanted.args.board, number)
        further = SkinInLab(scene, wanted.T_tool_skin, world.seed + number)
        return SimulatedSkin(self.simulated, self.simulated.carry(further))

    @cached_property
    def emulated(self) -> tuple[str, Path]:
        """The controller's address, and the folder with the skins' ports by their numbers, of a lab that is started."""
        from i2t.emulators import lab, ur_controller

        world, board = self.args.world, self.args.skin.board or DEFAULT_BOARD
        if world.pad:
            read_pad(world.pad, board)  # one that is on another board is refused before a process starts
        folder = Path(self.stack.enter_context(tempfile.TemporaryDirectory()))
        self.rig.write(folder / "rig.toml")
        host = ur_controller.loopback(EMULATED_ADDRESS)
        options = ["--host", host, "--rig", str(folder / "rig.toml"), "--link", str(folder / "0"), "--board", board]
        for each in self.wanted[1:]:
            if each.args.kind == "emulated":
                options += ["--carried", each.name, str(folder / str(each.number))]
        for name, value in vars(world).items():
            if value not in (None, False):
                options += [f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])]
        self.stack.enter_context(lab.started(*options))
        return host, folder


def _make_arm(args: ArmArgs, lab: _Lab) -> GuardedArm:
    """An arm, not connected."""
    if args.kind == SIMULATED:
        from i2t.emulators.in_process import SimulatedArm

        return SimulatedArm(lab.simulated, lab.rig.limits)
    given = {"state_timeout": args.state_timeout, "watchdog_rate": args.watchdog_rate}
    watch = {name: value for name, value in given.items() if value is not None}
    if args.kind == "emulated":
        return named_arm("ur", args.host or lab.emulated[0], lab.rig, **watch)
    return named_arm(args.kind, args.host, lab.rig, **watch)


def _make_skin(wanted: WantedSkin, lab: _Lab, arm: GuardedArm) -> SkinOnTool:
    """A skin, not connected, with its board."""
    args = wanted.args
    named = make_board(args.board or DEFAULT_BOARD)
    skin: Skin
    if args.kind == SIMULATED:
        skin = lab.simulated_skin(wanted)
    elif args.kind in ("reskin", "emulated"):
        from i2t.hardware.reskin.driver import ReSkin

        started = args.kind == "emulated" and not args.port
        port = str(lab.emulated[1] / str(wanted.number)) if started else args.port
        skin = ReSkin(port, chips=named.num_chips, serial_number=args.skin_serial)
    else:
        if args.board and not wanted.number:
            raise ValueError(
                f"--board {args.board} means nothing to --skin {args.kind}, which knows its own; leave it out"
            )
        skin = load_plugin("skin", args.kind, DeviceSetup(lab.rig, args.port, arm))
        if not wanted.number and getattr(skin, "board", None) is None:
            raise ValueError(
                f"--skin {args.kind}: does not say where its chips are; give it an attribute board, such as "
                "i2t.skin.boards.reskin_board(), or grid_board() for chips in a square"
            )
    board = Board(*(np.asarray(part) for part in getattr(skin, "board", None) or named))
    values = len(skin.features.channels)
    if values != board.num_readings:
        raise ValueError(
            f"{skin.features.name} sends {values} values, and a board of {board.num_chips} chips has "
            f"{board.num_readings}; give the skin an attribute board with its own chips"
        )
    note = board_note(args.board or DEFAULT_BOARD)
    return SkinOnTool(wanted.name, skin, board, wanted.T_tool_skin, wanted.pad, note)


def _make_camera(args: CameraArgs, lab: _Lab, arm: GuardedArm) -> Any:
    """A camera, not connected; its type cannot be asked before it is: only then is a lens known."""
    if args.kind == SIMULATED:
        from i2t.emulators.in_process import SimulatedCamera

        return SimulatedCamera(
            lab.scene,
            replace(lab.rig.camera, model=Distortion.NONE, coefficients=()),
            lab.rig.T_tool_camera,
            lambda: arm.state().T_b_t,
            lab.clock,
            seed=lab.args.world.seed,
        )
    return named_camera(args.kind, args.camera_serial, lab.rig, arm)
