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
import queue
import signal
import sys
import threading
import time
from types import FrameType
from typing import Any, Literal

import numpy as np

from i2t.errors import DeviceError
from i2t.errors import MotionStoppedError as MotionStoppedError
from i2t.hardware.limits import Limits as Limits
from i2t.hardware.protocols import ApproachResult as ApproachResult
from i2t.hardware.protocols import ArmFeatures
from i2t.hardware.ur.access import probe, release, take_lock
from i2t.hardware.ur.motion import Motions
from i2t.hardware.ur.rtde_link import BRAKE as BRAKE
from i2t.hardware.ur.rtde_link import POLL, RATE, VARIABLES, to_ur
from i2t.hardware.ur.rtde_link import from_ur as from_ur
from i2t.types import Array


class UR(Motions):
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
        super().__init__(host, stale, watchdog)
        self.limits, self.tool, self.payload = limits, tool, payload
        self.source = source or ("emulated" if host == "localhost" or host.startswith("127.") else "real")
        self._closer = threading.Lock()
        self._lock: Any = None
        self._handlers: dict[int, Any] = {}

    @property
    def features(self) -> ArmFeatures:
        """Known before `connect`."""
        box = np.array([self.limits.lower, self.limits.upper], float)
        return ArmFeatures(f"UR at {self.host}", self.source, RATE, box, self.limits.speed, self.limits.acceleration)

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
            probe(self.host)
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
            try:
                if self._thread is not None:
                    # The library may find the connection broken only now, and say so by a RuntimeError.
                    with contextlib.suppress(DeviceError, RuntimeError):
                        self.stop()
                    with contextlib.suppress(DeviceError, RuntimeError):
                        if self._fresh(self.stale).program:
                            self._ask(self._control.stopScript)
                if self._abandoning is not None:
                    self._abandoning.join(5.0)
                self._let_go()
            finally:
                if self._lock is not None:
                    self._lock.close()
                    self._lock = None

    def recover(self) -> None:
        """Release a protective stop and connect again, once a person has looked at what caused it."""
        self.close()
        release(self.host)
        self.connect()

    def _take_lock(self) -> None:
        self._lock = take_lock(self.host)
