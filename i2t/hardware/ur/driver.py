"""A Universal Robots arm over ur_rtde, moved only in ways that can be watched and stopped.

`UrArm` moves (`i2t.hardware.ur.motion`) over a connection (`i2t.hardware.ur.rtde_link`). The
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
from types import FrameType
from typing import IO, Any, Literal

from i2t.errors import DeviceError
from i2t.hardware.limits import MotionLimits
from i2t.hardware.protocols import ArmFeatures, ArmState
from i2t.hardware.ur.access import (
    NO_LIBRARY,
    check_controller,
    controller_serial,
    release_protective_stop,
    take_lock,
)
from i2t.hardware.ur.config import check_watch
from i2t.hardware.ur.motion import MotionController
from i2t.hardware.ur.rtde_link import RtdeConnection
from i2t.hardware.ur.rtde_worker import STATE_RATE_HZ
from i2t.types import Array

# Windows has no SIGHUP.
BRAKING_SIGNALS = [signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class UrArm(MotionController):
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

    def __init__(
        self,
        host: str,
        limits: MotionLimits,
        tool: Array | None = None,
        payload: tuple[float, tuple[float, float, float]] | None = None,
        *,
        state_timeout: float = 0.1,
        watchdog_rate: float = 10.0,
        source: Literal["real", "emulated"] | None = None,
    ) -> None:
        check_watch(state_timeout, watchdog_rate)
        if any(importlib.util.find_spec(module) is None for module in ("rtde_control", "rtde_receive")):
            raise DeviceError(NO_LIBRARY)
        super().__init__(RtdeConnection(host, state_timeout, watchdog_rate), limits)
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
        for number in self._handlers:  # a second Ctrl-C must not keep the arm from being stopped
            signal.signal(number, lambda *_: None)
        try:
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

    def recover(self) -> None:
        """Release a protective stop and connect again, once a person has looked at what caused it.

        Raises:
            DeviceError: It cannot be released, or as in `connect`.
        """
        self.close()
        release_protective_stop(self.host)
        self.connect()

    def state(self, timeout: float | None = None) -> ArmState:
        """The newest state, as in `Arm.state`; by default it may be as old as the state timeout.

        Raises:
            DeviceTimeoutError: It is older; the arm has been stopped as far as it can be told to.
            DeviceError: Once, for anything else that has stopped the arm.
        """
        return self.connection.running(self.connection.state_timeout if timeout is None else timeout).arm

    def stop(self, timeout: float = 1.0) -> None:
        """Brake and return when the arm stands, as in `Arm.stop`."""
        self.connection.stop(timeout)

    def zero_wrench(self, timeout: float = 1.0) -> None:
        """Take the wrench felt now for zero, as in `Arm.zero_wrench`."""
        if self.state().moving:
            raise DeviceError("The wrench can be zeroed only while the arm stands.")
        self.connection.zero_wrench(timeout)
