"""Program of a UR controller: the script that ur_rtde uploads, and what the safety system does to it.

Commands and results pass through registers: input_int_0 holds a command, output_int_0 says ready (1) or done (2), and
goes back to ready once the client has written 0. `i2t.emulators.ur_controller` says what is emulated and what is not.
"""

import sys
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np

from i2t.emulators import rtde_protocol
from i2t.emulators.robot_motion import Array, ConstantTwist, ForceMotion, Robot
from i2t.geometry import so3_exp

Finished: TypeAlias = Callable[[], bool]  # whether a command that takes time has ended

TICK = 0.002  # s
STOPPED, PLAYING, PAUSED = 1, 2, 4  # runtime state
READY, DONE = 1, 2  # output_int_0
REGISTERS = 48  # of each kind
COUNTER = 128  # at which the numbers of operations begin anew
CONTACT_FORCE_N = 5.0  # that ends moveUntilContact
FREE_FORCE_N = 1e-9  # below which nothing is touched
BACK_OFF_SPEED = 0.01  # m/s, back to where contact began
PROTECTIVE_DECELERATION = 10.0  # m/s^2


class Command(IntEnum):
    """Values of input_int_0, as ur_rtde 1.6.5 writes them."""

    MOVE_L = 3
    FORCE_MODE = 6
    FORCE_MODE_STOP = 7
    ZERO_FT_SENSOR = 8
    SPEED_L = 10
    SPEED_STOP = 15
    SET_PAYLOAD = 17
    SET_TCP = 29
    PROTECTIVE_STOP = 31
    STOP_L = 33
    SET_WATCHDOG = 35
    GET_TCP_OFFSET = 40
    IS_STEADY = 47
    MOVE_UNTIL_CONTACT = 51
    STOP_SCRIPT = 255


REPEATED_COMMANDS = (Command.FORCE_MODE, Command.SPEED_L)  # as long as the register holds them, and never answered


