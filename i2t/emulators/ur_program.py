"""Program of a UR controller: the script that ur_rtde uploads, and the effects of the safety system on it.

Commands and results pass through registers: input_int_0 holds a command. output_int_0 is 1 (ready) or 2 (done), and
returns to ready once the client has written 0. `i2t.emulators.ur_controller` describes what is emulated.
"""

import logging
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np

from i2t.emulators import rtde_protocol
from i2t.emulators.robot_motion import Robot

log = logging.getLogger(__name__)

TICK = 0.002  # s, period of the emulated controller
STOPPED, PLAYING, PAUSED = 1, 2, 4  # values of RTDE's runtime_state


class Handshake(IntEnum):
    """Values that the robot's program writes to RTDE output_int_0: ready for a command, or done with one."""

    READY = 1
    DONE = 2


class Command(IntEnum):
    """Commands to the robot's program: values that the client ur_rtde 1.6.5 writes to RTDE input_int_0."""

    MOVE_L = 3
    ZERO_FT_SENSOR = 8
    SET_PAYLOAD = 17
    SET_TCP = 29
    STOP_L = 33
    SET_WATCHDOG = 35
    GET_TCP_OFFSET = 40
    STOP_SCRIPT = 255


class Controller:
    """Emulation of the ur_rtde program that runs on a UR controller, and of the safety system's effects on it.

    Args:
        robot: The simulated robot tool that the program moves.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.clock = 0.0  # s
        self.heard_clock = 0.0  # s, when the client was last heard
        self.moving_clock = 0.0  # s, when the tool last moved
        self.runtime, self.protective, self.local = STOPPED, False, False
        registers = 48  # of each kind
        self.in_ints, self.in_doubles = [0] * registers, [0.0] * registers
        self.out_ints, self.out_doubles = [0] * registers, [0.0] * registers
        self.watchdog: float | None = None  # s, timeout
        # Whether a motion is under way, its number, and the number of state changes.
        self.asynchronous, self.operation, self.changes = False, 0, 0
        # The pendant's TCP is the one with which a program begins.
        self.payload, self.tcp_offset, self.pendant_tcp = 0.0, [0.0] * 6, [0.0] * 6
        self.commands: list[int] = []
        self.uploads = 0
        self.outputs: dict[str, rtde_protocol.Value] = {}  # computed since the last `observe`
        self.forged: dict[str, rtde_protocol.Value] = {}  # sent instead of the true values

    def upload(self) -> None:
        """Start the client's program, ending any running one; ignored in local mode and in a protective stop."""
        if self.local or self.protective:
            return
        self.uploads += 1
        self.tcp_offset = list(self.pendant_tcp)
        self.robot.stop()
        self.runtime, self.watchdog = PLAYING, None
        self.out_ints[:2] = [Handshake.READY, 0]
        self._set_asynchronous(False)

    def kill(self) -> None:
        """End the program on the controller without a message to the client; the robot slows down."""
        self.robot.stop()
        self.runtime, self.watchdog = STOPPED, None

    def protective_stop(self) -> None:
        """Trigger a protective stop: brake the robot with 10 m/s^2 and pause the program."""
        self.robot.stop(deceleration=10.0)
        self.protective = True
        self.runtime = PAUSED if self.runtime == PLAYING else self.runtime

    def unlock(self) -> None:
        """Release the protective stop. The program has to be started again."""
        self.protective, self.runtime = False, STOPPED

    def write(self, values: Mapping[str, rtde_protocol.Value]) -> None:
        """Take values that the client writes to input registers. Writing input_int_0, even with 0, resets the watchdog.

        A speed slider in the values is ignored: it is left to the pendant, as the driver leaves it.

        Args:
            values: Values by the RTDE names of the inputs.
        """
        for name, value in values.items():
            kind, _, index = name.rpartition("_")
            number: Any = value
            if kind == "input_int_register":
                self.in_ints[int(index)] = int(number)
                self.heard_clock = self.clock if index == "0" else self.heard_clock
            elif kind == "input_double_register":
                self.in_doubles[int(index)] = float(number)

    def step(self) -> None:
        """Advance robot, program and safety system, which stops the robot above 150 N, by a tick of 2 ms."""
        self.clock += TICK
        if not getattr(self.robot.contact, "busy", False):  # a motion waits for the contact ahead of it
            self.robot.step(TICK)
        if self.robot.motion is not None:
            self.moving_clock = self.clock
        force = np.linalg.norm(self.robot.wrench()[:3])
        if not self.protective and not force <= 150.0:  # N
            self.protective_stop()
        if self.asynchronous and self.robot.motion is None:
            self._set_asynchronous(False)
        if self.runtime == PLAYING and not self.protective:
            if self.watchdog is not None and self.clock - self.heard_clock > self.watchdog:
                self.kill()
            else:
                self._run_program()

    def _run_program(self) -> None:
        """Run one cycle of the script's loop: wait for a command, execute it, report that it is done."""
        command, state = self.in_ints[0], self.out_ints[0]
        if state == Handshake.DONE and command == 0:
            self.out_ints[0] = Handshake.READY
        elif state == Handshake.READY and command != 0:
            self.commands.append(command)
            try:
                self._execute(command)
                self.out_ints[0] = Handshake.DONE
            except (ArithmeticError, ValueError) as error:  # a runtime error ends the program on a real controller
                log.warning("command %s: %s: the program ends", command, error)
                self.kill()

    def _execute(self, command: int) -> None:
        """Execute a command; raise ValueError for one that is not emulated."""
        d, robot = self.in_doubles, self.robot
        if command in (Command.MOVE_L, Command.STOP_L) and not self.in_ints[1]:
            raise ValueError("only asynchronous motions are emulated")
        match command:
            case Command.MOVE_L:
                robot.line_to(np.array(d[:6]), d[6], d[7])
                self._set_asynchronous(True)
            case Command.STOP_L:
                robot.stop(d[0])
            case Command.SET_WATCHDOG:
                self.watchdog, self.heard_clock = 1 / d[0], self.clock
            case Command.ZERO_FT_SENSOR:
                robot.zero_wrench()
            case Command.SET_PAYLOAD:
                self.payload = d[0]
            case Command.SET_TCP:
                self.tcp_offset = d[:6]
            case Command.GET_TCP_OFFSET:
                self.out_doubles[:6] = self.tcp_offset
            case Command.STOP_SCRIPT:
                self.kill()
            case _:
                raise ValueError("is not emulated")

    def _set_asynchronous(self, running: bool) -> None:
        """Report in output_int_2 whether an asynchronous motion is under way, and which."""
        modulus = 128
        if running:
            self.operation = (self.operation + 1) % modulus
        self.asynchronous, self.changes = running, (self.changes + 1) % modulus
        self.out_ints[2] = self.operation << 24 | self.changes << 16 | running << 15

    def output(self, name: str) -> rtde_protocol.Value:
        """Return the value of an RTDE output, the same to every client until the next `observe`, or a register's value.

        Args:
            name: RTDE name of the output.

        Returns:
            The number or numbers of the output.
        """
        kind, _, index = name.rpartition("_")
        if kind == "output_int_register":
            return self.out_ints[int(index)]
        if kind == "output_double_register":
            return self.out_doubles[int(index)]
        if name in self.forged:
            return self.forged[name]
        if name not in self.outputs:
            self.outputs[name] = self._output(name)
        return self.outputs[name]

    def observe(self) -> None:
        """Discard the last tick's outputs; each output of this tick is computed when a client first receives it."""
        self.outputs = {}

    def _output(self, name: str) -> rtde_protocol.Value:
        """Compute an RTDE output that is not a register."""
        robot = self.robot
        match name:
            case "timestamp":
                return self.clock
            case "actual_q":
                return (0.0,) * 6
            case "actual_TCP_pose":
                return tuple(robot.pose)
            case "actual_TCP_speed":
                return tuple(robot.twist)
            case "actual_TCP_force":
                return tuple(robot.measured_wrench())
            case "safety_status_bits":
                return 0x4 if self.protective else 0x1
            case "robot_status_bits":
                return 0x1 | 0x2 * (self.runtime == PLAYING)
            case "runtime_state":
                return self.runtime
            case "target_speed_fraction":
                return robot.speed_fraction
        raise KeyError(name)

    def status(self) -> dict[str, Any]:
        """Return the emulator's state (pose, program, commands, ...) for tests, whatever clients see; times in s."""
        robot = self.robot
        return {
            "clock": self.clock,
            "pose": robot.pose.tolist(),
            "twist": robot.twist.tolist(),
            "moving": robot.motion is not None,
            "stood": self.moving_clock,
            "heard": self.heard_clock,
            "fastest": robot.max_speed,
            "runtime": self.runtime,
            "watchdog": self.watchdog,
            "payload": self.payload,
            "commands": self.commands,
            "uploads": self.uploads,
        }
