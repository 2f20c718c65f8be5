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

from i2t.collect.arguments import ArmArgs, CameraArgs, CollectArgs, SkinArgs
from i2t.collect.checks import SKINS
from i2t.collect.touch import TOOL, SkinOnTool
from i2t.depth.camera import Distortion
from i2t.emulators.world import WorldConfig, carried_scene, make_scene, read_pad
from i2t.hardware.carried_skins import CarriedSkin
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.named_devices import named_arm, named_camera, require_named
from i2t.hardware.plugins import DeviceSetup, is_plugin, load_plugin
from i2t.hardware.protocols import DepthCamera, GuardedArm, Skin
from i2t.hardware.rig import Rig
from i2t.skin.boards import DEFAULT_BOARD, board_note, make_board
from i2t.types import Board

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


def make_devices(args: CollectArgs, rig: Rig, stack: ExitStack, *, begin: float = 0.0) -> Devices:
    """Build the devices of a collection.

    Args:
        args: Which; options of each device are checked (`i2t.collect.checks`).
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
    skins = {TOOL: args.skin} | {place.name: _carried_args(place) for place in rig.skins}
    for name, named in skins.items():
        _require_together(args.arm, named, f"skins.{name}.device" if name else "--skin")
    lab = _Lab(args, skins, rig, stack, begin)
    arm = _make_arm(args.arm, lab)
    pad, note = args.pad_name or _pad_name(args.skin, args.world.pad), board_note(args.skin.board or DEFAULT_BOARD)
    made = [SkinOnTool(TOOL, *_make_skin(args.skin, TOOL, 0, lab, arm), pad=pad, note=note)]
    for number, place in enumerate(rig.skins, start=1):
        skin, board = _make_skin(skins[place.name], place.name, number, lab, arm)
        pad, note = place.pad or place.name, board_note(place.board)
        made.append(SkinOnTool(place.name, skin, board, place.T_tool_skin, pad, note))
    return Devices(arm, tuple(made), _make_camera(args.camera, lab, arm), lab.clock)


def _carried_args(place: CarriedSkin) -> SkinArgs:
    """Arguments of a further skin, as the rig has them."""
    if place.device not in SKINS.split(", ") and not is_plugin("skin", place.device):
        raise ValueError(
            f"skins.{place.name}.device is {place.device!r}; give one of {SKINS}, a name that an installed package "
            "registers, or package.module:Class"
        )
    return SkinArgs(place.device, place.address or None, place.serial_number or None, place.board)


def _require_together(arm: ArmArgs, skin: SkinArgs, whose: str) -> None:
    """Refuse a skin that feels nothing of what this arm does."""
    if skin.kind == "simulated" and arm.kind != "simulated":
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


def _pad_name(skin: SkinArgs, pad: Path | None) -> str:
    """Name of the skin that presses, in a data set, where none is given."""
    if skin.kind not in ("simulated", "emulated"):
        return "skin"
    return f"simulated, {pad.stem}" if pad else "simulated pad 0"


class _Lab:
    """World of simulated and emulated devices; each part is made when it is first asked for."""

    def __init__(self, args: CollectArgs, skins: dict[str, SkinArgs], rig: Rig, stack: ExitStack, begin: float) -> None:
        self.args, self.skins, self.rig, self.stack, self.begin = args, skins, rig, stack, begin
        board = {"simulated": args.skin.board, "emulated": args.skin.board or DEFAULT_BOARD}.get(args.skin.kind)
        self.world = WorldConfig(**vars(args.world), board=board)

    @cached_property
    def clock(self) -> Clock:
        """Clock: virtual where only simulated devices take part, else this machine's."""
        if {self.args.arm.kind, *(skin.kind for skin in self.skins.values())} == {"simulated"}:
            from i2t.emulators.in_process import VirtualClock

            return VirtualClock(max(time.time(), self.begin))
        return MonotonicClock()

    @cached_property
    def scene(self) -> "ObjectScene":
        """Scene that simulated devices meet."""
        return make_scene(self.world, self.rig)

    @cached_property
    def simulated(self) -> "SimulatedLab":
        """Lab of the simulated arm and skins."""
        from i2t.emulators.in_process import SimulatedLab

        return SimulatedLab(self.scene, self.clock, seed=self.world.seed)

    def simulated_skin(self, name: str, number: int) -> Skin:
        """A skin of the simulated arm; a further one (its number is from 1) has a pad of its own."""
        from i2t.emulators.in_process import CarriedSkinLab, SimulatedSkin

        if name == TOOL:
            return SimulatedSkin(self.simulated)
        place = self.rig.skins[number - 1]
        scene = carried_scene(self.world, self.rig, place.board, number)
        return SimulatedSkin(CarriedSkinLab(self.simulated, scene, place.T_tool_skin, seed=self.world.seed + number))

    @cached_property
    def emulated(self) -> tuple[str, dict[str, str]]:
        """The controller's address, and the skins' ports by their names, of an emulated lab that is started."""
        from i2t.emulators import lab, reskin_board, ur_controller

        world = self.world
        if world.pad:
            read_pad(world.pad, world.board)  # one that is on another board is refused before a process starts
        folder = Path(self.stack.enter_context(tempfile.TemporaryDirectory()))
        self.rig.write(folder / "rig.toml")
        host, link = ur_controller.loopback(EMULATED_ADDRESS), folder / "skin"
        ports, carried = {TOOL: str(link)}, []
        for name, skin in self.skins.items():
            if name != TOOL and skin.kind == "emulated":
                named = ("--link", str(folder / f"skin-{name}"), "--board", str(skin.board))
                port, process = self.stack.enter_context(reskin_board.started(*reskin_board.SHOWS_FIELDS, *named))
                heard_on, at = lab.board_address(process)
                ports[name] = port
                carried += ["--carried", name, f"{heard_on}:{at}"]
        options = ["--host", host, "--link", str(link), "--object", world.object]
        options += ["--unit", world.unit] if world.unit else []
        options += ["--seed", str(world.seed), "--rig", str(folder / "rig.toml"), "--mount", str(world.stiffness)]
        options += ["--pad", str(world.pad)] if world.pad else []
        options += ["--no-pose-error"] if world.no_pose_error else []
        started = lab.started(*options, *carried, "--board", "--board", world.board or DEFAULT_BOARD)
        self.stack.enter_context(started)
        return host, ports


