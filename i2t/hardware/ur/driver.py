"""A Universal Robots arm over ur_rtde, moved only in ways that can be watched and stopped.

A motion is refused before anything is sent if its goal is outside the box or it is too fast. The client library runs in
a process of its own (`i2t.hardware.ur.rtde_worker`), where it can neither crash this process nor reconnect without a
watchdog. Motions are asynchronous straight lines, so no call into the library hides the robot's state, and `stop` works
from any thread.

Besides `stop` and the limits of a motion, these events stop the arm:

- No states: during a motion the controller's clock must advance within `state_timeout` seconds. Otherwise the watchdog
  is no longer fed, so that the controller ends the program by itself, and "stop" goes to the dashboard over another
  connection.
- A lost connection: one of the library's connections breaks, or its process dies. The arm is given up in the same way;
  nothing reconnects before `connect` is called.
- An unwatched approach: the caller has not polled for `state_timeout` seconds, for example because its stop condition
  hangs. `i2t.hardware.guarded` lists the other checks of every state. The library's process checks force and torque
  too, as soon as it reads them.
- The death or hang of this process, even by kill -9: the watchdog runs out (`watchdog_rate` Hz; 0.1 s by default) and
  the controller ends the program. Ctrl-C, SIGTERM and SIGHUP (a closed terminal) brake at once, inside a `with` block
  on the main thread.

Poses are (4, 4) T_b_t in metres, tool in robot base; forces act on the tool, in the tool's axes. The driver respects
the pendant's speed slider and never sets it. Linux and macOS, ur_rtde 1.6 (Python 3.11 and 3.12).

WARNING: The box holds the tool's origin only. Flange, elbow and cable are not watched: set the robot's own safety
limits on the pendant too.
"""

import contextlib
import importlib.util
import signal
import sys
import threading
from types import FrameType
from typing import IO, Any, Literal

import numpy as np

from i2t.cli.signals import ENDING_SIGNALS
from i2t.errors import DeviceError, MissingDriverError
from i2t.hardware.guarded import PolledArm
from i2t.hardware.limits import SAFETY, range_of
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.protocols import ArmState
from i2t.hardware.ur.access import (
    check_controller,
    controller_serial,
    explain_missing_library,
    is_on_this_machine,
    take_lock,
    tool_pose,
)
from i2t.hardware.ur.rtde_link import RtdeConnection
from i2t.hardware.ur.rtde_worker import POLL_S, STATE_RATE_HZ
from i2t.types import Array

# Timeouts of an emulated arm in i2t's own lab, in s and Hz. Nothing can be hit, and on a busy computer states wait for
# the processor longer than the limits of a real arm (`i2t.hardware.limits`) allow.
EMULATED_WATCH = {"state_timeout": 2.0, "watchdog_rate": 0.5}


