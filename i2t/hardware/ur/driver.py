"""A Universal Robots arm over ur_rtde, moved only in ways that can be watched and stopped.

A motion is refused before anything is sent if its goal is outside the box or it is too fast. The
client library runs in a process of its own (`i2t.hardware.ur.rtde_worker`), where it can neither crash this one nor
connect again without a watchdog. Motions are asynchronous straight lines, so no call into the library hides what the
robot does, and `stop` works from any thread.

What stops the arm, besides `stop` and the limits of a motion:

- No news: during a motion the controller's clock must advance within `state_timeout` seconds. Otherwise the watchdog is
  no longer fed, so that the controller ends the program by itself, and "stop" goes to the dashboard, another
  connection.
- A lost connection: one of the library's connections breaks, or its process dies. The arm is given up in the same way;
  nothing connects again before `connect` is called.
- Nobody watches: an approach whose caller has not looked for `state_timeout` seconds, as when its stop condition hangs.
- This process dies or hangs, even by kill -9: the watchdog runs dry (`watchdog_rate` Hz; 0.1 s by default) and the
  controller ends the program. Ctrl-C, SIGTERM and SIGHUP (a terminal that is closed) brake at once, inside a `with`
  block on the main thread.

Poses are (4, 4) T_b_t in metres, tool in robot base; forces act on the tool, in the tool's axes. The box holds the
tool's origin: flange, elbow and cable are not watched here, so set the robot's own safety limits on the pendant too.
The speed slider is left to people and respected. Linux and macOS, ur_rtde 1.6 (Python 3.11 and 3.12).
"""

import contextlib
import importlib.util
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import IO, Any, Literal

import numpy as np

from i2t.errors import DeviceError
from i2t.hardware.guarded import (
    BOX_MARGIN_M,
    BRAKING_SIGNALS,
    free_limits,
    longest_duration,
    require_arrived,
    require_inside,
    signals_ignored,
)
from i2t.hardware.limits import MotionLimits, format_position
from i2t.hardware.poses import pose_from_vector, pose_to_vector, shifted_along_z
from i2t.hardware.protocols import ApproachResult, ArmFeatures, ArmState, StopReason
from i2t.hardware.ur.access import (
    NO_LIBRARY,
    check_controller,
    controller_serial,
    take_lock,
    tool_pose,
)
from i2t.hardware.ur.config import STATE_TIMEOUT_S, WATCHDOG_RATE_HZ, check_watch
from i2t.hardware.ur.rtde_link import MotionGuard, RtdeConnection
from i2t.hardware.ur.rtde_worker import POLL_S, STATE_RATE_HZ
from i2t.types import Array

SLIDER_MIN = 0.01  # speed fraction below which waiting no longer counts as slow motion


