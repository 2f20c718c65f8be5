"""An emulated lab, in processes of its own: a UR controller whose tool meets an object, and a skin that feels.

    python -m i2t.emulators.lab --host 127.0.0.9 --link /tmp/skin --object hexagon
    python -m i2t.collect --arm emulated --host 127.0.0.9 --skin emulated --port /tmp/skin --object hexagon

It starts a board of `i2t.emulators.reskin_board` and is itself the controller of `i2t.emulators.ur_controller`, whose
options it takes, faults on demand included; those after `--board` go to the board. What the skin feels goes to the
board over UDP on this machine whenever it changes, at each tick of 2 ms; the board shows the newest with ambient field,
noise and steps in its next frame, 2.5 ms after the last. So a reading is some 5 ms late on a machine with time to
spare. `python -m i2t.collect --arm emulated --skin emulated` starts one by itself.
"""

import argparse
import contextlib
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from i2t.emulators import reskin_board, ur_controller


def board_address(process: "subprocess.Popen[str]") -> tuple[str, int]:
    """Where a board that was started with `--field` listens.

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
    """An emulated lab next to this process, from when it is ready until the block is left or this process dies.

    Args:
        *options: Of the command line.

    Yields:
        Its process.

    Raises:
        RuntimeError: It does not start.
    """
    command = [sys.executable, "-m", "i2t.emulators.lab", "--tethered", *options]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if "ready" not in process.stdout.readline():
                raise RuntimeError(f"the emulated lab did not start: {' '.join(options)}")
            yield process
        finally:
            process.terminate()
            process.wait()


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        "python -m i2t.emulators.lab",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="Further options are those of python -m i2t.emulators.ur_controller.",
    )
    parser.add_argument("--link", type=Path, required=True, help="name of the skin's port")
    parser.add_argument("--object", default="hexagon", help="of the catalogue, or a mesh file")
    parser.add_argument("--board", nargs=argparse.REMAINDER, default=[], help="options of the board, to the end")
    args, further = parser.parse_known_args(arguments)
    with reskin_board.started("--field", "--link", str(args.link), *args.board) as (_, process):
        told = "{}:{}".format(*board_address(process))
        ur_controller.main(["--object", args.object, "--skin", told, *further])


if __name__ == "__main__":
    main()
