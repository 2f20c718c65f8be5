"""What a UR controller plays: the script that ur_rtde uploads, and what the safety system does to it.

Commands and results pass through registers: input_int_0 holds a command, output_int_0 says ready (1) or done (2), and
goes back to ready once the client has written 0. See `i2t.emulators.ur_controller` for what is played and what is not.
"""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from i2t.emulators import rtde_protocol
from i2t.emulators.robot_motion import Array, Compliant, Constant, Robot
from i2t.geometry import so3_exp

TICK = 0.002  # s
STOPPED, PLAYING, PAUSED = 1, 2, 4
MOVE_L, FORCE_MODE, FORCE_MODE_STOP, ZERO_FT, SPEED_L, SPEED_STOP, PAYLOAD, TCP = 3, 6, 7, 8, 10, 15, 17, 29
PROTECTIVE, STOP_L, WATCHDOG, TCP_OFFSET, STEADY, UNTIL_CONTACT, STOP_SCRIPT = 31, 33, 35, 40, 47, 51, 255
UNANSWERED = (FORCE_MODE, SPEED_L)  # repeated as long as the register holds them
TOUCHED = 5.0  # N
READY, DONE = 1, 2


class Controller:
    """The program that the client uploads, played on the robot, and what the safety system does to it."""

    def __init__(self, robot: Robot, unlock_delay: float, limit: float) -> None:
        self.robot, self.unlock_delay, self.limit = robot, unlock_delay, limit
        self.clock = self.heard = self.started = self.stopped_at = self.stood = 0.0
        self.runtime, self.protective, self.local = STOPPED, False, False
        self.ints, self.doubles = [0] * 48, [0.0] * 48
        self.out_ints, self.out_doubles = [0] * 48, [0.0] * 48
        self.slider, self.fraction = 0, 1.0
        self.watchdog: float | None = None
        self.busy: Callable[[], bool] | None = None
        self.running, self.operation, self.writes = False, 0, 0
        self.payload, self.cog, self.offset = 0.0, [0.0] * 3, [0.0] * 6
        self.taken: list[int] = []
        self.uploads = 0

    def upload(self) -> None:
        """Start the client's program; whatever ran before ends."""
        if self.local or self.protective:
            return
        self.uploads += 1
        self.robot.stop()
        self.runtime, self.started, self.watchdog, self.busy = PLAYING, self.clock, None, None
        self.out_ints[:2] = [READY, 0]
        self._set_running(False)

    def kill(self) -> None:
        """End the program without a word to the client; the robot slows down."""
        self.robot.stop()
        self.runtime, self.watchdog, self.busy = STOPPED, None, None

    def protect(self) -> None:
        """Protective stop: the robot brakes and the program is paused."""
        self.robot.stop(10.0)
        self.protective, self.stopped_at = True, self.clock
        self.runtime = PAUSED if self.runtime == PLAYING else self.runtime

    def unlock(self) -> bool:
        """Release the protective stop, if it is old enough; the program has to be started again."""
        if self.protective and self.clock - self.stopped_at < self.unlock_delay:
            return False
        self.protective, self.runtime = False, STOPPED
        return True

    def write(self, values: dict[str, rtde_protocol.Value]) -> None:
        """Take registers from the client; whatever it writes tells the watchdog that it lives."""
        for name, value in values.items():
            kind, _, index = name.rpartition("_")
            if kind == "input_int_register":
                self.ints[int(index)] = int(value)  # type: ignore[arg-type]
                self.heard = self.clock if index == "0" else self.heard
            elif kind == "input_double_register":
                self.doubles[int(index)] = float(value)  # type: ignore[arg-type]
            elif name == "speed_slider_mask":
                self.slider = int(value)  # type: ignore[arg-type]
            elif name == "speed_slider_fraction" and self.slider:
                self.robot.scaling = min(1.0, max(0.0, float(value)))  # type: ignore[arg-type]

    def step(self) -> None:
        """Advance robot, safety and program by a tick."""
        self.clock += TICK
        if not getattr(self.robot.contact, "busy", False):  # what lies ahead is being worked out: a motion waits for it
            self.robot.step(TICK)
        if self.robot.motion is not None:
            self.stood = self.clock
        if not self.protective and np.linalg.norm(self.robot.felt()[:3]) > self.limit:
            self.protect()
        if self.running and self.robot.motion is None:
            self._set_running(False)
        if self.runtime == PLAYING and not self.protective:
            if self.watchdog is not None and self.clock - self.heard > self.watchdog:
                self.kill()
            else:
                self._program()

    def _program(self) -> None:
        command, state = self.ints[0], self.out_ints[0]
        if self.busy is not None:
            if self.busy():
                self.busy, self.out_ints[0] = None, DONE
        elif state == DONE and command == 0:
            self.out_ints[0] = READY
        elif state == READY and command != 0:
            if command not in UNANSWERED or self.taken[-1:] != [command]:
                self.taken.append(command)
            try:
                self._execute(command)
            except (ArithmeticError, ValueError) as error:  # as the controller ends a program at a runtime error
                print(f"command {command}: {error}: the program ends", file=sys.stderr, flush=True)
                self.kill()

    def _execute(self, command: int) -> None:
        d, robot = self.doubles, self.robot

        def at_rest() -> bool:
            return robot.motion is None

        finished: Callable[[], bool] = lambda: True  # noqa: E731
        if command == SPEED_L:
            robot.motion = Constant(np.array(d[:6]), d[6])
            return
        if command == FORCE_MODE:
            chosen = np.array(self.ints[2:8], float)
            robot.motion = Compliant(so3_exp(np.array(d[3:6])), chosen, np.array(d[6:12]), np.array(d[12:18]))
            return
        if command == MOVE_L:
            robot.line_to(np.array(d[:6]), d[6], d[7])
            self._set_running(bool(self.ints[1]))
            finished = finished if self.ints[1] else at_rest
        elif command in (STOP_L, SPEED_STOP):
            robot.stop(d[0])
            finished = finished if command == STOP_L and self.ints[1] else at_rest
        elif command == FORCE_MODE_STOP:
            robot.stop()
        elif command == UNTIL_CONTACT:
            finished = self._until_contact(np.array(d[:6]), d[12])
        elif command == WATCHDOG:
            self.watchdog, self.heard = 1 / d[0], self.clock
        elif command == ZERO_FT:
            robot.zero = robot.felt() + robot.bias
        elif command == PAYLOAD:
            self.payload, self.cog = d[0], d[1:4]
        elif command == TCP:
            self.offset = d[:6]
        elif command == TCP_OFFSET:
            self.out_doubles[:6] = self.offset
        elif command == STEADY:
            self.out_ints[1] = int(robot.motion is None)
        elif command == PROTECTIVE:
            self.protect()
            return
        elif command == STOP_SCRIPT:
            self.kill()
            return
        else:
            print(f"command {command} is not played here: the program ends", file=sys.stderr, flush=True)
            self.kill()
            return
        self.busy = finished

    def _until_contact(self, twist: Array, acceleration: float) -> Callable[[], bool]:
        robot, met = self.robot, [False]
        before, free = robot.felt()[:3], [robot.pose]
        robot.motion = Constant(twist, acceleration)

        def finished() -> bool:
            change = float(np.linalg.norm(robot.felt()[:3] - before))
            if not met[0] and change < 1e-9:
                free[0] = robot.pose
            elif not met[0] and change > TOUCHED:
                met[0] = True
                robot.line_to(free[0], 0.01, acceleration)  # back to where contact began
            self.out_ints[1] = int(met[0])
            return met[0] and robot.motion is None

        return finished

    def _set_running(self, running: bool) -> None:
        if running:
            self.operation = (self.operation + 1) % 128
        self.running, self.writes = running, (self.writes + 1) % 128
        self.out_ints[2] = self.operation << 24 | self.writes << 16 | running << 15

    def output(self, name: str) -> rtde_protocol.Value:
        """The value of an output now."""
        kind, _, index = name.rpartition("_")
        if kind == "output_int_register":
            return self.out_ints[int(index)]
        if kind == "output_double_register":
            return self.out_doubles[int(index)]
        return self.state.get(name, nothing(name))

    def observe(self) -> None:
        """Gather what every client is told at this tick."""
        robot, pose = self.robot, tuple(self.robot.pose)
        force, twist = tuple(robot.measured()), tuple(robot.twist)
        self.state: dict[str, rtde_protocol.Value] = {
            "timestamp": self.clock,
            "actual_TCP_pose": pose,
            "target_TCP_pose": pose,
            "actual_TCP_speed": twist,
            "target_TCP_speed": twist,
            "actual_TCP_force": force,
            "ft_raw_wrench": force,
            "robot_mode": 7,
            "safety_mode": 3 if self.protective else 1,
            "safety_status_bits": 0x4 if self.protective else 0x1,
            "robot_status_bits": 0x1 | 0x2 * (self.runtime == PLAYING),
            "runtime_state": self.runtime,
            "speed_scaling": robot.scaling,
            "target_speed_fraction": robot.scaling,
            "payload": self.payload,
            "payload_cog": self.cog,
        }

    def status(self) -> dict[str, Any]:
        """What a test or a person wants to know, past the client."""
        robot = self.robot
        return {
            "clock": self.clock,
            "pose": robot.pose.tolist(),
            "twist": robot.twist.tolist(),
            "moving": robot.motion is not None,
            "stood": self.stood,
            "heard": self.heard,
            "force": robot.told().tolist(),
            "fastest": robot.fastest,
            "runtime": self.runtime,
            "protective": self.protective,
            "watchdog": self.watchdog,
            "payload": self.payload,
            "commands": self.taken,
            "uploads": self.uploads,
        }


def nothing(name: str) -> rtde_protocol.Value:
    """The value of an output that has no counterpart here."""
    return {"VECTOR6D": (0.0,) * 6, "VECTOR3D": (0.0,) * 3, "VECTOR6INT32": (0,) * 6}.get(
        rtde_protocol.OUTPUT_TYPES[name], 0
    )
