"""An emulated lab in its own processes: a UR controller whose tool touches an object, and the boards of its skins.

    i2t lab --host 127.0.0.9 --link /tmp/skin --object hexagon
    i2t collect --arm emulated --host 127.0.0.9 --skin emulated --port /tmp/skin --object hexagon

The lab is the controller of `i2t.emulators.ur_controller`, with its faults on demand. It starts a board of
`i2t.emulators.reskin_board` for each skin. The pose of the object is that in the rig's file. The force, its centre and
the readings follow from i2t's own contact mechanics. They are computed along the tool's z axis once the tool has stood
still for some ticks, which takes hundredths of a second, longer than the 2 ms of a tick; a motion waits for it. The
reading of a skin goes to its board over UDP on this machine whenever it changes, at each tick of 2 ms. The board sends
the newest one, with ambient field, noise and steps, in its next frame, 2.5 ms after the last. A reading is therefore
about 5 ms late if the machine is not busy. `i2t collect --arm emulated --skin emulated` starts its own lab.
"""

import subprocess
import sys
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import require_path
from i2t.emulators import processes, reskin_board, ur_controller
from i2t.emulators.world import make_scene
from i2t.hardware.rig import Rig
from i2t.hardware.world import WorldArgs
from i2t.objects.named import require_object
from i2t.skin.boards import DEFAULT_BOARD, make_board

if TYPE_CHECKING:
    from i2t.emulators.scene import ToolContactModel

run_lab = partial(processes.run_emulator, "i2t.emulators.lab")  # takes options; yields a line and the process


@dataclass(frozen=True, kw_only=True)
class EmulatedLabArgs(ur_controller.ControllerArgs):
    """Emulate a UR controller whose tool touches an object, and the boards of its skins, as separate programs."""

    link: Path  # symbolic link to create as the name of the skin's port
    board: str = DEFAULT_BOARD  # board of the skin: reskin, anyskin, eflesh, grid-RxC, or a board file (.toml)
    rig: Path | None = None  # the lab's calibration file, with the pose of the object; by default, the emulated lab's
    carried: Annotated[tyro.conf.UseAppendAction[tuple[tuple[str, Path], ...]], tyro.conf.arg(metavar="NAME LINK")] = ()
    """Name of a further skin in the rig, and the symbolic link to create as the name of its port."""
    world: Annotated[WorldArgs, tyro.conf.OmitArgPrefixes] = field(default_factory=WorldArgs)
    plane: tyro.conf.Suppress[tuple[float, float]] = (0.0, 0.0)  # replaced by the object


def _run(args: EmulatedLabArgs) -> None:
    """Run until SIGTERM or Ctrl-C, or until the standard input of a tethered lab ends."""
    _check(args)
    with ExitStack() as stack:
        contacts = _contacts(args, Rig() if args.rig is None else Rig.read(args.rig), stack)
        ur_controller.run(args, contacts, contacts.models[0].scene.errors.force)


def _check(args: EmulatedLabArgs) -> None:
    """Refuse missing files and unknown objects before any process starts."""
    require_object(args.world.object, args.world.unit, flag="--object")
    require_path("--rig", args.rig, "file")
    require_path("--pad", args.world.pad, "file")
    make_board(args.board)
    if args.link.exists() and not args.link.is_symlink():
        raise ValueError(f"--link {args.link}: exists and is not a link; give another name")


def _contacts(args: EmulatedLabArgs, rig: Rig, stack: ExitStack) -> "ToolContactModel":
    """Make the contact of each skin, within some seconds in which everything is compiled.

    The pad must be on the skin's board, which could not send the readings of another.
    """
    from i2t.emulators.scene import SkinContactModel, ToolContactModel

    def model(number: int, link: Path, board: str) -> SkinContactModel:
        scene = make_scene(args.world, rig, board, number)
        scene.line_ahead(rig.T_base_world @ rig.T_world_object)  # compiled before a motion waits for it
        named = ("--link", str(link), "--board", board)
        _, process = stack.enter_context(reskin_board.run_board("--field", *named))
        T_tool_skin = rig.skins[number - 1].T_tool_skin if number else None
        return SkinContactModel(scene, wait=False, T_tool_skin=T_tool_skin, to=_board_address(process))

    links, names = dict(args.carried), [place.name for place in rig.skins]
    unknown = set(links) - set(names)
    if unknown:
        raise ValueError(f"the rig has no skin {', '.join(sorted(unknown))}; correct --carried")
    carried = [model(names.index(name) + 1, link, rig.skins[names.index(name)].board) for name, link in links.items()]
    return ToolContactModel([model(0, args.link, args.board), *carried])


def _board_address(process: "subprocess.Popen[str]") -> processes.Address:
    """Read the address of a board that was started with `--field` from the next line that it prints."""
    assert process.stdout is not None
    host, port = process.stdout.readline().split()[1].rsplit(":", 1)
    return host, int(port)


main = command(EmulatedLabArgs, _run, program="python -m i2t.emulators.lab", description=__doc__)

if __name__ == "__main__":
    sys.exit(main())
