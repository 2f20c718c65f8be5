"""Motions of a UR arm: straight, asynchronous, watched, and only where and as fast as it may.

A motion is refused before anything is sent if its goal is outside the box or it is too fast. Once it runs, the process
of `i2t.hardware.ur.rtde_worker` stops it at its force or torque, and `i2t.hardware.ur.rtde_link` where nobody attends.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.errors import DeviceError
from i2t.hardware.limits import MotionLimits, format_position
from i2t.hardware.protocols import ApproachResult, ArmState, StopReason
from i2t.hardware.ur.poses import from_ur, to_ur
from i2t.hardware.ur.rtde_link import MotionGuard, RtdeConnection
from i2t.hardware.ur.rtde_worker import POLL_S
from i2t.types import Array

GOAL_TOLERANCE = (1e-3, 0.01)  # m, rad: how near its goal a finished motion ends
ROTATION_LEVER_M = 0.25  # of path, that a radian is reckoned as, to know how long a motion may take
RETREAT_FACTOR = 1.1  # by which the force may grow in a motion that begins above its limit
DURATION_FACTOR, DURATION_MARGIN_S = 2.0, 2.0  # a motion may take so much longer than a trapezoid of speed
SLIDER_MIN = 0.01  # speed fraction below which waiting no longer counts as slow motion


class MotionController:
    """The motions of an arm within limits.

    Args:
        connection: With the arm's controller.
        limits: Box, speed, acceleration, force and torque that nothing exceeds.
    """

    def __init__(self, connection: RtdeConnection, limits: MotionLimits) -> None:
        self.connection, self.limits = connection, limits

    def move(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> Array:
        """Start a straight motion and return at once, as in `Arm.move`; by default at the limits' free speed.

        A force above a third of the limit (`MotionLimits.trip_force`) or a torque above its own stops the motion, and
        the next `state` says so; a motion that begins above them, as one that backs out of a contact, is stopped where
        it gets worse by a tenth.
        """
        speed, acceleration = self.limits.checked(T_b_t, speed, acceleration)
        self._start(T_b_t, speed, acceleration, self._free_guard)
        return from_ur(to_ur(T_b_t))

    def go(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> ArmState:
        """Move straight to a pose and wait for the end, as in `GuardedArm.go`.

        Raises:
            ValueError: The goal is outside the box or too fast; nothing was sent.
            DeviceError: The motion ended elsewhere, or as in `move`.
        """
        speed, acceleration = self.limits.checked(T_b_t, speed, acceleration)
        with self._standing_at_the_end():
            begun = self._start(T_b_t, speed, acceleration, self._free_guard)
            state = next(state for state in self._follow(*begun) if not state.moving)
            _check_arrived(state, T_b_t)
        return state

    def approach(
        self,
        distance: float,
        speed: float = 0.005,
        stop_condition: Callable[[ArmState], Any] | None = None,
        force: float = 8.0,
        torque: float = 8.0,
        acceleration: float = 0.2,
    ) -> ApproachResult:
        """Move along the tool's z axis until something says stop, as in `GuardedArm.approach`."""
        self.limits.check_approach(distance, force, torque)
        start = self.connection.running(self.connection.state_timeout).arm.T_b_t
        goal = start.copy()
        goal[:3, 3] += distance * goal[:3, 2]
        self.limits.check(goal, speed, acceleration)
        reason: StopReason = "distance"
        answer: Any = None
        with self._standing_at_the_end():
            guard = MotionGuard(force, torque, attended=True)
            for trigger in self._follow(*self._start(goal, speed, acceleration, guard)):
                trip = self.connection.trip
                if trip is not None:
                    reason, trigger = trip
                elif trigger.moving and stop_condition is not None:
                    answer = stop_condition(trigger)
                    reason = "condition" if answer else reason
                if reason != "distance":
                    break
                if not trigger.moving:
                    _check_arrived(trigger, goal)
                    break
        state = self.connection.running(self.connection.state_timeout).arm
        moved = float(np.linalg.norm(state.T_b_t[:3, 3] - start[:3, 3]))
        return ApproachResult(reason, answer, trigger, state, moved)

    @contextlib.contextmanager
    def _standing_at_the_end(self) -> Iterator[None]:
        connection = self.connection
        try:
            yield
        except BaseException:
            with contextlib.suppress(DeviceError):
                connection.stop()
            raise
        if connection.newest(connection.state_timeout).arm.moving:
            connection.stop()

    def _follow(self, duration: float, stops: int) -> Iterator[ArmState]:
        """New states as long as all is well; `duration` is what the motion may take at full speed (s)."""
        connection = self.connection
        used, last_clock, last_time = 0.0, -1.0, time.monotonic()
        while used < duration:
            state = connection.movable(stops)
            connection.attend()
            now = time.monotonic()
            used += (now - last_time) * max(state.speed_fraction, SLIDER_MIN)
            last_time = now
            if state.clock != last_clock:
                last_clock = state.clock
                yield state.arm
            connection.attend()
            time.sleep(POLL_S / 2)
        raise DeviceError(f"The motion took longer than {duration:.1f} s and was stopped.")

    @property
    def _free_guard(self) -> MotionGuard:
        return MotionGuard(self.limits.trip_force, self.limits.torque, attended=False)

    def _start(self, goal: Array, speed: float, acceleration: float, guard: MotionGuard) -> tuple[float, int]:
        """Start a motion; returns how long it may take at full speed (s), and the number of stops so far."""
        connection = self.connection
        stops = connection.stops
        start = connection.movable(stops).arm
        if start.moving:
            connection.stop()
            stops = connection.stops
        position = start.T_b_t[:3, 3]
        if not self.limits.contains(position, GOAL_TOLERANCE[0]):
            raise DeviceError(
                f"The tool at {format_position(position)} m is outside its box: bring it back with the pendant."
            )
        if not guard.attended:  # a way out of a contact must not be barred
            force, torque = RETREAT_FACTOR * np.linalg.norm(start.wrench.reshape(2, 3), axis=1)
            guard = MotionGuard(max(guard.force, float(force)), max(guard.torque, float(torque)), False)
        connection.start_motion(goal, speed=speed, acceleration=acceleration, guard=guard, stops=stops)
        turn = Rotation.from_matrix(goal[:3, :3] @ start.T_b_t[:3, :3].T).magnitude()
        length = max(float(np.linalg.norm(goal[:3, 3] - position)), ROTATION_LEVER_M * turn)
        return DURATION_FACTOR * (length / speed + speed / acceleration) + DURATION_MARGIN_S, stops


def _check_arrived(state: ArmState, goal: Array) -> None:
    distance = np.linalg.norm(state.T_b_t[:3, 3] - goal[:3, 3])
    turn = Rotation.from_matrix(goal[:3, :3] @ state.T_b_t[:3, :3].T).magnitude()
    if distance > GOAL_TOLERANCE[0] or turn > GOAL_TOLERANCE[1]:
        raise DeviceError(f"The motion ended {1e3 * distance:.1f} mm and {np.degrees(turn):.1f} degrees off its goal.")
