"""A Universal Robots arm over ur_rtde, moved only in ways that can be watched and stopped.

One thread speaks with the controller: every 10 ms it looks at the state, brakes if a limit is crossed or somebody asked
for it, passes on a command if one waits, and feeds the controller's watchdog at 50 Hz. Motions are asynchronous
straight lines, so no call into the client library hides what the robot does, and `stop` works from any thread.

What stops the arm, besides `stop` and the limits of a motion:

- No news: during a motion the controller's clock must advance within `stale` seconds. Otherwise the watchdog is no
  longer fed, so that the controller ends the program by itself, and "stop" goes to the dashboard, another connection.
- Nobody watches: an approach whose caller has not looked for `stale` seconds, as when its verdict hangs.
- This process dies, even by kill -9: the watchdog runs dry (`watchdog` Hz; 0.1 s by default) and the controller ends
  the program. Ctrl-C and SIGTERM brake at once, inside a `with` block on the main thread.

Poses are (4, 4) T_b_t in metres, tool in robot base; forces act on the tool, in the tool's axes. The box holds the
tool's origin: flange, elbow and cable are not watched here, so set the robot's own safety limits on the pendant too.
The speed slider is left to people and respected. Linux and macOS, ur_rtde 1.6 (Python 3.10 to 3.12).
"""

import contextlib
import ctypes
import fcntl
import os
import queue
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.hardware.limits import Limits, place
from i2t.hardware.protocols import ArmFeatures, ArmState, DeviceError, NotConnected, Silent
from i2t.types import Array

POLL = 0.01  # s
FEED = 0.02  # s between two kicks of the watchdog
RATE = 125.0  # Hz, of states
BRAKE = 2.0  # m/s^2
STILL = 1e-3  # m/s and rad/s: slower is standing
REACHED = (1e-3, 0.01)  # m, rad: how near its goal a finished motion ends
LEVER = 0.25  # m of travel that a radian is reckoned as, to know how long a motion may take
RTDE, DASHBOARD = 30004, 29999
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


class Stopped(DeviceError):
    """A motion ended because somebody called `stop`."""


class Approach(NamedTuple):
    """How a guarded approach ended."""

    reason: Literal["verdict", "force", "torque", "travel"]
    verdict: Any  # what the caller's function said, None unless it stopped the arm
    trigger: ArmState  # what was known when the arm was told to brake
    state: ArmState  # at rest
    travel: float  # m from the start to rest


class _News(NamedTuple):
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


def ask_dashboard(host: str, line: str, timeout: float = 1.0) -> str:
    """One line to the controller's dashboard, and its answer; raises OSError if there is none in time."""
    with socket.create_connection((host, DASHBOARD), timeout) as connection, connection.makefile("rw") as lines:
        lines.readline()
        lines.write(line + "\n")
        lines.flush()
        answer = lines.readline().strip()
    if not answer:
        raise OSError("the dashboard closed the connection")
    return answer


