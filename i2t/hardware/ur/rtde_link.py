"""The one thread that speaks with a UR controller: it looks, brakes, passes on commands and feeds the watchdog.

Every 10 ms it looks at the state, brakes if a limit is crossed or somebody asked for it, passes on a command if one
waits, and feeds the controller's watchdog at 50 Hz. Whoever wants something of the client library asks this thread.
When no news come the watchdog is fed no longer, so that the controller ends the program by itself, and "stop" goes to
the dashboard, another connection.
"""

import contextlib
import ctypes
import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.errors import DeviceError, DeviceTimeoutError, MotionStoppedError, NotConnectedError
from i2t.hardware.protocols import ArmState
from i2t.hardware.ur.access import ask_dashboard
from i2t.types import Array

POLL = 0.01  # s
FEED = 0.02  # s between two kicks of the watchdog
RATE = 125.0  # Hz, of states
BRAKE = 2.0  # m/s^2
STILL = 1e-3  # m/s and rad/s: slower is standing
SETTLED = 0.05  # s of the controller's clock after a command to brake: news of before may still be on their way
PLAYING, NORMAL, REDUCED = 2, 0x1, 0x2
VARIABLES = [
    "timestamp",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "actual_q",
    "target_speed_fraction",
    "runtime_state",
    "safety_status_bits",
]


class News(NamedTuple):
    """What the controller said last."""

    arm: ArmState
    clock: float  # s, the controller's own
    fraction: float  # of the asked speed that the slider leaves
    program: bool  # whether the program that obeys us runs
    operation: int  # number of the newest motion


def to_ur(pose: Array) -> list[float]:
    """Position and rotation vector of a (4, 4) transform, as a UR controller takes them."""
    return [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()]


def from_ur(vector: Sequence[Any]) -> Array:
    """(4, 4) transform of a UR pose."""
    pose = np.eye(4)
    pose[:3, 3], pose[:3, :3] = vector[:3], Rotation.from_rotvec(vector[3:]).as_matrix()
    return pose


