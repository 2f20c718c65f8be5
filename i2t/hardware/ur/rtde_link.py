"""The connection with a UR controller: state of the arm, commands, and what happens when the connection is lost.

`RtdeConnection` starts the process that holds the client library (`i2t.hardware.ur.rtde_worker` explains why) and keeps
one thread. The thread receives the states, passes on a request to stop, and sends a heartbeat every 20 ms as long as
states arrive; the heartbeats feed the controller's watchdog. When states no longer arrive, or the process ends, the
heartbeats stop, "stop" goes to the dashboard over another connection, and the process is ended. A lost connection is
never restored automatically.
"""

import contextlib
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from i2t.errors import DeviceError, DeviceTimeoutError, MotionStoppedError, NotConnectedError
from i2t.hardware.limits import SAFETY
from i2t.hardware.poses import pose_from_vector, pose_to_vector
from i2t.hardware.protocols import ArmState
from i2t.hardware.rig_checks import compare_tool
from i2t.hardware.ur import rtde_worker
from i2t.hardware.ur.access import ask_dashboard
from i2t.hardware.ur.rtde_worker import POLL_S, Channel, Message, WorkerLimits
from i2t.types import Array


class ControllerState(NamedTuple):
    """State that a UR controller sent: the arm's, the speed slider as a fraction, and whether i2t's program runs."""

    arm: ArmState
    speed_share: float  # fraction of the requested speed at which the pendant's slider lets the arm move
    program: bool  # whether i2t's program runs on the controller


