"""The connection with a UR controller: what is known of the arm, the way to command it, and what happens if it is lost.

`RtdeConnection` starts the process that holds the client library (`i2t.hardware.ur.rtde_worker`, which says why) and
keeps one thread. The thread takes the states that come, passes on a request to stop, and sends a heartbeat every 20 ms
as long as states come; heartbeats are what feeds the controller's watchdog. When states no longer come, or the process
ends, no heartbeat is sent, "stop" goes to the dashboard, another connection, and the process is ended. A connection
that was lost is never made again by itself.
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
from i2t.hardware.poses import pose_from_vector, pose_to_vector
from i2t.hardware.protocols import ArmState
from i2t.hardware.rig_checks import other_tool
from i2t.hardware.ur import rtde_worker
from i2t.hardware.ur.access import ask_dashboard
from i2t.hardware.ur.rtde_worker import POLL_S, Channel, Message
from i2t.types import Array

HEARTBEAT_S = 0.02  # between two heartbeats
CONNECT_S = 20.0  # in which the client library must have connected
ANSWER_S = 2.0  # in which a command must have been carried out
GOODBYE_S = 1.0  # in which the process must have ended by itself


class ControllerState(NamedTuple):
    """Last state that the controller sent."""

    arm: ArmState
    speed_share: float  # of the asked speed that the slider on the pendant leaves
    program: bool  # whether the program that obeys us runs


class RtdeConnection:
    """A connection that can be opened, lost, closed and opened anew; every method may be called from any thread.

    Args:
        host: Address of the controller.
        state_timeout: s without a new state in a motion after which the controller is taken for lost.
        watchdog_rate: Hz, how often the controller must hear from us.
    """

    def __init__(self, host: str, state_timeout: float, watchdog_rate: float) -> None:
        self.host, self.state_timeout, self.watchdog_rate = host, state_timeout, watchdog_rate
        self._channel: Channel | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None
        self._ending: threading.Thread | None = None
        self._ordering = threading.Lock()  # a motion is sent before a brake or not at all
        self._reset()

    def _reset(self) -> None:
        self._state: ControllerState | None = None
        self._failure: DeviceTimeoutError | None = None
        self._answers: dict[int, Future[None]] = {}
        self._commands = 0
        self._heartbeat_time = -np.inf
        self._stop_requested = False
        self._brake: Future[None] | None = None
        self._trip: ArmState | None = None  # that was above a motion's limits, until a brake or the next motion

    @property
    def speed_share(self) -> float:
        """Share of the asked speed that the slider on the pendant leaves; NaN before the first state."""
        return np.nan if self._state is None else self._state.speed_share

    def open(self, tool: Array | None, payload: tuple[float, tuple[float, float, float]] | None) -> None:
        """Connect, set tool, payload and watchdog, and wait for the first state.

        Args:
            tool: (4, 4) pose of the tool in the flange, m; None keeps what is set on the pendant.
            payload: kg and centre (3,) in m in the flange; None keeps what is set.

        Raises:
            DeviceError: The controller cannot be controlled, or was told another TCP on its pendant.
        """
        self._reset()
        request = {
            "host": self.host,
            "tool": None if tool is None else pose_to_vector(tool),
            "payload": None if payload is None else [payload[0], list(payload[1])],
            "watchdog_rate": self.watchdog_rate,
            "state_timeout": self.state_timeout,
        }
        self._channel = self._start_worker(request)
        reply = self._first_message(self._channel)
        if "ready" not in reply:
            raise DeviceError(f"The controller at {self.host} cannot be controlled: {reply['error']}.")
        different = "" if tool is None else other_tool(tool, pose_from_vector(reply["pendant_tcp"]))
        if different:
            raise DeviceError(f"The controller at {self.host} has another tool: {different}.")
        self._thread = threading.Thread(target=self._read_loop, args=(self._channel,), name=f"UR {self.host}")
        self._thread.daemon = True
        self._thread.start()
        deadline = time.monotonic() + ANSWER_S  # the first states may be older than the program
        while self._heartbeat_time < 0 and self._failure is None and time.monotonic() < deadline:
            time.sleep(POLL_S / 2)
        self._wait(self._send("set_watchdog"), ANSWER_S)  # now that it is fed
        self.running(ANSWER_S)

    def close(self) -> None:
        """End the process and with it the connection; on a controller that still listens the program ends."""
        if self._ending is not None:
            self._ending.join(5.0)
        self._end()

    # What is known

    def newest(self, timeout: float) -> ControllerState:
        """The newest state, whatever its content.

        Args:
            timeout: s that the state may be old, and that the first one is waited for.

        Returns:
            The state.

        Raises:
            NotConnectedError: There is no connection.
            DeviceTimeoutError: The state is older; the arm has been given up.
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
            raise self.give_up(f"No news from the controller at {self.host} for {age:.2f} s: it was told to stop.")
        return state

    def running(self, timeout: float) -> ArmState:
        """The newest state of an arm whose program runs.

        Args:
            timeout: s, as in `newest`.

        Returns:
            The state; pose and wrench that were above a motion's limits until the arm is told to brake, or to move.

        Raises:
            DeviceError: The program has ended; and as in `newest`.
        """
        state, trip = self.newest(timeout), self._trip
        if not state.program and state.arm.safe:
            raise DeviceError(
                f"The program on the controller at {self.host} has ended, by the pendant, another client or the "
                "watchdog: connect() starts it again."
            )
        return state.arm if trip is None else trip._replace(time=state.arm.time, safe=state.arm.safe)

    # Commands

    def request_stop(self) -> None:
        """Have the thread brake; a plain assignment, for a signal handler, which must not wait for a lock."""
        self._stop_requested = True

    def stop(self, timeout: float = 1.0) -> None:
        """Brake and return when the arm stands.

        Args:
            timeout: s.

        Raises:
            DeviceError: It was not seen to stand in time; the arm has been given up.
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
        """Start a straight motion; on return the newest state says that the arm moves.

        Args:
            goal: (4, 4) pose of the tool in the base, m.
            speed: m/s.
            acceleration: m/s^2.
            bounds: N and Nm that end it early.

        Raises:
            MotionStoppedError: A stop was asked for meanwhile.
            DeviceError: As in `running`, or the controller did not take it.
        """
        motion = {"pose": pose_to_vector(goal), "speed": speed, "acceleration": acceleration}
        with self._ordering:
            self.running(self.state_timeout)
            if self._stop_requested:
                raise MotionStoppedError(f"The arm at {self.host} was stopped by request.")
            self._trip = None
            answer = self._send("move", {**motion, "force": bounds[0], "torque": bounds[1]})
        self._wait(answer, ANSWER_S)

    def zero_wrench(self, timeout: float) -> None:
        """Take the wrench felt now for zero, as in `Arm.zero_wrench`."""
        self._wait(self._send("zero_wrench"), timeout)

    def end_program(self) -> None:
        """End the program that obeys us; raises DeviceError."""
        self._wait(self._send("end_program"), ANSWER_S)

    def give_up(self, sentence: str) -> DeviceTimeoutError:
        """Take the arm for lost: no heartbeat any more, "stop" to the dashboard, and the process is ended.

        Args:
            sentence: What happened.

        Returns:
            The error to raise; the first one if the arm was lost already.
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
            why = self._last_words() if ended else error
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
        except (EOFError, BrokenPipeError, ConnectionResetError):  # whichever is met first once the process has ended
            self.give_up(f"The connection to the controller at {self.host} broke: {self._last_words()}.")
        except Exception as error:
            self.give_up(f"The connection to the controller at {self.host} broke: {error}.")

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
            raise OSError(message["error"])

    def _take_state(self, raw: Message, tripped: bool) -> None:
        T_b_t = pose_from_vector(raw["pose"])
        wrench = np.array(raw["wrench"]).reshape(2, 3) @ T_b_t[:3, :3]
        joints, twist = np.array(raw["joints"]), np.array(raw["twist"])
        arm = ArmState(raw["time"], T_b_t, joints, twist, wrench.ravel(), moving=raw["moving"], safe=raw["safe"])
        if tripped:
            self._trip = arm
        self._state = ControllerState(arm, raw["speed_share"], raw["program"])

    def _react(self) -> None:
        """Give up a controller that fell silent in a motion; brake by request."""
        state, now = self._state, time.monotonic()
        if state is not None and state.arm.moving:
            age = now - state.arm.time
            if not age <= self.state_timeout:
                self.give_up(f"No news from the controller at {self.host} for {age:.2f} s: it was told to stop.")
                return
        if self._stop_requested and self._brake is None:
            if state is not None and not now - state.arm.time <= self.state_timeout:  # it would not answer
                self.give_up(f"The controller at {self.host} fell silent: it was told to stop.")
                return
            with self._ordering:
                self._brake = self._send("brake")
        elif self._brake is not None and self._brake.done():
            self._brake, self._stop_requested, self._trip = None, False, None

    def _send_heartbeat(self, channel: Channel) -> None:
        state, now = self._state, time.monotonic()
        fresh = state is not None and state.program and now - state.arm.time <= self.state_timeout
        if fresh and now - self._heartbeat_time >= HEARTBEAT_S:
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
                start_new_session=True,  # Ctrl-C in the terminal is for us alone
            )
        return Channel(ours)

    def _first_message(self, channel: Channel) -> dict[str, Any]:
        deadline = time.monotonic() + CONNECT_S
        try:
            while time.monotonic() < deadline:
                for message in channel.receive(POLL_S):
                    return message
        except EOFError:
            return {"error": self._last_words()}
        return {"error": f"it did not answer within {CONNECT_S:g} s"}

    def _last_words(self) -> str:
        """Reason for the end of the process."""
        process = self._process
        code = None
        if process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = process.wait(GOODBYE_S)
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
                process.wait(GOODBYE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