class Link:
    """What is known of an arm now, and the thread that knows it; `i2t.hardware.ur.driver.UR` says what its values
    mean."""

    def __init__(self, host: str, stale: float, watchdog: float) -> None:
        self.host, self.stale, self.watchdog = host, stale, watchdog
        self._control: Any = None
        self._receive: Any = None
        self._connections: list[Any] = []
        self._abandoning: threading.Thread | None = None
        self._thread: threading.Thread | None = None
        self._commands: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        self._reset()

    def _reset(self) -> None:
        self._news: News | None = None
        self._trouble: DeviceError | None = None
        self._halt = False
        self._stops = 0
        self._braked = -np.inf  # the controller's clock when it was last told to brake
        self._before: tuple[int, float] | None = None  # the operation before one that has been asked for, and when
        self._guard: Callable[[ArmState], str] | None = None
        self._watched = False
        self._looked = 0.0
        self._tripped: tuple[str, ArmState] | None = None

    def stop(self, timeout: float = 1.0) -> None:
        """Brake and return when the arm stands, from any thread; raises DeviceError if it is not seen to stand."""
        if self._thread is None:
            return
        self._halt = True
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            state = self._fresh(timeout).arm
            if not self._halt and not state.moving:
                return
            time.sleep(POLL / 2)
        raise self._lose(f"The arm at {self.host} was not seen to stop within {timeout:g} s.")

    def _usable(self, stops: int) -> News:
        """The news, if a motion may start or go on; `stops` is how often `stop` had been called before."""
        news = self._newest(self.stale)
        if self._halt or self._stops != stops:
            raise MotionStoppedError(f"The arm at {self.host} was stopped by request.")
        if not news.arm.safe:
            raise DeviceError(
                f"The robot at {self.host} made a protective or emergency stop: clear its cause, then recover()."
            )
        return news

    def _newest(self, timeout: float) -> News:
        """The news, at most `timeout` old; raises whatever has gone wrong."""
        trouble = self._trouble
        if trouble is not None and not isinstance(trouble, DeviceTimeoutError):
            self._trouble = None
            raise trouble
        news = self._fresh(timeout)
        if not news.program and news.arm.safe:
            raise DeviceError(
                f"The program on the controller at {self.host} has ended, by the pendant, another client or the "
                "watchdog: connect() starts it again."
            )
        return news

    def _fresh(self, timeout: float) -> News:
        """The news, at most `timeout` old, waiting for the first; raises NotConnectedError or DeviceTimeoutError."""
        deadline = time.monotonic() + timeout
        while self._thread is not None and self._news is None and time.monotonic() < deadline:
            time.sleep(POLL / 2)
        news = self._news
        if isinstance(self._trouble, DeviceTimeoutError):
            raise self._trouble
        if self._thread is None:
            raise NotConnectedError(f"The arm at {self.host} is not connected.")
        age = np.inf if news is None else time.monotonic() - news.arm.time
        if news is None or age > timeout:
            raise self._lose(f"No news from the controller at {self.host} for {age:.2f} s: it was told to stop.")
        return news

    # The thread

    def _ask(self, call: Callable[[], Any], timeout: float = 2.0) -> Any:
        """Have the thread make a call into the library."""
        answer: Future[Any] = Future()
        self._commands.put((call, answer))
        deadline = time.monotonic() + timeout
        try:
            while time.monotonic() < deadline:
                with contextlib.suppress(FutureTimeout):
                    return answer.result(POLL)
                self._fresh(self.stale)
        finally:
            answer.cancel()
        raise DeviceError(f"The controller at {self.host} does not take commands.")

    def _serve(self) -> None:
        fed = 0.0
        while self._thread is threading.current_thread():
            try:
                self._observe()
                self._react()
                now = time.monotonic()
                news = self._news
                fresh = news is not None and news.program and now - news.arm.time <= self.stale
                if fresh and now - fed >= FEED:
                    fed = now
                    self._control.kickWatchdog()
            except Exception as error:
                self._lose(f"The connection to the controller at {self.host} broke: {error}.")
            time.sleep(POLL)

    def _observe(self) -> None:
        receive, last = self._receive, self._news
        clock = receive.getTimestamp()
        if clock == 0.0 or (last is not None and clock == last.clock and self._before is None):
            return
        now = time.monotonic() if last is None or clock != last.clock else last.arm.time
        status = self._control.getAsyncOperationProgressEx()
        if self._before is not None and (status.operationId() != self._before[0] or now > self._before[1] + 0.5):
            self._before = None
        pose, twist = from_ur(receive.getActualTCPPose()), np.array(receive.getActualTCPSpeed())
        wrench = np.array(receive.getActualTCPForce()).reshape(2, 3) @ pose[:3, :3]
        safe = bool(receive.getSafetyStatusBits() & (NORMAL | REDUCED))
        program = receive.getRuntimeState() == PLAYING
        # A program that has ended leaves its registers behind: then only the speed tells.
        busy = program and safe and (status.isAsyncOperationRunning() or self._before is not None)
        moving = bool(busy or np.linalg.norm(twist) > STILL or clock < self._braked + SETTLED)
        arm = ArmState(now, pose, np.array(receive.getActualQ()), twist, wrench.ravel(), moving, safe)
        self._news = News(arm, clock, receive.getTargetSpeedFraction(), program, status.operationId())

    def _react(self) -> None:
        """Brake where there is a reason to; then pass on what others ask."""
        news = self._news
        if news is not None and self._guard is not None:
            now = time.monotonic()
            reason = self._guard(news.arm)
            if now - news.arm.time > self.stale and news.arm.moving:
                age = now - news.arm.time
                self._lose(f"No news from the controller at {self.host} for {age:.2f} s: it was told to stop.")
            elif self._watched and now - self._looked > self.stale:
                self._brake()
                self._trouble = DeviceError(f"Nobody watched the arm's approach for {self.stale:g} s: it was stopped.")
            elif reason:
                self._tripped = reason, news.arm
                self._brake()
                if not self._watched:
                    felt = np.linalg.norm(news.arm.wrench.reshape(2, 3), axis=1)
                    self._trouble = DeviceError(
                        f"The arm met something on its way ({felt[0]:.1f} N, {felt[1]:.1f} Nm) and was stopped."
                    )
            elif not news.arm.moving:
                self._guard = None
        if self._halt:
            self._stops += 1
            self._brake()
            self._halt = False
        while not self._commands.empty() and self._thread is threading.current_thread():
            call, answer = self._commands.get()
            if answer.set_running_or_notify_cancel():
                try:
                    answer.set_result(call())
                except Exception as error:
                    answer.set_exception(error)

    def _brake(self) -> None:
        self._guard = self._before = None
        news = self._news
        if news is not None and time.monotonic() - news.arm.time > self.stale:
            self._lose(f"The controller at {self.host} fell silent: it was told to stop.")  # it would not answer
        elif news is not None and news.program and news.arm.safe:
            self._news = news._replace(arm=news.arm._replace(moving=True))  # until later news says otherwise
            self._braked = news.clock
            self._control.stopL(BRAKE, True)

    def _lose(self, sentence: str) -> DeviceTimeoutError:
        """Give the arm up: say why, and have the controller stop by the only other way there is."""
        if isinstance(self._trouble, DeviceTimeoutError):
            return self._trouble
        lost = self._trouble = DeviceTimeoutError(sentence)

        def abandon() -> None:
            with contextlib.suppress(OSError):
                ask_dashboard(self.host, "stop")
            self._let_go()

        thread = threading.Thread(target=abandon, daemon=True)
        thread.start()  # before others may join it
        self._abandoning = thread
        return lost

    # The client library

    def _kept(self, connection: Any) -> Any:
        # The library's destructors stop the whole interpreter for half a second, at a moment that the garbage collector
        # chooses, maybe in a motion. After a disconnect they have nothing left to do: a reference more, and none runs.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(connection))
        self._connections.append(connection)
        return connection

    def _let_go(self) -> None:
        """End the thread and the library's own, which would otherwise connect again by themselves and may crash."""
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join(1.0)
        # The library may wait for a dead controller: not for ever, and not for us.
        connections, self._connections = self._connections, []
        going = [threading.Thread(target=_disconnect, args=(each,), daemon=True) for each in connections]
        for each in going:
            each.start()
        for each in going:
            each.join(2.0)


def _disconnect(connection: Any) -> None:
    with contextlib.suppress(RuntimeError):
        connection.disconnect()