class Controller:
    """The program that the client uploads, run on the robot, and what the safety system does to it.

    Args:
        robot: What moves.
        unlock_delay: s before a protective stop can be released.
        force_limit: N, above which the robot makes a protective stop.
    """

    def __init__(self, robot: Robot, unlock_delay: float, force_limit: float) -> None:
        self.robot, self.unlock_delay, self.force_limit = robot, unlock_delay, force_limit
        self.clock = 0.0  # s
        self.heard_clock = 0.0  # when the client was heard last
        self.start_clock = 0.0  # when the program was started
        self.protective_clock = 0.0  # when the protective stop was made
        self.moving_clock = 0.0  # when the tool moved last
        self.runtime, self.protective, self.local = STOPPED, False, False
        self.in_ints, self.in_doubles = [0] * REGISTERS, [0.0] * REGISTERS
        self.out_ints, self.out_doubles = [0] * REGISTERS, [0.0] * REGISTERS
        self.slider_mask = 0
        self.watchdog: float | None = None  # s
        self.finished: Finished | None = None  # of the command that is being carried out
        self.asynchronous, self.operation, self.changes = False, 0, 0  # motion under way, its number, state changes
        self.payload, self.payload_centre, self.tcp_offset = 0.0, [0.0] * 3, [0.0] * 6
        self.pendant_tcp = [0.0] * 6  # that a program begins with
        self.commands: list[int] = []
        self.uploads = 0
        self.outputs: dict[str, rtde_protocol.Value] = {}

    def upload(self) -> None:
        """Start the client's program; whatever ran before ends."""
        if self.local or self.protective:
            return
        self.uploads += 1
        self.tcp_offset = list(self.pendant_tcp)
        self.robot.stop()
        self.runtime, self.start_clock, self.watchdog, self.finished = PLAYING, self.clock, None, None
        self.out_ints[:2] = [READY, 0]
        self._set_asynchronous(False)

    def kill(self) -> None:
        """End the program without a word to the client; the robot slows down."""
        self.robot.stop()
        self.runtime, self.watchdog, self.finished = STOPPED, None, None

    def protective_stop(self) -> None:
        """Brake and pause the program."""
        self.robot.stop(PROTECTIVE_DECELERATION)
        self.protective, self.protective_clock = True, self.clock
        self.runtime = PAUSED if self.runtime == PLAYING else self.runtime

    def unlock(self) -> bool:
        """Release the protective stop; the program has to be started again.

        Returns:
            False if it is too young to be released.
        """
        if self.protective and self.clock - self.protective_clock < self.unlock_delay:
            return False
        self.protective, self.runtime = False, STOPPED
        return True

    def write(self, values: Mapping[str, rtde_protocol.Value]) -> None:
        """Take registers from the client; a command, be it none, tells the watchdog that the client lives.

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
            elif name == "speed_slider_mask":
                self.slider_mask = int(number)
            elif name == "speed_slider_fraction" and self.slider_mask:
                self.robot.speed_fraction = min(1.0, max(0.0, float(number)))

    def step(self) -> None:
        """Advance robot, safety and program by a tick."""
        self.clock += TICK
        if not getattr(self.robot.contact, "busy", False):  # a motion waits until it is known what lies ahead
            self.robot.step(TICK)
        if self.robot.motion is not None:
            self.moving_clock = self.clock
        if not self.protective and np.linalg.norm(self.robot.wrench()[:3]) > self.force_limit:
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
        if self.finished is not None:
            if self.finished():
                self.finished, self.out_ints[0] = None, DONE
        elif state == DONE and command == 0:
            self.out_ints[0] = READY
        elif state == READY and command != 0:
            if command not in REPEATED_COMMANDS or self.commands[-1:] != [command]:
                self.commands.append(command)
            try:
                self.finished = self._execute(command)
            except (ArithmeticError, ValueError) as error:  # as the controller ends a program at a runtime error
                self._abort(f"command {command}: {error}")

    def _abort(self, reason: str) -> None:
        print(f"{reason}: the program ends", file=sys.stderr, flush=True)
        self.kill()

    def _execute(self, command: int) -> Finished | None:
        """Carry out a command; returns a test of its end, None where it is never answered."""
        if command in (Command.MOVE_L, Command.STOP_L, Command.SPEED_STOP, Command.MOVE_UNTIL_CONTACT):
            return self._execute_motion(command)
        d, robot = self.in_doubles, self.robot
        match command:
            case Command.SPEED_L:
                robot.motion = ConstantTwist(np.array(d[:6]), d[6])
                return None
            case Command.FORCE_MODE:
                selected = np.array(self.in_ints[2:8], float)
                frame = so3_exp(np.array(d[3:6]))
                robot.motion = ForceMotion(frame, selected, np.array(d[6:12]), np.array(d[12:18]))
                return None
            case Command.FORCE_MODE_STOP:
                robot.stop()
            case Command.SET_WATCHDOG:
                self.watchdog, self.heard_clock = 1 / d[0], self.clock
            case Command.ZERO_FT_SENSOR:
                robot.zero_wrench()
            case Command.SET_PAYLOAD:
                self.payload, self.payload_centre = d[0], d[1:4]
            case Command.SET_TCP:
                self.tcp_offset = d[:6]
            case Command.GET_TCP_OFFSET:
                self.out_doubles[:6] = self.tcp_offset
            case Command.IS_STEADY:
                self.out_ints[1] = int(robot.motion is None)
            case Command.PROTECTIVE_STOP:
                self.protective_stop()
                return None
            case Command.STOP_SCRIPT:
                self.kill()
                return None
            case _:
                self._abort(f"command {command} is not emulated")
                return None
        return _at_once

    def _execute_motion(self, command: int) -> Finished:
        d, robot = self.in_doubles, self.robot
        asynchronous = bool(self.in_ints[1])

        def at_rest() -> bool:
            return robot.motion is None

        if command == Command.MOVE_UNTIL_CONTACT:
            return self._move_until_contact(np.array(d[:6]), d[12])
        if command == Command.MOVE_L:
            robot.line_to(np.array(d[:6]), d[6], d[7])
            self._set_asynchronous(asynchronous)
            return _at_once if asynchronous else at_rest
        robot.stop(d[0])
        return _at_once if command == Command.STOP_L and asynchronous else at_rest

    def _move_until_contact(self, twist: Array, acceleration: float) -> Finished:
        robot = self.robot
        force_before, free_pose, touched = robot.wrench()[:3], robot.pose, False
        robot.motion = ConstantTwist(twist, acceleration)

        def finished() -> bool:
            nonlocal free_pose, touched
            change = float(np.linalg.norm(robot.wrench()[:3] - force_before))
            if not touched and change < FREE_FORCE_N:
                free_pose = robot.pose
            elif not touched and change > CONTACT_FORCE_N:
                touched = True
                robot.line_to(free_pose, BACK_OFF_SPEED, acceleration)
            self.out_ints[1] = int(touched)
            return touched and robot.motion is None

        return finished

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
            Its value, zero where it has no counterpart here.
        """
        kind, _, index = name.rpartition("_")
        if kind == "output_int_register":
            return self.out_ints[int(index)]
        if kind == "output_double_register":
            return self.out_doubles[int(index)]
        return self.outputs.get(name, _zero(name))

    def observe(self) -> None:
        """Gather what every client receives at this tick."""
        robot, pose = self.robot, tuple(self.robot.pose)
        wrench, twist = tuple(robot.measured_wrench()), tuple(robot.twist)
        self.outputs = {
            "timestamp": self.clock,
            "actual_TCP_pose": pose,
            "target_TCP_pose": pose,
            "actual_TCP_speed": twist,
            "target_TCP_speed": twist,
            "actual_TCP_force": wrench,
            "ft_raw_wrench": wrench,
            "robot_mode": 7,
            "safety_mode": 3 if self.protective else 1,
            "safety_status_bits": 0x4 if self.protective else 0x1,
            "robot_status_bits": 0x1 | 0x2 * (self.runtime == PLAYING),
            "runtime_state": self.runtime,
            "speed_scaling": robot.speed_fraction,
            "target_speed_fraction": robot.speed_fraction,
            "payload": self.payload,
            "payload_cog": self.payload_centre,
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
            "force": robot.zeroed_wrench().tolist(),
            "fastest": robot.max_speed,
            "runtime": self.runtime,
            "protective": self.protective,
            "watchdog": self.watchdog,
            "payload": self.payload,
            "commands": self.commands,
            "uploads": self.uploads,
        }


def _at_once() -> bool:
    return True


def _zero(name: str) -> rtde_protocol.Value:
    zeros: dict[str, rtde_protocol.Value] = {
        "VECTOR6D": (0.0,) * 6,
        "VECTOR3D": (0.0,) * 3,
        "VECTOR6INT32": (0,) * 6,
    }
    return zeros.get(rtde_protocol.OUTPUT_TYPES[name], 0)
