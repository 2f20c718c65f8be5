"""How a UR arm moves: straight, asynchronously, watched, and only where and as fast as it may.

A motion is refused before anything is sent if its goal is outside the box or it is too fast; once it runs, the thread
of `i2t.hardware.ur.rtde_link` stops it at its force or torque, and an approach when nobody watches it either.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.errors import DeviceError
from i2t.hardware.limits import Limits, place
from i2t.hardware.protocols import ApproachResult, ArmState
from i2t.hardware.ur.rtde_link import POLL, Link, from_ur, to_ur
from i2t.types import Array

REACHED = (1e-3, 0.01)  # m, rad: how near its goal a finished motion ends
LEVER = 0.25  # m of travel that a radian is reckoned as, to know how long a motion may take


class Motions(Link):
    """The motions of an arm within `limits`."""

    limits: Limits

    def state(self, timeout: float | None = None) -> ArmState:
        """The newest state, at most `timeout` old (by default `stale`); raises DeviceTimeoutError, with the arm stopped
        as far as it can be told to, and DeviceError once for anything else that has stopped it.
        """
        return self._newest(self.stale if timeout is None else timeout).arm

    def move(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> Array:
        """Start a straight motion to a (4, 4) pose and return what was sent; one under way is stopped first.

        Raises ValueError, before anything is sent, if the goal is outside the box or too fast. A force or torque above
        the limits stops the motion, and the next `state` says so; a motion that begins above them, as one that backs
        out of a contact, is stopped where it gets worse by a tenth.
        """
        speed = self.limits.speed if speed is None else speed
        acceleration = self.limits.acceleration if acceleration is None else acceleration
        self.limits.check(T_b_t, speed, acceleration)
        self._begin(T_b_t, speed, acceleration, self.limits.force, self.limits.torque, False)
        return from_ur(to_ur(T_b_t))

    def zero_wrench(self, timeout: float = 1.0) -> None:
        """Take the wrench felt now for zero; raises DeviceError while the arm moves."""
        if self.state().moving:
            raise DeviceError("The wrench can be zeroed only while the arm stands.")
        self._ask(self._control.zeroFtSensor, timeout)

    # Motions that are followed to their end

    def go(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> ArmState:
        """Move straight to a (4, 4) pose and return the state at rest; raises DeviceError if it ends elsewhere."""
        speed = self.limits.speed if speed is None else speed
        acceleration = self.limits.acceleration if acceleration is None else acceleration
        self.limits.check(T_b_t, speed, acceleration)
        with self._standing_at_the_end():
            begun = self._begin(T_b_t, speed, acceleration, self.limits.force, self.limits.torque, False)
            for state in self._follow(*begun):
                if not state.moving:
                    break
            _arrived(state, T_b_t)
        return state

    def approach(
        self,
        travel: float,
        speed: float = 0.005,
        verdict: Callable[[ArmState], Any] | None = None,
        force: float = 8.0,
        torque: float = 8.0,
        acceleration: float = 0.2,
    ) -> ApproachResult:
        """Move along the tool's z axis, out of the skin, until something says stop.

        Args:
            travel: m, to stop after at the latest
            speed: m/s
            verdict: called with each new state in the caller's thread; anything true stops the arm
            force: N, norm of the force that stops the arm
            torque: Nm, norm of the torque that stops the arm
            acceleration: m/s^2

        Raises ValueError before anything is sent, DeviceError if the arm is lost or stopped by somebody else.
        """
        self.limits.check_approach(travel, force, torque)
        start = self.state().T_b_t
        goal = start.copy()
        goal[:3, 3] += travel * goal[:3, 2]
        self.limits.check(goal, speed, acceleration)
        reason: Any = "travel"
        said: Any = None
        with self._standing_at_the_end():
            for trigger in self._follow(*self._begin(goal, speed, acceleration, force, torque, True)):
                if self._tripped is not None:
                    reason, trigger = self._tripped
                elif trigger.moving and verdict is not None:
                    said = verdict(trigger)
                    reason = "verdict" if said else reason
                if reason != "travel":
                    break
                if not trigger.moving:
                    _arrived(trigger, goal)
                    break
        state = self.state()
        moved = float(np.linalg.norm(state.T_b_t[:3, 3] - start[:3, 3]))
        return ApproachResult(reason, said, trigger, state, moved)

    @contextlib.contextmanager
    def _standing_at_the_end(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            with contextlib.suppress(DeviceError):
                self.stop()
            raise
        if self._fresh(self.stale).arm.moving:
            self.stop()

    def _follow(self, patience: float, stops: int) -> Iterator[ArmState]:
        """New states as long as all is well; `patience` is what the motion may take at full speed (s)."""
        used, seen, then = 0.0, -1.0, time.monotonic()
        while used < patience:
            news = self._usable(stops)
            now = self._looked = time.monotonic()
            used, then = used + (now - then) * max(news.fraction, 0.01), now
            if news.clock != seen:
                seen = news.clock
                yield news.arm
            self._looked = time.monotonic()
            time.sleep(POLL / 2)
        raise DeviceError(f"The motion took longer than {patience:.1f} s and was stopped.")

    # Before a motion

    def _begin(
        self, goal: Array, speed: float, acceleration: float, force: float, torque: float, watched: bool
    ) -> tuple[float, int]:
        """Start a motion; returns how long it may take at full speed (s), and the number of stops so far."""
        stops = self._stops
        start = self._usable(stops).arm
        if start.moving:
            self.stop()
            stops = self._stops
        at = start.T_b_t[:3, 3]
        if not self.limits.hold(at, REACHED[0]):
            raise DeviceError(f"The tool at {place(at)} m is outside its box: bring it back with the pendant.")

        if not watched:  # a way out of a contact must not be barred
            felt = np.linalg.norm(start.wrench.reshape(2, 3), axis=1)
            force, torque = max(force, 1.1 * float(felt[0])), max(torque, 1.1 * float(felt[1]))

        def guard(state: ArmState) -> str:
            if np.linalg.norm(state.wrench[:3]) > force:
                return "force"
            return "torque" if np.linalg.norm(state.wrench[3:]) > torque else ""

        def begin() -> None:
            self._usable(stops)
            before = self._control.getAsyncOperationProgressEx().operationId()
            self._tripped, self._watched, self._looked = None, watched, time.monotonic()
            self._before = before, time.monotonic()
            if not self._control.moveL(to_ur(goal), speed, acceleration, True):
                self._before = None
                raise DeviceError(f"The controller at {self.host} did not take the motion.")
            self._guard = guard
            self._observe()

        try:
            self._ask(begin)
        except BaseException:
            self._halt = True  # it may have begun all the same
            raise
        turn = Rotation.from_matrix(goal[:3, :3] @ start.T_b_t[:3, :3].T).magnitude()
        length = max(float(np.linalg.norm(goal[:3, 3] - at)), LEVER * turn)
        return 2 * (length / speed + speed / acceleration) + 2.0, stops


def _arrived(state: ArmState, goal: Array) -> None:
    off = np.linalg.norm(state.T_b_t[:3, 3] - goal[:3, 3])
    turn = Rotation.from_matrix(goal[:3, :3] @ state.T_b_t[:3, :3].T).magnitude()
    if off > REACHED[0] or turn > REACHED[1]:
        raise DeviceError(f"The motion ended {1e3 * off:.1f} mm and {np.degrees(turn):.1f} degrees off its goal.")