class UR:
    """A UR arm (`i2t.hardware.protocols.Arm`), with guarded approaches.

    Args:
        host: address of the controller
        limits: box, speed, acceleration, force and torque that nothing exceeds
        tool: (4, 4) pose of the tool in the flange, sent to the controller; None keeps what is set on the pendant
        payload: mass in kg and its centre (3,) in m in the flange, sent to the controller; None keeps what is set
        stale: s without news in a motion after which the arm is taken for lost
        watchdog: Hz, how often the controller must hear from us
        source: real or emulated; by default an address of this machine itself is emulated
    """

    def __init__(
        self,
        host: str,
        limits: Limits,
        tool: Array | None = None,
        payload: tuple[float, tuple[float, float, float]] | None = None,
        stale: float = 0.1,
        watchdog: float = 10.0,
        source: Literal["real", "emulated"] | None = None,
    ) -> None:
        try:
            import rtde_control
            import rtde_receive
        except ImportError as error:
            raise DeviceError("A UR arm needs ur_rtde: pip install 'i2t[hardware]' on Python 3.10 to 3.12.") from error
        self._sdk = rtde_control.RTDEControlInterface, rtde_receive.RTDEReceiveInterface
        self.host, self.limits, self.tool, self.payload = host, limits, tool, payload
        self.stale, self.watchdog = stale, watchdog
        self.source = source or ("emulated" if host == "localhost" or host.startswith("127.") else "real")
        self._control: Any = None
        self._receive: Any = None
        self._connections: list[Any] = []
        self._abandoning: threading.Thread | None = None
        self._thread: threading.Thread | None = None
        self._commands: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        self._closer = threading.Lock()
        self._lock: Any = None
        self._handlers: dict[int, Any] = {}
        self._reset()

    def _reset(self) -> None:
        self._news: _News | None = None
        self._trouble: DeviceError | None = None
        self._halt = False
        self._stops = 0
        self._before: tuple[int, float] | None = None  # the operation before one that has been asked for, and when
        self._guard: Callable[[ArmState], str] | None = None
        self._watched = False
        self._looked = 0.0
        self._tripped: tuple[str, ArmState] | None = None

    @property
    def features(self) -> ArmFeatures:
        """Known before `connect`."""
        box = np.array([self.limits.lower, self.limits.upper], float)
        return ArmFeatures(f"UR at {self.host}", self.source, RATE, box, self.limits.speed, self.limits.acceleration)

    # Connection

    def __enter__(self) -> "UR":
        self.connect()
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._interrupted)
        return self

    def __exit__(self, *error: Any) -> None:
        for number in self._handlers:  # a second Ctrl-C must not keep the arm from being stopped
            signal.signal(number, lambda *_: None)
        try:
            self.close()
        finally:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            self._handlers.clear()

    def _interrupted(self, number: int, frame: FrameType | None) -> None:
        self._halt = True  # a plain assignment: no lock that the interrupted thread could hold
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)

    def connect(self) -> None:
        """Take control, anew if need be; raises DeviceError if somebody else has it or the robot refuses."""
        self.close()
        self._take_lock()
        try:
            self._probe()
            self._reset()
            self._commands = queue.SimpleQueue()
            make_control, make_receive = self._sdk
            try:
                self._receive = self._kept(make_receive(self.host, RATE, VARIABLES))
                self._control = self._kept(make_control(self.host))
                if self.tool is not None:
                    self._control.setTcp(to_ur(self.tool))
                if self.payload is not None:
                    self._control.setPayload(self.payload[0], list(self.payload[1]))
                self._control.setWatchdog(self.watchdog)
            except RuntimeError as error:
                raise DeviceError(f"The controller at {self.host} cannot be controlled: {error}.") from error
            self._thread = threading.Thread(target=self._serve, name=f"UR {self.host}", daemon=True)
            self._thread.start()
            deadline = time.monotonic() + 1.0
            while not self._fresh(2.0).program and time.monotonic() < deadline:
                time.sleep(POLL)  # the first news may be older than the program
            self._newest(2.0)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Brake, end the program and let go, from any thread, as often as one likes; raises nothing."""
        with self._closer:
            if self._thread is not None:
                with contextlib.suppress(DeviceError):
                    self.stop()
                with contextlib.suppress(DeviceError):
                    if self._fresh(self.stale).program:
                        self._ask(self._control.stopScript)
            if self._abandoning is not None:
                self._abandoning.join(5.0)
            self._let_go()
            if self._lock is not None:
                self._lock.close()
                self._lock = None

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

    def recover(self) -> None:
        """Release a protective stop and connect again, once a person has looked at what caused it."""
        self.close()
        try:
            if "PROTECTIVE" in ask_dashboard(self.host, "safetystatus"):
                answer = ask_dashboard(self.host, "unlock protective stop")
                if answer != "Protective stop releasing":
                    raise DeviceError(f"The protective stop of {self.host} cannot be released: {answer}.")
        except OSError as error:
            raise DeviceError(f"The dashboard of {self.host} does not answer: {error}.") from error
        self.connect()

    def _take_lock(self) -> None:
        path = Path(tempfile.gettempdir()) / f"i2t-ur-{self.host}.lock"
        try:
            lock = path.open("a+")
        except OSError as error:
            raise DeviceError(f"The lock of the arm, {path}, cannot be opened: {error.strerror}.") from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.seek(0)
            owner = lock.read().strip() or "unknown"
            lock.close()
            raise DeviceError(
                f"The arm at {self.host} is in use by process {owner}: end it first, as a second client would "
                "replace it silently."
            ) from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        self._lock = lock

    def _probe(self) -> None:
        # The library's constructors wait for ever, and hold the interpreter, if the controller does not answer.
        host = self.host
        try:
            with socket.create_connection((host, RTDE), 1.0) as connection:
                connection.sendall(b"\x00\x05V\x00\x02")
                if not connection.recv(4):
                    raise OSError(f"port {RTDE} was closed")
            if ask_dashboard(host, "is in remote control") == "false":
                raise DeviceError(f"The robot at {host} is in local mode: choose remote control on its pendant.")
            if "PROTECTIVE" in ask_dashboard(host, "safetystatus"):
                raise DeviceError(f"The robot at {host} is in a protective stop: clear its cause, then recover().")
            if ask_dashboard(host, "running") == "Program running: true":
                raise DeviceError(
                    f"A program runs on the controller at {host}, perhaps for another client: end it first."
                )
        except OSError as error:
            raise DeviceError(f"The UR controller at {host} does not answer: {error}.") from error

    # The arm as everybody knows it

    def state(self, timeout: float | None = None) -> ArmState:
        """The newest state, at most `timeout` old (by default `stale`); raises Silent, with the arm stopped as far as
        it can be told to, and DeviceError once for anything else that has stopped it.
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
    ) -> Approach:
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
        if not 0 < travel < np.inf:
            raise ValueError(f"An approach must travel some way forward, not {travel} m.")
        if travel > self.limits.travel:
            raise ValueError(f"An approach of {travel} m exceeds the arm's limit, {self.limits.travel} m.")
        if not 0 < force <= self.limits.force or not 0 < torque <= self.limits.torque:
            raise ValueError(f"An approach up to {force} N and {torque} Nm exceeds the arm's limits.")
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
        return Approach(reason, said, trigger, state, moved)

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

    def _usable(self, stops: int) -> _News:
        """The news, if a motion may start or go on; `stops` is how often `stop` had been called before."""
        news = self._newest(self.stale)
        if self._halt or self._stops != stops:
            raise Stopped(f"The arm at {self.host} was stopped by request.")
        if not news.arm.safe:
            raise DeviceError(
                f"The robot at {self.host} made a protective or emergency stop: clear its cause, then recover()."
            )
        return news

    def _newest(self, timeout: float) -> _News:
        """The news, at most `timeout` old; raises whatever has gone wrong."""
        trouble = self._trouble
        if trouble is not None and not isinstance(trouble, Silent):
            self._trouble = None
            raise trouble
        news = self._fresh(timeout)
        if not news.program and news.arm.safe:
            raise DeviceError(
                f"The program on the controller at {self.host} has ended, by the pendant, another client or the "
                "watchdog: connect() starts it again."
            )
        return news

    def _fresh(self, timeout: float) -> _News:
        """The news, at most `timeout` old, waiting for the first; raises NotConnected or Silent."""
        deadline = time.monotonic() + timeout
        while self._thread is not None and self._news is None and time.monotonic() < deadline:
            time.sleep(POLL / 2)
        news = self._news
        if isinstance(self._trouble, Silent):
            raise self._trouble
        if self._thread is None:
            raise NotConnected(f"The arm at {self.host} is not connected.")
        age = np.inf if news is None else time.monotonic() - news.arm.time
        if news is None or age > timeout:
            raise self._lose(f"No news from the controller at {self.host} for {age:.2f} s: it was told to stop.")
        return news

    # The one thread that speaks with the controller

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
        moving = bool(busy or np.linalg.norm(twist) > STILL)
        arm = ArmState(now, pose, np.array(receive.getActualQ()), twist, wrench.ravel(), moving, safe)
        self._news = _News(arm, clock, receive.getTargetSpeedFraction(), program, status.operationId())

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
            self._control.stopL(BRAKE, True)

    def _lose(self, sentence: str) -> Silent:
        """Give the arm up: say why, and have the controller stop by the only other way there is."""
        if isinstance(self._trouble, Silent):
            return self._trouble
        lost = self._trouble = Silent(sentence)

        def abandon() -> None:
            with contextlib.suppress(OSError):
                ask_dashboard(self.host, "stop")
            self._let_go()

        self._abandoning = threading.Thread(target=abandon, daemon=True)
        self._abandoning.start()
        return lost


def _arrived(state: ArmState, goal: Array) -> None:
    off = np.linalg.norm(state.T_b_t[:3, 3] - goal[:3, 3])
    turn = Rotation.from_matrix(goal[:3, :3] @ state.T_b_t[:3, :3].T).magnitude()
    if off > REACHED[0] or turn > REACHED[1]:
        raise DeviceError(f"The motion ended {1e3 * off:.1f} mm and {np.degrees(turn):.1f} degrees off its goal.")


def _disconnect(connection: Any) -> None:
    with contextlib.suppress(RuntimeError):
        connection.disconnect()
