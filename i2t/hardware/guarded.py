"""Guarded motions: the check of every state of a moving arm, and a guarded arm made from a driver that is polled.

`MotionWatch` checks the states of one motion, of any arm. `PolledArm` makes a `GuardedArm` of a driver that can
report its state, move along a line, and brake.

WARNING: Keep every comparison in the form `not value <= limit`, so that NaN stops the arm.

Frames: B robot base, T tool; metres, radians, newtons.
"""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeVar

import numpy as np

from i2t.cli.signals import ENDING_SIGNALS
from i2t.errors import DeviceError, DeviceTimeoutError, MotionStoppedError, NotConnectedError
from i2t.hardware.base import DeviceBase
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.limits import SAFETY
from i2t.hardware.motion_limits import MotionLimits, format_position
from i2t.hardware.poses import pose_difference, translated_along_z
from i2t.hardware.protocols import ApproachResult, Arm, ArmFeatures, ArmState, StopReason
from i2t.types import Array

T = TypeVar("T")
# Advice in errors about late states: if the arm may have caused them, and if only this computer can have.
CHECK_CONNECTION = "check its connection"
BUSY = "this computer is too busy: close other programs"


class MotionWatch:
    """Check of each state of an arm in one motion: its age, safety, box, distance, speeds, progress, force and torque.

    Args:
        arm: The arm that moves. If it has a `state_timeout` (s), its states may be that old. If it has
            `can_be_paused`, a person may pause it, and its pose may stand still while it reports a motion. If it has a
            `late_remedy`, errors about late states end with this advice.
        limits: Limits of the rig.
        start: State of the arm in which the motion begins.
        distance: Length of the motion in m.
        speed: Requested speed in m/s.
        force: Norm of the force in N that ends the motion.
        torque: Norm of the torque in Nm that ends the motion.
        clock: Clock that dates the states.
    """

    def __init__(
        self,
        arm: Arm,
        limits: MotionLimits,
        start: ArmState,
        *,
        distance: float,
        speed: float,
        force: float,
        torque: float,
        clock: Clock,
    ) -> None:
        self._name, self._limits, self._clock = arm.features.name, limits, clock
        self._max_age = max(SAFETY.max_state_age_s, getattr(arm, "state_timeout", 0.0))
        self._late_remedy = getattr(arm, "late_remedy", CHECK_CONNECTION)
        self._stall_timeout = np.inf if getattr(arm, "can_be_paused", False) else SAFETY.stall_timeout_s
        self._start, self._distance, self._speed = start.T_b_t[:3, 3], distance, speed
        self._force, self._torque = force, torque
        self.start_time = self._change_time = clock.now()  # _change_time: when the pose last changed
        self._newest = start

    def __call__(self, state: ArmState) -> Literal["force", "torque"] | None:
        """Check a state.

        Args:
            state: The newest state.

        Returns:
            "force" or "torque" if that is above its limit, otherwise None.

        Raises:
            DeviceTimeoutError: The state is too old, or older than the one before.
            DeviceError: A value is not finite, or the arm is outside its box, too far, too fast, stalled or unsafe.
        """
        now, position, before = self._clock.now(), state.T_b_t[:3, 3], self._newest
        if invalid := non_finite(state):
            raise DeviceError(f"{self._name} reports that its {invalid}, which is not finite; it was stopped")
        if not state.time - before.time >= 0 or not abs(now - state.time) <= self._max_age:
            raise DeviceTimeoutError(f"{self._name} sends no new states and was stopped; {self._late_remedy}")
        if not state.safe:
            raise DeviceError(f"{self._name} made a protective or emergency stop; clear its cause, and release it")
        if not self._limits.contains(position, SAFETY.box_margin_m):
            raise DeviceError(f"{self._name} is outside its box, at {format_position(position)} m; it was stopped")
        travel, speed = float(np.linalg.norm(position - self._start)), float(np.linalg.norm(state.velocity[:3]))
        if not travel <= self._distance + SAFETY.travel_margin_m:
            raise DeviceError(f"{self._name} moved {1e3 * travel:.3g} mm instead of {1e3 * self._distance:.3g} mm")
        if not speed <= SAFETY.max_speed_ratio * self._speed + SAFETY.speed_margin_m_s:
            raise DeviceError(f"{self._name} moves at {speed:.3g} m/s instead of {self._speed:.3g} m/s")
        if not np.linalg.norm(state.velocity[3:]) <= SAFETY.max_angular_speed_rad_s:
            raise DeviceError(f"{self._name} turns at {np.linalg.norm(state.velocity[3:]):.3g} rad/s; it was stopped")
        if not state.moving or not np.array_equal(state.T_b_t, before.T_b_t):
            self._change_time = now
        if not now - self._change_time <= self._stall_timeout:
            raise DeviceError(
                f"{self._name} reports a motion, but its pose does not change; check whether its speed slider is at 0"
            )
        self._newest = state
        force, torque = np.linalg.norm(state.wrench.reshape(2, 3), axis=1)
        return "force" if not force <= self._force else "torque" if not torque <= self._torque else None