class UrArm(PolledArm):
    """Driver of a Universal Robots (UR) arm (`i2t.hardware.protocols.GuardedArm`).

    Args:
        host: Address of the controller.
        limits: Box, speed, acceleration, force and torque that no motion exceeds.
        tool: (4, 4) pose of the tool in the flange, m, sent to the controller; None keeps the pendant's setting.
        payload: Mass in kg and its centre (3,) in the flange, m, sent to the controller; None keeps the pendant's.
        state_timeout: Time in s without a new state in a motion, after which the connection counts as lost.
        watchdog_rate: Minimum rate in Hz of this program's heartbeats, below which the controller ends its program.
        source: "real" or "emulated"; by default an address of this machine is emulated.

    Raises:
        ValueError: `state_timeout` or `watchdog_rate` is outside the range of `i2t.hardware.limits`.
        DeviceError: ur_rtde is not installed.
    """

    rate, poll_s, start_s = STATE_RATE_HZ, POLL_S / 2, 0.0
    can_be_paused = True  # with the pendant's speed slider

    def __init__(
        self,
        host: str,
        limits: MotionLimits,
        tool: Array | None = None,
        payload: tuple[float, tuple[float, float, float]] | None = None,
        *,
        state_timeout: float = SAFETY.state_timeout_s,
        watchdog_rate: float = SAFETY.watchdog_rate_hz,
        source: Literal["real", "emulated"] | None = None,
    ) -> None:
        for name, value in (("state_timeout", state_timeout), ("watchdog_rate", watchdog_rate)):
            low, high, unit = range_of(name)
            if not low <= value <= high:
                raise ValueError(
                    f"The {name.replace('_', ' ')} {value:g} {unit} is outside {low:g} to {high:g} {unit}."
                )
        if any(importlib.util.find_spec(module) is None for module in ("rtde_control", "rtde_receive")):
            raise MissingDriverError(explain_missing_library())
        super().__init__(limits)
        self.name, self.host, self.tool, self.payload = f"UR at {host}", host, tool, payload
        self.source = source or ("emulated" if is_on_this_machine(host) else "real")
        self.state_timeout = state_timeout
        remedy = "" if self.source == "real" else self.late_remedy
        self.connection = RtdeConnection(host, state_timeout, watchdog_rate, late_remedy=remedy)
        self.serial_number = ""  # of the controller, once it is connected
        self._closing = threading.Lock()
        self._lock: IO[str] | None = None
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> "UrArm":
        self.connect()
        if threading.current_thread() is threading.main_thread():
            for number in ENDING_SIGNALS:
                self._handlers[number] = signal.signal(number, self._interrupted)
        return self

    def __exit__(self, *error: object) -> None:
        try:
            super().__exit__(*error)
        finally:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            self._handlers.clear()

    def _interrupted(self, number: int, frame: FrameType | None) -> None:
        self._stops += 1
        self.connection.request_stop()
        before = self._handlers.get(number)
        if callable(before):  # the handler of a command, or Python's own of Ctrl-C
            before(number, frame)
        else:
            sys.exit(128 + number)

    def open_link(self) -> None:
        """Take control of the arm; raise DeviceError if another client has it, or the robot refuses or is silent."""
        try:
            self._lock = take_lock(self.host)
            check_controller(self.host)
            self.serial_number = controller_serial(self.host)
            self.connection.open(self.tool, self.payload)
        except BaseException:
            self.close_link()
            raise

    def close_link(self) -> None:
        """End the program on the controller and disconnect; may be called from any thread."""
        with self._closing:
            try:
                with contextlib.suppress(DeviceError):
                    if self.connection.newest(self.state_timeout).program:
                        self.connection.end_program()
                self.connection.close()
            finally:
                lock, self._lock = self._lock, None
                if lock is not None:
                    lock.close()

    def read_state(self) -> ArmState:
        """Return the arm's newest state; raise DeviceError if the connection is lost or the program has ended."""
        return self.connection.running(np.inf)

    def begin_line(self, T_b_t: Array, speed: float, acceleration: float) -> None:
        """Start a straight motion, as in `PolledArm.begin_line`; the worker process checks its bounds too."""
        self.connection.start_motion(T_b_t, speed=speed, acceleration=acceleration, bounds=self.bounds)

    def brake(self) -> None:
        """Command the arm to brake to a stop."""
        self.connection.request_stop()

    def zero_sensor(self) -> None:
        """Zero the force and torque sensor at its present value."""
        self.connection.zero_wrench(1.0)

    def speed_share(self) -> float:
        """Return the fraction (0 to 1) of the requested speed to which the pendant's slider reduces motions."""
        return self.connection.speed_share

    def stop(self, timeout: float = SAFETY.stop_timeout_s) -> None:
        """Brake the arm and return when it stands, as in `Arm.stop`; disconnect if it is not seen to stand."""
        # No lock, because a motion that is being started holds it; that motion checks the number of stops again.
        self._stops, self._free_watch = self._stops + 1, None
        self.connection.stop(timeout)

    def _halt(self, ended: threading.Event | None = None) -> None:
        """Stop once: the connection keeps braking until the arm stands or is given up."""
        with contextlib.suppress(DeviceError):
            self.stop()

    def tool_pose(self) -> Array:
        """Read the pose of the tool without controlling the arm, which need not be connected.

        Returns:
            (4, 4) T_b_t, m.

        Raises:
            DeviceError: The controller does not answer.
        """
        return tool_pose(self.host)

    @property
    def late_remedy(self) -> str:
        """Advice if states are late, as in `PolledArm.late_remedy`, with longer timeouts for an emulated arm."""
        timeout, rate = EMULATED_WATCH["state_timeout"], EMULATED_WATCH["watchdog_rate"]
        helpful = self.source != "real" and self.state_timeout < timeout
        options = f", or allow more time with --state-timeout {timeout:g} --watchdog-rate {rate:g}"
        return super().late_remedy + options * helpful

    @property
    def stall_s(self) -> float:
        """Time (s) after which the arm stops by itself if this computer stalls."""
        return 1 / self.connection.watchdog_rate
