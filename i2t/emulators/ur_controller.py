"""An emulated Universal Robots controller, as a process of its own, that the real ur_rtde client accepts.

    python -m i2t.emulators.ur_controller --host 127.0.0.9

It opens the ports the client uses (30004 RTDE, 29999 dashboard, 30003 script) and does what the script would do that
the client uploads: commands and results pass through registers. A tool without arm or joints moves in time, in straight
lines with a trapezoidal speed profile. Joint values are therefore zero, and the tool is where the controller says,
whatever TCP it is given. Any 127.0.0.x is a robot of its own.

The tool meets a springy horizontal plane (`--plane`, `--stiffness`), or an object:

    python -m i2t.emulators.ur_controller --object star --rig lab.toml

`--object` is a name of `i2t.objects.catalogue` or a mesh file, which stands where the rig's file says; force, its
centre and what the skin would read come from i2t's own contact mechanics, worked out along the tool's z axis once it
has stood for some ticks (hundredths of a second of computing, next to the 500 Hz; a motion waits for it). With `--skin
HOST:PORT` that reading goes to an emulated board: `i2t.emulators.lab` starts both. A command takes effect at the next
tick of 2 ms.

Faults on demand. A fourth port, 30100, takes a line and answers one, for instance
`echo protective | nc -q1 127.0.0.9 30100`:

    protective            protective stop; the dashboard's "unlock protective stop" releases it after --unlock-delay
    stall | resume        RTDE packets stop, connections stay open | and come again
    mute                  every port still connects, and answers nothing more
    drop-control          the connections that write registers are closed, and can be made again
    drop-state            the connections that only listen are closed, and can be made again
    kill-program          the running program ends at once, as when someone presses stop on the pendant
    local | remote        control is refused: local mode, scripts are ignored | and allowed again
    wrench X Y Z A B C    a constant force (N) and torque (Nm) on the tool, base axes, besides the plane's
    plane Z STIFFNESS     move the plane: height in metres, newtons per metre; stiffness 0 removes it
    tcp X Y Z RX RY RZ    the TCP on the pendant (m, rotation vector), with which a program begins
    speed FRACTION        the speed slider on the pendant
    status                a JSON object: pose, twist, force, program, how often it was
                          uploaded, commands taken, greatest speed so far, since when
                          the tool stands and when the client was heard last (s on the controller's clock)

Sources: Universal Robots' RTDE guide, dashboard server and URScript manuals (watchdog: `rtde_set_watchdog` with the
action "stop"); the register handshake was observed from ur_rtde 1.6.5. The stopping distance, the lever by which
rotation counts as path, and the delays of a real controller are not modelled on measurements. Of the client's commands
those that i2t's driver sends are emulated: asynchronous straight lines, stopping, payload, tool, zeroing and watchdog;
any other ends the program, and says so.
"""

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from i2t.cli import read_options
from i2t.emulators.processes import Address, started
from i2t.emulators.robot_motion import Contact, Robot, plane
from i2t.emulators.ur_program import PLAYING as PLAYING
from i2t.emulators.ur_program import STOPPED as STOPPED
from i2t.emulators.ur_program import TICK as TICK
from i2t.emulators.ur_program import Controller
from i2t.emulators.ur_server import FAULT_PORT, Server
from i2t.emulators.world import WorldConfig, make_contacts

PoseVector = tuple[float, float, float, float, float, float]  # position (m) and rotation vector (rad)
POINTING_DOWN: PoseVector = (0.4, 0.0, 0.3, np.pi, 0.0, 0.0)  # m, rad: the tool's pose at the start
ASK_TIMEOUT_S = 5.0


def loopback(number: int) -> str:
    """The address of a controller of this process's own.

    Args:
        number: Which, one of 250.

    Returns:
        An address 127.x.y.z of this machine.
    """
    pid = os.getpid()
    return f"127.{pid // 250 % 250 + 1}.{pid % 250 + 1}.{number % 250 + 1}"