def non_finite(state: ArmState) -> str:
    """Find a NaN or infinite value in the state of an arm.

    Args:
        state: State of an arm.

    Returns:
        The first part with such a value, such as "wrench is [nan, 0.0, ...]"; empty if all values are finite.
    """
    for name in ("T_b_t", "joints", "velocity", "wrench"):
        values = np.asarray(getattr(state, name), float)
        if not np.isfinite(values).all():
            return f"{name.replace('T_b_t', 'pose')} is {np.round(values, 3).tolist()}"
    return ""


def free_limits(limits: MotionLimits, wrench: Array) -> tuple[float, float]:
    """Calculate the force and torque at which a motion in the air is stopped.

    A motion may begin above the limits, such as one that backs out of a contact. It is then stopped when the load grows
    by a tenth.

    Args:
        limits: Limits of the rig.
        wrench: (6,) wrench on the tool at the start of the motion, in N and Nm.

    Returns:
        The force in N and the torque in Nm that stop the motion.

    Raises:
        DeviceError: The load at the start is not finite, or above `SAFETY.max_start_load` times a limit of the rig.
    """
    force, torque = (float(norm) for norm in np.linalg.norm(np.reshape(wrench, (2, 3)), axis=1))
    if not (force <= SAFETY.max_start_load * limits.force and torque <= SAFETY.max_start_load * limits.torque):
        raise DeviceError(
            f"The arm measures {force:.0f} N and {torque:.0f} Nm before it moves: free the tool with the pendant, and "
            "check the payload."
        )
    growth = SAFETY.max_retreat_growth
    return max(limits.trip_force, growth * force), max(limits.torque, growth * torque)


