"""A lab to rehearse in, as processes of their own: a UR controller whose tool meets an object, and a skin that feels.

    python -m i2t.stand_ins.rehearsal --host 127.0.0.9 --link /tmp/skin --object hexagon
    python -m i2t.collect --arm emulated --host 127.0.0.9 --skin emulated --port /tmp/skin --object hexagon

The controller is that of `i2t.stand_ins.ur_controller`, faults on demand included; instead of a plane it meets an
object on a table through the physics of `i2t.stand_ins.scene`, and sends what its skin feels to a board of
`i2t.stand_ins.reskin_board`, which adds noise and sends it on as bytes. Options after `--board` go to the board.
`python -m i2t.collect --arm emulated --skin emulated` starts one by itself.
"""

import argparse
import contextlib
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from i2t.stand_ins import reskin_board
from i2t.stand_ins.motion import Robot
from i2t.stand_ins.scene import Feeler, Met
from i2t.stand_ins.simulated import HOME
from i2t.stand_ins.ur_controller import Controller, Server
from i2t.types import READINGS, Array


class Wired(Feeler):
    """A feeler that tells a board what it feels, by datagrams."""

    def __init__(self, scene: Met, to: tuple[str, int], wait: bool = False) -> None:
        super().__init__(scene, wait)
        self._to, self._told = to, np.zeros(READINGS)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def __call__(self, position: Array, turned: Array) -> Array:
        """Wrench (6,) on the tool at a pose, base axes."""
        wrench = super().__call__(position, turned)
        if not np.array_equal(self.reading, self._told):
            with contextlib.suppress(OSError):
                self._socket.sendto(struct.pack(f"<{READINGS}f", *self.reading), self._to)
                self._told = self.reading
        return wrench


def address(process: "subprocess.Popen[str]") -> tuple[str, int]:
    """Where a board that was started with `--field` listens; it is the next line that it prints."""
    assert process.stdout is not None
    host, port = process.stdout.readline().split()[1].rsplit(":", 1)
    return host, int(port)


@contextlib.contextmanager
def started(*options: str) -> Iterator["subprocess.Popen[str]"]:
    """A rehearsal beside this process, from when it is ready until the block is left or this process dies."""
    command = [sys.executable, "-m", "i2t.stand_ins.rehearsal", "--tethered", *options]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if "ready" not in process.stdout.readline():
                raise RuntimeError(f"the rehearsal did not start: {' '.join(options)}")
            yield process
        finally:
            process.terminate()
            process.wait()


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    from i2t import wiring

    parser = argparse.ArgumentParser("python -m i2t.stand_ins.rehearsal", description=__doc__.split("\n\n")[0])
    parser.add_argument("--host", default="127.0.0.9", help="address of the controller (default %(default)s)")
    parser.add_argument("--link", type=Path, required=True, help="name of the skin's port")
    parser.add_argument("--object", default="hexagon", help="of the catalogue, or a mesh file")
    parser.add_argument("--unit", default="mm", help="of a mesh file")
    parser.add_argument("--rig", type=Path, help="where everything is (i2t.hardware.rig)")
    parser.add_argument("--pad", type=Path, help="a pad on disk; by default a random one")
    parser.add_argument("--stiffness", type=float, default=10e3, help="of arm and mount, N/m (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the errors")
    parser.add_argument("--exact", action="store_true", help="the object is where it is believed to be")
    parser.add_argument("--tethered", action="store_true", help="end when standard input closes")
    parser.add_argument("--board", nargs=argparse.REMAINDER, default=[], help="options of the board, to the end")
    args = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        rig = wiring.read_rig(args.rig)
        scene = wiring.scene_of(args.object, args.unit, rig, args.pad, args.seed, args.exact, args.stiffness)
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    scene.ahead(rig.T_base_world @ rig.T_world_object)  # compiled before anybody waits for it
    if args.tethered:
        threading.Thread(target=_wait_for_the_end, daemon=True).start()
    with reskin_board.started("--field", "--link", str(args.link), *args.board) as (port, process):
        feeler = Wired(scene, address(process))
        robot = Robot(np.array(HOME), feeler, np.zeros(6), scene.errors.force)
        try:
            server = Server(Controller(robot, 5.0, 150.0), args.host, [])
        except OSError as error:
            sys.exit(f"The rehearsal cannot start on {args.host}: {error}.")
        print(f"simulated lab with {args.object}: UR on {args.host}, skin on {port}, ready", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.run()


def _wait_for_the_end() -> None:
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
