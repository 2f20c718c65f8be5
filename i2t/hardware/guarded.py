"""Guarded motions: what every state of an arm in motion must be, and an arm that is guarded by asking for states.

`MotionWatch` judges states, one after another, whoever's arm they are of. `GuardedByPolling` makes a `GuardedArm` of an
arm that can be asked for its state, sent along a line, and told to brake.

Frames: B robot base, T tool; metres, radians, newtons.
"""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeVar

import numpy as np

from i2t.errors import DeviceError, DeviceTimeoutError, MotionStoppedError, NotConnectedError
from i2t.hardware.base import DeviceBase
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.limits import MotionLimits, format_position
from i2t.hardware.poses import apart, shifted_along_z
from i2t.hardware.protocols import ApproachResult, Arm, ArmFeatures, ArmState, StopReason
from i2t.types import Array

GOAL_TOLERANCE = (1e-3, 0.01)  # m, rad: how near its goal a finished motion ends
ROTATION_LEVER_M = 0.25  # of path, that a radian is reckoned as, to know how long a motion may take
DURATION_FACTOR, DURATION_MARGIN_S = 2.0, 2.0  # a motion may take so much longer than a trapezoid of speed
RETREAT_FACTOR = 1.1  # by which the force may grow in a motion that begins above its limit
MOST_START_SHARE = 2.0  # of the rig's limits, that may be felt where a free motion begins
BOX_MARGIN_M, TRAVEL_MARGIN_M = 5e-3, 3e-3  # of a state: outside the box; past the goal
SPEED_FACTOR, SPEED_MARGIN_M_S = 1.5, 0.02  # of a state, over the speed that was asked
MOST_TURN_RAD_S = 10.0  # of a tool: no arm that carries a skin turns it so fast
STATE_AGE_S = 0.25  # of a state in a motion, at the most: a press gains 5 N meanwhile, at 10 N/mm
LEAST_WAY = 1e-5  # m or rad, of a motion that is one
HALT_S = 1.0  # in which an arm must have been told to brake, and stand
STILL_S = 3.0  # in which the pose of an arm that says that it moves must have changed
START_S, START_SHARE = 0.5, 0.1  # in which an arm must have begun a motion, and gone that part of it
SLOWEST_SHARE, PAUSED_SHARE = 0.05, 0.01  # of the asked speed, to which a person may turn an arm down; below, it waits
T = TypeVar("T")
# Windows has no SIGHUP.
BRAKING_SIGNALS = [signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
NUMBERS = ("T_b_t", "joints", "velocity", "wrench")  # of a state


class MotionWatch:
    """Judge of the states of one motion.

    Args:
        arm: Whose they are. One that is taken for lost only later (`state_timeout`, s) may give older states, and the
            pose of one that a person may pause (`can_be_paused`) may stand still while it says that it moves.
        limits: Of the rig.
        start: Where the motion begins.
        distance: m, that the tool goes.
        speed: m/s, that was asked.
        force: N, norm of the force that ends the motion.
        torque: Nm, likewise.
        clock: That dates states.
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
        self._age = max(STATE_AGE_S, getattr(arm, "state_timeout", 0.0))
        self._still = np.inf if getattr(arm, "can_be_paused", False) else STILL_S
        self._start, self._distance, self._speed = start.T_b_t[:3, 3], distance, speed
        self._force, self._torque = force, torque
        self.begun = self._changed = clock.now()  # when the pose was another for the last time
        self._newest = start

    def __call__(self, state: ArmState) -> Literal["force", "torque"] | None:
        """Judge a state.

        Args:
            state: The newest.

        Returns:
            What is above its limit, if anything.

        Raises:
            DeviceTimeoutError: The state is old, or older than the one before.
            DeviceError: It holds what is no number, or the arm is outside its box, too far, too fast, or not safe.
        """
        now, position, before = self._clock.now(), state.T_b_t[:3, 3], self._newest
        if wrong := not_numbers(state):
            raise DeviceError(f"{self._name} says that its {wrong}, which is no number; it was stopped")
        if not state.time - before.time >= 0 or not abs(now - state.time) <= self._age:
            raise DeviceTimeoutError(f"{self._name} gives no new states; it was stopped, check its connection")
        if not state.safe:
            raise DeviceError(f"{self._name} made a protective or emergency stop; clear its cause, and release it")
        if not self._limits.contains(position, BOX_MARGIN_M):
            raise DeviceError(f"{self._name} is outside its box, at {format_position(position)} m; it was stopped")
        travel, speed = float(np.linalg.norm(position - self._start)), float(np.linalg.norm(state.velocity[:3]))
        if not travel <= self._distance + TRAVEL_MARGIN_M:
            raise DeviceError(f"{self._name} went {1e3 * travel:.3g} mm where {1e3 * self._distance:.3g} were asked")
        if not speed <= SPEED_FACTOR * self._speed + SPEED_MARGIN_M_S:
            raise DeviceError(f"{self._name} moves at {speed:.3g} m/s where {self._speed:.3g} were asked")
        if not np.linalg.norm(state.velocity[3:]) <= MOST_TURN_RAD_S:
            raise DeviceError(f"{self._name} turns at {np.linalg.norm(state.velocity[3:]):.3g} rad/s; it was stopped")
        if not state.moving or not np.array_equal(state.T_b_t, before.T_b_t):
            self._changed = now
        if not now - self._changed <= self._still:
            raise DeviceError(f"{self._name} says that it moves, but its pose stands still; is its speed slider at 0?")
        self._newest = state
        force, torque = np.linalg.norm(state.wrench.reshape(2, 3), axis=1)
        return "force" if not force <= self._force else "torque" if not torque <= self._torque else None


def not_numbers(state: ArmState) -> str:
    """Find what is NaN or infinite in a state.

    Args:
        state: Of an arm.

    Returns:
        Such as "wrench is [nan, 0.0, ...]"; empty where all is finite.
    """
    for name in NUMBERS:
        values = np.asarray(getattr(state, name), float)
        if not np.isfinite(values).all():
            return f"{name.replace('T_b_t', 'pose')} is {np.round(values, 3).tolist()}"
    return ""


def free_limits(limits: MotionLimits, wrench: Array) -> tuple[float, float]:
    """Force and torque that stop a free motion, which may begin above them, as one that backs out of a contact.

    Args:
        limits: Of the rig.
        wrench: (6,) N and Nm, where it begins.

    Returns:
        The trip force (N) and the limit of torque (Nm), or a tenth more than is felt already.

    Raises:
        DeviceError: So much is felt that no motion may begin.
    """
    force, torque = (float(each) for each in np.linalg.norm(np.reshape(wrench, (2, 3)), axis=1))
    if not (force <= MOST_START_SHARE * limits.force and torque <= MOST_START_SHARE * limits.torque):
        raise DeviceError(
            f"The arm feels {force:.0f} N and {torque:.0f} Nm before it moves: free the tool with the pendant, and "
            "check the payload."
        )
    return max(limits.trip_force, RETREAT_FACTOR * force), max(limits.torque, RETREAT_FACTOR * torque)


class GuardedByPolling(DeviceBase):
    """A guarded arm (`i2t.hardware.protocols.GuardedArm`) of a driver with six short methods.

    Its states are asked for every `poll_s` seconds while it moves. It brakes where something is above a limit, a state
    is old or nonsense, the caller's stop condition says so, an error ends the call, or nobody has looked for
    `state_timeout` seconds, as where a stop condition hangs. A motion that `move` began is judged only where its caller
    asks for a state. What a driver raises becomes a DeviceError. A driver gives

        open_link, close_link     to the arm; closing may be asked for at any time
        read_state                the newest `ArmState`, as fresh as it can be had
        begin_line                a straight motion, without waiting for its end; its arm may stop itself by `bounds`
        brake                     to a stand, at once, without waiting for it; from any thread
        zero_sensor               of force and torque; the arm stands

    Args:
        limits: Box, speed, acceleration, force and torque that nothing exceeds.
        clock: In whose time the arm lives; by default this machine's.
    """

    name = "the arm"  # for messages
    source: Literal["real", "simulated", "emulated"] = "real"
    rate = 125.0  # Hz, of its states
    state_timeout = STATE_AGE_S  # s, that a state may be old
    can_be_paused = False  # by a person, so that it moves and its pose stands still
    poll_s = 0.008  # between two looks
    start_s = 0.1  # in which a motion that was asked for shows in the flag `moving` of states of then

    def __init__(self, limits: MotionLimits, clock: Clock | None = None) -> None:
        self.limits, self.clock = limits, clock or MonotonicClock()
        self._open = self._accepting = False  # whether there is a link, and whether a motion may begin
        self._stops, self._begun = 0, -np.inf  # s, when the newest motion was sent
        self._free: MotionWatch | None = None  # of a motion that `move` began
        self._judging = threading.RLock()  # states are judged in the order in which they are read
        self.bounds = (0.0, 0.0)  # N, Nm, of the motion that is begun
        self._ordering = threading.RLock()  # a line is sent before a brake or not at all
        self._looked = np.inf  # s, of this machine's clock, when a motion was looked at last

    # What a driver gives

    def open_link(self) -> None:
        """Connect; raises DeviceError."""

    def close_link(self) -> None:
        """Disconnect, as often as one likes."""

    def read_state(self) -> ArmState:
        """The newest state."""
        raise NotImplementedError

    def begin_line(self, T_b_t: Array, speed: float, acceleration: float) -> None:
        """Start a straight motion and return at once; the arm stands.

        Args:
            T_b_t: (4, 4) goal, m.
            speed: m/s.
            acceleration: m/s^2.
        """
        raise NotImplementedError

    def brake(self) -> None:
        """Brake, without waiting for the stand."""
        raise NotImplementedError

    def zero_sensor(self) -> None:
        """Take the wrench felt now for zero."""
        raise NotImplementedError

    def speed_share(self) -> float:
        """Share of the asked speed that a person leaves at the arm now; where that is not known, the least."""
        return SLOWEST_SHARE

    # What it has by that

    @property
    def features(self) -> ArmFeatures:
        """Features, known before `connect`."""
        limits = self.limits
        return ArmFeatures(self.name, self.source, self.rate, limits.box, limits.speed, limits.acceleration)

    def connect(self) -> None:
        """Connect, anew if need be; raises DeviceError."""
        self.close()
        self._ask(self.open_link)
        self._open = self._accepting = True

    def close(self) -> None:
        """Brake and disconnect; raises nothing."""
        with self._ordering:
            self._accepting = False
        if self._open:
            self._halt()
        self._open = False
        with contextlib.suppress(Exception):
            self.close_link()

    def __exit__(self, *error: Any) -> None:
        with signals_ignored():  # a second Ctrl-C must not keep the arm from being stopped
            self.close()

    def state(self, timeout: float | None = None) -> ArmState:
        """The newest state, as in `Arm.state`.

        Args:
            timeout: s, how old it may be; by default as old as the state timeout.

        Returns:
            The state.

        Raises:
            DeviceTimeoutError: It is older; the arm has been told to stop.
            DeviceError: It is nonsense, or a motion that `move` began has met something or is not as it was asked; the
                arm has been told to stop.
        """
        if not self._open:
            raise NotConnectedError(f"{self.name} is not connected; call connect() or use with")
        with self._judging:
            state, now = self._ask(self.read_state), self.clock.now()
            wrong, oldest = not_numbers(state), self.state_timeout if timeout is None else timeout
            fresh, failure, free = -STATE_AGE_S <= now - state.time <= oldest, None, self._free
            if fresh and not wrong:
                self._begun = -np.inf if state.moving else self._begun
                state = state._replace(moving=state.moving or state.time - self._begun < self.start_s)
                try:
                    failure = _met_something(state) if free is not None and free(state) else None
                except DeviceError as error:
                    failure = error
                if free is not None and not state.moving and now > free.begun + START_S:
                    self._free = None
        if failure is not None:
            self._halt()
            raise failure
        if not (fresh and not wrong):
            self._stops += 1
            self._ask(self.brake)
            if not fresh:
                raise DeviceTimeoutError(f"{self.name} gives a state of {now - state.time:.2g} s ago; it was stopped")
            raise DeviceError(f"{self.name} says that its {wrong}, which is no number; it was stopped")
        return state

    def move(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> Array:
        """Start a straight motion and return at once, as in `Arm.move`; by default as fast as the limits allow.

        A force above a third of the limit (`MotionLimits.trip_force`) or a torque above its own ends the motion, of
        which the next `state` tells, unless `stop` came first; one that begins above them, as one that backs out of a
        contact, ends where it gets worse by a tenth.
        """
        speed, acceleration = self.limits.checked(T_b_t, speed, acceleration)
        goal = np.array(T_b_t, float)
        self._begin(goal, speed, acceleration, followed=False)
        return goal

    def stop(self, timeout: float = HALT_S) -> None:
        """Brake and return when the arm stands, as in `Arm.stop`."""
        with self._ordering:
            self._stops, self._begun, self._free = self._stops + 1, -np.inf, None
            self._ask(self.brake)
        until = self.clock.now() + timeout
        while self.state().moving:
            if not self.clock.now() <= until:
                raise DeviceError(f"{self.name} was not seen to stop within {timeout:g} s")
            self.clock.sleep(self.poll_s)

    def zero_wrench(self, timeout: float = 1.0) -> None:
        """Take the wrench felt now as zero, as in `Arm.zero_wrench`."""
        if self.state().moving:
            raise DeviceError("The wrench can be zeroed only while the arm stands.")
        self._ask(self.zero_sensor)

    def go(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> ArmState:
        """Move straight to a pose and wait, as in `GuardedArm.go`."""
        speed, acceleration = self.limits.checked(T_b_t, speed, acceleration)
        reason, _, state = self._guarded(np.array(T_b_t, float), speed, acceleration)
        if reason != "distance":
            raise _met_something(state)
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
        """Move along tool z until something says stop, as in `GuardedArm.approach`."""
        self.limits.check_approach(distance, force, torque)
        start = self.state().T_b_t
        goal = shifted_along_z(start, distance)
        self.limits.check(goal, speed, acceleration)
        reason, answer, trigger = self._guarded(goal, speed, acceleration, (force, torque), stop_condition)
        state = self.state()
        moved = float(np.linalg.norm(state.T_b_t[:3, 3] - start[:3, 3]))
        return ApproachResult(reason, answer, trigger, state, moved)

    def _begin(
        self,
        goal: Array,
        speed: float,
        acceleration: float,
        bounds: tuple[float, float] | None = None,
        followed: bool = True,
    ) -> tuple[MotionWatch, ArmState, int]:
        """Start a motion from a stand, inside the box, under bounds (N, Nm), by default those of free motions; returns
        its judge, whom `state` asks where nobody follows it, where it begins, and the number of stops so far.
        """
        if self.state().moving:
            self.stop()
        stops, start = self._stops, self.state()
        position = start.T_b_t[:3, 3]
        if not start.safe:
            raise DeviceError(f"{self.name} made a protective or emergency stop; release it, and connect again")
        if not self.limits.contains(position, GOAL_TOLERANCE[0]):
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
        with self._ordering:
            if self._stops != stops or not self._accepting:
                raise MotionStoppedError(f"{self.name} was stopped by request.")
            self.bounds = force, torque
            try:
                self._ask(self.begin_line, goal, speed, acceleration)
                if self._stops != stops:
                    raise MotionStoppedError(f"{self.name} was stopped by request.")
            except BaseException:
                self._halt()  # it may have begun all the same
                raise
            with self._judging:
                self._begun, self._free = self.clock.now(), None if followed else watch
        return watch, start, stops

    def _guarded(
        self,
        goal: Array,
        speed: float,
        acceleration: float,
        bounds: tuple[float, float] | None = None,
        stop_condition: Callable[[ArmState], Any] | None = None,
    ) -> tuple[StopReason, Any, ArmState]:
        """Follow a motion until the arm stands: what ended it, the stop condition's answer, and the state that did."""
        ended, unattended = threading.Event(), threading.Event()
        age = max(self.state_timeout, STATE_AGE_S if stop_condition is None else 0.0)  # a busy computer is no fault
        attending = threading.Thread(target=self._attend, args=(ended, unattended, age), daemon=True)
        try:
            watch, start, stops = self._begin(goal, speed, acceleration, bounds)
            now, self._looked, newest = self.clock.now(), time.monotonic(), start
            if isinstance(self.clock, MonotonicClock):
                attending.start()
            used, longest = 0.0, _longest_duration(start.T_b_t, goal, speed, acceleration)
            while True:
                self.clock.sleep(self.poll_s)
                before, newest, answer = newest, self.state(), None
                above = watch(newest)
                if unattended.is_set():
                    raise DeviceError(f"Nobody looked at {self.name} for {age:g} s: it was stopped.")
                if self._stops != stops:
                    raise MotionStoppedError(f"{self.name} was stopped by request.")
                last, now = now, self.clock.now()
                used += (now - last) * max(self.speed_share(), PAUSED_SHARE)  # NaN stays NaN
                if not used <= longest:
                    raise DeviceError(f"{self.name} took longer for a motion than it may, and was stopped")
                self._looked = time.monotonic()
                if above is None and newest.moving and newest.time != before.time and stop_condition is not None:
                    answer = stop_condition(newest)
                    self._looked = time.monotonic()
                if above or answer:
                    break
                if not (newest.moving or (_not_begun(start, newest, goal) and now < watch.begun + START_S)):
                    off = apart(newest.T_b_t, goal)
                    if not all(part <= most for part, most in zip(off, GOAL_TOLERANCE, strict=True)):
                        away = f"{1e3 * off[0]:.1f} mm and {np.degrees(off[1]):.1f} degrees"
                        raise DeviceError(f"The motion ended {away} off its goal.")
                    return "distance", None, newest
            self.stop()
        except BaseException:
            self._halt()
            raise
        finally:
            ended.set()
            if attending.is_alive():
                attending.join()
        return (above, None, newest) if above else ("condition", answer, newest)

    def _attend(self, ended: threading.Event, unattended: threading.Event, age: float) -> None:
        """Brake where nobody has looked at a motion for so long (s)."""
        while not ended.wait(self.poll_s):
            if not time.monotonic() - self._looked <= age:
                unattended.set()
                self._halt(ended)
                return

    def _halt(self, ended: threading.Event | None = None) -> None:
        """Brake until it stands, again where the driver fails; gives up after a second, or when the motion has ended
        that it is to stop.
        """
        until = self.clock.now() + HALT_S
        while self.clock.now() <= until and not (ended and ended.is_set()):
            try:
                self.stop(HALT_S)
            except Exception:
                self.clock.sleep(self.poll_s)
            else:
                return

    def _ask(self, call: Callable[..., T], *arguments: Any) -> T:
        """What a driver answers; whatever it raises is a DeviceError."""
        try:
            return call(*arguments)
        except DeviceError:
            raise
        except Exception as error:  # a library may raise anything
            raise DeviceError(f"{self.name} failed ({error}); check its connection") from error


@contextlib.contextmanager
def signals_ignored() -> Iterator[None]:
    """Within, on the main thread, what ends a program does not."""
    main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, lambda *_: None) for number in BRAKING_SIGNALS if main}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _not_begun(start: ArmState, state: ArmState, goal: Array) -> bool:
    """Tell whether an arm has gone hardly any part of its way."""
    asked, gone = apart(start.T_b_t, goal), apart(start.T_b_t, state.T_b_t)
    return max(asked) > LEAST_WAY and all(part <= START_SHARE * whole for part, whole in zip(gone, asked, strict=True))


def _longest_duration(start: Array, goal: Array, speed: float, acceleration: float) -> float:
    """Time (s) that a straight motion may take at full speed."""
    distance, turn = apart(start, goal)
    length = max(distance, ROTATION_LEVER_M * turn)
    return DURATION_FACTOR * (length / speed + speed / acceleration) + DURATION_MARGIN_S


def _met_something(state: ArmState) -> DeviceError:
    force, torque = np.linalg.norm(state.wrench.reshape(2, 3), axis=1)
    return DeviceError(f"The arm met something on its way ({force:.1f} N, {torque:.1f} Nm) and was stopped.")
