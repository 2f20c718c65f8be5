"""Program of a UR controller: the script that ur_rtde uploads, and what the safety system does to it.

Commands and results pass through registers: input_int_0 holds a command, output_int_0 says ready (1) or done (2), and
goes back to ready once the client has written 0. `i2t.emulators.ur_controller` says what is emulated and what is not.
"""

import sys
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np

from i2t.emulators import rtde_protocol
from i2t.emulators.robot_motion import Robot

TICK = 0.002  # s
STOPPED, PLAYING, PAUSED = 1, 2, 4  # runtime state
READY, DONE = 1, 2  # output_int_0
REGISTERS = 48  # of each kind
COUNTER = 128  # at which the numbers of operations begin anew
PROTECTIVE_DECELERATION = 10.0  # m/s^2
FORCE_LIMIT_N = 150.0  # of a protective stop


class Command(IntEnum):
    """Values of input_int_0, as ur_rtde 1.6.5 writes them."""

    MOVE_L = 3
    ZERO_FT_SENSOR = 8
    SET_PAYLOAD = 17
    SET_TCP = 29
    STOP_L = 33
    SET_WATCHDOG = 35
    GET_TCP_OFFSET = 40
    STOP_SCRIPT = 255


class Controller:
    """The program that the client uploads, run on the robot, and what the safety system does to it.

    Args:
        robot: What moves.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.clock = 0.0  # s
        self.heard_clock = 0.0  # when the client was heard last
        self.moving_clock = 0.0  # when the tool moved last
        self.runtime, self.protective, self.local = STOPPED, False, False
        self.in_ints, self.in_doubles = [0] * REGISTERS, [0.0] * REGISTERS
        self.out_ints, self.out_doubles = [0] * REGISTERS, [0.0] * REGISTERS
        self.watchdog: float | None = None  # s
        self.asynchronous, self.operation, self.changes = False, 0, 0  # motion under way, its number, state changes
        self.payload, self.tcp_offset, self.pendant_tcp = 0.0, [0.0] * 6, [0.0] * 6  # the last: a program begins with
        self.commands: list[int] = []
        self.uploads = 0
        self.outputs: dict[str, rtde_protocol.Value] = {}
        self.forged: dict[str, rtde_protocol.Value] = {}  # sent in place of what is so

    def upload(self) -> None:
        """Start the client's program; whatever ran before ends."""
        if self.local or self.protective:
            return
        self.uploads += 1
        self.tcp_offset = list(self.pendant_tcp)
        self.robot.stop()
        self.runtime, self.watchdog = PLAYING, None
        self.out_ints[:2] = [READY, 0]
        self._set_asynchronous(False)

    def kill(self) -> None:
        """End the program without a word to the client; the robot slows down."""
        self.robot.stop()
        self.runtime, self.watchdog = STOPPED, None

    def protective_stop(self) -> None:
        """Brake and pause the program."""
        self.robot.stop(PROTECTIVE_DECELERATION)
        self.protective = True
        self.runtime = PAUSED if self.runtime == PLAYING else self.runtime

    def unlock(self) -> None:
        """Release the protective stop; the program has to be started again."""
        self.protective, self.runtime = False, STOPPED

    def write(self, values: Mapping[str, rtde_protocol.Value]) -> None:
        """Take registers from the client; a command, be it none, tells the watchdog that the client lives.

        The speed slider is left to the pendant, as the driver leaves it.

        Args:
            values: By the name of the input.
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
        """Advance robot, safety and program by a tick."""
        self.clock += TICK
        if not getattr(self.robot.contact, "busy", False):  # a motion waits until it is known what lies ahead
            self.robot.step(TICK)
        if self.robot.motion is not None:
            self.moving_clock = self.clock
        if not self.protective and not np.linalg.norm(self.robot.wrench()[:3]) <= FORCE_LIMIT_N:
            self.protective_stop()
        if self.asynchronous and self.robot.motion is None:
            self._set_asynchronous(False)
        if self.runtime == PLAYING and not self.protective:
            if self.watchdog is not None and self.clock - self.heard_clock > self.watchdog:
                self.kill()
            else:
                self._run_program()

    def _run_program(self) -> None:
        """One cycle of the script's loop: wait for a command, carry it out, say that it is done."""
        command, state = self.in_ints[0], self.out_ints[0]
        if state == DONE and command == 0:
            self.out_ints[0] = READY
        elif state == READY and command != 0:
            self.commands.append(command)
            try:
                self._execute(command)
                self.out_ints[0] = DONE
            except (ArithmeticError, ValueError) as error:  # as the controller ends a program at a runtime error
                print(f"command {command}: {error}: the program ends", file=sys.stderr, flush=True)
                self.kill()

    def _execute(self, command: int) -> None:
        """Carry out a command; raises ValueError for one that is not emulated."""
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
        """Say in output_int_2 whether an asynchronous motion is under way, and which."""
        if running:
            self.operation = (self.operation + 1) % COUNTER
        self.asynchronous, self.changes = running, (self.changes + 1) % COUNTER
        self.out_ints[2] = self.operation << 24 | self.changes << 16 | running << 15

    def output(self, name: str) -> rtde_protocol.Value:
        """The value of an output at the last `observe`; registers as they are now.

        Args:
            name: Of the output.

        Returns:
            Its value.
        """
        kind, _, index = name.rpartition("_")
        if kind == "output_int_register":
            return self.out_ints[int(index)]
        if kind == "output_double_register":
            return self.out_doubles[int(index)]
        return self.outputs[name]

    def observe(self) -> None:
        """Gather what every client receives at this tick."""
        robot = self.robot
        self.outputs = {
            "timestamp": self.clock,
            "actual_q": (0.0,) * 6,
            "actual_TCP_pose": tuple(robot.pose),
            "actual_TCP_speed": tuple(robot.twist),
            "actual_TCP_force": tuple(robot.measured_wrench()),
            "safety_status_bits": 0x4 if self.protective else 0x1,
            "robot_status_bits": 0x1 | 0x2 * (self.runtime == PLAYING),
            "runtime_state": self.runtime,
            "target_speed_fraction": robot.speed_fraction,
            **self.forged,
        }

    def status(self) -> dict[str, Any]:
        """State for a test or a person, past the client; clocks in s."""
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
