"""An emulated Universal Robots controller in its own process, to which the real ur_rtde client can connect.

    python -m i2t.emulators.ur_controller --host 127.0.0.9

The emulator opens the ports that the client uses (30004 RTDE, 29999 dashboard, 30003 script) and acts like the script
that the client uploads: commands and results pass through registers. A tool without arm or joints moves in real time,
in straight lines with a trapezoidal speed profile. Joint values are therefore zero, and the tool has the reported pose,
whatever the TCP. Each address 127.0.0.x is a separate robot.

The tool can press a horizontal plane, which yields like a spring (`--plane`), or an object in `i2t.emulators.lab`. A
command takes effect at the next tick of 2 ms.

Faults on demand. A fourth port, 30100, receives a command as one line and answers with one line, for instance
`echo protective | nc -q1 127.0.0.9 30100`:

    protective            protective stop; the dashboard's "unlock protective stop" releases it
    stall | resume        RTDE packets stop while connections stay open | and are sent again
    stall-control         only packets to the connections that write registers stop, until "resume"
    forge NAME NUMBERS    send these numbers as the output NAME, even nan or inf; "forge" alone ends this
    mute                  every port still accepts connections, but answers nothing more
    drop-control          the connections that write registers are closed; new ones are accepted
    drop-state            the connections that only listen are closed; new ones are accepted
    kill-program          the running program ends at once, as when someone presses stop on the pendant
    local | remote        control is refused (local mode, scripts are ignored) | and accepted again
    wrench X Y Z A B C    a constant force (N) and torque (Nm) on the tool, in base axes, added to the plane's
    plane Z STIFFNESS     move the plane: height in metres, newtons per metre; stiffness 0 removes it
    tcp X Y Z RX RY RZ    the TCP on the pendant (m, rotation vector), with which a program begins
    speed FRACTION        the speed slider on the pendant
    status                a JSON object: pose, twist, program, number of uploads, commands received, maximum speed so
                          far, and times of the tool's last motion and of the client's last message (s, controller's
                          clock)

Sources: Universal Robots' RTDE guide, dashboard server and URScript manuals (watchdog: `rtde_set_watchdog` with the
action "stop"); the register handshake was observed from ur_rtde 1.6.5. The stopping distance, the lever by which
rotation counts as path, and the delays of a real controller are not modelled on measurements. The commands that i2t's
driver sends are emulated: asynchronous straight lines, stopping, payload, tool, zeroing and watchdog. Any other ends
the program with a message.
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
from typing import Annotated

import numpy as np
import tyro

from i2t.cli.options import read_options
from i2t.cli.signals import ended_by_ctrl_c
from i2t.emulators.processes import run_emulator
from i2t.emulators.robot_motion import Contact, Robot, plane
from i2t.emulators.ur_program import PLAYING as PLAYING
from i2t.emulators.ur_program import STOPPED as STOPPED
from i2t.emulators.ur_program import TICK as TICK
from i2t.emulators.ur_program import Controller
from i2t.emulators.ur_server import FAULT_PORT, Server

PoseVector = tuple[float, float, float, float, float, float]  # position (m) and rotation vector (rad)


def loopback(number: int) -> str:
    """Return an address for an emulated controller that no other process of this machine uses.

    Args:
        number: Number of the controller within this process, one of 250.

    Returns:
        An address 127.x.y.z of this machine.
    """
    pid = os.getpid()
    return f"127.{pid // 250 % 250 + 1}.{pid % 250 + 1}.{number % 250 + 1}"


@contextlib.contextmanager
def process(host: str, *options: str) -> Iterator["subprocess.Popen[str]"]:
    """Run an emulated UR controller as a child process, as in `i2t.emulators.processes.run_emulator`.

    Args:
        host: Address to listen on.
        options: Options of the emulator's command line.

    Yields:
        The process of the emulator.
    """
    with run_emulator("i2t.emulators.ur_controller", "--host", host, *options) as (_, running):
        yield running


def ask(host: str, line: str) -> str:
    """Ask a running emulated controller for a fault or its status, through its fault port.

    Args:
        host: Address of the emulator.
        line: A fault as in the docstring of this module, or "status".

    Returns:
        The emulator's answer, one line.
    """
    with socket.create_connection((host, FAULT_PORT), 5.0) as connection, connection.makefile("rw") as lines:
        lines.write(line + "\n")
        lines.flush()
        return lines.readline().strip()


@dataclass(frozen=True, kw_only=True)
class ControllerArgs:
    """Emulate a UR controller, to which a real driver can connect."""

    host: str = "127.0.0.9"  # address to listen on
    pose: Annotated[PoseVector, tyro.conf.arg(metavar="X Y Z RX RY RZ")] = (0.4, 0.0, 0.3, np.pi, 0.0, 0.0)
    """Pose of the tool at the start: position (m) and rotation vector (rad). By default, the tool points down."""
    plane: Annotated[tuple[float, float], tyro.conf.arg(metavar="Z STIFFNESS")] = (0.0, 0.0)
    """Height (m) and stiffness (N/m) of a plane that the tool can press; stiffness 0 removes the plane."""
    # standard deviation (N) of the force sensor per axis; by default, 0, and 0.1 in an emulated lab
    noise: float | None = None
    tethered: bool = False  # exit when standard input closes


def main(arguments: Sequence[str] | None = None) -> None:
    """Run an emulated UR controller by its command line until SIGTERM or Ctrl-C, or the end of a tethered one's input.

    Args:
        arguments: Arguments without the program's name; by default, those of `sys.argv`.
    """
    program = "python -m i2t.emulators.ur_controller"
    options = read_options(ControllerArgs, arguments, program=program, description=__doc__)
    run(options, plane(*options.plane), 0.0)


def run(options: ControllerArgs, contact: Contact, noise: float) -> None:
    """Run an emulated UR controller until SIGTERM or Ctrl-C, or until the standard input of a tethered one ends.

    Args:
        options: Properties of the controller.
        contact: Function that computes the wrench of contact on the tool, as for `Robot`.
        noise: Noise (N) of the force sensor if the options state none.

    Raises:
        SystemExit: If the controller cannot start; the message gives the reason.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    robot = Robot(np.array(options.pose), contact, noise if options.noise is None else options.noise)
    server = Server(Controller(robot), options.host, options.tethered)
    try:
        with ended_by_ctrl_c():
            asyncio.run(server.run(lambda: print(f"emulated UR controller on {options.host}, ready", flush=True)))
    except (OSError, ValueError) as error:
        sys.exit(f"The emulator cannot start on {options.host}: {error}.")


if __name__ == "__main__":
    main()