def _make_arm(args: ArmArgs, lab: _Lab) -> GuardedArm:
    """An arm, not connected."""
    require_named("arm", args.kind, "ur, simulated, emulated")
    if args.kind == "simulated":
        from i2t.emulators.in_process import SimulatedArm

        return SimulatedArm(lab.simulated, lab.rig.limits)
    given = {"state_timeout": args.state_timeout, "watchdog_rate": args.watchdog_rate}
    watch = {name: value for name, value in given.items() if value is not None}
    if args.kind == "emulated":
        return named_arm("ur", args.host or lab.emulated[0], lab.rig, **watch)
    return named_arm(args.kind, args.host, lab.rig, **watch)


def _make_skin(args: SkinArgs, name: str, number: int, lab: _Lab, arm: GuardedArm) -> tuple[Skin, Board]:
    """A skin, not connected, and its board. A further skin has a name, and a number from 1."""
    require_named("skin", args.kind, SKINS)
    chips = make_board(args.board or DEFAULT_BOARD).num_chips
    skin: Skin
    if args.kind == "simulated":
        skin = lab.simulated_skin(name, number)
    elif args.kind in ("reskin", "emulated"):
        from i2t.hardware.reskin.driver import ReSkin

        port = args.port or lab.emulated[1][name] if args.kind == "emulated" else args.port
        skin = ReSkin(port, chips=chips, serial_number=args.skin_serial)
    else:
        if args.board and name == TOOL:
            raise ValueError(
                f"--board {args.board} means nothing to --skin {args.kind}, which knows its own; leave it out"
            )
        skin = load_plugin("skin", args.kind, DeviceSetup(lab.rig, args.port, arm))
        if name == TOOL and getattr(skin, "board", None) is None:
            raise ValueError(
                f"--skin {args.kind}: does not say where its chips are; give it an attribute board, such as "
                "i2t.skin.boards.reskin_board(), or grid_board() for chips in a square"
            )
    own: Board | None = getattr(skin, "board", None)
    board = Board(*(np.asarray(part) for part in own or make_board(args.board or DEFAULT_BOARD)))
    values = len(skin.features.channels)
    if values != board.num_readings:
        raise ValueError(
            f"{skin.features.name} sends {values} values, and a board of {board.num_chips} chips has "
            f"{board.num_readings}; give the skin an attribute board with its own chips"
        )
    return skin, board


def _make_camera(args: CameraArgs, lab: _Lab, arm: GuardedArm) -> Any:
    """A camera, not connected; its type cannot be asked before it is: only then is a lens known."""
    require_named("camera", args.kind, "realsense, simulated")
    if args.kind == "simulated":
        from i2t.emulators.in_process import SimulatedCamera

        return SimulatedCamera(
            lab.scene,
            replace(lab.rig.camera, model=Distortion.NONE, coefficients=()),
            lab.rig.T_tool_camera,
            lambda: arm.state().T_b_t,
            lab.clock,
            seed=lab.world.seed,
        )
    return named_camera(args.kind, args.camera_serial, lab.rig, arm)