class RtdeConnection:
    """Connection to a UR controller through a worker process; every method may be called from any thread.

    Args:
        host: Address of the controller.
        state_timeout: Time in s without a new state in a motion, after which the connection counts as lost.
        watchdog_rate: Minimum rate in Hz of the heartbeats, below which the controller ends its program.
        late_remedy: Advice that ends the errors about late states and heartbeats; empty for none.
    """

    exit_timeout = 1.0  # s, in which the process must have ended by itself

    def __init__(self, host: str, state_timeout: float, watchdog_rate: float, *, late_remedy: str = "") -> None:
        self.host, self.state_timeout, self.watchdog_rate = host, state_timeout, watchdog_rate
        self._late_remedy = late_remedy
        self._channel: Channel | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None
        self._ending: threading.Thread | None = None
        self._command_lock = threading.Lock()  # a motion is sent before a brake or not at all
        self._reset()

    def _reset(self) -> None:
        self._state: ControllerState | None = None
        self._failure: DeviceTimeoutError | None = None
        self._answers: dict[int, Future[None]] = {}
        self._commands = 0
        self._heartbeat_time = -np.inf
        self._stop_requested = False
        self._brake: Future[None] | None = None
        self._trip: ArmState | None = None  # state above a motion's bounds, until a brake or the next motion

    @property
    def speed_share(self) -> float:
        """Fraction (0 to 1) of the requested speed that the pendant's slider leaves; NaN before the first state."""
        return np.nan if self._state is None else self._state.speed_share

    @property
    def worker_limits(self) -> WorkerLimits:
        """Safety limits of the worker process, from this connection's settings and `i2t.hardware.limits`."""
        return WorkerLimits(
            watchdog_rate=self.watchdog_rate,
            state_timeout=self.state_timeout,
            braking=SAFETY.braking_m_s2,
            standing_speed=SAFETY.standing_speed,
            brake_settling=SAFETY.brake_settling_s,
            start_timeout=SAFETY.start_timeout_s,
            exit_timeout=SAFETY.worker_exit_timeout_s,
        )

    def open(self, tool: Array | None, payload: tuple[float, tuple[float, float, float]] | None) -> None:
        """Connect to the controller, set tool, payload and watchdog, and wait for the first state.

        Args:
            tool: (4, 4) pose of the tool in the flange, m; None keeps the pendant's setting.
            payload: Mass in kg and its centre (3,) in the flange, m; None keeps the pendant's setting.

        Raises:
            DeviceError: The controller cannot be controlled, or its pendant has another TCP.
        """
        self._reset()
        request = {
            "host": self.host,
            "tool": None if tool is None else pose_to_vector(tool),
            "payload": None if payload is None else [payload[0], list(payload[1])],
            "limits": self.worker_limits._asdict(),
        }
        self._channel = self._start_worker(request)
        reply = self._first_message(self._channel)
        if "ready" not in reply:
            raise DeviceError(f"The controller at {self.host} cannot be controlled: {reply['error']}.")
        different = "" if tool is None else compare_tool(tool, pose_from_vector(reply["pendant_tcp"]))
        if different:
            raise DeviceError(f"The controller at {self.host} has another tool: {different}.")
        self._thread = threading.Thread(target=self._read_loop, args=(self._channel,), name=f"UR {self.host}")
        self._thread.daemon = True
        self._thread.start()
        deadline = time.monotonic() + SAFETY.command_timeout_s  # the first states may be older than the program
        while self._heartbeat_time < 0 and self._failure is None and time.monotonic() < deadline:
            time.sleep(POLL_S / 2)
        self._wait(self._send("set_watchdog"), SAFETY.command_timeout_s)  # now that it is fed
        self.running(SAFETY.command_timeout_s)

    def close(self) -> None:
        """End the worker process and with it the connection; the program on a reachable controller ends too."""
        if self._ending is not None:
            self._ending.join(5.0)
        self._end()

    # State

    def newest(self, timeout: float) -> ControllerState:
        """Return the newest state of the controller, even if its program has ended.

        Args:
            timeout: Maximum age of the state, and maximum wait for the first state, in s.

        Returns:
            The newest state of the controller.

        Raises:
            NotConnectedError: There is no connection.
            DeviceTimeoutError: The newest state is older than `timeout`; the arm has been given up (`give_up`).
        """
        deadline = time.monotonic() + timeout
        while self._thread is not None and self._state is None and time.monotonic() < deadline:
            time.sleep(POLL_S / 2)
        state = self._state
        if self._failure is not None:
            raise self._failure
        if self._thread is None:
            raise NotConnectedError(f"The arm at {self.host} is not connected.")
        age = np.inf if state is None else time.monotonic() - state.arm.time
        if state is None or not age <= timeout:
            raise self.give_up(self._silence(age))
        return state

    def running(self, timeout: float) -> ArmState:
        """Return the arm's newest state, requiring that i2t's program runs on the controller.

        Args:
            timeout: Maximum age in s, as in `newest`.

        Returns:
            The newest state. After a force or torque above a motion's bounds, it keeps that state's pose and wrench
            until the next brake or motion.

        Raises:
            DeviceError: The program has ended, or an error of `newest`.
        """
        state, trip = self.newest(timeout), self._trip
        if not state.program and state.arm.safe:
            raise DeviceError(
                f"The program on the controller at {self.host} has ended, by the pendant, another client or the "
                f"watchdog: connect() starts it again{self._remedy('if the watchdog ended it, ')}."
            )
        return state.arm if trip is None else trip._replace(time=state.arm.time, safe=state.arm.safe)

    # Commands

    def request_stop(self) -> None:
        """Request that the connection's thread brakes the arm; never waits, so that a signal handler may call it."""
        self._stop_requested = True

    def stop(self, timeout: float = 1.0) -> None:
        """Brake the arm and return when it stands.

        Args:
            timeout: Time in s until the arm must stand.

        Raises:
            DeviceError: The arm was not seen to stand in time, and has been given up.
        """
        if self._thread is None:
            return
        self.request_stop()
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            state = self.newest(timeout)
            if not self._stop_requested and not state.arm.moving:
                return
            time.sleep(POLL_S / 2)
        raise self.give_up(f"The arm at {self.host} was not seen to stop within {timeout:g} s.")

    def start_motion(self, goal: Array, *, speed: float, acceleration: float, bounds: tuple[float, float]) -> None:
        """Start a straight motion of the arm; on return, the newest state shows it moving.

        Args:
            goal: (4, 4) pose of the tool in the base, m.
            speed: Speed in m/s.
            acceleration: Acceleration in m/s^2.
            bounds: Force in N and torque in Nm that end the motion early.

        Raises:
            MotionStoppedError: A stop was requested meanwhile.
            DeviceError: The controller refused the motion, or an error of `running`.
        """
        motion = {"pose": pose_to_vector(goal), "speed": speed, "acceleration": acceleration}
        with self._command_lock:
            self.running(self.state_timeout)
            if self._stop_requested:
                raise MotionStoppedError(f"The arm at {self.host} was stopped by request.")
            self._trip = None
            answer = self._send("move", {**motion, "force": bounds[0], "torque": bounds[1]})
        self._wait(answer, SAFETY.command_timeout_s)

    def zero_wrench(self, timeout: float) -> None:
        """Zero the measured wrench at its present value, as in `Arm.zero_wrench`."""
        self._wait(self._send("zero_wrench"), timeout)

    def end_program(self) -> None:
        """End i2t's program on the controller; raise DeviceError if that fails."""
        self._wait(self._send("end_program"), SAFETY.command_timeout_s)

    def give_up(self, sentence: str) -> DeviceTimeoutError:
        """Give up a lost arm: end the heartbeats, send "stop" to the dashboard, and end the worker process.

        Args:
            sentence: Message that states what happened.

        Returns:
            The error to raise; that of the first call if the arm had been given up already.
        """
        if self._failure is not None:
            return self._failure
        lost = self._failure = DeviceTimeoutError(sentence)

        def end() -> None:
            with contextlib.suppress(OSError):
                ask_dashboard(self.host, "stop")
            self._end()

        thread = threading.Thread(target=end, daemon=True)
        thread.start()  # before others may join it
        self._ending = thread
        return lost

    def _silence(self, age: float) -> str:
        """Describe that no state has arrived for `age` seconds."""
        return f"No state arrived from {self.host} for {age:.2f} s: a stop was sent to the arm{self._remedy()}."

    def _remedy(self, condition: str = "") -> str:
        """Return the end of an error's sentence with the advice about late states, if there is any."""
        return self._late_remedy and f"; {condition}{self._late_remedy}"

    def _send(self, command: str, arguments: Message | None = None) -> Future[None]:
        channel = self._channel
        if channel is None:
            raise NotConnectedError(f"The arm at {self.host} is not connected.")
        self._commands += 1
        number, answer = self._commands, Future[None]()
        self._answers[number] = answer
        try:
            channel.send({"command": command, "id": number, "arguments": arguments or {}})
        except OSError as error:
            ended = isinstance(error, BrokenPipeError | ConnectionResetError)
            why = self._exit_reason() if ended else error
            raise self.give_up(f"The connection to the controller at {self.host} broke: {why}.") from error
        return answer

    def _wait(self, answer: Future[None], timeout: float) -> None:
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            with contextlib.suppress(FutureTimeout):
                return answer.result(POLL_S)
            self.newest(self.state_timeout)
        raise DeviceError(f"The controller at {self.host} does not take commands.")

    # The thread

    def _read_loop(self, channel: Channel) -> None:
        try:
            while self._thread is threading.current_thread():
                for message in channel.receive(POLL_S):
                    self._take(message)
                self._react()
                self._send_heartbeat(channel)
        except (EOFError, BrokenPipeError, ConnectionResetError):  # whichever comes first when the process has ended
            self.give_up(f"The connection to the controller at {self.host} broke: {self._exit_reason()}.")
        except Exception as error:
            remedy = self._remedy() if isinstance(error, TimeoutError) else ""
            self.give_up(f"The connection to the controller at {self.host} broke: {error}{remedy}.")

    def _take(self, message: Message) -> None:
        if "state" in message:
            self._take_state(message["state"], message["tripped"])
        elif "answer" in message:
            answer = self._answers.pop(message["answer"])
            if message["error"] is None:
                answer.set_result(None)
            else:
                sentence = f"The controller at {self.host} refused the command: {message['error']}."
                answer.set_exception(DeviceError(sentence))
        else:
            raise (TimeoutError if message["late"] else OSError)(message["error"])

    def _take_state(self, raw: Message, tripped: bool) -> None:
        T_b_t = pose_from_vector(raw["pose"])
        wrench = np.array(raw["wrench"]).reshape(2, 3) @ T_b_t[:3, :3]
        joints, twist = np.array(raw["joints"]), np.array(raw["twist"])
        arm = ArmState(raw["time"], T_b_t, joints, twist, wrench.ravel(), moving=raw["moving"], safe=raw["safe"])
        if tripped:
            self._trip = arm
        self._state = ControllerState(arm, raw["speed_share"], raw["program"])

    def _react(self) -> None:
        """Give up a controller that falls silent in a motion; brake on request."""
        state, now = self._state, time.monotonic()
        if state is not None and state.arm.moving:
            age = now - state.arm.time
            if not age <= self.state_timeout:
                self.give_up(self._silence(age))
                return
        if self._stop_requested and self._brake is None:
            if state is not None and not now - state.arm.time <= self.state_timeout:  # it would not answer a command
                self.give_up(self._silence(now - state.arm.time))
                return
            with self._command_lock:
                self._brake = self._send("brake")
        elif self._brake is not None and self._brake.done():
            self._brake, self._stop_requested, self._trip = None, False, None

    def _send_heartbeat(self, channel: Channel) -> None:
        state, now = self._state, time.monotonic()
        fresh = state is not None and state.program and now - state.arm.time <= self.state_timeout
        if fresh and now - self._heartbeat_time >= SAFETY.heartbeat_period_s:
            self._heartbeat_time = now
            channel.send({"heartbeat": True})

    # The process

    def _start_worker(self, request: Message) -> Channel:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(Path(rtde_worker.__file__)), json.dumps(request)],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C in the terminal must not reach it
            )
        return Channel(ours)

    def _first_message(self, channel: Channel) -> dict[str, Any]:
        timeout = 20.0  # s, for the client library to connect
        deadline = time.monotonic() + timeout
        try:
            while time.monotonic() < deadline:
                for message in channel.receive(POLL_S):
                    return message
        except EOFError:
            return {"error": self._exit_reason()}
        return {"error": f"it did not answer within {timeout:g} s"}

    def _exit_reason(self) -> str:
        """Explain why the process ended."""
        process = self._process
        code = None
        if process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = process.wait(self.exit_timeout)
        if code is not None and code < 0:
            return f"the client library was ended by {signal.Signals(-code).name}"
        return "the client library ended"

    def _end(self) -> None:
        """End thread, channel and process."""
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join(1.0)
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()
        process, self._process = self._process, None
        if process is not None:
            try:
                process.wait(self.exit_timeout)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