class UrArm:
    """A UR arm (`i2t.hardware.protocols.Arm`), with guarded approaches.

    Args:
        host: Address of the controller.
        limits: Box, speed, acceleration, force and torque that nothing exceeds.
        tool: (4, 4) pose of the tool in the flange, m, sent to the controller; None keeps what is set on the pendant.
        payload: Mass in kg and its centre (3,) in m in the flange, sent to the controller; None keeps what is set.
        state_timeout: s without news in a motion after which the arm is taken for lost.
        watchdog_rate: Hz, how often the controller must hear from us.
        source: Real or emulated; by default an address of this machine itself is emulated.

    Raises:
        ValueError: `state_timeout` or `watchdog_rate` protects nobody, or no controller can keep to it.
        DeviceError: ur_rtde is not installed.
    """

    can_be_paused = True  # by the pendant's speed slider

    def __init__(
        self,
        host: str,
        limits: MotionLimits,
        tool: Array | None = None,
        payload: tuple[float, tuple[float, float, float]] | None = None,
        *,
        state_timeout: float = STATE_TIMEOUT_S,
        watchdog_rate: float = WATCHDOG_RATE_HZ,
        source: Literal["real", "emulated"] | None = None,
    ) -> None:
        check_watch(state_timeout, watchdog_rate)
        if any(importlib.util.find_spec(module) is None for module in ("rtde_control", "rtde_receive")):
            raise DeviceError(NO_LIBRARY)
        self.connection, self.limits = RtdeConnection(host, state_timeout, watchdog_rate), limits
        self.host, self.tool, self.payload = host, tool, payload
        self.source = source or ("emulated" if host == "localhost" or host.startswith("127.") else "real")
        self.serial_number = ""  # of the controller, once it is connected
        self._closing = threading.Lock()
        self._lock: IO[str] | None = None
        self._handlers: dict[int, Any] = {}

    @property
    def features(self) -> ArmFeatures:
        """Features, known before `connect`."""
        limits = self.limits
        bounds = limits.box, limits.speed, limits.acceleration
        return ArmFeatures(f"UR at {self.host}", self.source, STATE_RATE_HZ, *bounds)

    def __enter__(self) -> "UrArm":
        self.connect()
        if threading.current_thread() is threading.main_thread():
            for number in BRAKING_SIGNALS:
                self._handlers[number] = signal.signal(number, self._interrupted)
        return self

    def __exit__(self, *error: object) -> None:
        try:
            with signals_ignored():  # a second Ctrl-C must not keep the arm from being stopped
                self.close()
        finally:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            self._handlers.clear()

    def _interrupted(self, number: int, frame: FrameType | None) -> None:
        self.connection.request_stop()
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)

    def connect(self) -> None:
        """Take control, anew if need be.

        Raises:
            DeviceError: Somebody else has it, or the robot refuses or does not answer.
        """
        self.close()
        try:
            self._lock = take_lock(self.host)
            check_controller(self.host)
            self.serial_number = controller_serial(self.host)
            self.connection.open(self.tool, self.payload)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Brake, end the program and let go, from any thread, as often as one likes; raises nothing."""
        with self._closing:
            try:
                if self.connection.is_open:
                    with contextlib.suppress(DeviceError):
                        self.connection.stop()
                    with contextlib.suppress(DeviceError):
                        if self.connection.newest(self.connection.state_timeout).program:
                            self.connection.end_program()
                self.connection.close()
            finally:
                lock, self._lock = self._lock, None
                if lock is not None:
                    lock.close()

    def state(self, timeout: float | None = None) -> ArmState:
        """The newest state, as in `Arm.state`; by default it may be as old as the state timeout.

        Raises:
            DeviceTimeoutError: It is older; the arm has been stopped as far as it can be told to.
            DeviceError: Once, for anything else that has stopped the arm.
        """
        return self.connection.running(self.connection.state_timeout if timeout is None else timeout).arm

    def tool_pose(self) -> Array:
        """Pose of the tool now, (4, 4) T_b_t, by listening alone: the arm need not be connected, and is not controlled.

        Raises:
            DeviceError: The controller does not answer.
        """
        return tool_pose(self.host)

    @property
    def state_timeout(self) -> float:
        """Time (s) without a state, after which it is taken for lost."""
        return self.connection.state_timeout

    @property
    def stall_s(self) -> float:
        """Time (s) after which it stops by itself where this computer stalls."""
        return 1 / self.connection.watchdog_rate

    def stop(self, timeout: float = 1.0) -> None:
        """Brake and return when the arm stands, as in `Arm.stop`."""
        self.connection.stop(timeout)

    def zero_wrench(self, timeout: float = 1.0) -> None:
        """Take the wrench felt now for zero, as in `Arm.zero_wrench`."""
        if self.state().moving:
            raise DeviceError("The wrench can be zeroed only while the arm stands.")
        self.connection.zero_wrench(timeout)

    # Motions

    def move(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> Array:
        """Start a straight motion and return at once, as in `Arm.move`; by default at the limits' free speed.

        A force above a third of the limit (`MotionLimits.trip_force`) or a torque above its own stops the motion, and
        the next `state` says so; a motion that begins above them, as one that backs out of a contact, is stopped where
        it gets worse by a tenth.
        """
        speed, acceleration = self.limits.checked(T_b_t, speed, acceleration)
        self._start(T_b_t, speed, acceleration)
        return pose_from_vector(pose_to_vector(T_b_t))

    def go(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> ArmState:
        """Move straight to a pose and wait for the end, as in `GuardedArm.go`.

        Raises:
            ValueError: The goal is outside the box or too fast; nothing was sent.
            DeviceError: The motion ended elsewhere, or as in `move`.
        """
        speed, acceleration = self.limits.checked(T_b_t, speed, acceleration)
        with self._standing_at_the_end():
            begun = self._start(T_b_t, speed, acceleration)
            state = next(state for state in self._follow(*begun) if not state.moving)
            require_arrived(state, T_b_t)
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
        goal = shifted_along_z(start, distance)
        self.limits.check(goal, speed, acceleration)
        reason: StopReason = "distance"
        answer: Any = None
        with self._standing_at_the_end():
            bounds = force, torque
            for trigger in self._follow(*self._start(goal, speed, acceleration, bounds)):
                trip = self.connection.trip
                if trip is not None:
                    reason, trigger = trip
                elif trigger.moving and stop_condition is not None:
                    answer = stop_condition(trigger)
                    reason = "condition" if answer else reason
                if reason != "distance":
                    break
                if not trigger.moving:
                    require_arrived(trigger, goal)
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
                last_clock, position = state.clock, state.arm.T_b_t[:3, 3]
                if not self.limits.contains(position, BOX_MARGIN_M):
                    raise DeviceError(f"The tool left its box, to {format_position(position)} m: it was stopped.")
                yield state.arm
            connection.attend()
            time.sleep(POLL_S / 2)
        raise DeviceError(f"The motion took longer than {duration:.1f} s and was stopped.")

    def _start(
        self, goal: Array, speed: float, acceleration: float, bounds: tuple[float, float] | None = None
    ) -> tuple[float, int]:
        """Start a motion, attended where it has bounds (N, Nm) of its own; returns how long it may take at full speed
        (s), and the number of stops so far.
        """
        connection = self.connection
        stops = connection.stops
        start = connection.movable(stops).arm
        if start.moving:
            connection.stop()
            stops = connection.stops
        require_inside(self.limits, start)
        guard = MotionGuard(*(bounds or free_limits(self.limits, start.wrench)), attended=bounds is not None)
        connection.start_motion(goal, speed=speed, acceleration=acceleration, guard=guard, stops=stops)
        return longest_duration(start.T_b_t, goal, speed, acceleration), stops