@contextlib.contextmanager
def process(host: str, *options: str) -> Iterator["subprocess.Popen[str]"]:
    """Run an emulated controller next to this process, as in `i2t.emulators.processes.started`.

    Args:
        host: Address to listen on.
        options: Of its command line.

    Yields:
        Its process.
    """
    with started("i2t.emulators.ur_controller", "--host", host, *options) as (_, running):
        yield running


def ask(host: str, line: str) -> str:
    """Send a line to the fault port of a running emulator.

    Args:
        host: Its address.
        line: A fault, or "status".

    Returns:
        Its answer.
    """
    with socket.create_connection((host, FAULT_PORT), ASK_TIMEOUT_S) as connection, connection.makefile("rw") as lines:
        lines.write(line + "\n")
        lines.flush()
        return lines.readline().strip()


@dataclass(frozen=True, kw_only=True)
class ControllerArgs:
    """An emulated UR controller."""

    host: str = "127.0.0.9"  # address to listen on
    pose: Annotated[PoseVector, tyro.conf.arg(metavar="X Y Z RX RY RZ")] = POINTING_DOWN
    """The tool's pose at the start, metres and rotation vector."""
    plane: float = 0.0  # height of the plane in m
    stiffness: float = 0.0  # of the plane in N/m; 0: no plane
    noise: float | None = None  # of the force sensor, N, one sigma per axis; by default 0, with --object 0.1
    unlock_delay: float = 5.0  # s, before a protective stop can be released
    object: str | None = None  # what the tool touches: a name of the catalogue, or a mesh file
    unit: Literal["m", "cm", "mm", "inch"] | None = None  # of a mesh file, which does not say it itself
    rig: Path | None = None  # a lab's calibration, which says where the object is
    pad: Path | None = None  # the skin that the tool wears, on disk; by default a random one
    board: str | None = None  # that it is on: reskin, anyskin, or grid-RxC; by default the pad's own, else reskin
    seed: int = 0  # of the errors
    no_pose_error: bool = False  # the object is where it is believed to be
    mount: float = 10e3  # stiffness of arm and mount, N/m
    skin: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """An emulated board that shows what the skin feels."""
    carried: Annotated[
        tyro.conf.UseAppendAction[tuple[tuple[str, str], ...]], tyro.conf.arg(metavar="NAME HOST:PORT")
    ] = ()
    """An emulated board that shows what a further skin of the rig feels."""
    tethered: bool = False  # end when standard input closes


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line until SIGTERM or Ctrl-C, or until the standard input of a tethered controller ends.

    Args:
        arguments: Without the program's name; by default those of this process.
    """
    run(read_options(ControllerArgs, arguments, program="python -m i2t.emulators.ur_controller", description=__doc__))


def run(options: ControllerArgs) -> None:
    """Run a controller until SIGTERM or Ctrl-C, or until the standard input of a tethered controller ends.

    Args:
        options: What it is like.

    Raises:
        SystemExit: It cannot start; its message says why.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        contact, noise = _contact(options)
        controller = Controller(Robot(np.array(options.pose), contact, noise), options.unlock_delay)
        server = Server(controller, options.host, options.tethered)
        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(server.run(lambda: print(f"emulated UR controller on {options.host}, ready", flush=True)))
    except (OSError, ValueError) as error:
        sys.exit(f"The emulator cannot start on {options.host}: {error}.")


def _contact(options: ControllerArgs) -> tuple[Contact, float]:
    """Contact of the tool, and the noise of its force sensor (N)."""
    if options.object is None:
        return plane(options.plane, options.stiffness), options.noise or 0.0
    world = WorldConfig(
        options.object,
        options.unit,
        options.pad,
        seed=options.seed,
        no_pose_error=options.no_pose_error,
        stiffness=options.mount,
        board=options.board,
    )
    carried = {name: _address(text) for name, text in options.carried}
    contacts = make_contacts(world, options.rig, _address(options.skin) if options.skin else None, carried)
    return contacts, contacts.models[0].scene.errors.force if options.noise is None else options.noise


def _address(text: str) -> Address:
    host, port = text.rsplit(":", 1)
    return host, int(port)


if __name__ == "__main__":
    main()