class PolledArm(DeviceBase):
    """A guarded arm (`i2t.hardware.protocols.GuardedArm`), made from a driver with six short methods.

    The state is polled every `poll_s` seconds during a motion. The arm brakes if a value is above its limit, if a state
    is old or invalid, if the caller's stop condition is true, if an error ends the call, or, on this machine's clock,
    if the motion has not been watched for `state_timeout` seconds, for example because a stop condition hangs.
    Exceptions of the driver become DeviceErrors.

    CAUTION: A motion that `move` started is checked only when the caller asks for a state.

    A driver implements

        open_link, close_link     connect and disconnect; disconnecting is possible at any time
        read_state                the newest `ArmState`, as fresh as possible
        begin_line                start a straight motion without waiting; the arm may stop itself at `bounds`
        brake                     brake at once, without waiting for the stand, from any thread
        zero_sensor               zero the force and torque while the arm stands

    Args:
        limits: Box, speed, acceleration, force and torque that no motion exceeds.
        clock: Clock that dates the states; by default this machine's.
    """

    name = "the arm"  # for messages
    source: Literal["real", "simulated", "emulated"] = "real"
    rate = 125.0  # Hz, of the states
    state_timeout = SAFETY.max_state_age_s  # s, maximum age of a state
    can_be_paused = False  # True if a person can pause the arm, so that it reports a motion and stands still
    poll_s = 0.008  # time between two polls
    start_s = 0.1  # time until states report a motion that was requested

    def __init__(self, limits: MotionLimits, clock: Clock | None = None) -> None:
        self.limits, self.clock = limits, clock or MonotonicClock()
        self._open = self._accepting = False  # whether there is a link, and whether a motion may begin
        self._stops, self._sent_time = 0, -np.inf  # number of stops; s, when the newest motion was sent
        self._free_watch: MotionWatch | None = None  # of a motion that `move` started
        self._state_lock = threading.RLock()  # states are checked in the order in which they are read
        self.bounds = (0.0, 0.0)  # N and Nm that end the motion that is started
        self._command_lock = threading.RLock()  # a line is sent before a brake or not at all
        self._watched_time = np.inf  # s, of this machine's clock, when a motion was last polled

    # Methods that a driver implements

    def open_link(self) -> None:
        """Connect to the arm; raise DeviceError if that fails."""

    def close_link(self) -> None:
        """Disconnect from the arm; may be called repeatedly."""

    def read_state(self) -> ArmState:
        """Return the arm's newest state, as fresh as possible."""
        raise NotImplementedError

    def begin_line(self, T_b_t: Array, speed: float, acceleration: float) -> None:
        """Start a straight motion of the standing arm without waiting for its end.

        Args:
            T_b_t: (4, 4) goal in m.
            speed: Speed in m/s.
            acceleration: Acceleration in m/s^2.
        """
        raise NotImplementedError

    def brake(self) -> None:
        """Command the arm to brake, without waiting until it stands; may be called from any thread."""
        raise NotImplementedError

    def zero_sensor(self) -> None:
        """Zero the force and torque sensor at its present value, while the arm stands."""
        raise NotImplementedError

    def speed_share(self) -> float:
        """Return the fraction (0 to 1) of the requested speed that a person allows now; here the lowest, if unknown."""
        return SAFETY.min_speed_share

    @property
    def late_remedy(self) -> str:
        """Advice if states are late, which ends the error; without hardware only this computer can delay them."""
        return CHECK_CONNECTION if self.source == "real" else BUSY

    # Methods of a guarded arm

    @property
    def features(self) -> ArmFeatures:
        """Name, source, rate and limits of the arm, available before `connect`."""
        limits = self.limits
        return ArmFeatures(self.name, self.source, self.rate, limits.box, limits.speed, limits.acceleration)

    def connect(self) -> None:
        """Connect to the arm, again if necessary; raise DeviceError if that fails."""
        self.close()
        self._call(self.open_link)
        self._open = self._accepting = True

    def close(self) -> None:
        """Brake the arm and disconnect; never raises."""
        with self._command_lock:
            self._accepting = False
        if self._open:
            self._halt()
        self._open = False
        with contextlib.suppress(Exception):
            self.close_link()

    def __exit__(self, *error: Any) -> None:
        with signals_ignored():  # a second Ctrl-C must not prevent the stop
            self.close()

    def state(self, timeout: float | None = None) -> ArmState:
        """Return the arm's newest state, as in `Arm.state`; an invalid state or a bad motion stops the arm.

        Args:
            timeout: Maximum age of the state in s; by default the state timeout.

        Returns:
            The newest state.

        Raises:
            DeviceTimeoutError: The newest state is older than `timeout`; a stop was sent to the arm.
            DeviceError: The state is invalid, or a motion that `move` started met something or deviates from the
                request; a stop was sent to the arm.
        """
        if not self._open:
            raise NotConnectedError(f"{self.name} is not connected; call connect() or use with")
        with self._state_lock:
            state, now = self._call(self.read_state), self.clock.now()
            invalid, max_age = non_finite(state), self.state_timeout if timeout is None else timeout
            age, failure, watch = now - state.time, None, self._free_watch
            fresh = -SAFETY.max_state_age_s <= age <= max_age
            if fresh and not invalid:
                self._sent_time = -np.inf if state.moving else self._sent_time
                state = state._replace(moving=state.moving or state.time - self._sent_time < self.start_s)
                try:
                    failure = _collision_error(state) if watch is not None and watch(state) else None
                except DeviceError as error:
                    failure = error
                if watch is not None and not state.moving and now > watch.start_time + SAFETY.start_timeout_s:
                    self._free_watch = None
        if failure is not None:
            self._halt()
            raise failure
        if not (fresh and not invalid):
            self._stops += 1
            self._call(self.brake)
            if not fresh:
                late = f"{self.name} sent its last state {age:.2g} s ago and was stopped"
                raise DeviceTimeoutError(f"{late}; {self.late_remedy}")
            raise DeviceError(f"{self.name} reports that its {invalid}, which is not finite; it was stopped")
        return state

    def move(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> Array:
        """Start a straight motion and return at once, as in `Arm.move`; by default as fast as the limits allow.

        A force above `MotionLimits.trip_force` or a torque above its limit ends the motion, and the next call of
        `state` raises, unless `stop` was called first. A motion that begins above them, such as a retreat from a
        contact, ends when the load grows by a tenth.
        """
        speed, acceleration = self.limits.checked(T_b_t, speed, acceleration)
        goal = np.array(T_b_t, float)
        self._begin(goal, speed, acceleration, followed=False)
        return goal

    def stop(self, timeout: float = SAFETY.stop_timeout_s) -> None:
        """Brake the arm and return when it stands, as in `Arm.stop`."""
        with self._command_lock:
            self._stops, self._sent_time, self._free_watch = self._stops + 1, -np.inf, None
            self._call(self.brake)
        deadline = self.clock.now() + timeout
        while self.state().moving:
            if not self.clock.now() <= deadline:
                raise DeviceError(f"{self.name} was not seen to stop within {timeout:g} s")
            self.clock.sleep(self.poll_s)

    def zero_wrench(self, timeout: float = 1.0) -> None:
        """Zero the measured wrench at its present value, as in `Arm.zero_wrench`."""
        if self.state().moving:
            raise DeviceError("The wrench can be zeroed only while the arm stands.")
        self._call(self.zero_sensor)

    def go(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> ArmState:
        """Move the tool straight to a pose and wait for the end, as in `GuardedArm.go`."""
        speed, acceleration = self.limits.checked(T_b_t, speed, acceleration)
        reason, _, state = self._guarded(np.array(T_b_t, float), speed, acceleration)
        if reason != "distance":
            raise _collision_error(state)
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
        """Move the tool along its z axis up to a stop condition, load or distance, as in `GuardedArm.approach`."""
        self.limits.check_approach(distance, force, torque)
        start = self.state().T_b_t
        goal = translated_along_z(start, distance)
        self.limits.check(goal, speed, acceleration)
        reason, answer, trigger = self._guarded(goal, speed, acceleration, (force, torque), stop_condition)
        state = self.state()
        distance_moved = float(np.linalg.norm(state.T_b_t[:3, 3] - start[:3, 3]))
        return ApproachResult(reason, answer, trigger, state, distance_moved)

    def _begin(
        self,
        goal: Array,
        speed: float,
        acceleration: float,
        bounds: tuple[float, float] | None = None,
        followed: bool = True,
    ) -> tuple[MotionWatch, ArmState, int]:
        """Start a motion of the standing arm.

        Args:
            goal: (4, 4) T_b_t in m.
            speed: Speed in m/s.
            acceleration: Acceleration in m/s^2.
            bounds: Force (N) and torque (Nm) that end the motion; None for those of a free motion.
            followed: Whether the caller checks the states; otherwise `state` does.

        Returns:
            The watch of the motion, the state at its start, and the number of stops before it.
        """
        if self.state().moving:
            self.stop()
        stops, start = self._stops, self.state()
        position = start.T_b_t[:3, 3]
        if not start.safe:
            raise DeviceError(f"{self.name} made a protective or emergency stop; release it, and connect again")
        if not self.limits.contains(position, SAFETY.goal_tolerance_m):
            at = format_position(position)
            raise DeviceError(f"The tool at {at} m is outside its box: bring it back with the pendant.")
        force, torque = bounds or free_limits(self.limits, start.wrench)
        watch = MotionWatch(
            self,
            self.limits,
            start,
            distance=float(np.linalg.norm(goal[:3, 3] - position)),
            speed=speed,
            force=force,
            torque=torque,
            clock=self.clock,
        )
        with self._command_lock:
            if self._stops != stops or not self._accepting:
                raise MotionStoppedError(f"{self.name} was stopped by request.")
            self.bounds = force, torque
            try:
                self._call(self.begin_line, goal, speed, acceleration)
                if self._stops != stops:
                    raise MotionStoppedError(f"{self.name} was stopped by request.")
            except BaseException:
                self._halt()  # the motion may have begun nevertheless
                raise
            with self._state_lock:
                self._sent_time, self._free_watch = self.clock.now(), None if followed else watch
        return watch, start, stops

    def _guarded(
        self,
        goal: Array,
        speed: float,
        acceleration: float,
        bounds: tuple[float, float] | None = None,
        stop_condition: Callable[[ArmState], Any] | None = None,
    ) -> tuple[StopReason, Any, ArmState]:
        """Follow a motion until the arm stands.

        Returns:
            The reason for the end, the answer of the stop condition, and the state that ended the motion.
        """
        ended, unwatched = threading.Event(), threading.Event()
        # Without a stop condition no caller can hang, and a busy computer is not a fault.
        max_age = max(self.state_timeout, SAFETY.max_state_age_s if stop_condition is None else 0.0)
        supervisor = threading.Thread(target=self._supervise, args=(ended, unwatched, max_age), daemon=True)
        try:
            watch, start, stops = self._begin(goal, speed, acceleration, bounds)
            now, self._watched_time, newest = self.clock.now(), time.monotonic(), start
            if isinstance(self.clock, MonotonicClock):
                supervisor.start()
            elapsed, max_duration = 0.0, _max_duration(start.T_b_t, goal, speed, acceleration)
            while True:
                self.clock.sleep(self.poll_s)
                before, newest, answer = newest, self.state(), None
                above = watch(newest)
                if unwatched.is_set():
                    raise DeviceError(
                        f"{self.name} was not watched for {max_age:g} s and was stopped: {BUSY}, or correct the stop "
                        "condition if it takes that long"
                    )
                if self._stops != stops:
                    raise MotionStoppedError(f"{self.name} was stopped by request.")
                last, now = now, self.clock.now()
                elapsed += (now - last) * max(self.speed_share(), SAFETY.paused_speed_share)  # NaN stays NaN
                if not elapsed <= max_duration:
                    remedy = "" if self.source == "real" else f"; {BUSY}"
                    raise DeviceError(f"{self.name} took too long for a motion, and was stopped{remedy}")
                self._watched_time = time.monotonic()
                if above is None and newest.moving and newest.time != before.time and stop_condition is not None:
                    answer = stop_condition(newest)
                    self._watched_time = time.monotonic()
                if above or answer:
                    break
                may_start = now < watch.start_time + SAFETY.start_timeout_s
                if not (newest.moving or (_not_begun(start, newest, goal) and may_start)):
                    _check_arrival(newest.T_b_t, goal)
                    return "distance", None, newest
            self.stop()
        except BaseException:
            self._halt()
            raise
        finally:
            ended.set()
            if supervisor.is_alive():
                supervisor.join()
        return (above, None, newest) if above else ("condition", answer, newest)

    def _supervise(self, ended: threading.Event, unwatched: threading.Event, max_age: float) -> None:
        """Brake if a motion has not been polled for `max_age` seconds."""
        while not ended.wait(self.poll_s):
            if not time.monotonic() - self._watched_time <= max_age:
                unwatched.set()
                self._halt(ended)
                return

    def _halt(self, ended: threading.Event | None = None) -> None:
        """Brake until the arm stands, repeatedly if the driver fails.

        Give up after the stop timeout, or when `ended` returns that the motion is over.
        """
        deadline = self.clock.now() + SAFETY.stop_timeout_s
        while self.clock.now() <= deadline and not (ended and ended.is_set()):
            try:
                self.stop(SAFETY.stop_timeout_s)
            except Exception:
                self.clock.sleep(self.poll_s)
            else:
                return

    def _call(self, method: Callable[..., T], *arguments: Any) -> T:
        """Call a method of the driver, and turn every exception that it raises into a DeviceError."""
        try:
            return method(*arguments)
        except DeviceError:
            raise
        except Exception as error:  # a library may raise anything
            raise DeviceError(f"{self.name} failed ({error}); check its connection") from error


@contextlib.contextmanager
def signals_ignored() -> Iterator[None]:
    """Within the block, ignore SIGINT, SIGTERM and SIGHUP; has an effect on the main thread only."""
    main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, lambda *_: None) for number in ENDING_SIGNALS if main}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _not_begun(start: ArmState, state: ArmState, goal: Array) -> bool:
    """Test whether an arm has hardly moved towards its goal."""
    requested, covered = pose_difference(start.T_b_t, goal), pose_difference(start.T_b_t, state.T_b_t)
    return max(requested) > SAFETY.min_motion and all(
        part <= SAFETY.min_start_progress * whole for part, whole in zip(covered, requested, strict=True)
    )


def _max_duration(start: Array, goal: Array, speed: float, acceleration: float) -> float:
    """Time (s) that a straight motion may take at full speed: a multiple of a trapezoid of speed."""
    distance, angle = pose_difference(start, goal)
    length = max(distance, SAFETY.rotation_lever_m * angle)
    return SAFETY.duration_factor * (length / speed + speed / acceleration) + SAFETY.duration_margin_s


def _check_arrival(pose: Array, goal: Array) -> None:
    """Raise DeviceError if a finished motion did not reach its goal."""
    distance, angle = pose_difference(pose, goal)
    if not (distance <= SAFETY.goal_tolerance_m and angle <= SAFETY.goal_tolerance_rad):
        raise DeviceError(f"The motion ended {1e3 * distance:.1f} mm and {np.degrees(angle):.1f} degrees off its goal.")


def _collision_error(state: ArmState) -> DeviceError:
    force, torque = np.linalg.norm(state.wrench.reshape(2, 3), axis=1)
    return DeviceError(f"The arm met something on its way ({force:.1f} N, {torque:.1f} Nm) and was stopped.")
