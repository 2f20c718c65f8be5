"""An emulated arm and the emulated skin that it wears, so that a press of the one is felt by the other.

    python -m i2t.stand_ins.pair --link /tmp/skin --host 127.0.0.9 --mesh star --pad-seed 3
    python -m i2t.hardware.reskin --port /tmp/skin

Two processes with the interfaces of real devices: a UR controller's ports and a board's serial port. At each of its
ticks (500 Hz) the controller sends what the skin feels to the board, over UDP on this machine; the board shows the
newest with its own ambient field, noise and steps in its next frame (400 Hz). So a reading is at most some 5 ms late
on a machine with time to spare. Options that are not the pair's own go to the controller, those after `--` to the
board.
"""

import argparse
import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from i2t.stand_ins import reskin_board, ur_controller


class Pair(NamedTuple):
    """Where the two are."""

    host: str  # of the controller
    port: str  # of the board
    controller: subprocess.Popen[str]
    board: subprocess.Popen[str]


@contextlib.contextmanager
def started(host: str, arm: Sequence[str] = (), skin: Sequence[str] = ()) -> Iterator[Pair]:
    """Both, with further options for each, from when they are ready until the block is left; both end with the
    program that started them. Raises RuntimeError where one does not start.
    """
    with reskin_board.started("--field", *skin) as (port, board):
        assert board.stdout is not None
        _, address = board.stdout.readline().split()
        with ur_controller.process(host, "--skin", address, "--tethered", *arm) as controller:
            yield Pair(host, port, controller, board)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        "python -m i2t.stand_ins.pair", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--host", default="127.0.0.9", help="address of the controller (default %(default)s)")
    parser.add_argument("--link", help="name of the board's port")
    given = sys.argv[1:] if arguments is None else arguments
    own, skin = (given[: given.index("--")], given[given.index("--") + 1 :]) if "--" in given else (given, [])
    asked, arm = parser.parse_known_args(own)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        with started(asked.host, arm, [*(["--link", asked.link] if asked.link else []), *skin]) as pair:
            print(f"simulated UR controller on {pair.host}, its skin on {pair.port}, ready", flush=True)
            while pair.controller.poll() is None and pair.board.poll() is None:
                time.sleep(0.2)
    except KeyboardInterrupt:
        return 0
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 2
    print("one of the two has ended", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
