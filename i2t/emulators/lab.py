"""An emulated lab, in processes of its own: a UR controller whose tool meets an object, and a skin that feels.

    python -m i2t.emulators.lab --host 127.0.0.9 --link /tmp/skin --object hexagon
    python -m i2t.collect --arm emulated --host 127.0.0.9 --skin emulated --port /tmp/skin --object hexagon

It starts a board of `i2t.emulators.reskin_board` and is itself the controller of `i2t.emulators.ur_controller`, whose
options it takes, faults on demand included; those after `--board` go to the board, as in `--board --board grid-2x2`
for a skin of four chips. What the skin feels goes to the
board over UDP on this machine whenever it changes, at each tick of 2 ms; the board shows the newest with ambient field,
noise and steps in its next frame, 2.5 ms after the last. So a reading is some 5 ms late on a machine with time to
spare. `python -m i2t.collect --arm emulated --skin emulated` starts one by itself.
"""

import contextlib
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from i2t.cli import exit_code_of, read_options, require_path
from i2t.emulators import processes, reskin_board, ur_controller
from i2t.objects.named import require_object
from i2t.skin.boards import make_board

PROGRAM = "python -m i2t.emulators.lab"


def board_address(process: "subprocess.Popen[str]") -> tuple[str, int]:
    """Address at which a board that was started with `--field` listens.

    Args:
        process: Of the board; this is the next line that it prints.

    Returns:
        Address and port.
    """
    assert process.stdout is not None
    host, port = process.stdout.readline().split()[1].rsplit(":", 1)
    return host, int(port)


@contextlib.contextmanager
def started(*options: str) -> Iterator["subprocess.Popen[str]"]:
    """Run an emulated lab next to this process, as in `i2t.emulators.processes.started`.

    Args:
        *options: Of the command line.

    Yields:
        Its process.
    """
    with processes.started("i2t.emulators.lab", *options) as (_, process):
        yield process


@dataclass(frozen=True, kw_only=True)
class LabArgs(ur_controller.ControllerArgs):
    """An emulated lab; what follows `--board` are options of its board."""

    link: Path  # name of the skin's port
    object: str | None = "hexagon"  # of the catalogue, or a mesh file
    skin: tyro.conf.Suppress[str | None] = None  # the board, which is started here
    board: tyro.conf.Suppress[str | None] = None  # whose name is among its own options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line until SIGTERM or Ctrl-C, or until the standard input of a tethered lab ends.

    Args:
        arguments: Without the program's name; by default those of this process.

    Returns:
        The exit code.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    end = words.index("--board") if "--board" in words else len(words)
    args = read_options(LabArgs, words[:end], program=PROGRAM, description=__doc__)
    options = words[end + 1 :]
    board = read_options(reskin_board.EmulatedBoardArgs, options, program=f"{PROGRAM} --board").board

    def work() -> None:
        _check(args, board)
        with reskin_board.started(*reskin_board.SHOWS_FIELDS, "--link", str(args.link), *options) as (_, process):
            # The skin that is worn must be on that board: any other would send it what it cannot show.
            ur_controller.run(replace(args, skin="{}:{}".format(*board_address(process)), board=board))

    return exit_code_of(work)


def _check(args: LabArgs, board: str) -> None:
    """Refuse missing files and unknown objects before any process starts."""
    if args.object is not None:
        require_object(args.object, args.unit, flag="--object")
    require_path("--rig", args.rig, "file")
    require_path("--pad", args.pad, "file")
    make_board(board)
    if args.link.exists() and not args.link.is_symlink():
        raise ValueError(f"--link {args.link}: exists and is no link; give another name")


if __name__ == "__main__":
    sys.exit(main())
